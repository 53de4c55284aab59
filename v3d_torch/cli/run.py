"""Command ``v3d-torch run``: track a sequence or a camera, and write trajectory, map and scores."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from v3d_torch.cli.errors import exit_on_error
from v3d_torch.cli.options import Camera, DataRoot, DepthTopic, Fps, InfoTopic, RgbTopic, SkipBroken, Version, make_app
from v3d_torch.io.paths import expand_user_paths
from v3d_torch.runtime.imports import quick_imports

app = make_app()


@app.command()
@expand_user_paths
def main(
    seq: Annotated[
        str | None,
        typer.Option(
            help="demo, demo:sitting, demo:things, a TUM RGB-D sequence (fr3/w/xyz), a folder, bag or video of RGB-D"
            " images, or a live camera (realsense:)."
        ),
    ] = None,
    data_root: DataRoot = None,
    camera: Camera = None,
    rgb_topic: RgbTopic = None,
    depth_topic: DepthTopic = None,
    info_topic: InfoTopic = None,
    fps: Fps = None,
    config: Annotated[
        str | None,
        typer.Option(help="Name of a configuration (full, realtime, paper, baseline ...) or a YAML file [full]."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Set one value, such as objects.voting.distance_threshold=0.05; can be repeated."),
    ] = None,
    segmenter: Annotated[str | None, typer.Option(help="Source of instances: yolo, masks or none.")] = None,
    model: Annotated[str | None, typer.Option(help="Network: yolov8n-seg, yolo11n-seg or yolo26n-seg.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of id images, for --segmenter masks.")] = None,
    weights: Annotated[Path | None, typer.Option(help="Weights of the network, .pt or .onnx.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [results/<sequence>/<time>].")] = None,
    save_masks: Annotated[bool, typer.Option("--save-masks", help="Write the masked pixels of each frame.")] = False,
    skip_broken: SkipBroken = False,
    viz: Annotated[str | None, typer.Option(help="Show the run live with a viewer: rerun.")] = None,
    rerun: Annotated[Path | None, typer.Option(help="Record the run for rerun in this .rrd file.")] = None,
    bag: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Record the run as ROS 2 messages in this .mcap file."),
    ] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Print the time of each stage.")] = False,
    mesh: Annotated[bool, typer.Option("--mesh", help="Write a triangle mesh of the static scene.")] = False,
    occupancy: Annotated[
        bool, typer.Option("--occupancy", help="Build and write an occupancy map, for planning.")
    ] = False,
    save_map: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Save the map at the end, for later runs.")
    ] = None,
    load_map: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Localise the camera in this map and extend it.")
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Play the sequence at its own rate, and drop frames as on a live camera."),
    ] = False,
    serial: Annotated[bool, typer.Option("--serial", help="Use one thread; the results are the same.")] = False,
    localise: Annotated[bool, typer.Option("--localise", help="With --load-map: do not change the map.")] = False,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Resume the interrupted run with its results in this folder.")
    ] = None,
    version: Version = False,
) -> None:
    """Track an RGB-D camera, and map the static part of the scene."""
    from v3d_torch.datasets.locate import check_name

    if seq is not None:
        with exit_on_error():
            check_name(seq, data_root)  # before the imports below, which take seconds

    with quick_imports():
        from v3d_torch.cli.run_command import ConfigChoice, Display, resume_run, start_run
        from v3d_torch.errors import ConfigError
        from v3d_torch.runs.request import RunRequest
        from v3d_torch.segmentation.factory import check_network_is_used

    if seq is None and resume is None:
        raise typer.BadParameter("give a sequence, or a run to resume (--resume)", param_hint="--seq")
    options = {f"--masks {masks}": "segmentation.source=masks"} if masks is not None and segmenter is None else {}
    options |= {f"--segmenter {segmenter}": f"segmentation.source={segmenter}"} if segmenter is not None else {}
    options |= {f"--model {model}": f"segmentation.model={model}"} if model is not None else {}
    options |= {f"--seed {seed}": f"seed={seed}"} if seed is not None else {}
    options |= {"--mesh": "dense_map.mesh.enabled=true"} if mesh else {}
    options |= {"--occupancy": "occupancy.enabled=true"} if occupancy else {}
    options |= {"--localise": "mapping.enabled=false"} if localise else {}
    options |= {"--serial": "prefetch=false"} if serial else {}
    choice, display = ConfigChoice(config, tuple(set_ or ()), options), Display(viz, rerun, bag, profile)
    with exit_on_error():
        loaded = choice.load()
        if localise and load_map is None and resume is None:
            raise ConfigError("--localise: needs the map of an earlier run; add --load-map FILE")
        if model is not None:
            check_network_is_used(f"--model {model}", loaded)
        request = RunRequest(
            seq=seq or "",
            config=loaded,
            data_root=_text(data_root),
            camera=camera,
            rgb_topic=rgb_topic,
            depth_topic=depth_topic,
            info_topic=info_topic,
            fps=fps,
            masks=_text(masks),
            weights=_text(weights),
            load_map=_text(load_map),
            save_map=_text(save_map),
            save_masks=save_masks,
            realtime=realtime,
            skip_broken=skip_broken,
        )
        if resume is None:
            start_run(request, out, display)
        else:
            resume_run(resume, request, choice, out, display)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
