"""Imported by the fork server of a batch: what each job would import or load by itself, which takes two seconds."""

from __future__ import annotations

from collections import deque

from v3d_torch.runtime.imports import quick_imports

with quick_imports():
    import v3d_torch.batch.run_job
    import v3d_torch.runs.results  # noqa: F401 - with the libraries for tables and figures
    from v3d_torch.kernels.compiler import compile_kernels

deque(compile_kernels(), maxlen=0)
