"""Texts for messages and tables: printable, short, on one line."""

from __future__ import annotations

from v3d_torch.errors import V3DError


def printable(value: object) -> str:
    """Return a text in one line, with escapes in place of the control characters that names and contents can have.

    Args:
        value: Text, or an object that is converted to one, such as a path.
    """
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(value))


def shorten(text: str, length: int) -> str:
    """Leave out the middle of a text that is longer than ``length`` characters; names often differ at their ends."""
    head = length // 2
    return text if len(text) <= length else f"{text[:head]}…{text[len(text) - (length - 1 - head) :]}"


def first_line(error: BaseException) -> str:
    """Return the first line of the message of an error, which can fill pages; the type if there is no message."""
    message = str(error).strip()
    return message.splitlines()[0] if message else type(error).__name__


def describe_error(error: BaseException) -> str:
    """Return the message of an error on one line, with the type of the error unless it is a `V3DError`."""
    message = " ".join(str(error).split())
    if isinstance(error, V3DError):
        return message
    return f"{type(error).__name__}: {message}" if message else type(error).__name__
