"""Command ``v3d-torch calibrate``: calibrate the camera of a recording from its images."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import Camera, DataRoot, DepthTopic, Fps, InfoTopic, RgbTopic, make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

if TYPE_CHECKING:
    from v3d_torch.datasets import RGBDSequence
    from v3d_torch.datasets.cameras import CameraChoice

app = make_app()


@app.command()
@expand_user_paths
def main(
    seq: Annotated[
        str, typer.Option(help="Recording: a folder, bag or video of RGB-D images, a TUM sequence, or demo.")
    ],
    out: Annotated[Path, typer.Option(help="Camera file to write; must be new.")] = Path("camera.yaml"),
    data_root: DataRoot = None,
    camera: Camera = None,
    rgb_topic: RgbTopic = None,
    depth_topic: DepthTopic = None,
    info_topic: InfoTopic = None,
    fps: Fps = None,
    segmenter: Annotated[str | None, typer.Option(help="Source of instances: yolo or none.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Set one value of the configuration, such as features.count=2000.")
    ] = None,
) -> None:
    """Calibrate the camera of a recording from its images.

    Tracks the camera, calibrates it by a bundle adjustment of the map, and repeats both until the camera does not
    change. Writes a camera file; values that the recording does not determine are kept as given.
    """
    from v3d_torch.datasets.locate import check_name

    with exit_on_error():
        check_name(seq, data_root)  # before the imports below, which take seconds

    from rich.console import Console

    with quick_imports():
        from v3d_torch.config.loading import load_config
        from v3d_torch.datasets import SourceOptions, load_sequence
        from v3d_torch.errors import ConfigError, OutputError
        from v3d_torch.io.files import check_writable, write_text
        from v3d_torch.runs.calibration_report import calibration_table, calibration_text
        from v3d_torch.runs.calibration_run import calibrate_sequence
        from v3d_torch.runs.interrupts import interrupts_between_frames
        from v3d_torch.runs.kernel_compilation import compile_with_progress
        from v3d_torch.runs.open_sequences import check_groundtruth, print_notes
        from v3d_torch.runs.print_line import print_line
        from v3d_torch.runs.progress_bar import TrackingBar, progress_bars
        from v3d_torch.segmentation import make_segmenter

    console = Console(soft_wrap=True)
    options = SourceOptions(rgb_topic, depth_topic, info_topic, fps)
    overrides = [*(set_ or []), *([f"segmentation.source={segmenter}"] if segmenter is not None else [])]

    def open_sequence(camera: CameraChoice) -> RGBDSequence:
        return load_sequence(seq, data_root=data_root, camera=camera, options=options)

    with exit_on_error():
        if segmenter not in (None, "yolo", "none"):
            raise ConfigError(f"--segmenter {segmenter}: is neither yolo nor none")
        if os.path.lexists(out):  # also a link that leads nowhere, which the file would replace
            raise OutputError(f"{out}: already exists; choose another file with --out")
        check_writable(out)
        config = load_config(overrides=overrides)
        with console.status(f"opening {seq}"):
            sequence = open_sequence(camera)
        print_notes(sequence, console)
        check_groundtruth(sequence)  # it determines the depth scale
        compile_with_progress(console)
        with progress_bars(console) as progress, interrupts_between_frames() as interrupted:
            calibration = calibrate_sequence(
                sequence,
                open_sequence,
                lambda calibrated: make_segmenter(config, calibrated),
                config,
                lambda number, frames: TrackingBar(progress, frames, interrupted, description=f"run {number}"),
            )
        write_text(out, calibration_text(calibration, seq))
        console.print(calibration_table(calibration))
        if not calibration.accepted:
            print_line(
                console,
                f"note: {seq}: determines no value, so that the camera is the given one; move and turn the camera more,"
                " in front of near and far things with texture",
            )
        print_line(console, f"camera: {out}")
