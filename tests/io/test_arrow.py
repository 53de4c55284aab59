"""Arrow arrays: equal to those of pyarrow, in the same bytes, and made without pandas."""

from __future__ import annotations

import subprocess
import sys
from io import BytesIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from v3d_torch.io.arrow import to_arrow

LENGTHS = st.integers(0, 40)
SETTINGS = settings(deadline=None)  # the first expected array imports pandas


def stored(array: pa.Array) -> bytes:
    file = BytesIO()
    pq.write_table(pa.table({"column": array}), file)
    return file.getvalue()


def assert_same(found: pa.Array, expected: pa.Array) -> None:
    found.validate(full=True)
    assert found.type == expected.type and found.null_count == 0
    assert stored(found) == stored(expected)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64, np.bool_])
@SETTINGS
@given(data=st.data())
def test_numbers_and_truth_values_equal_those_of_pyarrow(dtype: type, data: st.DataObject) -> None:
    """NaN is a number, and no missing value. Columns of a matrix are not contiguous."""
    values = data.draw(arrays(dtype, st.tuples(LENGTHS, st.just(2))))
    assert_same(to_arrow(values[:, 1]), pa.array(values[:, 1]))


@SETTINGS
@given(texts=st.lists(st.text(st.characters(exclude_categories=["Cs"])), max_size=40))
def test_texts_equal_those_of_pyarrow(texts: list[str]) -> None:
    assert_same(to_arrow(texts), pa.array(texts, pa.string()))


def test_pandas_is_not_imported() -> None:
    code = """
import io, sys, numpy, pyarrow, pyarrow.parquet
from v3d_torch.io.arrow import to_arrow
table = pyarrow.table({"numbers": to_arrow(numpy.arange(3)), "texts": to_arrow(["a", "", "b"])})
pyarrow.parquet.write_table(table, io.BytesIO())
print("pandas" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout == "False\n"
