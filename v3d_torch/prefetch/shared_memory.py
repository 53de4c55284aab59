"""Transfer of objects with tensors between two processes, through shared memory."""

from __future__ import annotations

import os
import pickle
import socket
import struct
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import accumulate, cycle, pairwise
from mmap import mmap
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_NUMBER = struct.Struct("!Q")

SLOT_BYTES = 1 << 26
"""Size of the shared memory for one value in transit, bytes. Only the pages in use take memory: about 5 MB for a frame
of 640x480 pixels."""

_SMALL = 1 << 14
"""Values up to this size, bytes, are sent through the socket, which buffers them."""

_ALLOWED = {
    ("collections", "OrderedDict"),  # in torch's modules
    ("numpy", "dtype"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.numeric", "_frombuffer"),  # before NumPy 2
    ("pathlib", "PosixPath"),
}
"""Globals that can be unpickled in addition to those of this package."""


def new_shared_memory(values: int) -> int | None:
    """Create shared memory for both ends of a channel.

    Args:
        values: See `Channel`.

    Returns:
        File descriptor; None if the system has no ``memfd_create``.
    """
    if not hasattr(os, "memfd_create"):
        return None
    descriptor = os.memfd_create("v3d_torch")
    os.truncate(descriptor, values * SLOT_BYTES)
    return descriptor


class Channel:
    """One end of a connection between a process and its child process.

    The tensors of large values are copied through shared memory, with boolean masks packed to one bit per pixel.

    Args:
        connection: Socket to the other end; `close` closes it.
        memory: File descriptor of the shared memory, which the caller closes; None sends everything by the socket.
        values: Maximum number of large values in transit at a time, all of them in one direction.
    """

    def __init__(self, connection: socket.socket, memory: int | None, values: int) -> None:
        self.connection = connection
        self._memory = None if memory is None else mmap(memory, values * SLOT_BYTES)
        self._slots = cycle(range(0, values * SLOT_BYTES, SLOT_BYTES))

    def send(self, value: object) -> None:
        """Send a value.

        Raises:
            OSError: If the other end is closed.
            Exception: If the value cannot be pickled.
        """
        buffers: list[pickle.PickleBuffer] = []
        stream = BytesIO()
        _Pickler(stream, protocol=5, buffer_callback=buffers.append).dump(value)
        parts = [stream.getbuffer(), *(buffer.raw() for buffer in buffers)]
        sizes = [part.nbytes for part in parts]
        self.connection.sendall(b"".join(map(_NUMBER.pack, (len(parts), *sizes))))
        if self._memory is not None and _SMALL < sum(sizes) <= SLOT_BYTES:
            slot = next(self._slots)
            for part, (begin, end) in zip(parts, pairwise(accumulate(sizes, initial=slot)), strict=True):
                self._memory[begin:end] = part
            self.connection.sendall(_NUMBER.pack(slot))
        else:
            for part in parts:
                self.connection.sendall(part)

    def receive(self) -> Any:
        """Receive the next value.

        Raises:
            EOFError: If the other end is closed.
            OSError: If the connection is broken.
            pickle.UnpicklingError: If the value has a class or function that is neither of this package nor in
                `_ALLOWED`.
        """
        (count,) = _NUMBER.unpack(self._receive_exactly(_NUMBER.size))
        sizes = [size for (size,) in _NUMBER.iter_unpack(self._receive_exactly(count * _NUMBER.size))]
        if self._memory is not None and _SMALL < sum(sizes) <= SLOT_BYTES:
            (slot,) = _NUMBER.unpack(self._receive_exactly(_NUMBER.size))
            ends = pairwise(accumulate(sizes, initial=slot))
            parts = [_writable(memoryview(self._memory)[begin:end]) for begin, end in ends]
        else:
            parts = [self._receive_exactly(size) for size in sizes]
        stream, *buffers = parts
        return _Unpickler(BytesIO(stream), buffers=buffers).load()

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()

    def _receive_exactly(self, size: int) -> memoryview:
        """Receive a number of bytes in writable memory."""
        content = np.empty(size, np.uint8).data  # not initialised, unlike a bytearray
        received = 0
        while received < size:
            count = self.connection.recv_into(content[received:])
            if count == 0:
                raise EOFError("the other process has ended")
            received += count
        return content


def _writable(shared: memoryview) -> memoryview:
    """Return a copy, because the next value overwrites the shared memory."""
    return np.frombuffer(shared, np.uint8).copy().data


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: object) -> tuple[Callable[..., Tensor], tuple[object, ...]] | Any:
        if type(value) is not Tensor:
            return NotImplemented
        # In the order of the memory, so that channels-last images keep their layout.
        order = sorted(range(value.ndim), key=value.stride, reverse=True)
        rows = value.detach().permute(order).contiguous().numpy()
        if rows.dtype == np.bool_:
            return _mask, (np.packbits(rows), rows.shape, order)
        return _tensor, (rows, order)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "v3d_torch" or (module, name) in _ALLOWED:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")


def _tensor(rows: NDArray[Any], order: Sequence[int]) -> Tensor:
    return torch.from_numpy(rows).permute(tuple(np.argsort(order).tolist()))


def _mask(bits: NDArray[np.uint8], shape: tuple[int, ...], order: Sequence[int]) -> Tensor:
    return _tensor(np.unpackbits(bits, count=int(np.prod(shape))).reshape(shape).view(np.bool_), order)
