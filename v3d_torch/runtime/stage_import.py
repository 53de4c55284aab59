"""Stages that a configuration names by import path, see `StagesConfig`.

An import runs the code of a module. So a stage is imported only when a system is made, and only from a configuration
that the user gave: reading a configuration, a checkpoint, a saved state or the results of a run imports nothing.
"""

from __future__ import annotations

import importlib
import inspect
import operator
from collections.abc import Callable
from typing import Any

from v3d_torch.config import Config, StagesConfig
from v3d_torch.errors import ConfigError, StageError, V3DError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.text import describe_error
from v3d_torch.runtime.input_checks import describe_type
from v3d_torch.runtime.stage_proxy import StageProxy


def import_stage(name: str, path: str) -> Callable[..., Any]:
    """Import the class of a stage, or a function that returns the stage.

    Args:
        name: Name of the stage.
        path: ``module:attribute``.

    Raises:
        ConfigError: If the path is not of this form, the module cannot be imported, or it has no such attribute that
            can be called.
    """
    key = f"stages.{name}={path}"
    module_name, colon, attribute = path.partition(":")
    if not (module_name and colon and attribute):
        raise ConfigError(f"{key}: is not an import path; write module:attribute, such as my_package:MyStage")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # an import runs any code
        raise ConfigError(
            f"{key}: the module {module_name} cannot be imported ({describe_error(error)}); correct it, install it, or"
            " add its folder to PYTHONPATH"
        ) from error
    try:
        stage = operator.attrgetter(attribute)(module)
    except AttributeError as error:
        raise ConfigError(
            f"{key}: {module.__name__} has no attribute {attribute}; correct the name after the colon"
        ) from error
    if not callable(stage):
        raise ConfigError(
            f"{key}: is {describe_type(stage)}, which cannot be called; name a class, or a function that returns the"
            " stage"
        )
    return stage


def make_stage(name: str, path: str, config: Config, camera: PinholeCamera) -> Any:
    """Import a stage and make it for one run, with configuration and camera as positional arguments.

    Args:
        name: Name of the stage.
        path: ``module:attribute``, where the attribute is a class or a function that returns the stage.
        config: First argument.
        camera: Second argument.

    Raises:
        ConfigError: If it cannot be imported, does not accept the two arguments, raises an error, or returns something
            that cannot be called.
        StageError: When the stage or a method is called, if it raises another error than a `V3DError`.
    """
    key, make = f"stages.{name}={path}", import_stage(name, path)
    try:
        inspect.signature(make).bind(config, camera)
    except ValueError:  # some compiled classes do not tell their signature
        pass
    except TypeError as error:
        raise ConfigError(f"{key}: does not accept two arguments, config and camera ({error})") from error
    try:
        stage = make(config, camera)
    except (Exception, SystemExit) as error:  # a constructor runs any code
        raise ConfigError(f"{key}: cannot be made ({describe_error(error)}); correct it") from error
    if not callable(stage):
        raise ConfigError(f"{key}: returned {describe_type(stage)}, which cannot be called; return the stage")
    return ImportedStage(stage, key)


class ImportedStage(StageProxy):
    """Proxy of an imported stage whose errors name the stage.

    Args:
        stage: Stage.
        name: Its key and import path.

    Raises:
        StageError: When the stage or a method is called, if it raises another error than a `V3DError`.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage."""
        try:
            return self._stage(*args, **kwargs)
        except V3DError:
            raise
        except (Exception, SystemExit) as error:  # a stage runs any code; an exit would lose the results so far
            raise StageError(f"{self._name} failed with {describe_error(error)}") from error

    def __getattr__(self, name: str) -> Any:
        value = super().__getattr__(name)
        return ImportedStage(value, self._name) if callable(value) else value


def first_not_given(stored: StagesConfig, given: StagesConfig) -> str | None:
    """Find a stage of a stored configuration that the user does not give as well, and that is not to be imported.

    Returns:
        Its key and import path, such as ``stages.segment=my_package:MySegmenter``; None if there is none.
    """
    return next((f"stages.{name}={path}" for name, path in stored.paths.items() if given.paths.get(name) != path), None)
