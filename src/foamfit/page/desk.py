"""The files, the test and the fit of one window, and what it shows of a file without a specimen.

Each window has its own folder, which is removed with it. Windows share nothing.
"""

from __future__ import annotations

import math
import re
import shlex
import shutil
import tempfile
import time
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w

from foamfit.data.csv_file import read_test
from foamfit.data.energy import audit
from foamfit.data.measurement import Measurement
from foamfit.data.tables.columns import Source
from foamfit.data.tables.csv_table import read_text
from foamfit.data.toml_file import LONGEST, toml_beside
from foamfit.errors import InputError
from foamfit.page.worker import Job, Worker, parsed
from foamfit.report import figures
from foamfit.report.panels import Line, Panel
from foamfit.report.plots import panelled
from foamfit.report.summary import describe
from foamfit.study.study_file import ENDINGS
from foamfit.text import listed

LARGEST = 64 * 1024 * 1024  # bytes of the largest file that can be dropped
TOGETHER = 5.0  # s within which a table and its TOML arrive if they are dropped together
SAVED_TOML = "test.toml"  # name of the TOML in a saved result folder
BUSY = "A fit is running; stop it before you change the test."
# Label and example of each quantity to fill in, by its name in messages. The first `FIRST` are
# always shown, the others folded away.
FIRST = 4
QUANTITIES = {
    "[specimen] height": ("Specimen height", "1.19 mm"),
    "[specimen] diameter": ("Specimen diameter", "5 mm"),
    "[striker] mass": ("Striker mass (optional)", "7 g"),
    "[striker] velocity": ("Striker velocity (optional)", "1.75 m/s"),
    "[specimen] area": ("or its area", "19.6 mm^2"),
    "[specimen] mass": ("Specimen mass (optional)", "5.56 mg"),
}

# Quantities filled in, by name, and further TOML.
Fields = tuple[dict[str, str], str]


