"""View of a run in rerun (``pip install v3d-torch[rerun]``)."""
