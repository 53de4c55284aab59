"""Types of the arrays of kernels, by the type of their elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]

Bytes = NDArray[np.uint8]

SignedBytes = NDArray[np.int8]

Words = NDArray[np.uint64]

Ints = NDArray[np.int64]

Ints32 = NDArray[np.int32]

Floats = NDArray[np.float64]

Floats32 = NDArray[np.float32]
