"""Second process that reads and preprocesses the frames of a stored sequence.

A frame consists of thousands of small tensor operations, and Python starts only one at a time in all threads together,
so threads would wait for each other. Two processes do not. The second one takes seconds to start and has its own
libraries and network in memory. Several frames are requested in advance, so that neither process waits for the other
when one frame takes longer than the others.
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
from v3d_torch.frame_result import PreprocessedFrame
from v3d_torch.prefetch.shared_memory import Channel, new_shared_memory
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.slam import PREFETCHED_FRAMES, V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import restore_segmenter, segmenter_state_of

_LOG = logging.getLogger(__name__)

_START_TIMEOUT = 120.0
"""Seconds after which a process that has not started is regarded as hanging."""

_COMMAND = "from v3d_torch.prefetch.preprocess_worker import serve; serve(*{})"

_T = TypeVar("_T")


class PreprocessWorker:
    """Runs `V3DSLAM.preprocess` in a second process, with the same results to the bit.

    On any failure the caller processes the frame itself and gets the original error.

    Args:
        slam: System whose preprocessing stages are copied to the process, with the state of the segmenter.
        sequence: Sequence of the frames.

    Attributes:
        is_alive: False after the first failure.
    """

    def __init__(self, slam: V3DSLAM, sequence: StoredSequence) -> None:
        self._slam = slam
        self._sequence = sequence
        self.is_alive = True
        self._process: subprocess.Popen[bytes] | None = None
        ours, theirs = socket.socketpair()
        memory = new_shared_memory(PREFETCHED_FRAMES)
        self._channel = Channel(ours, memory, PREFETCHED_FRAMES)
        descriptors = [theirs.fileno()] if memory is None else [theirs.fileno(), memory]
        with theirs:
            try:
                # A session of its own, so that Ctrl-C in a terminal does not reach the process.
                self._process = subprocess.Popen(  # noqa: S603 - runs this package
                    [sys.executable, "-c", _COMMAND.format(descriptors)],
                    pass_fds=descriptors,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                )
            except (OSError, ValueError):  # no more processes, or Windows
                self.is_alive = False
        if memory is not None:
            os.close(memory)
        try:
            self._try(self._start)
        except BaseException:
            self.close()
            raise

    def submit(self, index: int, prediction: PosePrediction | None) -> None:
        """Request a frame. At most `PREFETCHED_FRAMES` requests can be open.

        Args:
            index: Index of the frame in the sequence; frames are requested in order, as the segmenter has state.
            prediction: See `V3DSLAM.preprocess`.
        """
        self._try(lambda: self._channel.send((index, prediction)))

    def result(self) -> PreprocessedFrame | None:
        """Return the result of the oldest open request; None after a failure."""
        preprocessed: PreprocessedFrame | None = self._try(self._channel.receive)
        if preprocessed is None:
            return None
        restore_segmenter(self._slam.segment, preprocessed.segmenter_state)
        return replace(preprocessed, frame=replace(preprocessed.frame, camera=self._sequence.camera))

    def close(self) -> None:
        """Kill the process."""
        self._channel.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _start(self) -> None:
        """Wait for the process to start, send it the preprocessing stages, and wait until it is ready."""
        slam, channel = self._slam, self._channel
        channel.connection.settimeout(_START_TIMEOUT)
        channel.receive()
        stages = slam.preprocessing_stages()
        channel.send((type(slam), slam.camera, slam.config, stages, segmenter_state_of(slam.segment), self._sequence))
        channel.receive()
        channel.connection.settimeout(None)

    def _try(self, step: Callable[[], _T]) -> _T | None:
        """Return the result of a step; None after the first failure."""
        if not self.is_alive:
            return None
        try:
            return step()
        except Exception:  # the process has ended, or a stage cannot be pickled
            _LOG.debug("the second process has stopped", exc_info=True)
            self.is_alive = False
            return None


@torch.inference_mode()
def serve(connection: int, memory: int | None = None) -> None:
    """Serve the requests of a `PreprocessWorker` until the connection closes or an error occurs.

    Args:
        connection: File descriptor of the socket to the first process.
        memory: File descriptor of the shared memory.
    """
    channel = Channel(socket.socket(fileno=connection), memory, PREFETCHED_FRAMES)
    channel.send(None)
    kind, camera, config, stages, state, sequence = channel.receive()
    set_num_threads(config.threads)
    slam: V3DSLAM = kind(camera, stages["segment"], config)
    vars(slam).update(stages)
    restore_segmenter(slam.segment, state)
    channel.send(None)
    while True:
        index, prediction = channel.receive()
        timer = StageTimer()
        with timer("read"):
            frame = sequence[index]
        preprocessed = slam.preprocess(frame, prediction)
        times = {**timer.times, **preprocessed.times}
        channel.send(replace(preprocessed, frame=replace(preprocessed.frame, camera=None), times=times))
