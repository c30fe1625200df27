"""What one window works on: its files, the test read from them, and its fit.

Everything lies in a folder of the window's own, which goes with the window. Two windows share
nothing.
"""

from __future__ import annotations

import io
import re
import shlex
import shutil
import tomllib
import unicodedata
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from foamfit.cli.options import cycles_of
from foamfit.data.csv_file import read_test
from foamfit.data.csv_table import find_table, read_text
from foamfit.data.describe import describe
from foamfit.data.energy import audit
from foamfit.data.measurement import Measurement
from foamfit.data.toml_file import toml_beside
from foamfit.errors import InputError
from foamfit.page.worker import Job, Worker, parsed
from foamfit.report.comparison import compare, comparison_text
from foamfit.text import listed

LARGEST = 64 * 1024 * 1024  # bytes of a file that is dropped
LONGEST = 80  # characters of the name of a file
BUSY = "A fit is running; stop it before anything of the test is changed."
TABLES = (".csv", ".txt", ".tsv", ".dat", ".gz", ".xlsx")
# Rows and columns of a file that are shown around a cell that is wrong.
AROUND, ACROSS, CELL = 2, 8, 24


@dataclass(frozen=True)
class Quantity:
    """A quantity that is filled in: its place in the TOML, what it is called, an example."""

    section: str
    key: str
    label: str
    example: str

    @property
    def name(self) -> str:
        """Its name as the sentences of `read_test` give it."""
        return f"[{self.section}] {self.key}"


QUANTITIES = (
    Quantity("specimen", "height", "Specimen height", "1.19 mm"),
    Quantity("specimen", "diameter", "Specimen diameter", "5 mm"),
    Quantity("specimen", "area", "or its area", "19.6 mm^2"),
    Quantity("specimen", "mass", "Specimen mass (optional)", "5.56 mg"),
    Quantity("striker", "mass", "Striker mass (optional)", "7 g"),
    Quantity("striker", "velocity", "Striker velocity (optional)", "1.75 m/s"),
)


@dataclass(frozen=True)
class Excerpt:
    """Some rows of a file around what is wrong in it; `row` and `column` are marked, from 0."""

    numbers: list[int]
    cells: list[list[str]]
    row: int | None
    column: int | None


@dataclass(frozen=True)
class Checked:
    """What was understood of a test, or the sentence that says why not and what it is about."""

    text: str = ""
    error: str = ""
    quantity: str = ""
    excerpt: Excerpt | None = None


