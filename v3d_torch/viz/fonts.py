"""Fonts for text of the user, such as names of sequences, in scripts that the default font of figures lacks."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from matplotlib import font_manager
from matplotlib.text import Text

from v3d_torch.io.text import shorten

_REPLACEMENT = "?"
"""Replacement for characters that no installed font has, instead of an empty box."""

_MAX_TITLE = 50
"""Maximum number of characters of a title, so that it fits into the figure; the middle of a longer one is left out."""

_PLACEHOLDERS = "Last Resort"
"""Beginning of the names of fonts that have a box for every character."""


def draw_title(set_title: Callable[..., Text], title: str) -> None:
    """Draw a title of the user, such as the name of a folder, which may contain dollar signs and letters of any script.

    Args:
        set_title: `Axes.set_title` or `Figure.suptitle`.
        title: Title.
    """
    text, fonts = drawable_text(shorten(title, _MAX_TITLE))
    set_title(text, parse_math=False, fontfamily=fonts)


def drawable_text(text: str) -> tuple[str, list[str]]:
    """Choose fonts for a text, and replace the characters that no installed font has.

    Args:
        text: Text in any script.

    Returns:
        The text with drawable characters only, and the font families to draw it with, in order of preference.
    """
    default = font_manager.FontProperties()
    families = [font_manager.get_font(font_manager.findfont(default)).family_name]
    text = "".join(" " if letter.isspace() and letter != "\n" else letter for letter in text)
    missing = set(text) - {"\n"} - _characters(font_manager.findfont(default))
    if missing:
        for family, path in _families().items():
            if covered := missing & _characters(path):
                families.append(family)
                missing -= covered
    return "".join(_REPLACEMENT if letter in missing else letter for letter in text), families


@cache
def _families() -> dict[str, str]:
    """Installed font families with the file of their regular style, in alphabetical order."""
    entries = sorted(font_manager.fontManager.ttflist, key=lambda entry: (entry.name, entry.fname))
    regular = {
        entry.name: entry.fname
        for entry in entries
        if entry.style == "normal" and entry.weight in (400, "normal", "regular") and entry.size == "scalable"
    }
    return {name: path for name, path in regular.items() if not name.startswith(_PLACEHOLDERS)}


@cache
def _characters(path: str) -> frozenset[str]:
    """Characters that a font file has; none if it cannot be used."""
    try:
        return frozenset(map(chr, font_manager.get_font(path).get_charmap()))
    except (OSError, RuntimeError, ValueError):  # such as a damaged file or a font of coloured bitmaps
        return frozenset()
