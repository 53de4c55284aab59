"""Program ``v3d-torch``, also ``python -m v3d_torch``: all commands of the package."""

from v3d_torch.cli.program import main

if __name__ == "__main__":
    main()
