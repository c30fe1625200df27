"""Formatting of numbers, lists and lines for readers."""

from __future__ import annotations

import pytest

from foamfit.text import (
    WIDTH,
    aligned,
    counted,
    engineering,
    labelled,
    listed,
    number,
    percent,
    signed,
    significant,
    wrapped,
)


def test_no_line_begins_with_the_percent_sign_of_a_number() -> None:
    lines = wrapped("a spread of 4.1 % to 20 %", width=15)
    assert lines == ["a spread of", "  4.1 % to 20 %"]


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (3.839e6, "Pa", "3.839 MPa"),
        (0.0, "m", "0 m"),
        (-2e-6, "m", "-2 µm"),
        (999.0, "Pa", "999 Pa"),
        (1e12, "Pa", "1000 GPa"),
    ],
)
def test_engineering(value: float, unit: str, text: str) -> None:
    assert engineering(value, unit) == text


def test_numbers() -> None:
    assert [number(v) for v in (0.0123, -1.2e-7, 138.4, float("nan"))] == [
        "0.01230",
        "−1.200e−07",
        "138.4",
        "–",
    ]
    assert [significant(v) for v in (138.4, 99.6, 9.97, 0.0, 1.2e-5)] == [
        "140",
        "100",
        "10",
        "0",
        "0.000012",
    ]
    assert [percent(v) for v in (1.384, 0.0023, 0.05)] == ["140 %", "0.23 %", "5 %"]
    assert percent(1e-9) == "less than 0.001 %"


def test_differences_have_a_sign() -> None:
    assert [signed(x, 1) for x in (1.23, -0.31, 0.04, -0.04)] == ["+1.2", "−0.3", "0.0", "0.0"]
    assert signed(-140.2, 0) == "−140"


def test_words() -> None:
    assert [counted(n, "sample") for n in (0, 1, 2)] == ["0 samples", "1 sample", "2 samples"]
    assert [listed(x) for x in (["a"], ["a", "b"], "abc")] == ["a", "a and b", "a, b and c"]


def test_lines_keep_their_width_and_their_words() -> None:
    text = "word " * 60
    lines = wrapped(text)
    assert " ".join(lines).split() == text.split()
    assert max(map(len, lines)) <= WIDTH
    assert all(line.startswith("  word") for line in lines[1:])
    lines = labelled([("done", [text, "end"]), ("none", [])]).splitlines()
    assert lines[0].startswith("done      word")
    assert lines[1].startswith(" " * 12 + "word")
    assert lines[-1] == " " * 10 + "end"
    assert aligned([("a", "bb"), ("ccc", "d")], right=[1]) == ["a    bb", "ccc   d"]


@pytest.mark.parametrize(("columns", "most"), [("200", 100), ("80", 80), ("44", 44), ("3", 40)])
def test_text_and_tables_fit_the_terminal(
    columns: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Columns that do not fit follow below, again next to the first column."""
    monkeypatch.setenv("COLUMNS", columns)
    rows = [["parameter", *"abcdefghij"], *([name, *["1234567 MPa"] * 10] for name in ("k0", "kc"))]
    lines = aligned(rows)
    assert max(map(len, [*lines, *wrapped("word " * 60)])) <= most
    assert sum(line.count("1234567 MPa") for line in lines) == 20
    assert all(line.startswith(("parameter", "k0", "kc")) for line in lines if line)
