"""A text file as a table: its encoding, separator, decimal sign and headers, and its numbers."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.data.headers import CHANNELS, Header, parse_header
from foamfit.data.measurement import MIN_ROWS
from foamfit.data.toml_file import LONGEST, read_bytes
from foamfit.data.units import is_unit
from foamfit.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_HEAD_ROWS = 400
_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?)", re.IGNORECASE | re.ASCII
)


@dataclass(frozen=True)
class Text:
    """The text of a file: its bytes without a mark, their encoding, and the digest of the file."""

    path: Path
    raw: bytes
    encoding: str
    sha256: str


@dataclass(frozen=True)
class Table(Text):
    """The text of a file, and where its numbers are, before they are read."""

    separator: str
    decimal: str
    header_row: int
    header_cells: tuple[str, ...]  # as they stand in the file
    first_row: int  # rows above the numbers
    headers: tuple[Header, ...]

    @property
    def listed(self) -> str:
        """The headers, in quotation marks."""
        return ", ".join(repr(h.text) for h in self.headers if h.text)

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield (row number in the file, cells) of the rows that are not blank."""
        file = io.BytesIO(self.raw)
        lines = io.TextIOWrapper(file, self.encoding, errors="replace", newline="")
        for number, cells in _cells(self.path, lines, self.separator):
            if number > self.first_row and any(cell.strip() for cell in cells):
                yield number, cells

    def body(self) -> bytes:
        """Return the rows below the header."""
        return self.raw.split(b"\n", self.first_row)[-1] if self.first_row else self.raw

    def row_numbers(self, count: int) -> NDArray[np.int64]:
        """Return the row numbers in the file of its `count` samples."""
        body = self.body().rstrip()
        if body.count(b"\n") + 1 == count:  # without a blank line
            return np.arange(count, dtype=np.int64) + self.first_row + 1
        return np.fromiter((number for number, _ in self.rows()), np.int64, count)

    def empty_rows(self) -> NDArray[np.int64]:
        """Return the numbers of the rows that have separators, but nothing between them."""
        empty = re.compile(rb'[\s"%s]+' % re.escape(self.separator).encode())
        lines = self.body().split(b"\n")
        found = [i for i, line in enumerate(lines) if line.strip(b"\r") and empty.fullmatch(line)]
        return np.array(found, dtype=np.int64) + self.first_row + 1


def read_text(path: Path, wanted: str) -> Text:
    """Read a file as text; `wanted` says what the path must be."""
    raw = read_bytes(path, f"give {wanted}")
    sha256 = hashlib.sha256(raw).hexdigest()
    if not raw.strip():
        raise InputError(f"{path}: the file is empty; it must hold a header and rows of numbers.")
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raw = raw.decode("utf-16", errors="replace").encode()
    raw = raw.removeprefix(codecs.BOM_UTF8)
    if b"\n" not in raw:
        raw = raw.replace(b"\r", b"\n")
    if b"\0" in raw:
        raise InputError(f"{path}: is a binary file; it must be a text table (CSV).")
    try:
        raw.decode()
    except UnicodeDecodeError:
        return Text(path, raw, "latin-1", sha256)
    return Text(path, raw, "utf-8", sha256)


