"""A test file and its TOML become a `Measurement`: column names end here, SI begins.

A file holds one table, one row per sample. Its separator, its decimal sign and the row that names
the columns are found from the first lines; the unit of a channel stands in its header, in a row of
units beneath it, or in the ``[columns]`` table of the TOML. Every refusal is one sentence that
names the file and the row, column or key, and says what would be right.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import (
    Array,
    Dropped,
    Measurement,
    Striker,
    interior_channel,
    interior_node,
)
from foamfit.data.noise import with_noise
from foamfit.data.prepare import Record, condition, engineering
from foamfit.data.toml_file import Column, Settings, read_settings
from foamfit.data.units import factor, is_unit
from foamfit.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

# Channel: its SI unit, an example of a header, and the words that name it (the first one is best).
_CHANNELS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "time": ("s", "time (ms)", ("time", "t")),
    "stress": ("Pa", "stress (MPa)", ("stress", "sigma")),
    "force": ("N", "force (N)", ("force", "load", "f")),
    "displacement": ("m", "displacement (mm)", ("displacement", "disp")),
    "strain": ("", "strain (%)", ("strain", "eps", "epsilon")),
    "acceleration": ("m/s**2", "acceleration (m/s^2)", ("acceleration", "accel", "deceleration")),
    "velocity": ("m/s", "velocity (m/s)", ("velocity", "speed")),
}
# Words that name the displacement where nothing better does: a machine's travel, or a gap.
_MOTION = ("extension", "gap", "travel", "stroke", "deflection", "crosshead", "position")
_WORDS = {word for _, _, words in _CHANNELS.values() for word in words}
# With one of these beside it a channel's name means something else.
_OTHER = {"std", "sd", "dev", "error", "err", "noise", "uncertainty", "rate", "specific", "energy"}
_WEIGHTS = {"lb": "lbf", "lbs": "lbf", "kg": "kgf", "kgs": "kgf"}
# Units of the examples in refusals; the others are in mm.
_UNITS = {"time": "ms", "stress": "MPa", "force": "N", "strain": "%"}
_UNITS |= {"acceleration": "m/s^2", "velocity": "m/s"}
_MIN_ROWS = 10
_HEAD_ROWS = 400
_LONGEST = 200  # characters of a column's name


# The table: separator, headers, numbers.


@dataclass(frozen=True)
class _Header:
    """One column's header: its text, the words of its name, its unit if it has one."""

    text: str
    words: tuple[str, ...]
    unit: str | None


