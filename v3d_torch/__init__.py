"""V3D-SLAM in batched PyTorch tensors: RGB-D tracking and mapping in rooms where people and things move.

The public names are listed once, in the stub beside this file, and imported when they are first used: torch alone takes
a second, and a command that only prints its help should not wait for it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