class Desk:
    """The files, the test and the fit of one window, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700)
        self.csv: Path | None = None
        self.replaced = False  # whether the file has taken the place of another, not read since
        self.measurement: Measurement | None = None
        self.worker: Worker | None = None
        self._fits = 0

    def close(self) -> None:
        """End the fit and remove the folder."""
        if self.worker is not None:
            self.worker.kill()
        shutil.rmtree(self.folder, ignore_errors=True)

    # ------------------------------------------------------------------------------- files

    def receive(self, name: str, content: bytes) -> str:
        """Keep a file that was dropped under a name that is safe, which is returned.

        InputError if it is too large or of no kind that is read.
        """
        if self.running:
            raise InputError(BUSY)
        if len(content) > LARGEST:
            raise InputError(too_large(name))
        name = safe_name(name)
        suffix = Path(name).suffix.lower()
        if suffix == ".toml":
            (self.folder / "dropped.toml").write_bytes(content)
            return name
        if suffix not in TABLES:
            raise InputError(
                f"{name} is no table; drop a file that ends in {listed(TABLES)}, or a TOML."
            )
        place = self.folder / "test"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        self.replaced = self.csv is not None
        self.csv, self.measurement, self.worker = place / name, None, None
        self.csv.write_bytes(content)
        return name

    def take(self, csv: Path) -> None:
        """Copy a test that is on this machine, and the TOML beside it, onto the desk.

        Only the command and the list of reconstructions name such a file, never the page.
        """
        if csv.stat().st_size > LARGEST:
            raise InputError(too_large(csv.name))
        self.receive(f"{csv.stem}.csv" if csv.suffix.lower() not in TABLES else csv.name,
                     csv.read_bytes())  # fmt: skip
        toml = toml_beside(csv)
        if toml.is_file():
            (self.folder / "dropped.toml").write_bytes(toml.read_bytes())

    def dropped_toml(self) -> tuple[dict[str, str], str] | None:
        """Split the TOML that was dropped last into quantities and the rest; None if there is none.

        It is read once. InputError if it is no TOML.
        """
        place = self.folder / "dropped.toml"
        if not place.is_file():
            return None
        raw = place.read_bytes()
        place.unlink()
        try:
            return split_toml(raw.decode("utf-8-sig"))
        except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
            raise InputError(f"The TOML that was dropped is no valid TOML: {error}.") from None

    # ------------------------------------------------------------------------------- the test

    def check(self, quantities: Mapping[str, str], rest: str, cycle: str = "") -> Checked:
        """Read the test as `foamfit check` does, and say what was understood or what is wrong.

        `cycle` is as the command takes it; of several the first is read.
        """
        if self.running:
            return Checked(error=BUSY)
        self.measurement = None
        if self.csv is None:
            return Checked(error="There is no test yet; drop a CSV or choose a reconstruction.")
        toml = self.csv.with_suffix(".toml")
        try:
            toml.write_text(join_toml(quantities, rest), encoding="utf-8")
            alone, several = cycles_of(cycle.strip() or None)
            measurement = read_test(self.csv, toml, several[0] if several else alone)
            # By its own name: the folder of the window means nothing to who reads it.
            text = describe(replace(measurement, path=Path(self.csv.name)), audit(measurement))
        except InputError as error:
            told = self._plain(str(error))
            quantity = next((q.name for q in QUANTITIES if f"{q.name} " in told), "")
            if "[specimen] needs a diameter" in told:
                quantity = "[specimen] diameter"
            excerpt = excerpt_of(self.csv, told)
            return Checked(error=told, quantity=quantity, excerpt=excerpt)
        self.measurement = measurement
        return Checked(text)

    def measured(self, cycle: int) -> Measurement:
        """Return a cycle of the test that was checked last, or that its fit has read."""
        assert self.csv is not None
        assert self.measurement is not None
        if cycle == self.measurement.cycle:
            return self.measurement
        return read_test(self.csv, self.csv.with_suffix(".toml"), cycle)

    @property
    def toml(self) -> bytes:
        """The TOML as it is filled in."""
        return b"" if self.csv is None else self.csv.with_suffix(".toml").read_bytes()

    def _plain(self, text: str) -> str:
        """Leave the folder of the window out of a sentence."""
        for folder in (self.folder / "test", self.folder):
            text = text.replace(f"{folder}/", "").replace(f"{folder}\\", "")
        return text

    # ------------------------------------------------------------------------------- the fit

    def fit(self, arguments: list[str]) -> Worker:
        """Begin a fit of the test as it was checked last, with arguments of `foamfit fit`."""
        if self.csv is None or self.measurement is None:
            raise InputError("There is no test that can be read yet; see what is wrong with it.")
        if self.running:
            raise InputError(BUSY)
        parsed(arguments)
        self._fits += 1
        folder = self.folder / f"fit-{self._fits}"
        toml = folder.with_suffix(".toml")  # as it is now, whatever is filled in later
        toml.write_bytes(self.toml)
        job = Job(str(self.csv), str(toml), str(folder), arguments)
        self.worker = Worker(job)
        return self.worker

    @property
    def running(self) -> bool:
        """Whether a fit is running."""
        return self.worker is not None and self.worker.ended is None

    @property
    def result(self) -> Path | None:
        """The folder of the last fit, if it has one."""
        if self.worker is None or self.worker.ended != "":
            return None
        return Path(self.worker.job.folder)

    @property
    def fits(self) -> dict[int, Path]:
        """The folders with a fit of the last result by the number of their cycle; 0 = the one."""
        if self.result is None:
            return {}
        cycles = {int(one.name.split("-")[1]): one for one in self.result.glob("cycle-*")}
        return dict(sorted(cycles.items())) or {0: self.result}

    def ending(self) -> str:
        """Say how the last fit ended, "" where it has a result."""
        assert self.worker is not None
        return self._plain(self.worker.ended or "")

    @property
    def command(self) -> str:
        """What asks for the last fit in a terminal, where the TOML lies beside the file."""
        assert self.csv is not None
        assert self.worker is not None
        return shlex.join(["foamfit", "fit", self.csv.name, *self.worker.job.arguments])

    @property
    def told(self) -> str:
        """What the command prints of several cycles, "" of one fit."""
        return "" if self.worker is None else self.worker.told

    def zipped(self) -> bytes:
        """The result folder as a ZIP, with the TOML of the test."""
        assert self.result is not None
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(self.result.rglob("*")):
                archive.write(path, path.relative_to(self.result))
            archive.write(self.result.with_suffix(".toml"), "test.toml")
        return content.getvalue()

    def compared(self, published: str, cycle: int = 0) -> str:
        """A fit of the result beside a published set, as `foamfit compare` prints it."""
        if cycle not in self.fits:
            raise InputError("There is no fit yet; run one to compare it.")
        return self._plain(comparison_text(compare([self.fits[cycle]], published)))


def too_large(name: str) -> str:
    """Say that a file is too large."""
    return (
        f"{safe_name(name)} is larger than {LARGEST // 2**20} MB, which the page takes; "
        "use foamfit fit in a terminal."
    )


def safe_name(name: str) -> str:
    """Return a name of one file, without a folder, of characters that mean nothing to a shell."""
    name = unicodedata.normalize("NFKC", name).replace("\\", "/").rsplit("/", 1)[-1]
    name = re.sub(r"[^\w.()+-]+", "_", name).lstrip("._-")
    stem, dot, suffix = name.rpartition(".")
    if not stem:
        stem, dot, suffix = name or "test", "", ""
    return f"{stem[: LONGEST - 10]}{dot}{suffix[:8]}"


# ------------------------------------------------------------------------------------ the TOML


def split_toml(text: str) -> tuple[dict[str, str], str]:
    """Split a TOML into the quantities of the page, by their names, and a TOML of the rest."""
    document = tomllib.loads(text)
    found = {}
    for q in QUANTITIES:
        section = document.get(q.section)
        if isinstance(section, dict) and isinstance(section.get(q.key), str | int | float):
            found[q.name] = str(section.pop(q.key))
            if not section:
                document.pop(q.section)
    return found, _written(document)


def join_toml(quantities: Mapping[str, str], rest: str) -> str:
    """Join the quantities that are filled in to a TOML of the rest; InputError if that is none."""
    try:
        document = tomllib.loads(rest)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"The further TOML is no valid TOML: {error}.") from None
    for q in QUANTITIES:
        value = quantities.get(q.name, "").strip()
        if not value:
            continue
        section = document.setdefault(q.section, {})
        if not isinstance(section, dict):
            raise InputError(f"The further TOML: {q.section} must be a table, [{q.section}].")
        if q.key in section:
            raise InputError(f"The further TOML: {q.name} is filled in above, too; give it once.")
        section[q.key] = value
    return _written(document)


def _written(document: Mapping[str, Any]) -> str:
    """Write a TOML: single values first, then a table for each section."""
    lines = [f"{_key(k)} = {_toml(v)}" for k, v in document.items() if not isinstance(v, dict)]
    for name, section in document.items():
        if isinstance(section, dict):
            lines += ["", f"[{_key(name)}]"]
            lines += [f"{_key(k)} = {_toml(v)}" for k, v in section.items()]
    return "\n".join(lines).strip() + "\n" if lines else ""


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + re.sub(r"[\x00-\x1f\x7f]", lambda c: f"\\u{ord(c[0]):04x}", escaped) + '"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return str(value)


# ------------------------------------------------------------------------- what is wrong, and where


def excerpt_of(path: Path, sentence: str) -> Excerpt | None:
    """Return the rows around the cell that a sentence of `read_test` names; None if it names none.

    A sentence that names no row is about the columns: the first rows are shown then.
    """
    try:
        text = read_text(path, "")
    except InputError:
        return None
    lines = text.raw.decode(text.encoding, errors="replace").splitlines()
    separator, header = _separator(path, lines)
    row = re.search(r"\brow (\d+)", sentence)
    at = int(row[1]) - 1 if row else None
    first = header if at is None else max(at - AROUND, header)
    some = range(first, min(first + 2 * AROUND + 1, len(lines)))
    numbers = [header, *(n for n in some if n != header)]
    cells = [_split(lines[n], separator) for n in numbers if n < len(lines)]
    if not cells:
        return None
    column = _column(cells[0], sentence)
    shift = 0 if column is None else max(0, column - ACROSS + 1)
    shown = [[cell[:CELL] for cell in line[shift : shift + ACROSS]] for line in cells]
    numbers = numbers[: len(shown)]
    marked = numbers.index(at) if at in numbers else None
    return Excerpt([n + 1 for n in numbers], shown, marked, column and column - shift)


def _separator(path: Path, lines: Iterable[str]) -> tuple[str, int]:
    """Return separator and line of the headers, as the reader finds them, or a guess."""
    try:
        table = find_table(read_text(path, ""), set())
    except InputError:
        head = "\n".join(list(lines)[:20])
        return max(("\t", ";", ","), key=head.count), 0
    return table.separator, max(table.header_row - 1, 0)


def _split(line: str, separator: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(separator)]


def _column(headers: list[str], sentence: str) -> int | None:
    """Return the column that a sentence names in quotation marks, the first if several."""
    for k, header in enumerate(headers):
        if header and f"'{header}'" in sentence:
            return k
    return None
