"""``python -m v3d_torch.run``: the same as ``v3d-torch run``."""

from v3d_torch.cli.run import app

if __name__ == "__main__":
    app()
