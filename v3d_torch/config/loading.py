"""Loading of the configuration: defaults, then a YAML file, then ``section.key=value`` overrides."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from v3d_torch.config import Config, Section
from v3d_torch.config.validation import first_error, similar_key
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.io.paths import StrPath, expand_user
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text_file import read_text, replace_odd_spaces

_NUMBERS = {int: (1, 10**6), float: (1e-9, 1e9)}
"""Range of the magnitude of a number that is neither 0 nor infinite."""

_LEADING_ZERO = re.compile(r"[-+]?0\d+")
"""Integer that is octal in YAML if all its digits are, and decimal otherwise: 010 is 8, and so is 008."""

_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
"""Dumper of libyaml, which writes the same text several times faster. Some builds of PyYAML lack it."""

FULL = "full"
"""Name of the default configuration."""

_FILES = sorted((Path(__file__).parent / "yaml").rglob("*.yaml"), key=lambda path: (path.stem != FULL, path))
CONFIGS: Mapping[str, Path] = {path.stem: path for path in _FILES}
"""Configurations of the package by name: the default (`FULL`), that of the paper and those of the ablation study."""


def find_config(name: StrPath) -> Path:
    """Find the file of a configuration.

    Args:
        name: Key of `CONFIGS`, such as ``paper``, or path of a YAML file.

    Raises:
        ConfigError: If the name is neither a key of `CONFIGS` nor a file.
    """
    if str(name) in CONFIGS:
        return CONFIGS[str(name)]
    with suppress(OSError):  # names can be too long for a path
        if (path := expand_user(name)).is_file():
            return path
    raise ConfigError(
        f"{str(name) or repr('')}: is neither the name of a configuration ({', '.join(CONFIGS)}) nor a YAML file; check"
        " name or path"
    )


def load_config(name: StrPath | None = None, overrides: Iterable[str] = ()) -> Config:
    """Load a configuration: defaults, then a YAML file, then overrides.

    Args:
        name: Key of `CONFIGS`, such as ``paper``, or path of a YAML file with any part of the values; None for the
            defaults.
        overrides: One string or several, such as ``objects.voting.distance_threshold=0.05``; values are parsed as YAML.

    Raises:
        ConfigError: If the file cannot be read, a key is unknown (the message names the nearest one) or a value is not
            valid.
    """
    tree = {} if name is None else _read_yaml(find_config(name))
    return _apply_overrides(tree, _validate(tree, f"{name}"), overrides, "--set")


def override_config(config: Config, overrides: Iterable[str], source: str = "--set") -> Config:
    """Return a copy of a configuration with overrides, which are parsed and checked as in `load_config`.

    Args:
        config: Configuration.
        overrides: Values to set, such as ``seed=3``.
        source: Option that sets them, for messages.

    Raises:
        ConfigError: If a key or a value is not valid.
    """
    return _apply_overrides(config.model_dump(), config, overrides, source)


def _apply_overrides(tree: dict[str, Any], config: Config, overrides: Iterable[str], source: str) -> Config:
    for override in [overrides] if isinstance(overrides, str) else overrides:  # a string is an iterable, too
        _apply_override(tree, override, source)
        config = _validate(tree, source)
    return config


def dump_config(config: Config) -> str:
    """Return the whole configuration as YAML, which `load_config` reads."""
    return yaml.dump(config.model_dump(mode="json"), Dumper=_DUMPER, sort_keys=False)


def _validate(tree: Mapping[str, Any], source: str) -> Config:
    _check_tree(tree, Config, source)
    try:
        config = Config.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(f"{source}: {first_error(error)}") from error
    _reject_extreme_numbers(config, source)
    return config


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        tree = parse_yaml(replace_odd_spaces(read_text(path, "a configuration is a YAML file")))
    except InputError as error:
        raise ConfigError(str(error)) from error
    except ValueError as error:
        raise ConfigError(f"{path}: is not valid YAML ({error}); repair it") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: contains a {type(tree).__name__}; a configuration is a mapping of sections")
    return tree


def _apply_override(tree: dict[str, Any], override: str, source: str) -> None:
    key, separator, text = replace_odd_spaces(override).partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"{source} {override!r}: write section.key=value, such as objects.voting.vote_threshold=2")
    *sections, leaf = key.strip().split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{source} {override!r}: {section!r} is a value and has no keys")
    if _LEADING_ZERO.fullmatch(text.strip()):
        raise ConfigError(f"{source} {override!r}: YAML reads a leading zero as octal; write {int(text)} instead")
    try:
        tree[leaf] = parse_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{source} {override!r}: the value is not valid YAML ({error})") from error


def _reject_extreme_numbers(section: Section, source: str, prefix: str = "") -> None:
    """Reject numbers that are valid by all other rules but would overflow arithmetic or memory."""
    for name, value in section:
        if isinstance(value, Section):
            _reject_extreme_numbers(value, source, f"{prefix}{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if name == "seed" or type(number) not in _NUMBERS or number == 0 or math.isinf(number):
                continue
            minimum, maximum = _NUMBERS[type(number)]
            if not minimum <= abs(number) <= maximum:
                raise ConfigError(
                    f"{source}: {prefix}{name}: input should be between {minimum:g} and {maximum:g}, got {number!r:.40}"
                )


def _check_tree(tree: Mapping[Any, Any], section: type[Section], source: str, prefix: str = "") -> None:
    """Reject unknown keys, and values for which pydantic has no good message or that it converts without one."""
    for key, value in tree.items():
        field = section.model_fields.get(str(key))
        if field is None:
            raise ConfigError(f"{source}: unknown key {prefix}{key}; {_advice(str(key), section, prefix)}")
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            if isinstance(value, Mapping):
                _check_tree(value, field.annotation, source, f"{prefix}{key}.")
            continue
        if f"{prefix}{key}" == "segmentation.source" and isinstance(value, str) and ":" in value:
            raise ConfigError(
                f"{source}: segmentation.source: {value} is not yolo, masks or none; for a segmenter by import path,"
                f" set stages.segment={value}"
            )
        values = value if isinstance(value, Sequence) else (value,)
        if type(field.default) in (int, float, tuple) and any(isinstance(each, bool) for each in values):
            raise ConfigError(f"{source}: {prefix}{key}: input should be a number, got {value!r}")
        if isinstance(field.default, tuple) and isinstance(value, int | float):
            raise ConfigError(f"{source}: {prefix}{key}: input should be a list such as [{value}], got {value}")


def _advice(key: str, section: type[Section], prefix: str) -> str:
    """Return what to write in place of an unknown key of a section."""
    *sections, leaf = key.split(".")
    if sections and sections[0] in section.model_fields:  # the notation of --set in a file
        return f"write nested sections, {''.join(f'{name}: {{' for name in sections)}{leaf}: ...{'}' * len(sections)}"
    if (near := similar_key(key, section.model_fields)) is not None:
        return f"did you mean {prefix}{near}?"
    return f"choose from {', '.join(section.model_fields)}"