@dataclass(frozen=True)
class _Table:
    """Where the numbers of a file are, before they are read."""

    path: Path
    raw: bytes
    encoding: str
    separator: str
    decimal: str
    header_row: int
    header_cells: tuple[str, ...]  # as they stand in the file
    first_row: int  # rows above the numbers
    n_fields: int
    headers: tuple[_Header, ...]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield (row number in the file, cells) of the rows that are not blank."""
        lines = io.TextIOWrapper(io.BytesIO(self.raw), self.encoding, errors="replace", newline="")
        reader = csv.reader(lines, delimiter=self.separator)
        try:
            for cells in reader:
                if reader.line_num > self.first_row and any(cell.strip() for cell in cells):
                    yield reader.line_num, cells
        except csv.Error as error:
            raise InputError(f"{self.path}: row {reader.line_num}: {error}.") from None

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


def _parse_header(text: str) -> _Header:
    text = text.strip()
    if len(text) > _LONGEST:  # a title or a comment
        return _Header(text, (), None)
    bracket = re.fullmatch(r"(.*)[(\[{]([^()\[\]{}]*)[)\]}]", text)
    bracket = bracket or re.fullmatch(r"(.+) / (\S+)", text)
    if bracket:
        return _Header(text, _words(bracket[1]), bracket[2].strip())
    tokens = re.split(r"[\s_]+", text)
    for i in range(1, len(tokens)):
        rest = tokens[i:]
        if rest[0].lower() in _WORDS or rest[0].isdigit():
            continue
        unit = "/".join(token for token in rest if token.lower() != "per")  # m_s2, N_per_kg
        if is_unit(unit, any_case=True):
            return _Header(text, _words(" ".join(tokens[:i])), unit)
    return _over_unit(text) or _Header(text, _words(text), None)


def _words(name: str) -> tuple[str, ...]:
    """Words of a name, in small letters: Force(Linear:Load) has three."""
    return tuple(word for word in re.split(r"[\s_:;()]+", name.lower()) if word)


def _over_unit(text: str) -> _Header | None:
    """Header of a quantity over its unit, Time/ms; None where these two do not belong together."""
    name, _, unit = (part.strip() for part in text.partition("/"))
    header = _Header(text, _words(name), unit)
    for channel in _CHANNELS:
        if unit and _rank(header, channel) is not None and _in_si(channel, unit) is not None:
            return header
    return None


def _in_si(channel: str, unit: str, times: str = "") -> float | None:
    """SI value of one `unit` · `times` of a channel; a mass or gram can only mean a weight or g."""
    if channel == "acceleration" and unit in {"g", "G"}:
        unit = "standard_gravity"
    if channel == "force":
        unit = _WEIGHTS.get(unit.casefold(), unit)
    return factor(unit, _kind(channel)[0], times=times)


def _kind(channel: str) -> tuple[str, str, tuple[str, ...]]:
    """SI unit, example of a header and words of a channel, of displacement_1 and so on too."""
    if interior_node(channel) is None:
        return _CHANNELS[channel]
    si, _, words = _CHANNELS["displacement"]
    return si, f"{channel} (mm)", words


_WEAK = 3


def _rank(header: _Header, channel: str) -> int | None:
    """How well a header names a channel: 0 is best, None not at all."""
    words, node = _kind(channel)[2], interior_node(channel)
    numbers = [word for word in header.words if word.isdecimal()]
    if [int(number) for number in numbers] != ([] if node is None else [node]):
        return None  # displacement_1 is inside the specimen
    rest = [word for word in header.words if word not in numbers]
    if len(rest) == 1 and rest[0] in words:
        return 0 if rest[0] == words[0] else 1
    named = [w for w in rest if w in _WORDS and len(w) > 1]
    if _OTHER & set(rest) or not all(word in words for word in named):
        return None
    if named:
        return 2
    return _WEAK if channel == "displacement" and set(_MOTION) & set(rest) else None


def _channels(table: _Table, given: dict[str, Column]) -> list[str]:
    """List the channels to look for: the usual ones, then the masses inside that are named."""
    numbers = {int(w) for h in table.headers for w in h.words if w.isdecimal()}
    inside = {c for c in map(interior_channel, numbers) if interior_node(c)}
    inside |= {c for c in given if interior_node(c)}
    return [*_CHANNELS, *sorted(inside, key=lambda c: (c not in given, interior_node(c) or 0))]


def _decode(path: Path, raw: bytes) -> tuple[bytes, str]:
    """Return the bytes without their mark, and their encoding."""
    if not raw.strip():
        raise InputError(f"{path}: the file is empty; it must hold a header and rows of numbers.")
    for mark in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        if raw.startswith(mark):
            raw = raw.decode("utf-16", errors="replace").encode()
    raw = raw.removeprefix(codecs.BOM_UTF8)
    if b"\n" not in raw:
        raw = raw.replace(b"\r", b"\n")
    if b"\0" in raw:
        raise InputError(f"{path}: is a binary file; it must be a text table (CSV).")
    try:
        raw.decode()
    except UnicodeDecodeError:
        return raw, "latin-1"
    return raw, "utf-8"


_NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?)", re.IGNORECASE | re.ASCII
)


def _number(cell: str) -> bool:
    return _NUMBER.fullmatch(cell.strip().replace(",", ".")) is not None


def _find_table(path: Path, raw: bytes, encoding: str, names: set[str]) -> _Table:
    """Find separator, header row and decimal sign; `names` are column names given in the TOML."""
    lines = io.TextIOWrapper(io.BytesIO(raw), encoding, newline=None)
    head = [line.rstrip("\r\n") for line, _ in zip(lines, range(_HEAD_ROWS), strict=False)]
    best: tuple[int, int, str, list[list[str]]] = (0, 0, ",", [])
    for separator in ("\t", ";", ","):
        grid = _cells(path, head, separator)
        numbers = False
        for i, cells in enumerate(grid):
            # On a tie the last row wins: titles and instrument settings stand above the header.
            # Below rows of numbers it is another header, which `_refuse_cells` will meet.
            score = _score(cells, names)
            if score > best[0] or (score and score == best[0] and not numbers):
                best, numbers = (score, i, separator, grid), False
            numbers = numbers or _holds_numbers(cells)
    score, i, separator, grid = best
    if not score:
        example = "time (ms), stress (MPa), displacement (mm)"
        raise InputError(f"{path}: no row names the columns; the first must be like '{example}'.")
    above = [k for k, cells in enumerate(grid[:i], 1) if _holds_numbers(cells)]
    if len(above) >= _MIN_ROWS:
        raise InputError(
            f"{path}: rows {above[0]} to {above[-1]} hold numbers above the header in row {i + 1}; "
            "a file must hold one table with one header."
        )
    for k, text in enumerate(grid[i], 1):
        if len(text) > _LONGEST:
            raise InputError(
                f"{path}: row {i + 1}: the name of column {k} has {len(text)} characters; "
                f"it must have {_LONGEST} at most."
            )
    first, texts = _unit_row(grid, i)
    headers = tuple(_parse_header(text) for text in texts)
    body = [cells for cells in grid[first:] if any(c.strip() for c in cells)]
    if not body:
        raise InputError(f"{path}: has a header in row {i + 1} but no rows of numbers below it.")
    decimal = _decimal_sign(path, body, len(texts), separator)
    named = tuple(cell.strip() for cell in grid[i])
    return _Table(
        path, raw, encoding, separator, decimal, i + 1, named, first, len(texts), headers
    )  # fmt: skip


def _cells(path: Path, lines: list[str], separator: str) -> list[list[str]]:
    reader = csv.reader(lines, delimiter=separator)
    try:
        return list(reader)
    except csv.Error:
        raise InputError(
            f"{path}: row {reader.line_num} has a cell of more than {csv.field_size_limit()} "
            "characters; the file must be a text table (CSV)."
        ) from None


def _holds_numbers(cells: list[str]) -> bool:
    """Whether a row is one of numbers: two at least, and nothing else."""
    full = [cell for cell in cells if cell.strip()]
    return len(full) > 1 and all(map(_number, full))


def _decimal_sign(path: Path, body: list[list[str]], width: int, separator: str) -> str:
    """Comma or point; where the comma separates cells too, the numbers stand in quotation marks."""
    values = [value.strip() for row in body for value in row[:width]]
    commas = [v for v in values if re.fullmatch(r"[+-]?\d*(?:,\d+)+(?:[eE][+-]?\d+)?", v)]
    if not commas:
        return "."
    if separator == ",":
        thousands = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
        if all(thousands.fullmatch(v) for v in commas):
            raise InputError(
                f"{path}: {commas[0]!r} may have a decimal comma or a separator of thousands; "
                "write the numbers with a decimal point and without separators."
            )
        points = sum(1 for v in values if "." in v and _number(v))
        return "," if len(commas) > points else "."
    return ","


def _score(cells: list[str], names: set[str]) -> int:
    if len(cells) < 2 or any(_number(cell) for cell in cells):
        return 0
    headers = [_parse_header(cell) for cell in cells if cell.strip()]
    channels = {c for c in _CHANNELS for h in headers if _rank(h, c) is not None}
    given = {n for n in names for h in headers if _is_named(h, n)}
    return len(channels) + len(given)


def _is_named(header: _Header, name: str) -> bool:
    name = " ".join(name.casefold().split())
    bare = header.text.split("(")[0].split("[")[0]
    return name in {" ".join(t.casefold().split()) for t in (header.text, bare)}


def _unit_row(grid: list[list[str]], i: int) -> tuple[int, list[str]]:
    """First row of numbers, and the headers with the units of the row beneath, if there is one."""
    texts = list(grid[i])
    below = [cell.strip().strip("()[]") for cell in grid[i + 1]] if i + 1 < len(grid) else []
    units = [cell for cell in below if cell]
    known = [unit for unit in units if is_unit(unit, any_case=True) and not _number(unit)]
    if not known or 2 * len(known) < len(units) or any(_number(unit) for unit in units):
        return i + 1, texts
    for k, unit in enumerate(below[: len(texts)]):
        if unit and texts[k].strip() and _parse_header(texts[k]).unit is None:
            texts[k] = f"{texts[k].strip()} ({unit})"
    return i + 2, texts


def _assign(table: _Table, given: dict[str, Column], toml: Path | None) -> dict[str, int]:
    """Which column each channel is in: as the TOML says, else as the headers do."""
    found: dict[str, int] = {}
    strained = "strain" in given or any(_rank(h, "strain") is not None for h in table.headers)
    for channel in _channels(table, given):
        if channel in given:
            name = given[channel].column
            matches = [k for k, h in enumerate(table.headers) if _is_named(h, name)]
            if len(matches) != 1:
                listed = ", ".join(repr(h.text) for h in table.headers if h.text)
                count = "twice" if matches else "nowhere"
                raise InputError(
                    f"{toml}: [columns] {channel}: column {name!r} is {count} in "
                    f"{table.path.name}, which has {listed}."
                )
            found[channel] = matches[0]
            continue
        ranks = {k: r for k, h in enumerate(table.headers) if (r := _rank(h, channel)) is not None}
        if interior_node(channel):  # a column that the TOML calls the top is not inside
            taken = {found[c] for c in given if c in found}
            ranks = {k: r for k, r in ranks.items() if k not in taken}
        best = [k for k, r in ranks.items() if r == min(ranks.values())]
        if len(best) > 1 and channel == "time":
            best = _clear_time(table, best)
        if len(best) > 1:
            both = " and ".join(repr(table.headers[k].text) for k in best)
            entry = f'{channel} = {{ column = "{table.headers[best[0]].text}" }}'
            raise InputError(
                f"{table.path}: columns {both} could both be the {channel}; keep one"
                + (f", or write {entry} in [columns] of {toml.name}." if toml else ".")
            )
        if best and ranks[best[0]] == _WEAK and strained:
            continue
        if best:
            found[channel] = best[0]
    # A channel that the TOML names replaces its twin that only a header names.
    for one, other in (("stress", "force"), ("displacement", "strain")):
        for named, twin in ((one, other), (other, one)):
            if named in given and twin not in given:
                found.pop(twin, None)
    return found


def _clear_time(table: _Table, columns: list[int]) -> list[int]:
    """Of several columns that could be the time keep the one that never goes back, if it is one.

    The others start anew with each cycle, or stand still.
    """
    numbers, _ = _read_numbers(table, {str(k): k for k in columns})
    steps = {k: np.diff(numbers[str(k)]) for k in columns}
    onward = [k for k, step in steps.items() if step.size and step.min() >= 0.0 < step.max()]
    return onward if len(onward) == 1 else columns


def _factor(table: _Table, channel: str, header: _Header, given: Column | None) -> float:
    """Return what the numbers of a column are multiplied by to be SI."""
    _, example, _ = _kind(channel)
    given = given or Column("")
    unit = given.unit if given.unit is not None else header.unit
    where = f"{table.path}: column {header.text!r}"
    over = header.text.partition("/")[2].strip()  # Weg/mm, which only the TOML calls displacement
    if unit is None and over and _in_si(channel, over, given.scale_unit) is not None:
        unit = over
    if unit is None and not given.scale_unit and channel != "strain":
        entry = f'{channel} = {{ column = "{header.text}", unit = "{_UNITS.get(channel, "mm")}" }}'
        raise InputError(
            f"{where} has no unit; write it in the header like '{example}' or in [columns] like "
            f"{entry}."
        )
    unit = unit or ""
    if not is_unit(unit, any_case=True):
        raise InputError(f"{where} has an unknown unit {unit!r}; write it like '{example}'.")
    if given.unit is not None:
        _check_unit(channel, header, given.unit, where)
    si_per_unit = _in_si(channel, unit, given.scale_unit)
    if si_per_unit is not None:
        return given.scale * si_per_unit * (-1.0 if given.counts_down else 1.0)
    raise InputError(
        f"{where} cannot be read as {channel}: its unit {unit!r} is of another kind; "
        f"write it like '{example}' or give a scale in [columns]."
    )


def _check_unit(channel: str, header: _Header, given: str, where: str) -> None:
    """Refuse a unit in [columns] that contradicts the one in the header."""
    own = header.unit
    if own is None or not is_unit(own, any_case=True):
        return
    stated, there = _in_si(channel, given), _in_si(channel, own)
    if there is None and not header.text.endswith((")", "]", "}")):
        return  # the last word of a name only looks like a unit
    if stated != there or (stated is None and given.casefold() != own.casefold()):
        raise InputError(
            f"{where} has the unit {own!r} in its header, but [columns] {channel} says {given!r}; "
            "leave unit out, or, if the header is wrong, correct it by scale."
        )


def _read_numbers(
    table: _Table, columns: dict[str, int]
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Read the columns as they stand in the file; whatever is no number is refused.

    Returns
    -------
    numbers : dict of str to (n,) array
        By the keys of `columns`.
    empty : (k,) array of int
        Numbers of the rows that hold separators only; they are left out.
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
    if frame[str(table.n_fields)].astype(bool).any():
        _refuse_cells(table, columns)
    numbers = {c: frame[str(k)].to_numpy(np.float64) for c, k in columns.items()}
    if not all(np.isfinite(values).all() for values in numbers.values()):
        _refuse_cells(table, columns)
    return numbers, empty


def _frame(table: _Table, columns: dict[str, int], body: bytes) -> pd.DataFrame:
    """Parse rows of numbers; the columns have their places as names."""
    import pandas as pd

    # A header of our own, with one column more: that one shows if any row has too many cells.
    header = table.separator.join(str(k) for k in range(table.n_fields + 1)).encode()
    kinds = {str(k): "float64" for k in columns.values()}
    excess = str(table.n_fields)
    return pd.read_csv(  # its ParserError is a ValueError
        io.BytesIO(header + b"\n" + body),
        sep=table.separator,
        decimal=table.decimal,
        encoding=table.encoding,
        usecols=[*kinds, excess],
        dtype=kinds | {excess: "str"},
        na_filter=False,
        index_col=False,
    )


def _refuse_cells(table: _Table, columns: dict[str, int]) -> None:
    """Find the first bad cell, row by row, and name it."""
    for row, cells in table.rows():
        if tuple(cell.strip() for cell in cells) == table.header_cells:
            raise InputError(
                f"{table.path}: row {row} repeats the header of row {table.header_row}; a file "
                "must hold one table with one header."
            )
        if any(cell.strip() for cell in cells[table.n_fields :]):
            raise InputError(
                f"{table.path}: row {row} has {len(cells)} cells, but the header has "
                f"{table.n_fields}; every row must have as many as the header."
            )
        for k in columns.values():
            cell = cells[k].strip() if k < len(cells) else ""
            where = f"{table.path}: row {row}, column {table.headers[k].text!r}"
            if not cell:
                raise InputError(f"{where} is empty; every sample must have a number there.")
            if table.decimal == "," and "." in cell and _number(cell):
                raise InputError(
                    f"{where} is {cell!r}, but other numbers have a decimal comma; all must have "
                    "the same decimal sign."
                )
            text = cell.replace(",", ".") if table.decimal == "," else cell
            if not _NUMBER.fullmatch(text):
                raise InputError(f"{where} is {_short(cell)}; it must be a number{_hint(cell)}.")
            if not math.isfinite(float(text)):
                raise InputError(f"{where} is {cell!r}; it must be a finite number.")


def _short(text: str) -> str:
    return repr(text if len(text) <= _LONGEST else text[:_LONGEST] + " …")


def _hint(cell: str) -> str:
    """Say how to write a number whose digits are separated in groups."""
    plain = re.sub(r"(?<=\d)[_' ,\u2009\u202f](?=\d{3})", "", cell)
    return f" without separators, {plain}" if plain != cell and _number(plain) else ""


# From columns to channels.


def _record(
    table: _Table, columns: dict[str, int], settings: Settings
) -> tuple[Record, tuple[str, ...]]:
    """Read the channels that are needed, in SI, and say what was read from where."""
    needed = _needed(table, columns, settings)
    factors = {
        c: _factor(table, c, table.headers[k], settings.columns.get(c)) for c, k in needed.items()
    }
    numbers, empty = _read_numbers(table, needed)
    count = len(next(iter(numbers.values())))
    if count < _MIN_ROWS:
        raise InputError(f"{table.path}: has fewer than {_MIN_ROWS} rows; a test needs more.")
    for channel, values in numbers.items():
        if np.ptp(values) == 0:
            name = table.headers[needed[channel]].text
            raise InputError(f"{table.path}: column {name!r} is constant; a {channel} must vary.")
        numbers[channel] = values * factors[channel]
    notes = [_columns_note(table, needed, settings), *_announced(table, count)]
    rows, dropped = table.row_numbers(count), list[Dropped]()
    if empty.size:
        why = "no cell of it holds anything"
        dropped.append(Dropped(empty.size, int(empty[0]), int(empty[-1]), why))
    if "time" in numbers:
        if settings.duplicates == "average":
            numbers, rows = _averaged(numbers, rows, dropped, notes)
        _check_time(table, numbers["time"], table.headers[needed["time"]].text, rows)
    time = numbers.pop("time", None)
    specimen = settings.specimen
    stress = _one_of(numbers, "stress", "force", specimen.area, "the area", notes)
    displacement = _one_of(numbers, "displacement", "strain", 1 / specimen.height, "height", notes)
    velocity, acceleration = numbers.get("velocity"), numbers.get("acceleration")
    if stress is None:  # _needed has seen to it that these are there
        assert settings.striker is not None
        assert settings.striker.mass is not None
        assert acceleration is not None
        stress, acceleration = acceleration * settings.striker.mass / specimen.area, None
        notes.append("The force is the striker's mass times its acceleration.")
    inside = {node: values for c, values in numbers.items() if (node := interior_node(c))}
    for node, values in tuple(inside.items()):
        if displacement is not None and np.allclose(
            values, displacement, rtol=0.0, atol=1e-9 * float(np.ptp(displacement))
        ):
            del inside[node]
            notes.append(
                f"{interior_channel(node)} is the displacement of the top; it is left out."
            )
    record = Record(time, stress, displacement, velocity, acceleration, inside)
    return replace(record, numbers=rows, dropped=tuple(dropped)), tuple(notes)


def _needed(table: _Table, columns: dict[str, int], settings: Settings) -> dict[str, int]:
    """Choose the channels worth reading; refuse a file that lacks one that nothing can replace."""
    has = set(columns)
    listed = ", ".join(repr(h.text) for h in table.headers if h.text)
    striker = settings.striker or Striker()
    forced = bool(has & {"stress", "force"})
    if not forced and not ({"acceleration", "time"} <= has and striker.mass):
        more = "; with a time and the [striker] mass an acceleration will do"
        raise InputError(
            f"{table.path}: no column is a stress or a force (there are {listed}); name one like "
            f'\'stress (MPa)\', or write force = {{ column = "…", unit = "N" }} in [columns]{more}.'
        )
    if has & {"displacement", "strain"}:
        spare = {"velocity", "acceleration"} if forced else {"velocity"}
        return {c: k for c, k in columns.items() if c not in spare}
    helping = {"velocity", "acceleration"} if forced else {"velocity"}
    for channel in has & helping - set(settings.columns):
        try:  # these only help, so one whose unit does not say what it is can be left
            _factor(table, channel, table.headers[columns[channel]], None)
        except InputError:
            has.remove(channel)
    sources = "velocity" in has or (striker.velocity and (striker.mass or "acceleration" in has))
    if "time" not in has or not sources:
        timed = "" if "time" in has else 'time = { column = "…", unit = "s" } there, and '
        raise InputError(
            f"{table.path}: no column is a displacement or a strain (there are {listed}); name one "
            'like \'displacement (mm)\', or write displacement = { column = "…", unit = "mm" } in '
            f"[columns], or give {timed}the [striker] mass and velocity to integrate the motion."
        )
    return {c: k for c, k in columns.items() if c in has}


def _columns_note(table: _Table, needed: dict[str, int], settings: Settings) -> str:
    parts = []
    for channel, k in needed.items():
        given = settings.columns.get(channel) or Column("")
        unit = f" in {given.unit}" if given.unit else ""
        by = f"{given.scale:.6g} {given.scale_unit}".strip()
        scale = f" times {by}" if by != "1" else ""
        scale += ", counting down" if given.counts_down else ""
        own = given.unit or table.headers[k].unit or ""
        if channel == "force" and own.casefold() in _WEIGHTS:
            scale += f" ({_WEIGHTS[own.casefold()]}: the weight of that mass)"
        parts.append(f"{channel} from {table.headers[k].text!r}{unit}{scale}")
    read = ", ".join(parts)
    rest = [
        repr(h.text) for k, h in enumerate(table.headers) if h.text and k not in needed.values()
    ]
    return f"Read {read}" + (f"; not used: {', '.join(rest)}." if rest else ".")


def _reversed(table: _Table, columns: dict[str, int], settings: Settings) -> dict[str, str]:
    """Say for each channel of a record what would turn it round; see `check_signs`."""
    found = {}
    for channel, k in columns.items():
        given, text = settings.columns.get(channel) or Column(""), table.headers[k].text
        if given.counts_down:
            told = "leave counts_down = true out"
        elif given.scale < 0.0:
            told = f"leave the minus sign of scale = {given.scale:g} out"
        else:
            by = f"{-given.scale:g} {given.scale_unit}".strip()
            by = f'"{by}"' if given.scale_unit else by
            told = f'write {channel} = {{ column = "{text}", scale = {by} }}'
            if channel.startswith("displacement"):
                down = f'write {channel} = {{ column = "{text}", counts_down = true }}'
                told = f"{down} (of a gap or a position; else scale = {by})"
        wrong = f"{channel} is negative in compression; it must be positive"
        if channel.startswith("displacement"):
            wrong = f"{channel} is negative or gets smaller in compression; it must get larger"
        found[channel] = f"{wrong}: {told} in [columns]"
    twins = {"stress": ("force", "acceleration"), "displacement": ("strain",)}
    for channel, others in twins.items():
        source = next((c for c in (channel, *others) if c in found), None)
        found |= {channel: found[source]} if source else {}
    return found


def _announced(table: _Table, n: int) -> list[str]:
    """Compare with the number of samples that an instrument's header announces."""
    head = table.raw.split(b"\n", table.first_row)[: table.first_row]
    for row, line in enumerate(head, 1):
        match = re.match(rb"\W*(?:number of )?samples\W+(\d+)", line, re.IGNORECASE)
        if match and int(match[1]) != n:
            told = f"row {row} announces {int(match[1])} samples, but the table has {n}"
            return [f"Check: {told}."]
    return []


