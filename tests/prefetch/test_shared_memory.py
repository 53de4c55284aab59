"""What goes from process to process comes out as it went in, to the bit and in the same order of memory."""

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
def share_all() -> Iterator[None]:
    """Small values, too, go through the memory that is shared, where there is any."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3d_torch.prefetch.shared_memory._SMALL", -1)
        yield


@contextmanager
def joined(*, shared: bool) -> Iterator[Ends]:
    """Both ends of a channel, with memory of their own to share or without."""
    here, there = socket.socketpair()
    arena = new_shared_memory(2) if shared else None
    with here, there:
        yield Channel(here, arena, 2), Channel(there, arena, 2)
    if arena is not None:
        os.close(arena)


@pytest.fixture(params=[True, False], ids=["shared memory", "socket"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    with joined(shared=request.param) as ends:
        yield ends


def sent(value: object, *, shared: bool = True) -> object:
    """A value after its way to the other end; a socket holds less than an image."""
    with joined(shared=shared) as (here, there):
        sender = threading.Thread(target=here.send, args=(value,))
        sender.start()
        came: object = there.receive()
        sender.join()
    return came


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([torch.bool, torch.uint8, torch.int64, torch.float32, torch.float64]),
    st.lists(st.integers(0, 9), min_size=0, max_size=4).flatmap(
        lambda shape: st.tuples(st.just(shape), st.permutations(range(len(shape))))
    ),
    st.integers(0, 1000),
    st.booleans(),
)
def test_tensors_of_all_kinds(dtype: torch.dtype, form: tuple[list[int], list[int]], seed: int, shared: bool) -> None:
    shape, order = form
    values = torch.randint(0, 2, shape, generator=torch.Generator().manual_seed(seed)).to(dtype).permute(order)
    came = sent(values, shared=shared)
    assert isinstance(came, Tensor) and came.dtype == dtype and torch.equal(came, values)


def test_what_is_not_a_number_stays_what_it_is() -> None:
    values = torch.tensor([torch.nan, torch.inf, -0.0, 1e-300], dtype=torch.float64)
    came = sent(values)
    assert isinstance(came, Tensor) and came.numpy().tobytes() == values.numpy().tobytes()


def test_an_image_keeps_its_channels_last_and_may_be_written_to() -> None:
    image = torch.arange(480 * 640 * 3).remainder(251).to(torch.uint8).reshape(480, 640, 3).permute(2, 0, 1)
    came = sent(RGBDFrame(3, 0.5, image, torch.ones(1, 480, 640), camera=PinholeCamera(500, 500, 320, 240)))
    assert isinstance(came, RGBDFrame) and came.index == 3 and came.stamp == 0.5
    assert torch.equal(came.image, image) and came.image.stride() == image.stride()
    assert came.camera == PinholeCamera(500, 500, 320, 240)
    came.image[:] = 0


def test_masks_are_a_bit_a_pixel() -> None:
    masks = torch.rand(3, 47, 61, generator=torch.Generator().manual_seed(0)) < 0.3
    instances = Instances(masks, torch.arange(3), torch.rand(3), torch.rand(3, 4))
    with joined(shared=False) as (here, there):
        here.send(instances)
        assert len(there.connection.recv(1 << 20, socket.MSG_PEEK)) < masks.numel() / 4
        came = there.receive()
    assert all(torch.equal(getattr(came, name), getattr(instances, name)) for name in vars(instances))


def test_a_value_stays_when_the_next_one_comes(ends: Ends) -> None:
    here, there = ends
    here.send(torch.zeros(5))
    first = there.receive()
    here.send(torch.ones(5))
    assert torch.equal(there.receive(), torch.ones(5)) and torch.equal(first, torch.zeros(5))


def test_values_stay_when_the_next_ones_come() -> None:
    """Two are on their way at a time: each has its place in the shared memory until it is asked for."""
    images = [torch.full((300, 400), value) for value in range(5)]
    with joined(shared=True) as (here, there):
        here.send(images[0])
        came = []
        for image in images[1:]:
            here.send(image)
            came.append(there.receive())
        came.append(there.receive())
    assert all(map(torch.equal, came, images))


def test_what_does_not_fit_into_the_shared_memory_goes_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.prefetch.shared_memory.SLOT_BYTES", 1 << 16)
    for size in (100, 30_000):
        values = torch.arange(float(size))
        assert torch.equal(sent(values), values)  # type: ignore[arg-type]


def test_a_closed_end_is_told(ends: Ends) -> None:
    here, there = ends
    here.connection.sendall(b"\0\0\0")
    here.close()
    with pytest.raises(EOFError, match="has ended"):
        there.receive()


def test_there_and_back(ends: Ends) -> None:
    here, there = ends
    for value in (None, (1, "zwei", None), np.arange(5.0).tolist()):
        here.send(value)
        there.send((there.receive(), value))
        assert here.receive() == (value, value)


def test_only_what_is_of_this_package_is_opened(ends: Ends) -> None:
    here, there = ends
    for stranger in (os.system, subprocess.Popen, eval, Fraction(1, 2)):
        here.send(stranger)
        with pytest.raises(pickle.UnpicklingError, match="is not for other processes"):
            there.receive()
