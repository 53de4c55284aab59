"""Writes docs/modules.md: which dtypes, devices and transforms of torch each public function of tensors supports.

Every cell is measured by running the function, see tests/helpers/module_table.py. This takes about a minute.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "modules.md"

HEAD = """<!-- Written by docs/write_modules.py, which runs every function. -->
# Functions of tensors

These functions, and the modules that call them, run on the device of their inputs and return their dtype, float32 for
integers. `docs/write_modules.py` measures the table by running each of them on a small batch; a test compares the page
with it.

| column | the function |
|---|---|
| `float64` to `bfloat16` | returns the result of float64 for the same inputs, up to the precision of the dtype |
| `meta` | returns the shapes and dtypes without values |
| other device | runs on fake tensors of a device other than the CPU; constants and results stay on that device |
| no synchronisation | runs there without copying a value to the CPU, for which a GPU would have to wait |
| `compile` | is captured by `torch.compile(fullgraph=True)`, with the same result and gradients |
| `export` | is captured by `torch.export.export`, with the same result |
| `vmap` | returns the same rows if `torch.func.vmap` maps it over the batch |
| `grad`, `jacrev` | has the same gradients with `torch.func` as with `torch.autograd` |

A number refers to a reason below the table; `-` means that the result has no gradients.

"""

TAIL = """
Half precision is computed in float32 or float64; costs, chi-square values and information, which can exceed its range,
are returned in float32. Inside `torch.autocast`, the results are the same as outside.

Under `compile`, `export` and `vmap`, and on other devices, the torch functions run instead of compiled kernels and
libraries for the CPU. Three of them then differ: `voxel_pool` returns as many voxels as points, with a mask;
`essential_ransac` and `pnp_ransac` take hypotheses from other solvers, so that the table compares only shapes and
dtypes of their results. The table was measured without a GPU.

`torch.jit.trace`, which the older exporter to ONNX uses, records the torch functions, too, but only for the sizes of
its example. It raises an `InputError` for `dbscan`, `match_descriptors` and `ate`. Use `torch.export` where possible.

The other public functions and classes take maps, sequences, frames or files, not only tensors: they run on the CPU.
"""


def page() -> str:
    """Return the text of the page, for which every function is run."""
    sys.path.insert(0, str(ROOT / "tests"))
    from helpers.module_table import CASES_BY_FUNCTION, COLUMNS, measure

    reasons: list[str] = []
    rows = []
    for name in CASES_BY_FUNCTION:
        cells = []
        for column in COLUMNS:
            cell = measure(name, column)
            if cell not in ("yes", "-"):
                if cell not in reasons:
                    reasons.append(cell)
                cell = f"({reasons.index(cell) + 1})"
            cells.append(cell)
        rows.append(f"| `{name.partition(',')[0]}`{''.join(name.partition(',')[1:])} | {' | '.join(cells)} |\n")
    table = f"| function | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}\n" + "".join(rows)
    return HEAD + table + "\n" + "".join(f"{k}. {reason}\n" for k, reason in enumerate(reasons, 1)) + TAIL


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
