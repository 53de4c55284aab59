"""Steps of the record command: save all frames as they are, or track the camera and save them without what moves."""

from __future__ import annotations

from collections.abc import Sized
from threading import Event

import torch
from rich.console import Console
from rich.progress import track

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDStream
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.export.static_recording import StaticRecordingViewer
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.console import TrackingBar, compile_kernels, progress_bars
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM


def record_all(source: RGBDStream, writer: TUMWriter, interrupted: Event, console: Console) -> None:
    """Write all frames of a source.

    Args:
        source: Frames.
        writer: Writer of the folder.
        interrupted: Event that ends the recording after the current frame.
        console: Console for the progress bar.

    Raises:
        InputError: If a frame cannot be read.
        OutputError: If a file cannot be written.
    """
    for frame in track(source, "saving (Ctrl-C to stop)", console=console, disable=not console.is_terminal):
        writer.add(frame)
        if interrupted.is_set():
            break


def record_static(
    source: RGBDStream, writer: TUMWriter, config: Config, interrupted: Event, console: Console
) -> str | None:
    """Track the camera, and write all frames without what moves, with masks and estimated poses.

    Args:
        source: Frames.
        writer: Writer of the folder.
        config: Configuration of the system.
        interrupted: Event that ends the recording after the current frame.
        console: Console for the progress bar.

    Returns:
        The reason if the recording ended early, unless the user ended it; else None.

    Raises:
        WeightsError: If the weights of the network are not available.
        OutputError: If the poses cannot be written.
    """
    set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    slam = V3DSLAM(source.camera, make_segmenter(config.segmentation), config)
    pipeline = Pipeline(source, slam, viewer=StaticRecordingViewer(writer), evaluate_masks=False)
    compile_kernels(console)
    with progress_bars(console) as progress:
        pipeline(TrackingBar(progress, len(source) if isinstance(source, Sized) else None, interrupted, done=0))
    pipeline.flush()
    return None if pipeline.record.interrupted else pipeline.record.failure
