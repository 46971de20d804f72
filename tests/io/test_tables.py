"""Tables of numbers, and what is said of bad ones."""

from pathlib import Path

import numpy as np
import pytest

from vstent.errors import ReadError
from vstent.io.tables import read_columns


@pytest.mark.parametrize("text", ["time_s,flow\n0,1\n0.5,2.5\n", "0;1\r\n0.5;2.5", "\ufeff0\t1\n\n0.5\t2.5\n"])
def test_columns_are_read_whatever_parts_them(tmp_path: Path, text: str) -> None:
    path = tmp_path / "flow.csv"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_columns(path, 2), [[0, 1], [0.5, 2.5]])


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("time,flow\n0,1\nO.2,3\n1,2\n", "line 3"),
        ("0,1\nn/a,2\n1,2\n", "line 2"),
        ("O.0,1\n1,2\n", "line 1"),
        ("0,1\n1,nan\n", "line 2"),
        ("0,1\n-inf,2\n", "line 2"),
        ("0,1\n1,1e999\n", "line 2"),
        ("0,1\nthe end\n", "line 2"),
        ("0,0;1,0\n0,5;2,0\n", "decimal points"),
        ("0,1\n1,2,3\n", "line 2"),
        ("0,1\n1,x\n", "line 2"),
        ("time,flow\n", "no numbers"),
        ("", "no numbers"),
    ],
)
def test_bad_tables_are_refused_with_the_line(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "flow.csv"
    path.write_text(text)
    with pytest.raises(ReadError, match=why):
        read_columns(path, 2)
