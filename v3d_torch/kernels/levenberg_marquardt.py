"""Rules of Levenberg-Marquardt for kernels; see `v3d_torch.optim.levenberg_marquardt`."""

from __future__ import annotations

from v3d_torch.kernels.compiler import device

DampingSchedule = tuple[float, float, float, float]
"""First, smallest and largest damping, and the factor between two steps."""


@device
def has_converged(cost: float, new_cost: float, damping: float, tolerance: float) -> bool:
    """Check for a small change of the cost; after a heavily damped step it does not indicate convergence."""
    return damping < 1 and abs(cost - new_cost) <= tolerance * (cost + tolerance)


@device
def next_damping(damping: float, is_lower: bool, schedule: DampingSchedule) -> float:
    """Reduce the damping after a step that lowers the cost, and increase it after another."""
    _, smallest, largest, factor = schedule
    return max(damping / factor, smallest) if is_lower else min(damping * factor, largest)
