"""Laboratory files beyond plain CSV: compressed, workbooks, blank-separated, oscilloscopes."""

from __future__ import annotations

import gzip
import io
import re
import warnings
import zlib
from statistics import mode
from typing import NamedTuple

from foamfit.data.measurement import MIN_ROWS
from foamfit.errors import InputError
from foamfit.text import listed

_LARGEST = 1 << 30  # bytes that a .gz may unpack to
_FEW = 20  # lines of numbers that show where the columns of a table stand
_TOKEN = re.compile(r"\S+")
_NAME = re.compile(r"[^\s(\[]+(?:\s?[(\[][^)\]]*[)\]])?")  # a word, with its unit in brackets
_NUMBERS = re.compile(r"\s*(?:[+-]?[\d.,]*\d[.,]?(?:e[+-]?\d+)?(?:\s+|$)){2,}", re.I | re.A)


class Scope(NamedTuple):
    """Headers and number of rows of an oscilloscope's preamble.

    `clock` is start and step, s, where the first column counts samples.
    """

    headers: list[str]
    rows: int
    clock: tuple[float, float] | None = None


def unpacked(raw: bytes, sheet: str | None) -> bytes:
    """Return the text in the bytes of a file: of a .gz what it holds, of an .xlsx one sheet."""
    if raw.startswith(b"\x1f\x8b"):
        try:
            raw = gzip.GzipFile(fileobj=io.BytesIO(raw)).read(_LARGEST + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"is no whole gzip file ({error}); pack it again.") from None
        if len(raw) > _LARGEST:
            raise InputError(f"unpacks to more than {_LARGEST >> 20} MB; cut it to the test.")
    if raw.startswith(b"PK\x03\x04"):
        return _sheet(raw, sheet)
    if sheet is not None:
        raise InputError("is no Excel workbook; leave [data] sheet out.")
    return raw


def _sheet(raw: bytes, sheet: str | None) -> bytes:
    """Return one sheet of a workbook, its cells separated by tabs."""
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # openpyxl on styles
            sheets = pd.read_excel(io.BytesIO(raw), sheet_name=None, header=None, dtype=object)
    except ImportError:
        needs = 'reading .xlsx needs openpyxl, which is not installed: pip install "foamfit[excel]"'
        raise InputError(needs) from None
    except Exception as error:  # many kinds are raised for a ZIP that is not a workbook
        raise InputError(f"is no Excel workbook that can be read ({error}).") from None
    tables = [
        str(name)
        for name, frame in sheets.items()
        if (frame.apply(pd.to_numeric, errors="coerce").notna().sum(axis=1) > 1).sum() >= MIN_ROWS
    ]
    if sheet is None and len(tables) != 1:
        found = f"{len(tables)} sheets of numbers, {listed(map(repr, tables))}" if tables else ""
        entry = f'[data] sheet = "{next(iter(tables or map(str, sheets)))}"'
        raise InputError(f"has {found or 'no sheet of numbers'}; choose one by {entry}.")
    name = tables[0] if sheet is None else sheet
    if name not in sheets:
        there = listed(repr(str(one)) for one in sheets)
        raise InputError(f"has no sheet {name!r} ([data] sheet); it has {there}.")
    frame = sheets[name].map(lambda cell: " ".join(cell.split()) if type(cell) is str else cell)
    return frame.to_csv(sep="\t", header=False, index=False).encode()


def scope_of(grid: list[list[str]]) -> Scope | None:
    """Return what the preamble of a Keysight, Rigol or Tektronix TDS scope says, if it is one."""
    rows = [cells for cells in grid[:20] if cells]
    first, second = (*rows, [], [])[:2]
    words = [cell.casefold() for cell in first]
    if len(second) > 1 and words[0] == "x-axis":
        return Scope(_with_units(["Time", *first[1:]], second), 2)
    if words[:1] == ["x"] and "start" in words and len(second) == len(first):
        start, step = (float(second[words.index(name)]) for name in ("start", "increment"))
        names = ["Time", *first[1:]]
        units = ["s", *second[1 : words.index("start")]]
        return Scope(_with_units(names, units), 2, (start, step))
    if words[:1] == ["record length"] and len(first) > 4:
        said = {cells[0].casefold(): cells[1] for cells in rows if len(cells) > 1}
        units = [said.get(f"{axis} units", "") for axis in ("horizontal", "vertical")]
        named = _with_units(["Time", said.get("source", "")], units)
        return Scope(["", "", "", *named, *first[5:]], 0)
    return None


def _with_units(names: list[str], units: list[str]) -> list[str]:
    units = units + [""] * len(names)
    return [f"{name} ({unit})" if unit else name for name, unit in zip(names, units, strict=False)]


def blanks_as_tabs(text: str) -> str | None:
    """Put tabs between columns that blanks separate; None if there are no such rows of numbers.

    Words of the header go to the column of numbers below them; in a row that lacks a number, the
    others keep their columns.
    """
    lines = text.splitlines()
    at = [k for k, line in enumerate(lines) if _NUMBERS.fullmatch(line)]
    if len(at) < MIN_ROWS:
        return None
    few = [[(m.start(), m.end()) for m in _TOKEN.finditer(lines[k])] for k in at[:_FEW]]
    count = mode(map(len, few))
    full = [spans for spans in few if len(spans) == count]
    places = [(min(s for s, _ in col), max(e for _, e in col)) for col in zip(*full, strict=True)]
    out = []
    for k, line in enumerate(lines):
        cells = line.split()
        if k < at[0]:
            names = line.lstrip(" \t#%")
            ways = re.split(r"\s{2,}|\t", names.strip()), names.split(), _NAME.findall(names)
            cells = next((way for way in ways if len(way) == count), _placed(line, places))
        elif 0 < len(cells) < count and _NUMBERS.fullmatch(f"{line} 0 0"):
            cells = _placed(line, places)
        out.append("\t".join(cells))
    return "\n".join(out)


def _placed(line: str, places: list[tuple[int, int]]) -> list[str]:
    """Sort the words of a line into the columns that they stand in or next to."""
    cells: list[list[str]] = [[] for _ in places]
    for word in _TOKEN.finditer(line):
        gaps = [max(start - word.end(), word.start() - end, 0) for start, end in places]
        cells[gaps.index(min(gaps))].append(word[0])
    return [" ".join(cell) for cell in cells]
