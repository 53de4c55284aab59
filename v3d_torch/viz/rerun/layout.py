"""Layout of a run in rerun's viewer: the world, the camera image, the frame summary, and curves."""

from __future__ import annotations

import rerun.blueprint as rrb


def layout(world_title: str) -> rrb.Blueprint:
    """Return the arrangement of the views. Their paths are those of `RerunViewer`.

    Args:
        world_title: Title of the view of the world.
    """
    world = rrb.Spatial3DView(origin="world", name=world_title)
    image = rrb.Spatial2DView(
        origin="world/camera/image",
        contents=["$origin/rgb", "$origin/masks", "$origin/objects", "world/votes/**"],
        name="Objects and votes",
    )
    summary = rrb.TextDocumentView(origin="frame_summary", name="Frame")
    curves = rrb.Tabs(
        rrb.TimeSeriesView(origin="seconds", name="Time per stage, s"),
        rrb.TimeSeriesView(origin="votes", name="Votes per object"),
        rrb.TimeSeriesView(origin="chamfer", name="Change of shape (Chamfer) per object, m"),
        rrb.TextLogView(origin="log", name="Log"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(image, summary, curves, row_shares=[5, 3, 3]), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        collapse_panels=True,
    )
