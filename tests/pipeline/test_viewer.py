"""Viewers of a run."""

from __future__ import annotations

from typing import Any, cast

import pytest

from v3d_torch.errors import OutputError
from v3d_torch.pipeline import ViewerGroup


class Recording:
    """Viewer that records that it was finished; then it fails with a message, if there is one."""

    def __init__(self, message: str | None = None) -> None:
        self._message = message
        self.is_finished = False

    def show(self, *_: Any) -> None:
        pass

    def finish(self, *_: Any) -> None:
        self.is_finished = True
        if self._message is not None:
            raise OutputError(self._message)


def test_all_viewers_are_finished_and_all_errors_reported() -> None:
    viewers = [Recording("a.rrd: disk full"), Recording(), Recording("b.bag: disk full")]
    with pytest.raises(OutputError, match=r"^a\.rrd: disk full; b\.bag: disk full$"):
        ViewerGroup(viewers).finish(cast("Any", None), cast("Any", None))
    assert all(viewer.is_finished for viewer in viewers)
