"""``python -m v3d_torch.run``: the same as ``v3d-torch run``."""

import sys

from v3d_torch.cli.program import main

if __name__ == "__main__":
    sys.argv.insert(1, "run")
    main()