def find_table(text: Text, names: set[str]) -> Table:
    """Find separator, header row and decimal sign; `names` are column names given in the TOML."""
    path, lines = text.path, io.TextIOWrapper(io.BytesIO(text.raw), text.encoding, newline=None)
    head = [line.rstrip("\r\n") for line, _ in zip(lines, range(_HEAD_ROWS), strict=False)]
    separator, grid, i = _header_row(path, head, names)
    above = [k for k, cells in enumerate(grid[:i], 1) if _holds_numbers(cells)]
    if len(above) >= MIN_ROWS:
        where = f"rows {above[0]} to {above[-1]} hold numbers above the header in row {i + 1}"
        raise InputError(f"{path}: {where}; a file must hold one table with one header.")
    for k, n in enumerate(map(len, grid[i]), 1):
        if n > LONGEST:
            many = f"row {i + 1}: the name of column {k} has {n} characters"
            raise InputError(f"{path}: {many}; it must have {LONGEST} at most.")
    first, texts = _unit_row(grid, i)
    headers = tuple(map(parse_header, texts))
    body = [cells for cells in grid[first:] if any(c.strip() for c in cells)]
    if not body:
        raise InputError(f"{path}: has a header in row {i + 1} but no rows of numbers below it.")
    decimal = _decimal_sign(path, body, len(texts), separator)
    cells, whole = tuple(cell.strip() for cell in grid[i]), (path, text.raw, text.encoding)
    return Table(*whole, text.sha256, separator, decimal, i + 1, cells, first, headers)