class Desk:
    """The files, the test and the fit of one window, in its own folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700, exist_ok=True)
        self.csv: Path | None = None
        self.given = ""  # name of the file as the user gave it
        # Times at which a table arrived, and a TOML that came before its table.
        self._came, self._ahead = -math.inf, -math.inf
        self.measurement: Measurement | None = None
        self.worker: Worker | None = None
        self._fits = 0

    def close(self) -> None:
        """End the fit and remove the folder."""
        if self.worker is not None:
            self.worker.end()
        shutil.rmtree(self.folder, ignore_errors=True)

    def receive(self, name: str, content: bytes) -> Fields | None:
        """Store a dropped table as test.*, or return the content of a TOML.

        A table that replaces another returns empty fields, unless its TOML has just come. Raises
        InputError if the file is too large or not a table, or an invalid TOML.
        """
        if self.running:
            raise InputError(BUSY)
        name = name.replace("\\", "/").rsplit("/", 1)[-1]
        given = "".join(one if one.isprintable() else "_" for one in name)
        if len(content) > LARGEST:
            raise InputError(
                f"{given} is larger than {LARGEST // 2**20} MB, the limit of the page; "
                "use foamfit fit in a terminal."
            )
        suffix, now = Path(given).suffix.lower(), time.monotonic()
        if suffix == ".toml":
            self._ahead = now if now - self._came > TOGETHER else -math.inf
            return split_toml(content)
        if suffix not in ENDINGS:
            raise InputError(
                f"{given} is not a table; drop a file that ends in {listed(ENDINGS)}, or a TOML."
            )
        replaced = self.csv is not None and now - self._ahead > TOGETHER
        self._came, self._ahead = now, -math.inf
        self.csv, self.given = self.folder / f"test{suffix}", given
        self.measurement, self.worker = None, None
        self.csv.write_bytes(content)
        return ({}, "") if replaced else None

    def take(self, csv: Path) -> Fields | None:
        """Copy a test and its TOML from this machine; the browser must never name such a file."""
        known = csv.suffix.lower() in ENDINGS
        cleared = self.receive(csv.name if known else f"{csv.stem}.csv", csv.read_bytes())
        toml = toml_beside(csv)
        return self.receive("test.toml", toml.read_bytes()) if toml.is_file() else cleared

    def check(self, quantities: Mapping[str, str], rest: str, arguments: Sequence[str] = ()) -> str:
        """Read the test, with --cycle or --cycles, and return what `foamfit check` prints of it."""
        if self.running:
            raise InputError(BUSY)
        self.measurement = None
        if self.csv is None:
            raise InputError("There is no test yet; drop a CSV or try the example.")
        toml = self.csv.with_suffix(".toml")
        try:
            name = Path(self.given).stem.strip()[:LONGEST] or "test"
            document = {"name": name} | join_toml(quantities, rest)
            toml.write_text(tomli_w.dumps(document), encoding="utf-8")
            asked = parsed([*arguments])
            wanted = asked["cycle"]
            # Of several cycles to be fitted one by one the first is read.
            first = next(iter(wanted), None) if isinstance(wanted, tuple) else wanted
            measurement = read_test(self.csv, toml, first, cycles=asked["cycles"])
            # The folder of the window means nothing to a user.
            text = describe(replace(measurement, path=Path(self.given)), audit(measurement))
        except InputError as error:
            raise InputError(self._plain(str(error))) from None
        self.measurement = measurement
        return text

    def measured(self, cycle: int, last: int | None) -> Measurement:
        """Return a cycle of the test checked last, or the history from `cycle` to `last`."""
        assert self.csv is not None
        checked = self.measurement
        if checked is not None and (cycle, last) == (checked.cycle, checked.last_cycle):
            return checked
        which: Any = {"cycles": (cycle, last)} if last else {"cycle": cycle}
        return read_test(self.csv, self.csv.with_suffix(".toml"), **which)

    def _plain(self, text: str) -> str:
        """Return a message with the user's name of the file, without the folder of the window."""
        text = text.replace(f"{self.folder}/", "").replace(f"{self.folder}\\", "")
        return text if self.csv is None else text.replace(self.csv.name, self.given)

    def fit(self, arguments: list[str], tell: Callable[[], object] = lambda: None) -> Worker:
        """Fit the test checked last as `foamfit fit`; a thread calls `tell` at news and the end."""
        if self.csv is None or self.measurement is None:
            raise InputError("The test cannot be read yet; see the error message.")
        if self.running:
            raise InputError(BUSY)
        parsed(arguments)
        self._fits += 1
        folder = self.folder / f"fit-{self._fits}"
        toml = folder.with_suffix(".toml")  # the page may change it later
        shutil.copy(self.csv.with_suffix(".toml"), toml)
        self.worker = Worker(Job(self.csv, toml, folder, arguments), tell)
        return self.worker

    @property
    def running(self) -> bool:
        """Whether a fit is running."""
        return self.worker is not None and self.worker.ended is None

    @property
    def result(self) -> Path | None:
        """The folder of the last fit, if it has one."""
        return None if self.worker is None or self.worker.ended != "" else self.worker.job.folder

    @property
    def fits(self) -> dict[int, Path]:
        """The folders of the last result's fits by cycle; 0 for a single fit."""
        if self.result is None:
            return {}
        cycles = {int(one.name.split("-")[1]): one for one in self.result.glob("cycle-*")}
        return dict(sorted(cycles.items())) or {0: self.result}

    def ending(self) -> str:
        """Return why the last fit has no result, or "" if it has one."""
        return self._plain((self.worker and self.worker.ended) or "")

    @property
    def command(self) -> str:
        """The command that repeats the last fit in a terminal, in the saved result folder."""
        assert self.worker is not None
        files = self.given, "--specimen", SAVED_TOML
        return shlex.join(["foamfit", "fit", *files, *self.worker.job.arguments])

    def zipped(self) -> bytes:
        """Return the result folder as a ZIP, with the TOML of the test."""
        assert self.result is not None
        shutil.copy(self.result.with_suffix(".toml"), self.result / SAVED_TOML)
        return _zip(self.result)

    def card(self, cycle: int) -> bytes:
        """Return an LS-DYNA card of the fit of a cycle (0: a single fit) as a ZIP."""
        from foamfit.cards.card import card

        with tempfile.TemporaryDirectory() as folder:
            card(self.fits[cycle], format="mat083").save(Path(folder, "foam.k"))
            return _zip(Path(folder))

    def planned(self, cycle: int) -> bytes:
        """Return plan.html, the plan after the fit of a cycle (0: a single fit)."""
        from foamfit.study.plan import plan

        with tempfile.TemporaryDirectory() as folder:
            plan(self.fits[cycle]).save(Path(folder, "plan"))
            return Path(folder, "plan", "plan.html").read_bytes()


def _zip(folder: Path) -> bytes:
    """Return the files of a folder as a ZIP."""
    with tempfile.TemporaryDirectory() as place:
        return Path(shutil.make_archive(f"{place}/result", "zip", folder)).read_bytes()


def wrong_quantity(message: str) -> str:
    """Return the name of the quantity that an error message rejects, or ""."""
    if "[specimen] needs a diameter" in message:
        return "[specimen] diameter"
    return next((name for name in QUANTITIES if f"{name} " in message), "")


