"""Keep tracked results if a new run has not changed their numbers.

On another machine or another day, last digits, run times and the pixels of letters change. A study
that runs inside `keep_unchanged` keeps a file under these rules:

- numbers agree to 1e-3, to one unit in the last digit if three or more are written, or to 1e-9
  absolute (rounding); counts agree exactly;
- run times and evaluations (in a column or behind a key named for them, or followed by the unit s,
  ms or µs) agree within a factor of ten, because machines are shared or differ in speed;
- machine and versions may differ;
- figures have the same size, and at most one pixel in two hundred has clearly changed; run times
  are drawn from the kept table.
"""

from __future__ import annotations

import gzip
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib.image
import numpy as np

DIGITS, THIRD, ROUNDING, RUN_TIMES, PIXELS, PLAIN = 1e-3, 1e-2, 1e-9, 10.0, 5e-3, 0.2
TEXT = {".csv", ".json", ".md", ".toml", ".txt", ".gz"}

_NUMBER = re.compile(r"[-−+]?\d[\d,]*\.?\d*(?:[eE][-+−]?\d+)?")
_TIMED_KEY = re.compile(r"(?:seconds|runtime\w*|run time|nfev|evaluations|steps)[^\d]{0,6}$", re.I)
_TIMED_UNIT = re.compile(r"\s?(?:s|ms|µs)\b")
_TIMED_COLUMN = re.compile(
    r"seconds|runtime|nfev|evaluations|steps|(^|\W)(s|ms|µs)$|^runs$|^ns per |/ (simulate|kernel)$"
    r"|(median|quartile( \d)?|simulate|kernel|SciPy|fixed step) \(s\)$|^median fit \(s\)$",
    re.I,
)
# Machine and its placeholder: versions, architecture, processor.
_CIRCUMSTANCES = (
    (
        re.compile(r"\b(foamfit|python|numpy|scipy|numba|lmfit)\b([\s\":]{1,4})\d+(\.\w+)+", re.I),
        r"\1",
    ),
    (re.compile(r"\b(x86_64|amd64|arm64|aarch64)\b", re.I), "machine"),
    (re.compile(r"^(# )?[^\n]* \(machine, \d+ cores\)", re.M), r"\1machine"),
    (re.compile(r"\b(processor)\b[^\n]*?, \d+ cores, machine"), r"\1"),
)


@contextmanager
def keep_unchanged(place: Path) -> Iterator[None]:
    """Restore, at the end, the file or the files of a folder that have not really changed.

    This also happens if the body raises an exception, as a study does after a failed check.
    """
    paths = place.rglob("*") if place.is_dir() else [place]
    before = {path: path.read_bytes() for path in paths if path.is_file()}
    try:
        yield
    finally:
        for path, old in before.items():
            if path.is_file() and (new := path.read_bytes()) != old and same(path, old, new):
                path.write_bytes(old)


def same(path: Path, old: bytes, new: bytes) -> bool:
    """Return whether two versions of a file are equivalent."""
    if path.suffix == ".png":
        return _same_picture(old, new)
    if path.suffix not in TEXT:
        return False
    if path.suffix == ".gz":
        old, new = gzip.decompress(old), gzip.decompress(new)
    one, other = old.decode("utf-8"), new.decode("utf-8")
    if ".csv" in path.suffixes:  # else commas would be thousands separators
        one, other = one.replace(",", "|"), other.replace(",", "|")
    return same_text(one, other)


def same_text(one: str, other: str) -> bool:
    """Return whether two texts differ only in numbers, and these within their tolerance."""
    for pattern, name in _CIRCUMSTANCES:
        one, other = pattern.sub(name, one), pattern.sub(name, other)
    if _NUMBER.sub("0", one) != _NUMBER.sub("0", other):
        return False
    timed = _timed_columns(one)
    pairs = zip(_NUMBER.finditer(one), _NUMBER.finditer(other), strict=True)
    return all(
        _same_number(a[0], b[0], _is_timed(one, a) or any(a.start() in cell for cell in timed))
        for a, b in pairs
    )


def _is_timed(text: str, found: re.Match[str]) -> bool:
    """Return whether a number in a text is a run time."""
    before = text[max(found.start() - 20, 0) : found.start()]
    return bool(_TIMED_KEY.search(before) or _TIMED_UNIT.match(text, found.end()))


def _timed_columns(text: str) -> list[range]:
    """Return the positions of table cells that contain run times."""
    found, head, at = list[range](), list[str](), 0
    for line in text.splitlines(keepends=True):
        if line.startswith("#") or "|" not in line:
            head = []
        else:
            cells, start = line.rstrip("\n").split("|"), at
            head = head or [cell.strip() for cell in cells]
            for name, cell in zip(head, cells, strict=False):
                if _TIMED_COLUMN.search(name):
                    found.append(range(start, start + len(cell)))
                start += len(cell) + 1
        at += len(line)
    return found


def _same_number(one: str, other: str, timed: bool) -> bool:
    """Compare two numbers given as text."""
    a, b = (float(text.replace(",", "").replace("−", "-")) for text in (one, other))
    if timed and a > 0.0 and b > 0.0:
        return max(a, b) <= RUN_TIMES * min(a, b)
    if one.isdigit() or other.isdigit():
        return a == b
    last = min(_last_digit(one), _last_digit(other))  # trailing zeros may be omitted
    near = abs(a - b) <= max(
        DIGITS * abs(a), ROUNDING, 1.01 * last if last <= THIRD * abs(a) else 0.0
    )
    return a == b or near


def _last_digit(number: str) -> float:
    """Return the value of one unit in the last digit of a number."""
    mantissa, _, power = number.lower().replace(",", "").replace("−", "-").partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


def _same_picture(old: bytes, new: bytes) -> bool:
    """Compare two PNG pictures pixel by pixel."""
    one, other = (matplotlib.image.imread(io.BytesIO(image)) for image in (old, new))
    if one.shape != other.shape:
        return False
    changed = np.abs(one - other).max(axis=-1) > PLAIN
    return bool(changed.mean() <= PIXELS)
