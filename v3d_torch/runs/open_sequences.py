"""Sequences opened for a command, with a progress bar for downloads and notes on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from v3d_torch.datasets import RGBDSequence, RGBDStream, load_sequence
from v3d_torch.datasets.realtime_playback import stored_source
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.io.names import folder_name
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars

_MANY_PIXELS = 1 << 22
"""Number of pixels of an image above which the memory of a run is stated: that of smaller images is below 3 GB."""

_BYTES_PER_PIXEL = 500
"""Memory of a run for each pixel of an image, measured on sequences of 640x360 to 1920x1080 pixels."""


def open_sequence(name: str, data_root: Path | None, console: Console) -> RGBDSequence:
    """Open a sequence as `load_sequence` does, with a progress bar for downloads, and print notes on it."""
    sequence = _load(name, data_root, console)
    print_notes(sequence, console)
    return sequence


def _load(name: str, data_root: Path | None, console: Console, *, skip_broken: bool = False) -> RGBDSequence:
    with progress_bars(console) as progress:
        bar = ProgressBar(progress, "sequence")
        return load_sequence(name, data_root=data_root, progress=bar, skip_broken=skip_broken)


def print_notes(source: RGBDStream, console: Console) -> None:
    """Print notes on a source: those of the sequence, and the memory of a run with large images."""
    stored = stored_source(source)
    notes = stored.notes if isinstance(stored, StoredSequence) else []
    width, height = source.camera.width, source.camera.height
    if width * height > _MANY_PIXELS:
        gigabytes = width * height * _BYTES_PER_PIXEL / 1e9
        notes.append(
            f"a run with images of {width}x{height} pixels needs about {gigabytes:.0f} GB of memory; scale images and"
            " camera file down if there is less"
        )
    for note in notes:
        print_line(console, f"note: {source.name}: {note}")


def check_groundtruth(source: RGBDStream) -> None:
    """Check that the ground truth of a source could be read, for a command whose results depend on it.

    Raises:
        InputError: If the source has a ground truth that could not be read.
    """
    if isinstance(source, StoredSequence) and source.groundtruth_error is not None:
        raise source.groundtruth_error


def open_sequences(
    names: Sequence[str], data_root: Path | None, console: Console, *, skip_broken: bool = False
) -> dict[str, RGBDSequence]:
    """Open several sequences in the given order, before the first of them is run; see `load_sequence`.

    All sequences are opened before an InputError is raised. If several are not valid, a line is printed for each.

    Returns:
        Sequences by their name in tables.

    Raises:
        InputError: If sequences are not valid, or two sequences have the same name, also as folders of results.
        DownloadError: If a sequence is missing and cannot be downloaded.
    """
    sequences: dict[str, RGBDSequence] = {}
    sources: dict[str, str] = {}
    errors: list[InputError] = []
    names = list(dict.fromkeys(names))
    for name in names:
        try:
            sequence = _load(name, data_root, console, skip_broken=skip_broken)
            check_groundtruth(sequence)  # runs are compared by their scores
            print_notes(sequence, console)
            folder = folder_name(sequence.name)  # of the results, such as a_b for the sequence a/b
            if (other := sources.setdefault(folder, name)) != name:
                raise InputError(f"{name}: {other} has the same name, {folder}; run them separately")
            sequences[sequence.name] = sequence
        except InputError as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        console.print("These sequences are not valid:")
        for invalid in errors:
            print_line(console, str(invalid))
        raise InputError(f"{len(errors)} of {len(names)} sequences are not valid, the first: {errors[0]}")
    return sequences
