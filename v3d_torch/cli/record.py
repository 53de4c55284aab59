"""Command ``v3d-torch record``: save a live camera or any other source as a folder in TUM layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import Camera, DataRoot, DepthTopic, Fps, InfoTopic, RgbTopic, make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command()
@expand_user_paths
def main(
    out: Annotated[Path, typer.Option(help="Folder to write; must be new or empty.")],
    seq: Annotated[
        str,
        typer.Option(help="Source to save: a live camera (realsense:, realsense:SERIAL), or a sequence, bag or video."),
    ] = "realsense:",
    data_root: DataRoot = None,
    camera: Camera = None,
    rgb_topic: RgbTopic = None,
    depth_topic: DepthTopic = None,
    info_topic: InfoTopic = None,
    fps: Fps = None,
    static: Annotated[
        bool,
        typer.Option(
            "--static", help="Track the camera, set the depth of moving objects to 0, and write masks and poses."
        ),
    ] = False,
    config: Annotated[
        str | None, typer.Option(help="With --static: name of a configuration or a YAML file [full].")
    ] = None,
) -> None:
    """Save a live camera or any other source in TUM layout.

    Writes PNG images, their lists and the camera until the source ends or Ctrl-C is pressed.
    """
    from rich.console import Console

    with quick_imports():
        from v3d_torch.cli.record_command import record_all, record_static
        from v3d_torch.config.loading import FULL, find_config, load_config
        from v3d_torch.datasets import SourceOptions, open_source
        from v3d_torch.datasets.stored import StoredSequence
        from v3d_torch.errors import ConfigError, InputError, RunError
        from v3d_torch.io.files import check_empty_folder
        from v3d_torch.runs.interrupts import interrupts_between_frames
        from v3d_torch.runs.open_sequences import print_notes
        from v3d_torch.runs.print_line import print_line

    console = Console(soft_wrap=True)
    with exit_on_error():
        if config is not None and not static:
            raise ConfigError(f"--config {config}: has an effect with --static only; remove it")
        static_config = load_config(find_config(FULL if config is None else config)) if static else None
        check_empty_folder(out)  # before the source is opened, which can download it
        with console.status(f"opening {seq}"):
            options = SourceOptions(rgb_topic, depth_topic, info_topic, fps)
            source = open_source(seq, data_root=data_root, camera=camera, options=options)
        print_notes(source, console)
        with interrupts_between_frames(source) as interrupted:
            if static_config is not None:
                frames, failure = record_static(source, out, static_config, interrupted, console)
            else:
                frames, failure = record_all(source, out, interrupted, console), None
        if failure is not None:
            raise RunError(f"{failure} (the {frames} frames before are saved in {out})")
        if not frames and interrupted.is_set():
            raise RunError("interrupted before the first frame")
        if not frames:
            raise InputError(f"{seq}: the source ended before its first frame")
        print_line(console, f"{frames} frames: {out}")
        if isinstance(source, StoredSequence) and source.groundtruth_error is not None:
            raise InputError(f"{source.groundtruth_error} (the frames are saved in {out} without ground truth)")