def _cells(path: Path, lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the last line of each row, and its cells."""
    reader = csv.reader(lines, delimiter=separator)
    try:
        for cells in reader:
            yield reader.line_num, cells
    except csv.Error:
        cell = f"row {reader.line_num} has a cell of more than {csv.field_size_limit()} characters"
        raise InputError(f"{path}: {cell}; the file must be a text table (CSV).") from None


def _header_row(path: Path, lines: list[str], names: set[str]) -> tuple[str, list[list[str]], int]:
    """Separator, cells and place of the row that names most channels."""
    best: tuple[int, str, list[list[str]], int] = (0, ",", [], 0)
    for separator in ("\t", ";", ","):
        grid, numbers = [cells for _, cells in _cells(path, lines, separator)], False
        for i, cells in enumerate(grid):
            # On a tie the last row wins: titles and instrument settings stand above the header.
            # Below rows of numbers it is another header, which `_refuse_cells` will meet.
            score = _score(cells, names)
            if score > best[0] or (score and score == best[0] and not numbers):
                best, numbers = (score, separator, grid, i), False
            numbers = numbers or _holds_numbers(cells)
    if not best[0]:
        example = "time (ms), stress (MPa), displacement (mm)"
        raise InputError(f"{path}: no row names the columns; the first must be like '{example}'.")
    return best[1:]


def _score(cells: list[str], names: set[str]) -> int:
    """How many channels and given names a row holds; 0 for a row with numbers."""
    if len(cells) < 2 or any(map(_is_number, cells)):
        return 0
    headers = [parse_header(cell) for cell in cells if cell.strip()]
    channels = {c for c in CHANNELS for h in headers if h.rank(c) is not None}
    return len(channels) + len({n for n in names for h in headers if h.is_named(n)})


def _is_number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell.strip().replace(",", ".")) is not None


def _holds_numbers(cells: list[str]) -> bool:
    """Whether a row is one of numbers: two at least, and nothing else."""
    full = [cell for cell in cells if cell.strip()]
    return len(full) > 1 and all(map(_is_number, full))


def _decimal_sign(path: Path, body: list[list[str]], width: int, separator: str) -> str:
    """Comma or point; where the comma separates cells too, the numbers stand in quotation marks."""
    values = [value.strip() for row in body for value in row[:width]]
    commas = [v for v in values if re.fullmatch(r"[+-]?\d*(?:,\d+)+(?:[eE][+-]?\d+)?", v)]
    if not commas or separator != ",":
        return "," if commas else "."
    thousands = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
    if all(thousands.fullmatch(v) for v in commas):
        raise InputError(
            f"{path}: {commas[0]!r} may have a decimal comma or a separator of thousands; "
            "write the numbers with a decimal point and without separators."
        )
    points = sum("." in v and _is_number(v) for v in values)
    return "," if len(commas) > points else "."


def _unit_row(grid: list[list[str]], i: int) -> tuple[int, list[str]]:
    """First row of numbers, and the headers with the units of the row beneath, if there is one."""
    texts = list(grid[i])
    below = [cell.strip().strip("()[]") for cell in grid[i + 1]] if i + 1 < len(grid) else []
    units = [cell for cell in below if cell]
    known = [unit for unit in units if is_unit(unit, any_case=True) and not _is_number(unit)]
    if not known or 2 * len(known) < len(units) or any(map(_is_number, units)):
        return i + 1, texts
    for k, unit in enumerate(below[: len(texts)]):
        if unit and texts[k].strip() and parse_header(texts[k]).unit is None:
            texts[k] = f"{texts[k].strip()} ({unit})"
    return i + 2, texts


def read_numbers(
    table: Table, columns: dict[str, int]
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Read columns as they stand in the file, and the numbers of rows that are left out as empty.

    InputError names the first cell that is no number.
    """
    empty = np.zeros(0, dtype=np.int64)
    try:
        frame = _frame(table, columns, table.body())
    except ValueError as error:
        _refuse_cells(table, columns)
        empty = table.empty_rows()
        if not empty.size:
            raise InputError(f"{table.path}: is no regular table ({error}).") from None
        lines = table.body().split(b"\n")
        for number in empty:
            lines[number - table.first_row - 1] = b""
        frame = _frame(table, columns, b"\n".join(lines))
    numbers = {c: frame[str(k)].to_numpy(np.float64) for c, k in columns.items()}
    too_many = frame[str(len(table.headers))].astype(bool).any()
    if too_many or not all(np.isfinite(values).all() for values in numbers.values()):
        _refuse_cells(table, columns)
    return numbers, empty


def _frame(table: Table, columns: dict[str, int], body: bytes) -> pd.DataFrame:
    """Parse rows of numbers; the columns have their places as names."""
    import pandas as pd

    # A header of our own, with one column more: that one shows if any row has too many cells.
    excess = len(table.headers)
    header = table.separator.join(map(str, range(excess + 1))).encode()
    kinds = {str(k): "float64" for k in columns.values()}
    return pd.read_csv(  # its ParserError is a ValueError
        io.BytesIO(header + b"\n" + body),
        sep=table.separator,
        decimal=table.decimal,
        encoding=table.encoding,
        usecols=[*kinds, str(excess)],
        dtype=kinds | {str(excess): "str"},
        na_filter=False,
        index_col=False,
    )


def _refuse_cells(table: Table, columns: dict[str, int]) -> None:
    """Find the first bad cell, row by row, and name it."""
    count = len(table.headers)
    for row, cells in table.rows():
        where = f"{table.path}: row {row}"
        if tuple(cell.strip() for cell in cells) == table.header_cells:
            again = f"repeats the header of row {table.header_row}"
            raise InputError(f"{where} {again}; a file must hold one table with one header.")
        if any(cell.strip() for cell in cells[count:]):
            many = f"has {len(cells)} cells, but the header has {count}"
            raise InputError(f"{where} {many}; every row must have as many as the header.")
        for k in columns.values():
            cell = cells[k].strip() if k < len(cells) else ""
            wrong = _wrong(cell, table.decimal)
            if wrong:
                raise InputError(f"{where}, column {table.headers[k].text!r} is {wrong}.")


def _wrong(cell: str, decimal: str) -> str:
    """Say what is wrong with a cell, and what would be right; nothing if it is a number."""
    if not cell:
        return "empty; every sample must have a number there"
    if decimal == "," and "." in cell and _is_number(cell):
        return f"{cell!r}, but others have a decimal comma; all must have the same decimal sign"
    text = cell.replace(",", ".") if decimal == "," else cell
    if not _NUMBER.fullmatch(text):
        plain = re.sub(r"(?<=\d)[_' ,\u2009\u202f](?=\d{3})", "", cell)  # digits in groups
        hint = f" without separators, {plain}" if plain != cell and _is_number(plain) else ""
        shown = repr(cell if len(cell) <= LONGEST else cell[:LONGEST] + " …")
        return f"{shown}; it must be a number{hint}"
    return "" if math.isfinite(float(text)) else f"{cell!r}; it must be a finite number"
