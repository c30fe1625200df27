"""Formatting of numbers, lists and lines for readers."""

import math

import pytest

import fabricated
from foamfit import text as t
from foamfit.report.render import in_unit, readable


def ranged(low: float, high: float, unit: str = "Pa") -> str:
    p = fabricated.estimate("s1_k0", high / 2.0, unit=unit, range=(low, high))
    return readable("s1_k0", p).range


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (t.engineering(3.839e6, "Pa"), "3.839 MPa"),
        (t.engineering(-1.735e-18, "m"), "−1.735e−09 nm"),
        (t.engineering(999960.0, "Pa"), "1 MPa"),
        (t.engineering(0.0, "m"), "0 m"),
        (t.engineering(-2e-6, "m"), "−2 µm"),
        (t.engineering(1e12, "Pa"), "1000 GPa"),
        (t.engineering(72000.0, "s"), "72000 s"),
        (t.engineering(12345.0, "m/s²"), "12.35 km/s²"),
        (t.engineering(0.593, "m/s"), "0.593 m/s"),
        (t.engineering(-410.0, "Pa", 6214.0), "−0.4 ± 6.2 kPa"),
        (in_unit((1.7e4, 1.7e11), "Pa"), "17.00 kPa to 170.0 GPa"),
        (ranged(1.7e4, 1.7e11), "17 kPa to 170 GPa"),
        (ranged(0.042, 0.1, ""), "0.042 to 0.10"),
        (ranged(8.9e-5, 230.0, "Pa s"), "0 to 230"),
        (t.times(1234.5), "1,230"),
        (t.number(0.0123), "0.01230"),
        (t.number(-1.2e-7), "−1.200e−07"),
        (t.number(math.nan), "–"),
        (t.significant(138.4), "140"),
        (t.significant(9.97), "10"),
        (t.significant(1.2e-5), "0.000012"),
        (t.percent(1.384), "140 %"),
        (t.percent(1e-9), "less than 0.001 %"),
        (t.signed(1.23, 1), "+1.2"),
        (t.signed(-0.31, 1), "−0.3"),
        (t.signed(-0.04, 1), "0.0"),
        (t.counted(1, "sample"), "1 sample"),
        (t.counted(0, "sample"), "0 samples"),
        (t.listed("a"), "a"),
        (t.listed("abc"), "a, b and c"),
    ],
)
def test_numbers_and_lists(made: str, text: str) -> None:
    assert made == text


def test_lines_keep_their_width_and_their_words() -> None:
    text = "word " * 60
    lines = t.wrapped(text)
    assert " ".join(lines).split() == text.split()
    assert max(map(len, lines)) <= t.WIDTH
    assert all(line.startswith("  word") for line in lines[1:])
    # No line begins with the % sign of a number.
    assert t.wrapped("a spread of 4.1 % to 20 %", width=15) == ["a spread of", "  4.1 % to 20 %"]
    lines = t.labelled([("done", text), ("", "end")]).splitlines()
    assert lines[1].startswith(" " * 12 + "word")
    assert lines[-1] == " " * 10 + "end"


@pytest.mark.parametrize(("columns", "most"), [("200", 100), ("80", 80), ("3", 40)])
def test_text_and_tables_fit_the_terminal(
    columns: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Columns that do not fit follow below, again next to the first column."""
    monkeypatch.setenv("COLUMNS", columns)
    rows = [["parameter", *"abcdefghij"], *([name, *["1234567 MPa"] * 10] for name in ("k0", "kc"))]
    lines = t.aligned(rows)
    assert max(map(len, [*lines, *t.wrapped("word " * 60)])) <= most
    assert sum(line.count("1234567 MPa") for line in lines) == 20
    assert all(line.startswith(("parameter", "k0", "kc")) for line in lines if line)


@pytest.mark.parametrize(("systematic", "shown"), [(7.6e-4, ""), (7.6e4, "0.076")])
def test_a_systematic_error_of_the_size_of_rounding_is_not_shown(systematic, shown):
    estimate = fabricated.estimate("s1_k0", 3.8e6, unit="Pa", systematic=systematic)
    assert readable("s1_k0", estimate).systematic == shown
