"""Formatting of numbers and sentences for all output that people read."""

from __future__ import annotations

import math
import re
import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal

# Line length, characters: that of the terminal, within these limits.
WIDTH, NARROWEST = 100, 40
ASKED = "Check:"  # starts a note about a probable error in the input
COLUMN = 10  # column in which the text after a label begins
_NO_BREAK = "\u00a0"  # no-break space
_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}
# Prefixes that are usual before a unit: no one says 7.2 ks or 593 mm/s.
_USUAL = {"Pa": "GMk", "J/m³": "GMk", "Hz": "GMk", "N": "Mkm", "g": "kmµ", "s": "mµn", "m": "mµn"}
# Names of a unit for large and small numbers, with their factors, the largest first.
UNITS = {
    unit: sorted(((_PREFIXES[one], one + unit) for one in ("", *prefixes)), reverse=True)
    for unit, prefixes in _USUAL.items()
}
UNITS["kg"] = [(1e-3 * factor, name) for factor, name in UNITS["g"]]
UNITS["m/s^2"] = UNITS["m/s²"] = [(1e3, "km/s²"), (1.0, "m/s²")]
UNITS["Pa s"] = [(1.0, "Pa·s")]


def readable_unit(size: float, unit: str) -> tuple[float, str]:
    """Return factor and name of a suitable unit for numbers up to `size`, which is given in `unit`.

    A unit that is not in `UNITS` is kept.
    """
    scales, size = UNITS.get(unit, [(1.0, unit)]), abs(size) or 1.0
    return next((scale for scale in scales if size >= scale[0]), scales[-1])


def engineering(value: float, unit: str, error: float = 0.0) -> str:
    """Write a value with four digits and a prefix: 3.839e6, "Pa" gives "3.839 MPa".

    With a standard error both are rounded to two digits of it: "3.839 ± 0.012 MPa". Far below the
    smallest prefix the number has an exponent.
    """
    factor, name = readable_unit(float(f"{max(abs(value), error):.3e}"), unit)
    plain = value == 0.0 or abs(value) >= 1e-3 * factor
    shown = significant(value / factor, 4).replace("-", "−") if plain else number(value / factor)
    if error:
        shown = " ± ".join(with_error(value / factor, error / factor)[:2])
    return f"{shown} {name}".rstrip()


def with_error(value: float, stderr: float) -> tuple[str, str, int]:
    """Return value and standard error to two digits of the error, and the number of decimals."""
    places = 1 - math.floor(math.log10(float(f"{stderr:.1e}")))
    most = 6 - math.floor(math.log10(abs(value))) if value else 6
    if places > most:  # tiny error, as with synthetic data: seven digits are enough
        return fixed(value, most), f"{stderr:.1e}", most
    return fixed(value, places), fixed(stderr, places), places


