"""Laboratory files other than plain CSV: gzip, workbooks, blank-separated, oscilloscopes."""

from __future__ import annotations

import codecs
import gzip
import io
import re
import warnings
import zlib
from statistics import mode

from foamfit.data.measurement import MIN_ROWS
from foamfit.errors import InputError
from foamfit.text import listed

_LARGEST = 1 << 30  # most bytes of an unpacked .gz
_FEW = 20  # number of lines used to find the positions of the columns
# First bytes, in lower case, of files other than tables.
_FOREIGN = {
    b"\xd0\xcf\x11\xe0": "an old Excel workbook (.xls)",
    b"<html": "a web page",
    b"<!doctype": "a web page",
    b"<?xml": "an XML file",
}
_TOKEN = re.compile(r"\S+")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.I | re.A)
_NAME = re.compile(r"[^\s(\[]+(?:\s?[(\[][^)\]]*[)\]])?")  # a word, with its unit in brackets
_NUMBERS = re.compile(r"\s*(?:[+-]?[\d.,]*\d[.,]?(?:e[+-]?\d+)?(?:\s+|$)){2,}", re.I | re.A)


# Headers and number of rows in the preamble of an oscilloscope file, and start and step of its
# clock, s, if the first column contains sample numbers.
Scope = tuple[list[str], int, tuple[float, float] | None]


def unpacked(raw: bytes, sheet: str | None) -> bytes:
    """Return the table in the bytes of a file: unpack a .gz, convert a sheet of an .xlsx."""
    if raw.startswith(b"\x1f\x8b"):
        try:
            raw = gzip.GzipFile(fileobj=io.BytesIO(raw)).read(_LARGEST + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"is not a complete gzip file ({error}); compress it again.") from None
        if len(raw) > _LARGEST:
            raise InputError(f"unpacks to more than {_LARGEST >> 20} MB; cut it to the test.")
    if raw.startswith(b"PK\x03\x04"):
        return _sheet(raw, sheet)
    for start, what in _FOREIGN.items():
        if raw[:100].lstrip(codecs.BOM_UTF8 + b" \r\n\t").lower().startswith(start):
            raise InputError(f"is {what}; open it in a spreadsheet and save it as CSV or .xlsx.")
    if sheet is not None:
        raise InputError("is not an Excel workbook; leave [data] sheet out.")
    return raw


def _sheet(raw: bytes, sheet: str | None) -> bytes:
    """Return a sheet of a workbook as tab-separated text."""
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # openpyxl on styles
            sheets = pd.read_excel(io.BytesIO(raw), sheet_name=None, header=None, dtype=object)
    except ImportError:
        wrong = 'reading .xlsx needs openpyxl, which is not installed: pip install "foamfit[excel]"'
        raise InputError(wrong) from None
    except Exception as error:  # pandas raises many kinds for a ZIP that is not a workbook
        wrong = f"is not a readable Excel workbook ({error}); if it is a ZIP file, unpack it"
        raise InputError(f"{wrong}.") from None
    of_numbers = [
        str(name)
        for name, frame in sheets.items()
        if (frame.apply(pd.to_numeric, errors="coerce").notna().sum(axis=1) > 1).sum() >= MIN_ROWS
    ]
    tables = of_numbers or [*map(str, sheets)]  # numbers with decimal commas may be texts
    if sheet is None and len(tables) != 1:
        found = f"{len(tables)} sheets, {listed(map(repr, tables))}"
        raise InputError(f'has {found}; choose one by [data] sheet = "{tables[0]}".')
    name = tables[0] if sheet is None else sheet
    if name not in sheets:
        present = listed(repr(str(sheet_name)) for sheet_name in sheets)
        raise InputError(f"has no sheet {name!r} ([data] sheet); it has {present}.")
    frame = sheets[name].map(lambda cell: " ".join(cell.split()) if type(cell) is str else cell)
    return frame.to_csv(sep="\t", header=False, index=False).encode()


def scope_of(grid: list[list[str]]) -> Scope | None:
    """Parse the preamble of a Keysight, Rigol or Tektronix TDS oscilloscope; None without one."""
    rows = [cells for cells in grid[:20] if cells]
    first, second = (*rows, [], [])[:2]
    words = [cell.casefold() for cell in first]
    if len(second) > 1 and words[0] == "x-axis":
        return _with_units(["Time", *first[1:]], second), 2, None
    preamble = dict(zip(words, second, strict=False))
    numbers = [preamble.get(name, "") for name in ("start", "increment")]
    if words[:1] == ["x"] and len(second) == len(first) and all(map(_NUMBER.fullmatch, numbers)):
        start, step = map(float, numbers)
        units = ["s", *second[1 : words.index("start")]]
        return _with_units(["Time", *first[1:]], units), 2, (start, step)
    if words[:1] == ["record length"] and len(first) > 4:
        entries = {cells[0].casefold(): cells[1] for cells in rows if len(cells) > 1}
        units = [entries.get(f"{axis} units", "") for axis in ("horizontal", "vertical")]
        named = _with_units(["Time", entries.get("source", "")], units)
        return ["", "", "", *named, *first[5:]], 0, None
    return None


def _with_units(names: list[str], units: list[str]) -> list[str]:
    units = units + [""] * len(names)
    return [f"{name} ({unit})" if unit else name for name, unit in zip(names, units, strict=False)]


def blanks_as_tabs(text: str) -> str | None:
    """Replace blanks between columns by tabs; None if the text has too few rows of numbers.

    Words of the header are assigned to the column of numbers below them. If a number is missing in
    a row, the others keep their columns.
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
            splits = re.split(r"\s{2,}|\t", names.strip()), names.split(), _NAME.findall(names)
            cells = next((cut for cut in splits if len(cut) == count), _placed(line, places))
        elif 0 < len(cells) < count and _NUMBERS.fullmatch(f"{line} 0 0"):
            cells = _placed(line, places)
        out.append("\t".join(cells))
    return "\n".join(out)


def _placed(line: str, places: list[tuple[int, int]]) -> list[str]:
    """Assign each word of a line to the nearest column; all if one is above several columns."""
    cells: list[list[str]] = [[] for _ in places]
    for word in _TOKEN.finditer(line):
        gaps = [max(start - word.end(), word.start() - end) for start, end in places]
        if sum(gap < 0 for gap in gaps) > 1:
            return line.split()
        cells[gaps.index(min(gaps))].append(word[0])
    return [" ".join(cell) for cell in cells]
