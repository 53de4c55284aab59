"""Steps of the export command: read the run, open its images, write the format."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.progress import track

from v3d_torch.config import Config
from v3d_torch.datasets import RGBDStream
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.export.colmap import write_colmap
from v3d_torch.export.landmark_tracks import LandmarkTracks, has_keyframes, landmark_tracks
from v3d_torch.export.nerfstudio import write_nerfstudio
from v3d_torch.export.posed_image import PosedImage, Undistorter
from v3d_torch.export.static_recording import StaticRecording
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.files import check_empty_folder, emptied_on_failure
from v3d_torch.io.ply import read_ply_points
from v3d_torch.mapping.map_io import load_map
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars
from v3d_torch.runs.request import RunRequest, read_request
from v3d_torch.runs.run_images import (
    LocalisedFrames,
    localised_frames,
    note_other_name,
    open_images,
    posed_images,
)
from v3d_torch.runs.stored_run import StoredRun, read_run

_MAX_IMAGES = 300
"""Number of images that tools take from a video by default (nerfstudio's ``ns-process-data``)."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    Attributes:
        format: ``nerfstudio``, ``colmap`` or ``tum``.
        every: Every n-th frame is exported; None for the default of the format.
        keyframes: True to export keyframes only.
        undistort: True to remove the lens distortion.
        masks: True to write masks, and to remove the depth of masked pixels.
    """

    format: str
    every: int | None = None
    keyframes: bool = False
    undistort: bool = False
    masks: bool = True


def export_run(folder: Path, out: Path, options: ExportOptions, seq: str | None, console: Console) -> None:
    """Export the images of a run.

    Args:
        folder: Results of the run.
        out: Folder to write, new or empty.
        options: Format and options.
        seq: Sequence of the run; None for the sequence that the run stored.
        console: Console for progress and summary.

    Raises:
        InputError: If the run, its images or its masks are missing or do not belong together.
        ConfigError: If an option does not fit the format.
        OutputError: If the folder is not empty or cannot be written.
    """
    if options.format == "tum" and (options.undistort or not options.masks):
        raise ConfigError("--format tum: needs masks and the recorded images; remove --no-masks and --undistort")
    run = read_run(folder)
    check_empty_folder(out)
    request = read_request(folder)
    request = request if seq is None else replace(request, seq=seq)
    with progress_bars(console) as progress:
        source = open_images(run, request, ProgressBar(progress, "sequence"))
    frames = _select_frames(run, options)
    images = posed_images(run, source, frames, masks=options.masks, masks_needed=options.format == "tum")
    other_name = note_other_name(run, source)
    shown: Iterable[PosedImage] = track(
        images, "exporting", len(frames), console=console, disable=not console.is_terminal
    )
    out_camera = source.camera
    if options.undistort:
        undistort = Undistorter(source.camera)
        out_camera, shown = undistort.camera, map(undistort, shown)
    with emptied_on_failure(out):  # else, the same command would reject the folder
        notes = _WRITERS[options.format](out, _Export(run, request, source, frames), out_camera, shown)
    notes += [note for note in (other_name, _note_early_end(run)) if note is not None]
    if left_out := len(run.metrics.status) - len(localised_frames(run)):
        notes.append(f"{left_out} frames without a known pose are left out")
    print_line(console, f"{len(frames)} images: {out}")
    for note in notes:
        print_line(console, f"note: {note}")


@dataclass(frozen=True)
class _Export:
    """Inputs of an export.

    Attributes:
        run: Results of the run.
        request: Options of the run.
        source: Images of the run.
        frames: Frames to export.
    """

    run: StoredRun
    request: RunRequest
    source: RGBDStream
    frames: LocalisedFrames


def _select_frames(run: StoredRun, options: ExportOptions) -> LocalisedFrames:
    localised = localised_frames(run, only_keyframes=options.keyframes)
    takes_all = options.format == "tum" or options.keyframes
    return localised.every(options.every or (1 if takes_all else -(-len(localised) // _MAX_IMAGES)))


def _write_nerfstudio(out: Path, export: _Export, camera: PinholeCamera, images: Iterable[PosedImage]) -> list[str]:
    write_nerfstudio(out, camera, images, _point_map(export.run))
    return []


def _write_colmap(out: Path, export: _Export, camera: PinholeCamera, images: Iterable[PosedImage]) -> list[str]:
    points = read_ply_points(_point_map(export.run))
    tracks, notes = _read_tracks(export)
    write_colmap(out, camera, images, points, tracks)
    return notes


def _write_static_recording(
    out: Path, export: _Export, camera: PinholeCamera, images: Iterable[PosedImage]
) -> list[str]:
    with TUMWriter(out, camera, export.source.groundtruth) as writer:
        recording = StaticRecording(writer)
        recording.write_poses(export.frames.poses)
        for image in images:
            recording.add(image.frame, image.static)
    return []


_WRITERS = {"nerfstudio": _write_nerfstudio, "colmap": _write_colmap, "tum": _write_static_recording}
"""Function that writes a format and returns notes for the user."""


def _point_map(run: StoredRun) -> Path:
    path = run.folder / RunFile.MAP
    if not path.is_file():
        raise InputError(f"{path}: is missing, because the run did not end; {_way_to_continue(run)}")
    return path


def _note_early_end(run: StoredRun) -> str | None:
    """Return a sentence on a run that ended before the end of its sequence; None for other runs."""
    metrics = run.metrics
    if metrics.failure is None or metrics.processed + metrics.skipped >= metrics.frames:
        return None
    fix = f"; {_way_to_continue(run)}" if (run.folder / RunFile.CHECKPOINT).is_file() else ""
    return f"the run ended early, after {metrics.processed} of {metrics.frames} frames{fix}"


def _way_to_continue(run: StoredRun) -> str:
    return f"continue it with run --resume {shlex.quote(str(run.folder))}"


def _read_tracks(export: _Export) -> tuple[LandmarkTracks, list[str]]:
    """Read the landmarks of the exported images from the map that the run saved, if there is one."""
    path, tables = export.request.save_map, MapTables()
    reason = "the run was not called with --save-map"
    if path is not None:
        reason = f"{path} has no landmarks that two of the images observe"
        try:
            tables = load_map(path, export.source.camera, export.run.config or Config()).map
            if export.run.keyframes is not None and not has_keyframes(tables, export.run.keyframes):
                reason = f"{path} is the map of another run; run the sequence again with --save-map and another file"
        except InputError as error:
            reason = str(error)
    tracks = landmark_tracks(tables, export.frames.poses)
    return tracks, [] if len(tracks.points) else [f"no image points are written: {reason}"]
