"""A second process that reads and looks at the frames of a stored sequence.

Two threads of Python wait for each other: a frame is a thousand small operations, and only one thread at a time may
begin one. Two processes do not, but a new one takes seconds until it is up, and has libraries and network of its own in
memory.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import subprocess
import sys
from dataclasses import replace

import torch

from v3d_torch.datasets.stored import StoredFrames
from v3d_torch.mapping.recorder import Outlook
from v3d_torch.percept import Percept
from v3d_torch.slam import V3DSLAM
from v3d_torch.timing import StageClock
from v3d_torch.types import memory_of, remind
from v3d_torch.wire import Channel, new_arena

_LOG = logging.getLogger(__name__)

_STAGES = "segment", "smooth", "detect", "lift"
"""Those that look at a frame by itself, as attributes of `V3DSLAM`."""

_COMMAND = "from v3d_torch.second_process import serve; serve(*{})"


class SecondProcess:
    """Looks at frames as `V3DSLAM.perceive` does, to the bit, in a process of its own.

    What it cannot do, whatever the reason, it leaves to the one who asks, who then sees the error where it arises.

    Args:
        slam: whose stages are taken along.
        sequence: of the frames.
    """

    def __init__(self, slam: V3DSLAM, sequence: StoredFrames) -> None:
        self._slam = slam
        self._sequence = sequence
        self._told = self._ready = self._gone = False
        self._process: subprocess.Popen[bytes] | None = None
        ours, theirs = socket.socketpair()
        arena = new_arena()
        self._channel = Channel(ours, arena)
        taken_along = [theirs.fileno()] if arena is None else [theirs.fileno(), arena]
        with theirs:
            try:
                # In a session of its own, where a terminal's Ctrl-C does not reach it.
                self._process = subprocess.Popen(  # noqa: S603 - this program itself
                    [sys.executable, "-c", _COMMAND.format(taken_along)],
                    pass_fds=taken_along,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                )
            except (OSError, ValueError):  # no more processes, or Windows
                self._gone = True
        if arena is not None:
            os.close(arena)

    def look(self, index: int, outlook: Outlook | None) -> Percept | None:
        """Read and look at a frame.

        Args:
            index: of the frame.
            outlook: see `V3DSLAM.perceive`.

        Returns:
            None while the process is not up, and when it cannot.
        """
        segment = self._slam.segment
        try:
            if self._gone or not self._is_ready():
                return None
            self._channel.send((index, outlook, memory_of(segment)))
            percept: Percept = self._channel.receive()
        except Exception:  # it has ended, or is to look with what cannot be sent
            _LOG.debug("the second process looks at no more frames", exc_info=True)
            self._gone = True
            return None
        remind(segment, percept.memory)
        return replace(percept, frame=replace(percept.frame, camera=self._sequence.camera))

    def close(self) -> None:
        """End the process."""
        self._channel.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _is_ready(self) -> bool:
        """Whether it is up: first it is told what to look with, then it is ready."""
        while not self._ready and select.select([self._channel.connection], [], [], 0)[0]:
            self._channel.receive()
            if self._told:
                self._ready = True
            else:
                slam, self._told = self._slam, True
                stages = {name: getattr(slam, name) for name in _STAGES}
                self._channel.send((type(slam), slam.camera, slam.config, stages, self._sequence))
        return self._ready


@torch.inference_mode()
def serve(connection: int, arena: int | None = None) -> None:
    """The whole life of the process: it ends with the connection, or with the first thing that goes wrong.

    Args:
        connection: descriptor of the socket to the one who started it.
        arena: of the memory that they share.
    """
    channel = Channel(socket.socket(fileno=connection), arena)
    channel.send(None)
    kind, camera, config, stages, sequence = channel.receive()
    torch.set_num_threads(config.threads)
    slam: V3DSLAM = kind(camera, stages["segment"], config)
    vars(slam).update(stages)
    channel.send(None)
    while True:
        index, outlook, memory = channel.receive()
        remind(slam.segment, memory)
        clock = StageClock()
        with clock("read"):
            frame = sequence[index]
        percept = slam.perceive(frame, outlook)
        seconds = {**clock.seconds, **percept.seconds}
        channel.send(replace(percept, frame=replace(percept.frame, camera=None), seconds=seconds))
