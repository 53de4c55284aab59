"""Table of the states of the camera at each frame, without later corrections."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from v3d_torch.pipeline import RunRecord

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_LIVE = {"pose_latency": pa.float64(), "latency": pa.float64(), "dropped": pa.int64()}


def make_state_table(record: RunRecord) -> pa.Table:
    """Make the table of states: status, pose, twist, covariances; for a live run also latencies and dropped frames."""
    states, live = record.states, record.live
    T_wc, count = states["T_wc"].numpy(), len(states)
    quaternions = Rotation.from_matrix(T_wc[:, :, :3]).as_quat(canonical=True) if count else np.zeros((0, 4))
    pose = [*T_wc[:, :, 3].T, *quaternions.T]
    covariance = pa.array(states["covariance"].reshape(-1).numpy())
    columns = {
        "stamp": states["stamp"].numpy(),
        "status": pa.array(states.statuses, pa.string()),
        **dict(zip(_POSE, pose, strict=True)),
        **dict(zip(_TWIST, states["twist"].T.numpy(), strict=True)),
        "covariance": pa.FixedSizeListArray.from_arrays(covariance, 36),
        **{name: pa.array(live[name].numpy()) if len(live) else pa.nulls(count, kind) for name, kind in _LIVE.items()},
    }
    return pa.table(columns)
