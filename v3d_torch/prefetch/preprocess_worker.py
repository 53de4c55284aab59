"""A second process that reads and looks at the frames of a stored sequence.

Two threads of Python wait for each other: a frame is thousands of small operations, and only one thread at a time may
begin one. Two processes do not, but a new one takes seconds until it is up, and has libraries and network of its own in
memory. It is asked for some frames ahead, so that neither waits for the other while a frame takes longer than most.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch

from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.frame_result import PREFETCHED_FRAMES, PreprocessedFrame
from v3d_torch.prefetch.shared_memory import Channel, new_shared_memory
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import restore_segmenter, segmenter_state_of

_LOG = logging.getLogger(__name__)

_STAGES = "segment", "smooth_depth", "detect_features"
"""Those that look at a frame by itself, as attributes of `V3DSLAM`."""

_LONGEST = 120.0
"""Seconds after which a process that is not up is taken to hang."""

_COMMAND = "from v3d_torch.prefetch.preprocess_worker import serve; serve(*{})"

_Given = TypeVar("_Given")


class PreprocessWorker:
    """Looks at frames as `V3DSLAM.preprocess` does, to the bit, in a process of its own, which is up when this is made.

    What it cannot do, whatever the reason, it leaves to the one who asks, who then sees the error where it arises.

    Args:
        slam: whose stages are taken along, and what its segmentation remembers.
        sequence: of the frames.

    Attributes:
        can: whether it can still look at frames.
    """

    def __init__(self, slam: V3DSLAM, sequence: StoredSequence) -> None:
        self._slam = slam
        self._sequence = sequence
        self.is_alive = True
        self._process: subprocess.Popen[bytes] | None = None
        ours, theirs = socket.socketpair()
        arena = new_shared_memory(PREFETCHED_FRAMES)
        self._channel = Channel(ours, arena, PREFETCHED_FRAMES)
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
                self.is_alive = False
        if arena is not None:
            os.close(arena)
        try:
            self._try(self._greet)
        except BaseException:
            self.close()
            raise

    def submit(self, index: int, outlook: PosePrediction | None) -> None:
        """Let it read and look at a frame, behind those that it was asked for and has not answered, fewer than `PREFETCHED_FRAMES`.

        Args:
            index: of the frame; the segmentation goes by those before, so they come in order.
            outlook: see `V3DSLAM.preprocess`.
        """
        self._try(lambda: self._channel.send((index, outlook)))

    def result(self) -> PreprocessedFrame | None:
        """What the next of these frames shows; None when it cannot tell."""
        percept: PreprocessedFrame | None = self._try(self._channel.receive)
        if percept is None:
            return None
        restore_segmenter(self._slam.segment, percept.segmenter_state)
        return replace(percept, frame=replace(percept.frame, camera=self._sequence.camera))

    def close(self) -> None:
        """End the process."""
        self._channel.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _greet(self) -> None:
        """Wait until it has begun, tell it what to look with, and wait until it can."""
        slam, channel = self._slam, self._channel
        channel.connection.settimeout(_LONGEST)
        channel.receive()
        stages = {name: getattr(slam, name) for name in _STAGES}
        channel.send((type(slam), slam.camera, slam.config, stages, segmenter_state_of(slam.segment), self._sequence))
        channel.receive()
        channel.connection.settimeout(None)

    def _try(self, step: Callable[[], _Given]) -> _Given | None:
        """What a step gives; None once one of them failed."""
        if not self.is_alive:
            return None
        try:
            return step()
        except Exception:  # it has ended, or is to look with what cannot be sent
            _LOG.debug("the second process looks at no more frames", exc_info=True)
            self.is_alive = False
            return None


@torch.inference_mode()
def serve(connection: int, arena: int | None = None) -> None:
    """The whole life of the process: it ends with the connection, or with the first thing that goes wrong.

    Args:
        connection: descriptor of the socket to the one who started it.
        arena: of the memory that they share.
    """
    channel = Channel(socket.socket(fileno=connection), arena, PREFETCHED_FRAMES)
    channel.send(None)
    kind, camera, config, stages, segmenter_state, sequence = channel.receive()
    set_num_threads(config.threads)
    slam: V3DSLAM = kind(camera, stages["segment"], config)
    vars(slam).update(stages)
    restore_segmenter(slam.segment, segmenter_state)
    channel.send(None)
    while True:
        index, outlook = channel.receive()
        clock = StageTimer()
        with clock("read"):
            frame = sequence[index]
        percept = slam.preprocess(frame, outlook)
        seconds = {**clock.seconds, **percept.seconds}
        channel.send(replace(percept, frame=replace(percept.frame, camera=None), seconds=seconds))
