"""``python -m v3d_torch.run --seq ...``: a sequence in, trajectory, map and scores out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.io.paths import expand_user_paths

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
@expand_user_paths
def main(
    context: typer.Context,
    seq: Annotated[
        str | None,
        typer.Option(
            help="demo, a TUM RGB-D sequence (fr3/w/xyz), a folder, bag or video of RGB-D images, or a live camera"
            " (realsense:)."
        ),
    ] = None,
    data_root: Annotated[
        Path | None, typer.Option(envvar="V3D_DATA", help="Where named sequences are, or are downloaded to.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="camera.yaml, K.txt or a preset (tum_fr3), where the folder does not say.")
    ] = None,
    rgb_topic: Annotated[str | None, typer.Option(help="Topic of a bag's colour images [guessed].")] = None,
    depth_topic: Annotated[str | None, typer.Option(help="Topic of a bag's depth images [guessed].")] = None,
    info_topic: Annotated[str | None, typer.Option(help="Topic of the colour images' camera [guessed].")] = None,
    fps: Annotated[
        float | None, typer.Option(help="Frames a second, where images or videos do not say their times.")
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(help="paper, baseline or another of the package, or a YAML file over the defaults."),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="A value, such as objects.voting.distance_threshold=0.05.")
    ] = None,
    segmenter: Annotated[str | None, typer.Option(help="yolo, masks or none.")] = None,
    model: Annotated[str | None, typer.Option(help="yolov8n-seg, yolo11n-seg or yolo26n-seg.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of id images, for --segmenter masks.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Checkpoint or ONNX file of the network.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random choice.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/<sequence>/<time>].")] = None,
    save_masks: Annotated[bool, typer.Option("--save-masks", help="Write what is left out of tracking.")] = False,
    viz: Annotated[str | None, typer.Option(help="Look on while it runs, with: rerun.")] = None,
    rerun: Annotated[Path | None, typer.Option(help="File (.rrd) to record for rerun, to look at it later.")] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Show what each stage took.")] = False,
    mesh: Annotated[bool, typer.Option("--mesh", help="Write a triangle mesh of the room, too.")] = False,
    map_out: Annotated[
        Path | None, typer.Option("--save-map", metavar="FILE", help="Write the map, for later runs.")
    ] = None,
    map_in: Annotated[
        Path | None, typer.Option("--load-map", metavar="FILE", help="Find the camera in a map, and go on with it.")
    ] = None,
    serial: Annotated[
        bool, typer.Option("--serial", help="One thing after the other on one core, with the same results.")
    ] = False,
    localise: Annotated[bool, typer.Option("--localise", help="With --load-map: leave the map as it is.")] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Go on with the run whose results are there, which was killed or interrupted."
        ),
    ] = None,
) -> None:
    """Track an RGB-D camera where people move; map what stands still."""
    from v3d_torch.cli.console import exit_on_error
    from v3d_torch.runs.request import RunRequest
    from v3d_torch.runs.runner import Display, resume_run, run_sequence

    if seq is None and resume is None:
        raise typer.BadParameter("say what to run, or which run to go on with (--resume)", param_hint="--seq")
    segmenter = segmenter or ("masks" if masks is not None else None)
    overrides = list(set_ or [])
    overrides += [f"segmentation.source={segmenter}"] if segmenter is not None else []
    overrides += [f"segmentation.model={model}"] if model is not None else []
    overrides += [f"seed={seed}"] if seed is not None else []
    overrides += ["dense_map.mesh.enabled=true"] if mesh else []
    overrides += ["mapping.enabled=false"] if localise else []
    overrides += ["prefetch=false"] if serial else []
    request = RunRequest(
        seq=seq or "",
        data_root=_text(data_root),
        camera=camera,
        rgb_topic=rgb_topic,
        depth_topic=depth_topic,
        info_topic=info_topic,
        fps=fps,
        masks=_text(masks),
        weights=_text(weights),
        load_map=_text(map_in),
        save_map=_text(map_out),
        save_masks=save_masks,
    )
    display = Display(viz, rerun, profile)
    with exit_on_error():
        if resume is not None:
            if (source := context.get_parameter_source("data_root")) is not None and source.name == "ENVIRONMENT":
                request = replace(request, data_root=None)  # the run knows its own
            resume_run(resume, request, display, config_name=config, overrides=overrides, out=out)
        else:
            run_sequence(request, display, config_name=config, overrides=overrides, out=out)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
