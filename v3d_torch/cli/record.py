"""``python -m v3d_torch record --out ...``: a live camera, or any other source, saved as a folder in TUM layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
@expand_user_paths
def main(
    out: Annotated[Path, typer.Option(help="Folder to write, new or empty.")],
    seq: Annotated[
        str, typer.Option(help="What to save: a live camera (realsense:, realsense:SERIAL), or a sequence, bag, video.")
    ] = "realsense:",
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Where named sequences are, or are downloaded to.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="camera.yaml, K.txt or a preset (tum_fr3), where the source does not say.")
    ] = None,
    rgb_topic: Annotated[str | None, typer.Option(help="Topic of a bag's colour images [guessed].")] = None,
    depth_topic: Annotated[str | None, typer.Option(help="Topic of a bag's depth images [guessed].")] = None,
    info_topic: Annotated[str | None, typer.Option(help="Topic of the colour images' camera [guessed].")] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames a second, of a live camera or where nothing says the times.")
    ] = None,
) -> None:
    """Save any source, also a live camera, in TUM layout.

    Frames become PNG with their lists and camera, until the source ends or Ctrl-C.
    """
    from rich.console import Console
    from rich.progress import track

    from v3d_torch.datasets import SourceOptions, open_source
    from v3d_torch.datasets.stored import StoredSequence
    from v3d_torch.datasets.tum_writer import TUMWriter
    from v3d_torch.errors import InputError
    from v3d_torch.runs.console import exit_on_error, interrupts_between_frames

    console = Console(soft_wrap=True)
    with exit_on_error():
        with console.status(f"opening {seq}"):
            options = SourceOptions(rgb_topic, depth_topic, info_topic, fps)
            source = open_source(seq, data_root=data_root, camera=camera, options=options)
        with interrupts_between_frames() as interrupted, TUMWriter(out, source.camera, source.groundtruth) as writer:
            for frame in track(source, "saving, Ctrl-C ends it", console=console, disable=not console.is_terminal):
                writer.add(frame)
                if interrupted.is_set():
                    break
        if not len(writer):
            raise InputError(f"{seq}: sent no frame before the end")
        console.print(f"{len(writer)} frames: {out}", markup=False)
        if isinstance(source, StoredSequence) and source.groundtruth_error is not None:
            raise InputError(f"{source.groundtruth_error} (the frames, without ground truth, are in {out})")
