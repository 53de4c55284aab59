"""Processes that the system ends when they open an internet socket, also from compiled code."""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import struct

SOCKET_CALLS = {"x86_64": 41, "aarch64": 198}
"""Number of the system call `socket` by machine."""

KILLED = -signal.Signals["SIGSYS"] if hasattr(signal, "SIGSYS") else None
"""Return code of a process that opened an internet socket."""

_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, _PR_SET_NO_NEW_PRIVS = 22, 2, 38
_LOAD, _JUMP_IF_EQUAL, _RETURN = 0x20, 0x15, 0x06  # instructions of the Berkeley packet filter
_NUMBER_OFFSET, _FIRST_ARGUMENT_OFFSET = 0, 16  # in struct seccomp_data
_AF_INET, _AF_INET6 = 2, 10
_ALLOW, _KILL_PROCESS = 0x7FFF0000, 0x80000000


class _Filter(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def can_forbid_internet() -> bool:
    return hasattr(os, "fork") and platform.system() == "Linux" and platform.machine() in SOCKET_CALLS


def forbid_internet() -> None:
    """End this process, or a process that it becomes or starts, by SIGSYS when it opens an internet socket.

    The audit events of Python tell about sockets of Python code only. Here the system filters the calls (seccomp).

    Raises:
        OSError: If the system does not allow filters.
    """
    instructions = (  # operation, instructions to skip if true and if false, value
        (_LOAD, 0, 0, _NUMBER_OFFSET),
        (_JUMP_IF_EQUAL, 0, 3, SOCKET_CALLS[platform.machine()]),
        (_LOAD, 0, 0, _FIRST_ARGUMENT_OFFSET),
        (_JUMP_IF_EQUAL, 2, 0, _AF_INET),
        (_JUMP_IF_EQUAL, 1, 0, _AF_INET6),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _KILL_PROCESS),
    )
    program = b"".join(struct.pack("HBBI", *instruction) for instruction in instructions)
    library = ctypes.CDLL(None, use_errno=True)
    filters = ctypes.byref(_Filter(len(instructions), program))
    if library.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or library.prctl(
        _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, filters, 0, 0
    ):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
