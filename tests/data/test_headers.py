"""Headers of several rows, line ends, and files that look like a table but contain more or less."""

from pathlib import Path

import numpy as np
import pytest

from conftest import SPECIMEN, refused, write_lines
from foamfit.data.csv_file import read_test

T = np.linspace(0.0, 10.0, 201)
W = 4.0 * np.sin(np.pi * T / 10.0)
F = 50.0 * W
PLAIN = "time (s),force (N),displacement (mm)"
ROWS = [f"{t:.9g},{f:.9g},{w:.9g}" for t, f, w in zip(T, F, W, strict=True)]
FIRST, NAMES = "Compression of a foam, sample 3", "Time,Force,Displacement"


@pytest.mark.parametrize(
    "head",
    [
        [FIRST, "", NAMES, "s,N,mm"],
        [FIRST, "Operator,A. Person", NAMES, "(s),(N),(mm)"],
        ["Run 1,Run 1,Run 1", NAMES, "[s],[N],[mm]"],
        [NAMES, "s,N,mm", "double,double,double"],
        [NAMES, "measured,measured,measured", "s,N,mm"],
        [NAMES, "s,N,mm", "-----,-----,-----"],
        [NAMES, "s,N,mm", ",Sensor A,"],
        ["Time (s),Force,Displacement (mm)", ",N,"],
        ["s,N,mm", NAMES],
        [FIRST, "s,N,mm", NAMES],
        ['\ufeff"Time\n(s)","Force\n(N)","Displacement\n(mm)"'],
        [FIRST, '"Time\n(s)","Force\n\n(N)",Displacement / mm'],
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16-le", "utf-16-be"])
def test_a_header_may_have_several_rows(
    tmp_path: Path, head: list[str], end: str, encoding: str
) -> None:
    form = {"newline": end, "encoding": encoding}
    test = read_test(write_lines(tmp_path, [*head, *ROWS], **form))
    assert (test.rows.rows, test.rows.used) == (T.size, T.size)
    assert test.stress.max() == pytest.approx(2e6)
    assert test.displacement.max() == pytest.approx(4e-3)
    assert test.time[-1] == pytest.approx(10.0)
    broken = [*ROWS[:7], "0.35,x,1", *ROWS[8:]]
    count = sum(line.count("\n") + 1 for line in head)
    refused(write_lines(tmp_path, [*head, *broken], **form), f"row {count + 8}, column")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(512), "an old Excel workbook (.xls)"),
        (b"\n<HTML><table><tr><td>Time (s)</td></tr></table></HTML>", "a web page"),
        (b"<!DOCTYPE html>\n<p>1,2,3</p>", "a web page"),
        (b'\xef\xbb\xbf<?xml version="1.0"?>\n<Workbook>1,2,3</Workbook>', "an XML file"),
    ],
)
def test_a_workbook_in_another_format_can_be_saved_as_a_table(
    tmp_path: Path, content: bytes, what: str
) -> None:
    path = tmp_path / "test.xls"
    path.write_bytes(content)
    path.with_suffix(".toml").write_text(SPECIMEN)
    refused(path, f"is {what}; open it in a spreadsheet and save it as CSV or .xlsx.")


MINUS = [f"{t},\u2212{f},\u2212{w}" for t, f, w in zip(T, F, W, strict=True)]  # minus signs
EMPTY, BELOW = "no numbers in the columns in use", "statistics below the table"


@pytest.mark.parametrize(
    ("rows", "unused", "first", "why"),
    [
        ([*ROWS, "# end of the test", "stopped by the operator,,"], 2, 203, EMPTY),
        ([*ROWS, *(f"{t:g},," for t in (10.1, 10.2, 10.3))], 3, 203, EMPTY),
        ([*ROWS[:50], "2.475,,", *ROWS[50:]], 1, 52, EMPTY),
        ([*MINUS, "Max force,200,N"], 1, 203, "a remark below the table"),
        ([*ROWS, "Mean,100,2", "", "Std. Dev.,1,1"], 2, 203, BELOW),
        ([*MINUS, "15,100,2,mean", "max,30,200,4"], 2, 203, BELOW),  # with a column more
    ],
)
def test_rows_that_are_no_samples_are_counted(
    tmp_path: Path, rows: list[str], unused: int, first: int, why: str
) -> None:
    test = read_test(write_lines(tmp_path, [PLAIN, *rows]))
    assert (test.rows.rows, test.rows.used) == (T.size + unused, T.size)
    (item,) = test.rows.dropped
    assert (item.rows, item.first, item.why) == (unused, first, why)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["0 s,0 N,0 mm", *ROWS[1:]], "row 2, column 'time (s)' is '0 s'"),
        (["N/A,N/A,1", *ROWS[1:]], "row 2, column 'time (s)' is 'N/A'"),
        ([*ROWS[:30], "here,the,force", *ROWS[30:]], "row 32, column 'time (s)' is 'here'"),
        ([*ROWS[:30], "Max force,200,N", *ROWS[30:]], "row 32, column 'time (s)' is 'Max force'"),
        ([f"{t},NaN,{w}" for t, w in zip(T, W, strict=True)], "row 2, column 'force (N)' is 'NaN'"),
        ([f"{t},{f},n/a" for t, f in zip(T, F, strict=True)], "row 2, column 'displacement (mm)'"),
        (ROWS[:1], "fewer than 10 rows"),
    ],
)
def test_samples_that_are_not_numbers_are_refused_by_row(
    tmp_path: Path, rows: list[str], words: str
) -> None:
    refused(write_lines(tmp_path, [PLAIN, *rows]), words)
