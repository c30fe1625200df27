"""Read a text file as a table: encoding, separator, decimal sign, headers and numbers."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from foamfit.arrays import Array, Integers
from foamfit.data.measurement import MIN_ROWS, Dropped, Entry
from foamfit.data.tables.headers import CHANNELS, Header, parse_header
from foamfit.data.tables.layouts import blanks_as_tabs, scope_of, unpacked
from foamfit.data.toml_file import LONGEST, read_bytes
from foamfit.data.units import factor, is_unit
from foamfit.errors import InputError, naming

_HEAD_ROWS = 400
_SEPARATORS = "\t", ";", "|", ","
_HEADERS = 4  # most rows of a header, from its names to the numbers
_ABOVE = 40  # number of rows compared with the last row
_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?)", re.IGNORECASE | re.ASCII
)
# Names of statistics below a table, without blanks and points.
_STATISTICS = re.compile(
    "mean|average|avg|mittelwert|median|st(andar)?d(d?ev(iation)?)?|sd|standardabweichung|stabw|cv|"
    "sem|var(iance|ianz)?|min(imum)?|max(imum)?|range|count|n|sum|summe|25%|50%|75%"
)
_STATISTICS_ROWS, _FOOT = 12, 24  # most of these, and rows among which they are sought
# What programs write for a missing number
_MISSING = {"", "nan", "na", "n/a", "#n/a", "null", "none"}
# A time such as 12:00:00.5 or 3:00:00.5 PM, with or without a date before it, or in minutes and
# seconds like 59:30.5, as spreadsheets show a time with fractions of a second.
_CLOCK = re.compile(
    r"(?:(?:[\w./-]*\d[T ]+)?(\d{1,3}):)?((?(1)[0-5]\d|\d{1,3})):"
    r"([0-5]\d(?(1)(?:[.,]\d+)?|[.,]\d+))(?: ?([ap])m|Z|[+-]\d\d:?\d\d)?",
    re.IGNORECASE | re.ASCII,
)
# First bytes of UTF-16, with and without a byte order mark.
_WIDE = {b"\xff\xfe|\xfe\xff": "utf-16", b".\0": "utf-16-le", b"\0.": "utf-16-be"}
_ONE = "a file must contain one table with one header"
_NO_THOUSANDS = "write the numbers with a decimal point and without separators"


@dataclass(frozen=True)
class Text:
    """Text of a file, the digest of its bytes, and whether its encoding was guessed."""

    path: Path
    content: str
    sha256: str
    guessed: bool


@dataclass(frozen=True)
class Table(Text):
    """Layout of the table in a file, before its numbers are read.

    `header_row` is 0 in a file without headers. For `clock` see `layouts.Scope`; rows `dropped`
    from the end are not in `content`.
    """

    separator: str
    decimal: str
    header_row: int
    header_cells: tuple[str, ...]  # unchanged from the file
    first_row: int  # rows above the numbers
    headers: tuple[Header, ...]
    clock: tuple[float, float] | None = None
    dropped: tuple[Dropped, ...] = ()

    @property
    def listed(self) -> str:
        """Quoted headers, separated by commas, and a hint if they may be garbled."""
        garbled = " – if letters look wrong, save the file as UTF-8" * self.guessed
        return ", ".join(repr(h.text) for h in self.headers if h.text) + garbled

    def name(self, column: int) -> str:
        """Return a quoted header, with its number if it is not unique."""
        text = self.headers[column].text
        unique = sum(header.text == text for header in self.headers) == 1
        return repr(text) if unique else f"{text!r} (number {column + 1})"

    def period(self, column: int) -> float:
        """Return the time (s) after which a clock like 59:30.5 begins anew; 0 without colons."""
        first = next((cells[column] for _, cells in self.rows() if len(cells) > column), "")
        return (0.0, 3600.0, 86400.0)[min(first.count(":"), 2)]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield (row number in the file, cells) of the lines that are not blank."""
        for row, cells in _cells(io.StringIO(self.content, newline=""), self.separator):
            if row > self.first_row and (len(cells) > 1 or "".join(cells).strip()):
                yield row, cells

    def body(self) -> str:
        """Return the rows below the header."""
        return self.content.split("\n", self.first_row)[-1] if self.first_row else self.content