def fixed(value: float, places: int) -> str:
    """Write a number with some decimals, and zero without a sign."""
    shown = f"{round(value, places):.{max(places, 0)}f}"
    return (shown.lstrip("-") if float(shown) == 0 else shown).replace("-", "−")


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with some digits, or all those of an integer, and a true minus sign.

    None and numbers that are not finite become "–".
    """
    if value is None or not math.isfinite(value):
        return "–"
    if isinstance(value, int):
        return str(value)
    shown = f"{value:.{digits - 1}e}"
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        exponent = int(shown.partition("e")[2]) if value else digits  # 999.96 is 1000, not 1000.0
        shown = f"{value:.{max(0, digits - 1 - exponent)}f}"
    return shown.replace("-", "−")


def times(ratio: float) -> str:
    """Write a ratio with three digits and no exponent: "0.770", "1,230"."""
    return f"{Decimal(f'{ratio:#.3g}'):,f}" if math.isfinite(ratio) else str(ratio)


def significant(value: float, digits: int = 2) -> str:
    """Write a number with a few significant digits and no exponent: 138.4, 2 gives "140"."""
    rounded = f"{value:.{digits}g}"
    return f"{Decimal(rounded):f}" if math.isfinite(value) else rounded


def rounded(value: float, within: float) -> str:
    """Write a number with three digits, or more to keep it within a relative difference."""
    for decimals in range(2, 11):
        near = f"{value:.{decimals}e}"
        if abs(float(near) - value) <= within * abs(value):
            break
    return f"{Decimal(near):f}" if value else "0"


def percent(share: float, digits: int = 2) -> str:
    """Write a fraction as a percentage with a few significant digits: 1.384 gives "140 %"."""
    if 0.0 < abs(share) < 1e-5:
        return "less than 0.001 %"
    return f"{significant(100.0 * share, digits)} %"


def signed(value: float, decimals: int) -> str:
    """Write a difference with its sign, and zero without one: "+1.2", "−0.3", "0.0"."""
    shown = f"{value:+.{decimals}f}"
    return shown[1:] if float(shown) == 0.0 else shown.replace("-", "−")


def field(value: float | str, width: int = 10) -> str:
    """Write a number right-aligned in a field of fixed width that begins with a blank."""
    for digits in range(9, 0, -1):
        text = value if isinstance(value, str) else f"{value:.{digits}G}"
        text += ".0" if isinstance(value, float) and text.lstrip("-").isdigit() else ""
        if len(text) < width:
            return text.rjust(width)
    raise ValueError(f"{value} has no room in {width} columns")


def counted(count: int, noun: str) -> str:
    """Write a count with its noun: "1 sample", "3 samples"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def listed(items: Iterable[str]) -> str:
    """Write a list: "a", "a and b", "a, b and c"."""
    *others, last = items
    return f"{', '.join(others)} and {last}" if others else last


def option_value(value: object) -> str:
    """Write the value of an option: "1.5", "s1_eta=0,s1_k0=6e+07"."""
    if isinstance(value, Mapping):
        return ",".join(f"{key}={option_value(one)}" for key, one in sorted(value.items()))
    if isinstance(value, list):
        return ",".join(map(option_value, value))
    short = isinstance(value, float) and float(f"{value:g}") == value
    return f"{value:g}" if short else str(value)


def warning(text: str) -> str:
    """Write a warning with its label, which replaces the word with which a note asks to check."""
    return f"warning: {text.removeprefix(ASKED).lstrip()}"


def line_width() -> int:
    """Return the line length of the terminal; `WIDTH` at most, and without a terminal."""
    return max(min(shutil.get_terminal_size((WIDTH, 24)).columns, WIDTH), NARROWEST)


def wrapped(text: str, indent: int = 2, width: int | None = None) -> list[str]:
    """Wrap a paragraph; all lines but the first are indented by `indent` spaces.

    A line never begins with the % sign of a number.
    """
    width = width or line_width()
    whole = re.sub(r"(?<=\d) %", f"{_NO_BREAK}%", text)
    lines = textwrap.wrap(whole, width, subsequent_indent=" " * indent)
    return [line.replace(f"{_NO_BREAK}%", " %") for line in lines]


def aligned(
    rows: Sequence[Sequence[str]],
    gap: str = "  ",
    right: Iterable[int] = (),
    most: int | None = None,
) -> list[str]:
    """Align rows of cells as a table; the first row is the header.

    Columns whose indices are in `right` are right-aligned, all others left-aligned. Columns that do
    not fit into `most` characters, by default the line, follow in a second table, which repeats
    the first column.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    right, blocks, most = set(right), [[0]], most or line_width()
    for i, width in enumerate(widths[1:], start=1):
        taken = sum(widths[j] + len(gap) for j in blocks[-1])
        if taken + width > most and len(blocks[-1]) > 1:
            blocks.append([0])
        blocks[-1].append(i)
    lines = list[str]()
    for block in blocks:
        lines += [""] if lines else []
        for row in rows:
            cells = (f"{row[i]:{'>' if i in right else '<'}{widths[i]}}" for i in block)
            lines.append(gap.join(cells).rstrip())
    return lines


def labelled(items: Iterable[tuple[str, str]]) -> str:
    """Write each label, or "", and its text, wrapped from `COLUMN` on; no final newline."""
    paragraphs = (wrapped(f"{label:<{COLUMN}}{text}", COLUMN + 2) for label, text in items)
    return "\n".join(line for paragraph in paragraphs for line in paragraph)
