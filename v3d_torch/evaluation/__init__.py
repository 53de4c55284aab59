"""Evaluation of trajectories and masks: ATE, RPE, masked pixels, id switches, and the paper's tables."""

from __future__ import annotations

from v3d_torch.evaluation.ate import Alignment
from v3d_torch.evaluation.evaluation import Evaluation, evaluate

__all__ = ["Alignment", "Evaluation", "evaluate"]
