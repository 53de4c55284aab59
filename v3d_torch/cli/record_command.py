"""Steps of the record command: save all frames as they are, or track the camera and save the static scene."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from pathlib import Path
from threading import Event

import torch
from rich.console import Console
from rich.progress import track

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDStream
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.export.static_recording import ESTIMATE, StaticRecording
from v3d_torch.frame_result import FrameResult
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.kernel_compilation import compile_with_progress
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import TrackingBar, progress_bars
from v3d_torch.runs.system import check_map_is_given, make_system
from v3d_torch.segmentation import make_segmenter
from v3d_torch.types import RGBDFrame


def record_all(source: RGBDStream, out: Path, interrupted: Event, console: Console) -> int:
    """Write all frames of a source. A KeyboardInterrupt while it waits for the next frame ends the recording, too.

    Args:
        source: Frames.
        out: Folder to write, new or empty.
        interrupted: Event that ends the recording after the current frame.
        console: Console for the progress bar.

    Returns:
        Number of frames.

    Raises:
        InputError: If a frame cannot be read.
        OutputError: If the folder is not empty, or a file cannot be written.
        KeyboardInterrupt: If a frame is being written, whose images can be incomplete; the lists contain those before.
    """
    with TUMWriter(out, source.camera, source.groundtruth) as writer:
        frames = track(source, "saving (Ctrl-C to stop)", console=console, disable=not console.is_terminal)
        for frame in _until_interrupted(frames):
            writer.add(frame)
            if interrupted.is_set():
                break
    return len(writer)


def _until_interrupted(frames: Iterable[RGBDFrame]) -> Iterator[RGBDFrame]:
    """Yield frames until a KeyboardInterrupt ends the wait for the next one."""
    source = iter(frames)
    while True:
        try:
            frame = next(source)
        except (StopIteration, KeyboardInterrupt):
            return
        yield frame


def record_static(
    source: RGBDStream, out: Path, config: Config, interrupted: Event, console: Console
) -> tuple[int, str | None]:
    """Track the camera, and write all frames without the depth of moving objects, with masks and estimated poses.

    Args:
        source: Frames.
        out: Folder to write, new or empty.
        config: Configuration of the system.
        interrupted: Event that ends the recording after the current frame.
        console: Console for the progress bar.

    Returns:
        Number of frames, and the reason why the recording ended early; None if it did not, or if the user ended it.

    Raises:
        ConfigError: If the configuration does not map, or its segmenter cannot be made.
        WeightsError: If the weights of the network are not available.
        OutputError: If the folder is not empty, or the poses cannot be written.
    """
    check_map_is_given(config)
    slam = make_system(source.camera, make_segmenter(config, source.camera), config)
    pipeline = Pipeline(source, slam, evaluate_masks=False)
    compile_with_progress(console)
    total = len(source) if isinstance(source, Sized) else None
    with TUMWriter(out, source.camera, source.groundtruth) as writer, progress_bars(console) as progress:
        recording, bar = StaticRecording(writer), TrackingBar(progress, total, interrupted, done=0)

        def on_frame(frame: RGBDFrame, result: FrameResult) -> None:
            recording.add(frame, result.map_mask)
            bar(frame, result)

        record = pipeline(on_frame)
        with torch.inference_mode():
            slam.flush()
        if len(writer):
            known = slam.poses.trajectory().select(slam.poses.localised)
            recording.write_poses(known)
            if unknown := len(slam.poses) - len(known):
                print_line(console, f"note: {unknown} frames without a known pose are left out of {ESTIMATE}")
    return len(writer), None if record.interrupted else record.failure
