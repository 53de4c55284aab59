"""Reading of text files, with a bound on their size and errors that name the expected content."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from v3d_torch.errors import InputError

_MAX_LENGTH = 100_000_000
"""Maximum length of a text that is read, characters: more than an hour of poses at 200 Hz; it ends endless devices."""

_ODD_SPACES = str.maketrans(
    dict.fromkeys(
        "\u00a0\u1680\u2000\u2001\u2002\u2003\u2004\u2005\u2006\u2007\u2008\u2009\u200a\u202f\u205f\u3000", " "
    )
    | dict.fromkeys("\u00ad\u200b\u2060\ufeff", "")
)
"""Spaces that word processors and web pages insert, and invisible characters without width."""


def read_text(path: Path, expected: str) -> str:
    r"""Read a UTF-8 text file.

    A byte order mark is removed, and all line ends become ``\n``.

    Args:
        path: File to read.
        expected: Expected content, for error messages, such as "a trajectory has lines of ...".

    Returns:
        Content of the file.

    Raises:
        InputError: If the file cannot be read, is not UTF-8, or is larger than any valid file.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            text = file.read(_MAX_LENGTH + 1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that it is a file, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not a UTF-8 text file; convert it to UTF-8 ({expected})") from error
    if len(text) > _MAX_LENGTH:
        limit = f"{_MAX_LENGTH / 1e6:.0f} MB"
        raise InputError(f"{path}: is larger than {limit}; check that it is the right file ({expected})")
    return text


def numbered_lines(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """Yield the line number (from 1) and the stripped text of each line that is not empty and not a # comment.

    Args:
        path: File to read.
        expected: Expected content, for error messages, see `read_text`.

    Raises:
        InputError: As `read_text`.
    """
    return ((number, line) for number, line in lines_and_comments(path, expected) if not line.startswith("#"))


def lines_and_comments(path: Path, expected: str) -> Iterator[tuple[int, str]]:
    """Yield the line number (from 1) and the stripped text of each line that is not empty.

    Args:
        path: File to read.
        expected: Expected content, for error messages, see `read_text`.

    Raises:
        InputError: As `read_text`.
    """
    for number, line in enumerate(read_text(path, expected).split("\n"), start=1):
        if line := line.strip():
            yield number, line


def replace_odd_spaces(text: str) -> str:
    """Replace no-break and other typographic spaces by plain ones, and remove invisible characters.

    Args:
        text: Text of a configuration or of numbers. A file name can contain these characters on purpose.
    """
    return text.translate(_ODD_SPACES)
