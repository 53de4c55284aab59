"""Import of onnxruntime without its telemetry."""

from __future__ import annotations

import os
from types import ModuleType


def import_onnxruntime() -> ModuleType:
    """Import onnxruntime with its telemetry turned off.

    On import, onnxruntime writes a device id and a database of events to the user's cache, and it connects to a server
    some seconds later, unless the environment variable ``ORT_DISABLE_TELEMETRY`` is set before. A value that the user
    has set is kept. The package imports onnxruntime only with this function, and only to run or quantise a network.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    return onnxruntime
