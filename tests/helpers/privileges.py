"""File permissions that hold also if the tests run as root, which could read every file otherwise."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_CAPABILITY_VERSION = 0x20080522
"""_LINUX_CAPABILITY_VERSION_3 (capget(2))."""
_BYPASS_PERMISSIONS = 1 << 1 | 1 << 2
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH (capabilities(7))."""


@contextmanager
def without_root_rights() -> Iterator[None]:
    """Enforce file permissions in this thread, even for root on Linux."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header = struct.pack("Ii", _CAPABILITY_VERSION, 0)
    capabilities = ctypes.create_string_buffer(24)
    assert libc.capget(header, capabilities) == 0
    effective, *others = struct.unpack("6I", capabilities.raw)
    assert libc.capset(header, struct.pack("6I", effective & ~_BYPASS_PERMISSIONS, *others)) == 0
    try:
        yield
    finally:
        assert libc.capset(header, capabilities.raw) == 0