def read_text(path: Path, wanted: str, sheet: str | None = None) -> Text:
    """Read a file or a `sheet` of a workbook as text; `wanted` describes it for messages."""
    raw = read_bytes(path, f"give {wanted}")
    sha256, guessed = hashlib.sha256(raw).hexdigest(), False
    with naming(path):
        raw = unpacked(raw, sheet)
        if not raw.strip():
            raise InputError("the file is empty; it must contain a header and rows of numbers.")
        try:
            wide = next((w for start, w in _WIDE.items() if re.match(start, raw, re.DOTALL)), "")
            text = raw[: len(raw) // 2 * 2].decode(wide) if wide else raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text, guessed = _of_code_page(raw.removeprefix(codecs.BOM_UTF8)), True
        text = text.lstrip("\ufeff")  # a converted file may have several byte order marks
        text = re.sub(r"\u2212(?=[\d.,])", "-", text) if "\u2212" in text else text
        if "\0" in text:
            raise InputError("is a binary file; it must be a text table (CSV) or .xlsx.")
    content = re.sub(r"\r*\n|\r", "\n", text) if "\r" in text else text
    return Text(path, content, sha256, guessed)


def _of_code_page(raw: bytes) -> str:
    """Decode Latin-1; if that has control characters, Shift-JIS, Windows-1252 or Mac Roman."""
    text = raw.decode("latin-1")
    if not re.search(r"[\x80-\x9f]", text):
        return text
    japanese = raw.decode("cp932", "replace")
    words = "\ufffd" not in japanese and re.search(r"[\u3040-\u30ff\u4e00-\u9fff]{2}", japanese)
    if words:
        return japanese
    windows = raw.decode("cp1252", "replace")
    # The ä and ü of a Macintosh would be capitals within a word: "PrŸfzeit".
    return raw.decode("mac_roman") if re.search("[a-z][ŠŸ]", windows) else windows


def find_table(text: Text, names: set[str | int]) -> Table:
    """Find separator, header row and decimal sign; `names` are the columns in the TOML."""
    lines = io.StringIO(text.content, newline=None)
    head = [line.rstrip("\n") + "\n" for line, _ in zip(lines, range(_HEAD_ROWS), strict=False)]
    read = {s: list(_cells(head, s)) for s in _SEPARATORS}
    grids = {s: [[" ".join(c.split()) for c in row] for _, row in rows] for s, rows in read.items()}
    whole = text.path, text.content, text.sha256, text.guessed
    if scope := scope_of(grids[","]):
        named, first, clock = scope
        row, cells = (1, tuple(grids[","][0])) if first else (0, ())
        return Table(*whole, ",", ".", row, cells, first, tuple(map(parse_header, named)), clock)
    found = _header_row(grids, {n for n in names if isinstance(n, str)})
    if found is None or not any(map(_is_sample, grids[found[0]][found[1] :])):
        rows = (sum(map(_is_sample, grid)) > 2 for grid in grids.values())
        tabbed = None if any(rows) else blanks_as_tabs(text.content)
        if tabbed not in (None, text.content):
            return find_table(replace(text, content=tabbed), names)
    separator, i = found or _above_numbers(grids, names)
    grid = grids[separator]
    if i < 0:  # no header
        first = next(k for k, cells in enumerate(grid) if _is_sample(cells))
        headers = tuple(Header(f"column {k}") for k in range(1, len(grid[first]) + 1))
        decimal = _decimal_sign(grid[first:], len(headers), separator)
        above_rows = read[separator][first - 1][0] if first else 0
        return Table(*whole, separator, decimal, 0, (), above_rows, headers)
    row = read[separator][i][0]  # a cell may contain line breaks
    above = [k for k, cells in enumerate(grid[:i], 1) if _holds_numbers(cells)]
    if len(above) >= MIN_ROWS:
        wrong = f"rows {above[0]} to {above[-1]} contain numbers above the header in row {row}"
        raise InputError(f"{wrong}; {_ONE}.")
    first, texts = _unit_row(grid, i)
    body = [cells for cells in grid[first:] if any(cells)]
    if not body:
        raise InputError(f"has a header in row {row} but no rows of numbers below it.")
    decimal, headers = _decimal_sign(body, len(texts), separator), tuple(map(parse_header, texts))
    last = read[separator][first - 1][0]
    return Table(*whole, separator, decimal, row, tuple(grid[i]), last, headers)


def _cells(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the last line number and the cells of each row."""
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        for cells in reader:
            yield reader.line_num, cells
    except csv.Error:
        cell = f"row {reader.line_num} has a cell of more than {csv.field_size_limit()} characters"
        raise InputError(f"{cell}; the file must be a text table (CSV).") from None


def _header_row(grids: dict[str, list[list[str]]], names: set[str]) -> tuple[str, int] | None:
    """Return separator and index of the row that names most channels, None if none does."""
    best, found = 0, None
    # On a tie the first separator wins, so those that divide the numbers come first.
    first = sorted(grids, key=lambda separator: not any(map(_is_sample, grids[separator])))
    for separator, grid in ((separator, grids[separator]) for separator in first):
        numbers = False
        for i, cells in enumerate(grid):
            # On a tie the last row wins, as titles and instrument settings precede the header.
            # Below rows of numbers it would be a second header, which `read_numbers` rejects.
            score = _score(cells, names)
            tie = found is not None and found[0] == separator and score == best
            if score > best or (tie and not numbers):
                best, found, numbers = score, (separator, i), False
            numbers = numbers or _holds_numbers(cells)
    return found


def _above_numbers(grids: dict[str, list[list[str]]], names: set[str | int]) -> tuple[str, int]:
    """Return separator and index of the row above the numbers, -1 if that is not a header.

    Without a header, the TOML must refer to the columns by number.
    """
    for separator, grid in grids.items():
        rows = [k for k, cells in enumerate(grid) if _is_sample(cells)]
        if len(rows) < 3 or len({len(grid[k]) for k in rows[:3]}) > 1:
            continue
        above = [k for k in range(rows[0]) if sum(map(bool, grid[k])) > 1]
        if above and _units(grid[above[-1]]):
            above.pop()
        if above and above[-1] >= rows[0] - 3:
            return separator, above[-1]
        if any(isinstance(name, int) for name in names):
            return separator, -1
        channels = enumerate(("time", "force", "displacement"), 1)
        entries = ", ".join(str(Entry(c, k, CHANNELS[c].unit)) for k, c in channels)
        shown = ", ".join(grid[rows[0]])[:LONGEST]
        wrong = f"no row names the columns above row {rows[0] + 1}, {shown!r}"
        raise InputError(f"{wrong}; give their numbers in [columns], like {entries}.")
    example = "time (ms), stress (MPa), displacement (mm)"
    raise InputError(f"no row names the columns; the first must be like '{example}'.")


def _score(cells: list[str], names: set[str]) -> int:
    """Count the channels and the given names in a row; 0 for a row with numbers."""
    if len(cells) < 2 or any(map(_is_number, cells)):
        return 0
    headers = list(map(parse_header, filter(None, cells)))
    channels = {c for c in CHANNELS for h in headers if h.rank(c) is not None}
    return len(channels) + len({n for n in names for h in headers if h.is_named(n)})


def _is_number(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell.replace(",", ".")) or _CLOCK.fullmatch(cell))


def _holds_numbers(cells: list[str]) -> bool:
    """Return whether a row contains at least two numbers and nothing else."""
    filled = list(filter(None, cells))
    return len(filled) > 1 and all(map(_is_number, filled))


def _is_sample(cells: list[str]) -> bool:
    """Return whether a row may be a sample: at least two numbers, and fewer other cells."""
    return 2 * sum(map(_is_number, cells)) > max(sum(map(bool, cells)), 3)


def _decimal_sign(body: list[list[str]], width: int, separator: str) -> str:
    """Return the decimal sign; if commas also separate cells, such numbers are quoted."""
    values = [value for row in body for value in row[:width]]
    commas = [v for v in values if re.fullmatch(r"[+-]?\d*(?:,\d+)+(?:[eE][+-]?\d+)?", v)]
    if not commas or separator != ",":
        return "," if commas else "."
    thousands = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
    if all(thousands.fullmatch(v) for v in commas):
        wrong = f"{commas[0]!r} may have a decimal comma or a thousands separator"
        raise InputError(f"{wrong}; {_NO_THOUSANDS}.")
    points = sum("." in v and _is_number(v) for v in values)
    return "," if len(commas) > points else "."


def _unit_row(grid: list[list[str]], i: int) -> tuple[int, list[str]]:
    """Return the first row of numbers, and the headers with the units from a row of units.

    Units are in one of a few rows of words below the header, or in the row above it.
    """
    texts = list(grid[i])
    entries = {cells[0].casefold(): cells[1:] for cells in grid[:i] if len(cells) > 1}
    above = [*entries.get("horizontal units", [])[:1], *entries.get("vertical units", [])]
    for k, unit in enumerate(above[: len(texts)]):  # from the preamble of a Tektronix MSO
        if unit and parse_header(texts[k]).unit is None:
            texts[k] = f"{texts[k]} ({unit})"
    first = i + 1
    while first < min(len(grid), i + _HEADERS) and _is_words(grid[first]):
        first += 1
    units = next((u for u in map(_units, [*grid[i + 1 : first], *grid[i - 1 : i]]) if u), [])
    for k, unit in enumerate(units[: len(texts)]):
        own = parse_header(texts[k]).unit
        bare = own is None or not texts[k].endswith((")", "]"))
        other = bare or (is_unit(own or "") and factor(unit, own or "") not in (None, 1.0))
        if unit and texts[k] and other:
            texts[k] = f"{texts[k]} ({unit})"
    return first, texts


def _units(cells: list[str]) -> list[str]:
    """Return the units in a row that contains little else; [] for any other row."""
    units = [cell.strip("()[]") for cell in cells]
    filled = list(filter(None, units))
    known = [unit for unit in filled if is_unit(unit, any_case=True) and not _is_number(unit)]
    right = known and 2 * len(known) >= len(filled) and not any(map(_is_number, filled))
    return units if right else []


def _is_words(cells: list[str]) -> bool:
    """Return whether a row below the header still belongs to it: a rule, or words only."""
    filled = list(filter(None, cells))
    rule = re.fullmatch(r"[-=+:|\s]*[-=]{3}[-=+:|\s]*", "".join(cells)) is not None
    words = bool(filled) and not any(re.match(r"[+-]?[.,]?\d", cell) for cell in filled)
    return rule or (words and not {cell.casefold() for cell in filled} & (_MISSING | {"inf"}))


def read_numbers(
    table: Table, columns: dict[str, int]
) -> tuple[dict[str, Array], Integers, list[Dropped]]:
    """Read columns without conversion; return the numbers, their rows, and the dropped rows.

    Times like 12:00:00.5 are converted to seconds. InputError names the first cell that is not a
    number.
    """
    read, rows, dropped = _rows_of_numbers(table, columns)
    for k, values in zip(columns.values(), read, strict=True):
        _refuse_thousands(table, k, values)
        if table.clock is not None and k == 0:
            values[:] = table.clock[0] + table.clock[1] * values
    if "time" in columns and (period := table.period(columns["time"])):  # past midnight
        time = read[[*columns].index("time")]
        time[:] = np.unwrap(time, period=period)
    return dict(zip(columns, read, strict=True)), rows, dropped


def _of_header(table: Table, row: int, cells: Sequence[str]) -> list[str]:
    """Return the cells of a row, at least as many as the header has; others must be empty."""
    count = len(table.headers)
    out = [" ".join(cell.split()) for cell in cells] + [""] * (count - len(cells))
    if tuple(out) == table.header_cells:
        raise InputError(f"row {row} repeats the header of row {table.header_row}; {_ONE}.")
    if any(out[count:]):
        wrong = f"row {row} has {len(out)} cells, but the header has {count}"
        raise InputError(f"{wrong}; every row must have as many as the header.")
    return out


def _rows_of_numbers(
    table: Table, columns: dict[str, int]
) -> tuple[Array, Integers, list[Dropped]]:
    """Read the columns (k, n) row by row; see `read_numbers`.

    A row is dropped if it contains at most a time, or if it is a remark below the table. A remark
    may contain a number, as in "Max force,23,N".
    """
    numbers, rows, empty, remarks = array("d"), array("q"), list[int](), list[int]()
    places, below = list(columns.values()), list[tuple[int, InputError]]()
    measured = [k for name, k in columns.items() if name != "time"] or places
    body, width = table.body(), len(table.headers)
    # Python reads 1_000, and digits of other scripts, as numbers.
    usual = table.decimal == "." and body.isascii() and "_" not in body
    for row, cells in table.rows():
        if usual and len(cells) == width and not below:
            values = _plain_numbers(cells, places)
            if math.isfinite(sum(values)):
                numbers.extend(values)
                rows.append(row)
                continue
        cells = _of_header(table, row, cells)
        if _is_empty(row, cells, measured):
            empty.append(row)
            continue
        clock = _CLOCK.fullmatch(cells[columns["time"]]) if "time" in columns else None
        if clock is not None:
            total = repr(_seconds(*clock.groups()))
            cells[columns["time"]] = total.replace(".", table.decimal)
        wrongs = ((table.headers[k].text, _wrong(cells[k], table.decimal)) for k in places)
        if bad := next((f"{name!r} is {wrong}" for name, wrong in wrongs if wrong), None):
            below.append((row, InputError(f"row {row}, column {bad}.")))
        counts = any(_is_number(cells[k]) for k in places)
        remark = cells[0][:1].isalpha() and not _is_sample(cells)
        if below and (not bad or (counts and not remark)):
            raise below[0][1]
        if bad:
            (remarks if counts else empty).append(row)
        else:
            numbers.extend(float(cells[k].replace(",", ".")) for k in places)
            rows.append(row)
    if below and not rows:
        raise below[0][1]
    read = np.array(numbers).reshape(-1, len(places)).T.copy()
    dropped = {"no numbers in the columns in use": empty, "a remark below the table": remarks}
    return read, np.array(rows), [Dropped.of(np.array(n), why) for why, n in dropped.items() if n]


def _plain_numbers(cells: Sequence[str], places: Sequence[int]) -> list[float]:
    """Return the numbers of a row, or NaN if one of its cells is not a number."""
    try:
        return [float(cells[k]) for k in places]
    except ValueError:
        return [math.nan]


def _is_empty(row: int, cells: Sequence[str], measured: Sequence[int]) -> bool:
    """Return whether a row has no measured value; InputError if one cell has all its numbers."""
    if not all(cells[k].lower() in _MISSING for k in measured):
        return False
    filled = [cell for cell in cells if cell.lower() not in _MISSING]
    if len(filled) == 1 and _is_sample(re.split(r"[\s;|,]+", filled[0])):
        raise InputError(
            f"row {row} has its numbers in one cell, {filled[0][:LONGEST]!r}; all rows must have "
            "the separator of the header and closed quotation marks."
        )
    return True


def _seconds(hours: str | None, minutes: str, seconds: str, half: str | None) -> float:
    """Return the time of a clock in s; `half` is "a" or "p" on one of twelve hours."""
    hour = float(hours or 0) if half is None else float(hours or 0) % 12.0 + 12.0 * (half in "pP")
    return 3600.0 * hour + 60.0 * float(minutes) + float(seconds.replace(",", "."))


def _refuse_thousands(table: Table, column: int, values: Array) -> None:
    """Raise InputError if the decimal sign seems to separate thousands: 998, then 1.002."""
    size, sign = np.abs(values), table.decimal
    fractions = size[size != np.round(size)]
    if not fractions.size or fractions.min() < 1 or size.max() >= 1000:
        return
    cells = [cells[column].strip() for _, cells in table.rows() if column < len(cells)]
    whole = [cell for cell in cells if re.fullmatch(r"[+-]?[1-9]\d{1,2}", cell)]
    signed = [cell for cell in cells if sign in cell]
    if whole and all(re.fullmatch(rf"[+-]?[1-9]\d{{0,2}}\{sign}\d{{3}}", cell) for cell in signed):
        wrong = f"{signed[0]!r} with numbers like {whole[-1]!r} seems to separate thousands"
        raise InputError(f"column {table.name(column)}: {wrong}; {_NO_THOUSANDS}.")


def without_foot(table: Table) -> Table:
    """Drop statistics below the table, and an incomplete last row.

    Such a row is left when writing was interrupted. It has no line end. It has fewer cells than the
    rows above, or its last number ends in the decimal sign, or has fewer decimals while the
    `_ABOVE` rows above all have the same number.
    """
    rest, *rows = table.content.rstrip().rsplit("\n", _FOOT)
    over, foot = rest.count("\n") + 1, list[int]()  # rows over these
    while rows and over + len(rows) > table.first_row and _is_statistic(table, rows[-1]):
        foot += [over + len(rows)] * bool(rows.pop().strip())
    if 0 < len(foot) <= _STATISTICS_ROWS:  # more are a column of words
        dropped = Dropped.of(np.array(foot[::-1]), "statistics below the table")
        return replace(table, content="\n".join([rest, *rows]), dropped=(dropped,))
    above = table.body().rsplit("\n", _ABOVE)[1:]
    if len(above) < MIN_ROWS or not above[-1].strip() or '"' in above[-1]:
        return table
    *whole, last = ([c.strip() for c in line.split(table.separator)] for line in above)
    (_, sign, end), *ends = (cells[-1].partition(table.decimal) for cells in (last, *whole))
    digits, counts = {len(digits) for *_, digits in ends}, {len(cells) for cells in whole}
    point = sign and not end and not any(sign and not digits for _, sign, digits in ends)
    fewer = len(above) == _ABOVE and len(digits) == 1 and len(end) < min(digits)
    cut = len(counts) == 1 and (point or fewer or len(last) < min(counts))
    if not cut or not all(map(_is_number, last)):
        return table
    row, why = table.content.count("\n") + 1, f"the file ends within it, at {last[-1]!r}"
    shorter = table.content.removesuffix(above[-1])
    return replace(table, content=shorter, dropped=(Dropped(1, row, row, why),))


def _is_statistic(table: Table, line: str) -> bool:
    """Return whether a row is blank, or contains the name of a statistic and numbers only."""
    cells = [cell for _, row in _cells([line], table.separator) for cell in map(str.strip, row)]
    words = [cell for cell in filter(None, cells) if not _is_number(cell)]
    bare = re.sub(r"[^\w%]", "", "".join(words).casefold())
    return not any(cells) or (len(words) == 1 and _STATISTICS.fullmatch(bare) is not None)


def _wrong(cell: str, decimal: str) -> str:
    """Return the error of a cell and what would be right; "" for a valid number."""
    if not cell:
        return "empty; every sample must have a number there"
    if decimal == "," and "." in cell and _is_number(cell):
        return f"{cell!r}, but others have a decimal comma; all must have the same decimal sign"
    text = cell.replace(",", ".") if decimal == "," else cell
    if not _NUMBER.fullmatch(text):
        groups = ". " if decimal == "," else ","
        plain = re.sub(rf"(?<=\d)[_' {groups}\u2009\u202f](?=\d{{3}})", "", cell)
        hint = f" without separators, {plain}" if plain != cell and _is_number(plain) else ""
        hint += " or a time like 0:01:30.5" * (":" in cell)
        shown = repr(cell if len(cell) <= LONGEST else cell[:LONGEST] + " …")
        return f"{shown}; it must be a number{hint}"
    return "" if math.isfinite(float(text)) else f"{cell!r}; it must be a finite number"
