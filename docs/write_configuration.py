"""Writes docs/configuration.md from the schema of the configuration: every value with type, default and description."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCHEMA = ROOT / "v3d_torch" / "config" / "schema.py"
PAGE = ROOT / "docs" / "configuration.md"

HEAD = """<!-- Written by docs/write_configuration.py from v3d_torch/config/schema.py. -->
# Configuration

Every value has a default, a unit and a reason. A YAML file lists the values to change:

```yaml
objects:
  voting:
    distance_threshold: 0.08
segmentation:
  model: yolo11n-seg
```

`--config my.yaml` reads it, `--set objects.voting.distance_threshold=0.08` changes a single value. The package has
named configurations: `full` (the default), `realtime`, `paper`, `baseline`, and the variants of the
[ablation study](commands/ablate.md). Unknown keys are rejected, and the message names the nearest one. Each run writes
its whole configuration to `config.yaml`.

::: v3d_torch.config.loading.load_config
"""

TAIL = """
## In Python
::: v3d_torch.config.schema
    options:
      show_root_heading: false
      show_signature: false
      show_docstring_attributes: false
      filters: ["!^model_config$", "!^_", "!^Section$"]
      show_labels: false
"""


def page() -> str:
    """Return the text of the page."""
    classes = {
        node.name: node for node in ast.parse(SCHEMA.read_text(encoding="utf-8")).body if isinstance(node, ast.ClassDef)
    }
    return HEAD + "".join(sections(classes, "Config", "")) + TAIL


def sections(classes: dict[str, ast.ClassDef], name: str, path: str) -> Iterator[str]:
    """Yield a table for a section of the configuration, then those of its subsections."""
    node = classes[name]
    rows, subsections = [], []
    for field, docstring in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(field, ast.AnnAssign):
            continue
        kind, key = ast.unparse(field.annotation), ast.unparse(field.target)
        if kind in classes:
            subsections.append((kind, f"{path}{key}."))
            continue
        text = ast.literal_eval(docstring.value) if isinstance(docstring, ast.Expr) else ""
        rows.append(f"| `{path}{key}` | `{default(field.value)}` | {re.sub(chr(10) + ' *', ' ', text)} |")
    title = path.removesuffix(".") or "General"
    head = ast.get_docstring(node) or ""
    if rows:
        yield f"\n## {title}\n{head}\n\n| key | default | meaning |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    for kind, prefix in subsections:
        yield from sections(classes, kind, prefix)


def default(value: ast.expr | None) -> str:
    """Return the default of a field as it is written in YAML."""
    literal = ast.literal_eval(value.args[0] if isinstance(value, ast.Call) else value or ast.Constant(None))
    if literal is None:
        return "null"
    if isinstance(literal, bool):
        return str(literal).lower()
    return str(list(literal) if isinstance(literal, tuple) else literal)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
