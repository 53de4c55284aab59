"""A run in rerun's viewer (``pip install v3d-torch[rerun]``)."""
