"""Sources of RGB-D frames. `open_source` opens any source by name, `load_sequence` opens stored sequences only.

The public names are listed in the stub beside this file, and are imported when they are first used: a command can find
a sequence, and reject a wrong path, before torch is imported.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
