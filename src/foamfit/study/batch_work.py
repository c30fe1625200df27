"""One test of a batch: read, fitted, and written whole; what runs in another process.

Everything here takes and returns what can be pickled, and a test depends on nothing but its task.
"""

from __future__ import annotations

import hashlib
import json
import platform
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from foamfit.api import fit
from foamfit.codec import build, encode
from foamfit.data.csv_file import read_test
from foamfit.data.toml_file import motion_file
from foamfit.errors import InputError, SimulationError
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import save_whole, write_result
from foamfit.report.studies.batch import REFUSED, Row, row_of
from foamfit.report.studies.cycles import write_cycles
from foamfit.springs import laws
from foamfit.study.cycles import fit_cycles

SCHEMA = 1
RECORD = "batch.json"  # in the folder of each test: its rows, and what they were made from
# One fit at a time in a process, whatever its executor: drawing is not safe in two threads.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class Recipe:
    """How every test of a batch is fitted.

    `cycles` is one number, several, () for all of a record, or None for the one that the TOML
    names; `options` are keywords of `foamfit.fit`.
    """

    model: str
    options: Mapping[str, Any]
    cycles: int | tuple[int, ...] | None = None
    pages: bool = True
    width: str = TWO  # of the figures
    laws: Mapping[str, str] = field(default_factory=laws.texts)  # texts of the user's law files
    history: tuple[int, int] | None = None  # first and last of several cycles fitted as one

    @cached_property
    def key(self) -> str:
        """What results are made by: settings and version; `stored` compares figures and pages."""
        parts = asdict(replace(self, pages=True)) | {"foamfit": version("foamfit")}
        del parts["width"]
        texts = parts.pop("laws")
        if any(laws.is_registered(kind) for kind in self.model.split("+")):
            parts["laws"] = sorted(texts.values())
        return json.dumps(parts, sort_keys=True)


@dataclass(frozen=True)
class Task:
    """One test to be fitted.

    `out` is the folder to write; None brings the files back in the outcome. `content` holds the
    bytes of the test, of its TOML and of its file of [motion] where the paths may be those of
    another machine, which must have the same `version` of foamfit.
    """

    name: str
    path: Path
    toml: Path
    recipe: Recipe
    fingerprint: str
    out: Path | None = None
    content: tuple[bytes, bytes | None, bytes | None] | None = None
    version: str = field(default_factory=lambda: version("foamfit"))

    @property
    def size(self) -> int:
        """Bytes of the content."""
        return sum(len(one) for one in self.content or () if one)


# What became of a test: its rows, and its files if they were to come back.
Outcome = tuple[tuple[Row, ...], Mapping[str, bytes] | None]


def fingerprint(key: str, data: bytes, toml: bytes | None, motion: bytes | None) -> str:
    """Identify what a result is made from: settings and version (`Recipe.key`), and files."""
    parts = (data, toml) if motion is None else (data, toml, motion)
    digests = (None if part is None else hashlib.sha256(part).hexdigest() for part in parts)
    return hashlib.sha256(json.dumps([key, *digests]).encode()).hexdigest()


def stored(folder: Path, wanted: str, recipe: Recipe) -> tuple[Row, ...] | None:
    """The rows in a test's folder if they were made from what is `wanted`; else None.

    Where figures are wanted, they must be there and as wide as the recipe says.
    """
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        if content["fingerprint"] != wanted:
            return None
        there = content.get("figure_width", inches(TWO)) if content["pages"] else None
        if recipe.pages and there != inches(recipe.width):
            return None
        return tuple(build(Row, row, {}) for row in content["rows"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None  # none, or of another version


def work(task: Task) -> Outcome:
    """Fit one test and write its folder whole; raises nothing that the test could be blamed for.

    InputError says why the result could not be written.
    """
    if task.version != (own := version("foamfit")):
        raise RuntimeError(
            f"{platform.node()} has foamfit {own}, the call came from {task.version}"
        )
    with _ALONE:
        laws.load_texts(task.recipe.laws)
        rows, write = _fitted(task)
        record = {
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "fingerprint": task.fingerprint,
            "pages": task.recipe.pages,
            "figure_width": inches(task.recipe.width),
            "rows": encode(rows, {}),
        }

        def fill(folder: Path) -> None:
            write(folder)
            text = json.dumps(record, ensure_ascii=False, allow_nan=False)
            (folder / RECORD).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")

        try:
            if task.out is not None:
                save_whole(task.out, fill, swept=True)
                return rows, None
            with TemporaryDirectory() as place:
                fill(folder := Path(place))
                found = (path for path in sorted(folder.rglob("*")) if path.is_file())
                files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}
            return rows, files
        except OSError as error:
            raise InputError(str(error)) from None


def put(files: Mapping[str, bytes], out: Path) -> None:
    """Write the files that came back from another process as a whole folder."""

    def write(folder: Path) -> None:
        for name, content in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)

    save_whole(out, write, swept=True)


Write = Callable[[Path], None]


def _fitted(task: Task) -> tuple[tuple[Row, ...], Write]:
    """The rows of a test, and what writes its files into a folder."""
    try:
        with _inputs(task) as (path, toml):
            return _results(task, path, toml)
    except (InputError, SimulationError) as error:
        why = str(error)
    except (MemoryError, OSError):  # of this machine
        raise
    except Exception as error:
        why = f"this is a defect of foamfit, please report it ({type(error).__name__}: {error})"
    return (Row(task.name, str(task.path), REFUSED, " ".join(why.split())),), lambda _: None


def _results(task: Task, path: Path, toml: Path) -> tuple[tuple[Row, ...], Write]:
    """One row, or one for each of several cycles, whose folders are in the folder of the test."""
    recipe, file = task.recipe, str(task.path)
    pictures: dict[str, Any] = {"pages": recipe.pages, "width": recipe.width}
    if not isinstance(recipe.cycles, tuple):
        test = read_test(path, toml, recipe.cycles, cycles=recipe.history)
        result = fit(test, model=recipe.model, **recipe.options)
        return (row_of(task.name, file, result),), partial(write_result, result, **pictures)
    wanted = recipe.cycles or None
    found = fit_cycles(path, toml, cycles=wanted, model=recipe.model, **recipe.options)
    rows = list[Row]()
    for number in sorted({*found.results, *found.refused}):
        name = f"{task.name}/cycle-{number}"
        if number in found.results:
            rows.append(row_of(name, file, found.results[number]))
        else:
            rows.append(Row(name, file, REFUSED, " ".join(found.refused[number].split())))
    return tuple(rows), partial(write_cycles, found, **pictures)


@contextmanager
def _inputs(task: Task) -> Iterator[tuple[Path, Path]]:
    """The files of a test, which are made here if they came with the task."""
    if task.content is None:
        yield task.path, task.toml
        return
    data, toml, motion = task.content
    with TemporaryDirectory() as place:
        folder = Path(place).resolve()
        path, settings = folder / task.path.name, folder / task.toml.name
        path.write_bytes(data)
        if toml is not None:
            settings.write_bytes(toml)
        moved = motion_file(settings)
        if moved is not None and motion is not None and folder in moved.resolve().parents:
            moved.parent.mkdir(parents=True, exist_ok=True)
            moved.write_bytes(motion)
        try:
            yield path, settings
        except (InputError, SimulationError) as error:
            told = str(error).replace(str(path), str(task.path))
            raise type(error)(told.replace(str(settings), str(task.toml))) from None