def _averaged(
    numbers: dict[str, Array], rows: NDArray[np.int64], dropped: list[Dropped], notes: list[str]
) -> tuple[dict[str, Array], NDArray[np.int64]]:
    """Average neighbouring rows with the same time stamp; each is counted with its reason."""
    time = numbers["time"]
    fresh = np.append(True, np.diff(time) != 0.0)
    again = rows[~fresh]
    if not again.size:
        return numbers, rows
    starts = np.flatnonzero(fresh)
    counts = np.diff(np.append(starts, len(time)))
    why = "the time stamp of the row before, averaged with it"
    dropped.append(Dropped(again.size, int(again[0]), int(again[-1]), why))
    notes.append(
        f"Check: {again.size} of {len(time)} rows have the time stamp of the row before, the first "
        f"in row {again[0]}; rows with the same stamp are averaged (or refused by [data] "
        'duplicates = "refuse").'
    )
    means = {c: np.add.reduceat(values, starts) / counts for c, values in numbers.items()}
    return means | {"time": time[starts]}, rows[starts]


def _check_time(table: _Table, time: Array, name: str, rows: NDArray[np.int64]) -> None:
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        index = int(back[0]) + 1
        where = f"{table.path}: row {rows[index]}, column {name!r}: time"
        if time[index] == time[index - 1]:
            raise InputError(
                f"{where} repeats; it must increase from row to row (in a test, [data] "
                'duplicates = "average" averages rows with the same time stamp).'
            )
        raise InputError(f"{where} goes back; it must increase from row to row.")


