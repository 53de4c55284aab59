"""How rerun's viewer lays a run out: the world, the camera's image, what is said of it, and curves."""

from __future__ import annotations

import rerun.blueprint as rrb


def layout(world: str) -> rrb.Blueprint:
    """The arrangement of views; paths are those of `RerunViewer`.

    Args:
        world: title of the view of the world.
    """
    image = rrb.Spatial2DView(
        origin="world/camera/image",
        contents=["$origin/rgb", "$origin/masks", "$origin/objects", "world/votes/**"],
        name="Verdicts and votes",
    )
    curves = rrb.Tabs(
        rrb.TimeSeriesView(origin="seconds", name="Seconds of each stage"),
        rrb.TimeSeriesView(origin="votes", name="Votes by object"),
        rrb.TimeSeriesView(origin="chamfer", name="Chamfer distance by object, m"),
        rrb.TextLogView(origin="log", name="Log"),
    )
    said = rrb.Vertical(image, rrb.TextDocumentView(origin="verdicts", name="Frame"), curves, row_shares=[5, 3, 3])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(origin="world", name=world), said, column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        collapse_panels=True,
    )
