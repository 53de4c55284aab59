"""V3D-SLAM in batched PyTorch tensors: RGB-D tracking and mapping in rooms where people and things move.

The public names are listed once, in the stub beside this file, and are imported when they are first used: the import of
torch takes a second, for which a command that only prints its help should not wait.
"""

import sys

import lazy_loader

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Import a public name.

    Tensors that a module creates when it is imported must not be inference tensors: gradients would fail for the rest
    of the process.
    """
    if "torch" not in sys.modules:
        return _import_name(name)
    import torch

    with torch.inference_mode(False):
        return _import_name(name)
