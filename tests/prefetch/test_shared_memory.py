"""Values sent between processes arrive identical to the bit, with the same memory layout."""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.prefetch.shared_memory import Channel, new_shared_memory
from v3d_torch.types import Instances, RGBDFrame

Ends = tuple[Channel, Channel]


@pytest.fixture(scope="module", autouse=True)
def share_small_values() -> Iterator[None]:
    """Send small values through shared memory, too, if there is any."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3d_torch.prefetch.shared_memory._SMALL", -1)
        yield


@contextmanager
def open_channel(*, shared: bool) -> Iterator[Ends]:
    """Both ends of a channel, with or without shared memory."""
    first, second = socket.socketpair()
    memory = new_shared_memory(2) if shared else None
    with first, second:
        yield Channel(first, memory, 2), Channel(second, memory, 2)
    if memory is not None:
        os.close(memory)


@pytest.fixture(params=[True, False], ids=["shared memory", "socket"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    with open_channel(shared=request.param) as ends:
        yield ends


def transfer(value: object, *, shared: bool = True) -> object:
    """Send a value and return it as received; a thread sends it because a socket buffers less than an image."""
    with open_channel(shared=shared) as (sender, receiver):
        thread = threading.Thread(target=sender.send, args=(value,))
        thread.start()
        received: object = receiver.receive()
        thread.join()
    return received


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([torch.bool, torch.uint8, torch.int64, torch.float32, torch.float64]),
    st.lists(st.integers(0, 9), min_size=0, max_size=4).flatmap(
        lambda shape: st.tuples(st.just(shape), st.permutations(range(len(shape))))
    ),
    st.integers(0, 1000),
    st.booleans(),
)
def test_tensors_of_all_types_and_layouts_arrive_identical(
    dtype: torch.dtype, layout: tuple[list[int], list[int]], seed: int, shared: bool
) -> None:
    shape, order = layout
    values = torch.randint(0, 2, shape, generator=torch.Generator().manual_seed(seed)).to(dtype).permute(order)
    received = transfer(values, shared=shared)
    assert isinstance(received, Tensor) and received.dtype == dtype and torch.equal(received, values)


def test_nan_infinity_and_negative_zero_arrive_identical() -> None:
    values = torch.tensor([torch.nan, torch.inf, -0.0, 1e-300], dtype=torch.float64)
    received = transfer(values)
    assert isinstance(received, Tensor) and received.numpy().tobytes() == values.numpy().tobytes()


def test_image_arrives_channels_last_and_writable() -> None:
    image = torch.arange(480 * 640 * 3).remainder(251).to(torch.uint8).reshape(480, 640, 3).permute(2, 0, 1)
    received = transfer(RGBDFrame(3, 0.5, image, torch.ones(1, 480, 640), camera=PinholeCamera(500, 500, 320, 240)))
    assert isinstance(received, RGBDFrame) and received.index == 3 and received.stamp == 0.5
    assert torch.equal(received.image, image) and received.image.stride() == image.stride()
    assert received.camera == PinholeCamera(500, 500, 320, 240)
    received.image[:] = 0


def test_masks_are_sent_as_one_bit_per_pixel() -> None:
    masks = torch.rand(3, 47, 61, generator=torch.Generator().manual_seed(0)) < 0.3
    instances = Instances(masks, torch.arange(3), torch.rand(3), torch.rand(3, 4))
    with open_channel(shared=False) as (sender, receiver):
        sender.send(instances)
        assert len(receiver.connection.recv(1 << 20, socket.MSG_PEEK)) < masks.numel() / 4
        received = receiver.receive()
    assert all(torch.equal(getattr(received, name), getattr(instances, name)) for name in vars(instances))


def test_received_value_is_not_overwritten_by_the_next(ends: Ends) -> None:
    sender, receiver = ends
    sender.send(torch.zeros(5))
    first = receiver.receive()
    sender.send(torch.ones(5))
    assert torch.equal(receiver.receive(), torch.ones(5)) and torch.equal(first, torch.zeros(5))


def test_two_values_in_transit_arrive_identical() -> None:
    """Each value in transit has a slot of its own in the shared memory."""
    images = [torch.full((300, 400), value) for value in range(5)]
    with open_channel(shared=True) as (sender, receiver):
        sender.send(images[0])
        received = []
        for image in images[1:]:
            sender.send(image)
            received.append(receiver.receive())
        received.append(receiver.receive())
    assert all(map(torch.equal, received, images))


def test_values_larger_than_a_slot_are_sent_by_the_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.prefetch.shared_memory.SLOT_BYTES", 1 << 16)
    for size in (100, 30_000):
        values = torch.arange(float(size))
        assert torch.equal(transfer(values), values)  # type: ignore[arg-type]


def test_receive_from_a_closed_end_raises(ends: Ends) -> None:
    sender, receiver = ends
    sender.connection.sendall(b"\0\0\0")
    sender.close()
    with pytest.raises(EOFError, match="has ended"):
        receiver.receive()


def test_values_are_sent_in_both_directions(ends: Ends) -> None:
    first, second = ends
    for value in (None, (1, "zwei", None), np.arange(5.0).tolist()):
        first.send(value)
        second.send((second.receive(), value))
        assert first.receive() == (value, value)


def test_globals_of_other_packages_are_not_unpickled(ends: Ends) -> None:
    sender, receiver = ends
    for foreign in (os.system, subprocess.Popen, eval, Fraction(1, 2)):
        sender.send(foreign)
        with pytest.raises(pickle.UnpicklingError, match=r"^[\w.]+ is not allowed$"):
            receiver.receive()
