"""Wall time of a run compared with the sum of its stages, which is larger if stages overlap."""

from __future__ import annotations


def do_stages_overlap(stage_seconds: float, seconds: float) -> bool:
    """Check whether stages ran at the same time, in threads.

    Args:
        stage_seconds: Sum of the wall times of all stages, seconds.
        seconds: Wall time of the run, seconds.
    """
    return stage_seconds > seconds


def describe_wall_time(stage_seconds: float, seconds: float, frames: int) -> str:
    """Return the wall time per frame, and why it differs from the sum of the stages.

    Args:
        stage_seconds: Sum of the wall times of all stages, seconds.
        seconds: Wall time of the run, seconds.
        frames: Number of frames, at least 1.
    """
    wall = f"{1e3 * seconds / frames:.1f} ms of wall time per frame"
    if do_stages_overlap(stage_seconds, seconds):
        return f"{wall}, less than the sum of the stages, because stages overlap"
    return f"{wall}, of which {1e3 * (seconds - stage_seconds) / frames:.1f} ms outside the stages"
