"""Text of a camera file, which `load_camera` reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import yaml

from v3d_torch.geometry.camera import PinholeCamera


def camera_text(camera: PinholeCamera, comments: Mapping[str, str] | None = None) -> str:
    """Return the text of a ``camera.yaml``.

    Args:
        camera: Camera.
        comments: Comments by name of the field; None for no comments.
    """
    lines = []
    for name, value in asdict(camera).items():
        field = {name: list(value) if isinstance(value, tuple) else value}
        text = yaml.safe_dump(field, default_flow_style=True, width=1000).strip()[1:-1]  # without the braces
        comment = (comments or {}).get(name)
        lines.append(text if comment is None else f"{text}  # {comment}")
    return "\n".join(lines) + "\n"
