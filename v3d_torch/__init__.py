"""V3D-SLAM in batched PyTorch tensors: RGB-D tracking and mapping in rooms where people and things move.

The public names are listed once, in the stub beside this file, and are imported when they are first used: the import of
torch takes a second, for which a command that only prints its help should not wait.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