def _one_of(
    numbers: dict[str, Array], first: str, second: str, ratio: float, by: str, notes: list[str]
) -> Array | None:
    """`first` if it is there, else `second` divided by `ratio`; both must agree to 3 %."""
    one, two = numbers.get(first), numbers.get(second)
    if two is None:
        return one
    if one is None:
        notes.append(
            f"The {first} is the {second} {'over' if first == 'stress' else 'times'} {by}."
        )
        return two / ratio
    slope = float(np.dot(two, one) / np.dot(one, one)) / ratio
    agree = f"the {second} is {slope:.3g} times what it gives with {by} of the specimen"
    if abs(slope - 1) > 0.03:
        notes.append(f"Check: the {first} is used, but {agree}; they are inconsistent.")
    else:
        notes.append(f"The {first} is used rather than the {second}, and they agree.")
    return one


# The public entries.


def _bytes(path: Path, wanted: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give {wanted}.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a directory; give {wanted}.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None


def read_history(path: Path, channel: str) -> tuple[Array, Array]:
    """Read time and one other channel of a table, as they stand there.

    Parameters
    ----------
    path : Path
        The table, as in `read_test`; a column without a unit is in SI.
    channel : str
        For example "stress".

    Returns
    -------
    time, values : (n,) array
        In SI.

    Raises
    ------
    InputError
        Where the file cannot be used.
    """
    wanted = f"a CSV with the columns 'time (ms)' and '{_CHANNELS[channel][1]}'"
    text, encoding = _decode(path, _bytes(path, wanted))
    table = _find_table(path, text, encoding, set())
    found = _assign(table, {}, None)
    for name in ("time", channel):
        if name not in found:
            raise InputError(f"{path}: has no column for the {name}; it must be {wanted}.")
    columns = {name: found[name] for name in ("time", channel)}
    numbers, _ = _read_numbers(table, columns)
    rows = table.row_numbers(len(numbers["time"]))
    _check_time(table, numbers["time"], table.headers[columns["time"]].text, rows)
    for name, k in columns.items():
        header = table.headers[k]
        in_si = Column(header.text, _CHANNELS[name][0]) if header.unit is None else None
        numbers[name] = numbers[name] * _factor(table, name, header, in_si)
    return numbers["time"], numbers[channel]


def _check_noise(toml: Path, settings: Settings, record: Record) -> None:
    """Refuse a stated noise that is larger than all that was measured."""
    for channel, unit in (("stress", "Pa"), ("displacement", "m")):
        values, sigma = record.channel(channel), getattr(settings.noise, channel)
        if values is not None and sigma is not None and sigma > np.ptp(values):
            raise InputError(
                f"{toml}: [noise] {channel} = {engineering(sigma, unit)} is "
                f"{100.0 * sigma / np.ptp(values):.3g} % of the range of the measured {channel}, "
                f"{engineering(float(np.ptp(values)), unit)}; give one standard deviation."
            )


def read_test(path: str | Path, specimen: str | Path | None = None) -> Measurement:
    """Read a test file and its TOML, check both and condition the data.

    Parameters
    ----------
    path : str or Path
        The table: CSV, separated by commas, semicolons or tabs, one row per sample.
    specimen : str or Path, optional
        The TOML; without it, the file beside the table that ends in ``.toml``.

    Returns
    -------
    Measurement
        Channels in SI, compression positive, time zero where contact starts. Its notes say what
        was done.

    Raises
    ------
    InputError
        Where the file, its TOML or what they hold cannot be used.
    """
    path = Path(path)
    raw = _bytes(path, "the CSV file of a test")
    text, encoding = _decode(path, raw)
    toml = Path(specimen) if specimen is not None else path.with_suffix(".toml")
    settings = read_settings(toml, path, channels=_CHANNELS)
    names = {column.column for column in settings.columns.values()}
    table = _find_table(path, text, encoding, names)
    columns = _assign(table, settings.columns, toml)
    record, notes = _record(table, columns, settings)
    try:
        conditioned = condition(
            record,
            settings.specimen,
            striker=settings.striker,
            window=settings.window,
            reversed_=_reversed(table, columns, settings),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    _check_noise(toml, settings, conditioned.record)
    measurement = Measurement(
        name=settings.name,
        path=path,
        data_sha256=hashlib.sha256(raw).hexdigest(),
        time=conditioned.record.time,
        stress=conditioned.record.stress,
        displacement=conditioned.record.displacement,
        specimen=settings.specimen,
        striker=settings.striker,
        noise=replace(settings.noise, estimated=conditioned.noise),
        motion=conditioned.motion,
        notes=(*notes, *conditioned.notes),
        interior=conditioned.record.interior,
        outliers=conditioned.outliers,
        contact=conditioned.contact,
        count=conditioned.count,
    )
    return with_noise(measurement)
