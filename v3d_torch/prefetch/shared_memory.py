"""Objects with tensors in them, from one process to another and back."""

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
"""Bytes of the memory that two processes share, for each value on its way: no more of it is taken than the values need,
for a frame of 640x480 about 5 MB."""

_SMALL = 1 << 14
"""Bytes up to which a value goes by the connection, which holds them until they are asked for."""


_KNOWN = {
    ("collections", "OrderedDict"),  # in torch's modules
    ("numpy", "dtype"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.numeric", "_frombuffer"),  # before NumPy 2
    ("pathlib", "PosixPath"),
}
"""What comes beside this package's own classes and functions."""


def new_shared_memory(values: int) -> int | None:
    """Descriptor of memory for both ends of a channel; None where the system has none of this kind.

    Args:
        values: see `Channel`.
    """
    if not hasattr(os, "memfd_create"):
        return None
    descriptor = os.memfd_create("v3d_torch")
    os.truncate(descriptor, values * SLOT_BYTES)
    return descriptor


class Channel:
    """One end of a connection between a process and another that it started.

    What the tensors of large values hold goes through memory that both share, as it lies there, masks as a bit a pixel.

    Args:
        connection: to the other end; is closed with this one.
        arena: descriptor of the shared memory; None sends all by the connection. It is the caller's to close.
        values: most large ones that are on their way at a time, all of them from one end.
    """

    def __init__(self, connection: socket.socket, arena: int | None, values: int) -> None:
        self.connection = connection
        self._arena = None if arena is None else mmap(arena, values * SLOT_BYTES)
        self._places = cycle(range(0, values * SLOT_BYTES, SLOT_BYTES))

    def send(self, value: object) -> None:
        """Send a value.

        Raises:
            OSError: nobody listens any more.
            Exception: the value cannot be pickled, whatever its classes raise.
        """
        buffers: list[pickle.PickleBuffer] = []
        stream = BytesIO()
        _Pickler(stream, protocol=5, buffer_callback=buffers.append).dump(value)
        parts = [stream.getbuffer(), *(buffer.raw() for buffer in buffers)]
        sizes = [part.nbytes for part in parts]
        self.connection.sendall(b"".join(map(_NUMBER.pack, (len(parts), *sizes))))
        if self._arena is not None and _SMALL < sum(sizes) <= SLOT_BYTES:
            place = next(self._places)
            for part, (begin, end) in zip(parts, pairwise(accumulate(sizes, initial=place)), strict=True):
                self._arena[begin:end] = part
            self.connection.sendall(_NUMBER.pack(place))
        else:
            for part in parts:
                self.connection.sendall(part)

    def receive(self) -> Any:
        """The next value that the other end sent.

        Raises:
            EOFError: the other end is closed.
            OSError: the connection is broken.
            pickle.UnpicklingError: the value has a part that is not of this package, nor one of `_KNOWN`.
        """
        (count,) = _NUMBER.unpack(self._exactly(_NUMBER.size))
        sizes = [size for (size,) in _NUMBER.iter_unpack(self._exactly(count * _NUMBER.size))]
        if self._arena is not None and _SMALL < sum(sizes) <= SLOT_BYTES:
            (place,) = _NUMBER.unpack(self._exactly(_NUMBER.size))
            ends = pairwise(accumulate(sizes, initial=place))
            parts = [_writable(memoryview(self._arena)[begin:end]) for begin, end in ends]
        else:
            parts = [self._exactly(size) for size in sizes]
        stream, *buffers = parts
        return _Unpickler(BytesIO(stream), buffers=buffers).load()

    def close(self) -> None:
        """End the connection, which the other end is told."""
        self.connection.close()

    def _exactly(self, size: int) -> memoryview:
        """So many bytes from the connection, in memory that may be written to."""
        content = np.empty(size, np.uint8).data  # a bytearray would be filled with zeros first
        got = 0
        while got < size:
            came = self.connection.recv_into(content[got:])
            if came == 0:
                raise EOFError("the other process has ended")
            got += came
        return content


def _writable(shared: memoryview) -> memoryview:
    """A copy, for another value takes the place of this one."""
    return np.frombuffer(shared, np.uint8).copy().data


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: object) -> tuple[Callable[..., Tensor], tuple[object, ...]] | Any:
        if type(value) is not Tensor:
            return NotImplemented
        # In the order of the memory: an image whose channels come last there stays as it is.
        order = sorted(range(value.ndim), key=value.stride, reverse=True)
        rows = value.detach().permute(order).contiguous().numpy()
        if rows.dtype == np.bool_:
            return _mask, (np.packbits(rows), rows.shape, order)
        return _tensor, (rows, order)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "v3d_torch" or (module, name) in _KNOWN:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not for other processes")


def _tensor(rows: NDArray[Any], order: Sequence[int]) -> Tensor:
    return torch.from_numpy(rows).permute(tuple(np.argsort(order).tolist()))


def _mask(bits: NDArray[np.uint8], shape: tuple[int, ...], order: Sequence[int]) -> Tensor:
    return _tensor(np.unpackbits(bits, count=int(np.prod(shape))).reshape(shape).view(np.bool_), order)