def split_toml(dropped: bytes) -> Fields:
    """Split a TOML into the quantities of the page, by name, and the rest as TOML."""
    document, found = _document(dropped, "dropped file"), {}
    for name in QUANTITIES:
        table, key = name[1:].split("] ")
        section = document.get(table)
        if isinstance(section, dict) and isinstance(section.get(key), str | int | float):
            found[name] = str(section.pop(key))
            if not section:
                document.pop(table)
    return found, tomli_w.dumps(document)


def _document(toml: str | bytes, what: str = "further TOML") -> dict[str, Any]:
    """Return the content of a TOML; InputError if it is invalid."""
    try:
        return tomllib.loads(toml.decode("utf-8-sig") if isinstance(toml, bytes) else toml)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"The {what} is not valid TOML: {error}.") from None


def join_toml(quantities: Mapping[str, str], rest: str) -> dict[str, Any]:
    """Merge the quantities filled in with the rest of the TOML; InputError if it is invalid."""
    document = _document(rest)
    for name in QUANTITIES:
        if value := quantities.get(name, "").strip():
            table, key = name[1:].split("] ")
            section = document.setdefault(table, {})
            if not isinstance(section, dict):
                raise InputError(f"The further TOML: {table} must be a table, [{table}].")
            if key in section:
                raise InputError(f"The further TOML: {name} is also filled in above; give it once.")
            section[key] = value
    return document


# Choices of unit for each channel that the page offers.
UNITS = {
    "time": ("s", "ms", "us"),
    "force": ("N", "kN", "mN"),
    "stress": ("MPa", "kPa", "Pa"),
    "displacement": ("mm", "um", "m"),
    "strain": ("%", ""),
}
# Any specimen: with 1 m² and 1 m, stress is force and strain displacement.
UNIT = {"specimen": {"height": "1 m", "area": "1 m^2"}}
ENTRY = re.compile(r"\b(\w+) = \{ ?(column = [^{}…]+?) ?\}")


class Preview(NamedTuple):
    """Headers of a file, and its curves as a PNG, or why they cannot be read."""

    headers: tuple[str, ...]
    picture: bytes | None
    why: str = ""


def preview(csv: Path, rest: str) -> Preview:
    """Return what can be shown of a file with the TOML of its columns, `rest`."""
    headers: tuple[str, ...] = ()
    try:
        source = Source.of(read_text(csv, "a table"), {}, {})
        headers = tuple(header.text for header in source.table.headers if header.text)
        with tempfile.TemporaryDirectory() as folder:
            toml, document = Path(folder, "test.toml"), _document(rest)
            toml.write_text(tomli_w.dumps(document | UNIT), encoding="utf-8")
            columns = {*source.columns, *document.get("columns", {})}
            return Preview(headers, _picture(csv, toml, columns))
    except InputError as error:
        return Preview(headers, None, str(error) if headers else "")


def _picture(csv: Path, toml: Path, columns: Collection[str]) -> bytes:
    """Draw force or stress over time and over the motion, as `read_test` chooses them."""
    test, panels = read_test(csv, toml), list[Panel]()
    pushed = ("stress", "Pa") if "stress" in columns else ("force", "N")
    strained = "strain" in columns and "displacement" not in columns
    motion = ("strain", "–") if strained else ("displacement", "m")
    for x, axis in ((test.time, ("time", "s")), (test.displacement, motion)):
        if x is not None:
            line = Line(x, test.stress, "", {"color": figures.BLUE, "lw": 0.9})
            panels.append(Panel(axis[0], axis, pushed, [line]))
    return figures.images(panelled(panels, figures.TWO), "png", dpi=130)[0]


def remedies(message: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the entries of [columns] that a message proposes, by the words of their buttons."""
    found = {}
    for channel, content in ENTRY.findall(message):
        entry = tomllib.loads(f"entry = {{ {content} }}")["entry"]
        unit = f" in {entry['unit']}" if "unit" in entry else ""
        found[f"Use {entry['column']}{unit} as {channel}"] = channel, entry
    return found


def with_column(rest: str, channel: str, entry: Mapping[str, Any]) -> str:
    """Return the TOML `rest` with an entry of [columns]; InputError if `rest` is invalid.

    `entry` is like {"column": "Load", "unit": "kN"}; an empty one is removed.
    """
    document = _document(rest)
    document["columns"] = document.get("columns", {}) | {channel: dict(entry)}
    document["columns"] = {name: one for name, one in document["columns"].items() if one}
    return tomli_w.dumps({name: one for name, one in document.items() if one != {}})
