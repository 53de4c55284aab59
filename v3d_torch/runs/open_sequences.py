"""Sequences opened for a command, with a progress bar for downloads and notes on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console

from v3d_torch.datasets import RGBDSequence, RGBDStream
from v3d_torch.datasets.realtime_playback import stored_source
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.io.names import folder_name
from v3d_torch.runs.print_line import print_line
from v3d_torch.runs.progress_bar import ProgressBar, progress_bars
from v3d_torch.runs.request import RunRequest

_MANY_PIXELS = 1 << 22
"""Number of pixels of an image above which the memory of a run is stated: that of smaller images is below 3 GB."""

_BYTES_PER_PIXEL = 500
"""Memory of a run for each pixel of an image, measured on sequences of 640x360 to 1920x1080 pixels."""


@dataclass(frozen=True)
class OpenedSequence:
    """Sequence that was opened for one or several runs.

    Attributes:
        request: Request of a run of the sequence.
        sequence: The sequence.
    """

    request: RunRequest
    sequence: RGBDSequence


def open_sequence(request: RunRequest, console: Console) -> RGBDSequence:
    """Open the sequence of a run, with a progress bar for downloads, and print notes on it.

    Raises:
        InputError: If the sequence is not valid, or its ground truth could not be read: runs are compared by scores.
        DownloadError: If the sequence is missing and cannot be downloaded.
    """
    with progress_bars(console) as progress:
        sequence = request.load_sequence(ProgressBar(progress, "sequence"))
    check_groundtruth(sequence)
    print_notes(sequence, console)
    return sequence


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


def open_sequences(requests: Sequence[RunRequest], console: Console) -> dict[str, OpenedSequence]:
    """Open several sequences in the given order, before the first of them is run.

    All sequences are opened before an InputError is raised. If several are not valid, a line is printed for each.

    Args:
        requests: Requests of runs. Duplicates are opened once.
        console: Console for progress bars, notes and errors.

    Returns:
        Sequences by their name in tables.

    Raises:
        InputError: If sequences are not valid, or two sequences have the same name, also as folders of results.
        DownloadError: If a sequence is missing and cannot be downloaded.
    """
    opened: dict[str, OpenedSequence] = {}
    sources: dict[str, str] = {}
    errors: list[InputError] = []
    requests = list(dict.fromkeys(requests))
    for request in requests:
        try:
            sequence = open_sequence(request, console)
            folder = folder_name(sequence.name)  # of the results, such as a_b for the sequence a/b
            if (other := sources.setdefault(folder, request.seq)) != request.seq:
                raise InputError(f"{request.seq}: {other} has the same name, {folder}; run them separately")
            opened[sequence.name] = OpenedSequence(request, sequence)
        except InputError as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        console.print("These sequences are not valid:")
        for invalid in errors:
            print_line(console, str(invalid))
        raise InputError(f"{len(errors)} of {len(requests)} sequences are not valid, the first: {errors[0]}")
    return opened
