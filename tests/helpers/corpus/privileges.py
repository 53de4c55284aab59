"""The rights of a common user, also where the tests run as root: who may read every file tests no permissions."""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_VERSION = 0x20080522
_OVERRIDE = 1 << 1 | 1 << 2
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH (capabilities(7))."""


@contextmanager
def without_root_rights() -> Iterator[None]:
    """Let permissions of files hold for this thread, even as root of Linux."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header = struct.pack("Ii", _VERSION, 0)
    rights = ctypes.create_string_buffer(24)
    assert libc.capget(header, rights) == 0
    effective, *others = struct.unpack("6I", rights.raw)
    assert libc.capset(header, struct.pack("6I", effective & ~_OVERRIDE, *others)) == 0
    try:
        yield
    finally:
        assert libc.capset(header, rights.raw) == 0
