"""Evaluation of trajectories: `evaluate` gives what the paper's tables hold."""

from __future__ import annotations

from v3d_torch.evaluation.ate import Alignment
from v3d_torch.evaluation.report import Evaluation, evaluate

__all__ = ["Alignment", "Evaluation", "evaluate"]
