"""The work on one test of a batch, done in another process: read, fit, and write its folder.

All arguments and results can be pickled, and a test depends only on its task.
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
from foamfit.codec import build, plain
from foamfit.data.csv_file import read_test
from foamfit.data.toml_file import motion_file
from foamfit.errors import InputError, SimulationError
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import save_whole, write_result
from foamfit.report.listing import REFUSED, Row, row_of
from foamfit.springs import laws
from foamfit.study.cycles import fit_cycles

SCHEMA = 1
RECORD = "batch.json"  # in the folder of each test: its rows, and the fingerprint of their inputs
# One fit at a time per process, also in an executor with threads: drawing is not thread-safe.
_ALONE = threading.Lock()


@dataclass(frozen=True)
class Recipe:
    """How every test of a batch is fitted.

    `cycles` is one number, several, () for all cycles of a record, or None for the cycle that the
    TOML names; `options` are keywords of `foamfit.fit`.
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
        """Settings and version that determine the results; `stored` checks pages and width."""
        parts = asdict(replace(self, pages=True)) | {"foamfit": version("foamfit")}
        del parts["width"]
        texts = parts.pop("laws")
        if any(laws.is_registered(kind) for kind in self.model.split("+")):
            parts["laws"] = sorted(texts.values())
        return json.dumps(parts, sort_keys=True)


@dataclass(frozen=True)
class Task:
    """One test to be fitted.

    `out` is the folder to write; with None the files are returned in the outcome. `content` has the
    bytes of the test, its TOML and its [motion] file if the fit may run on another machine, which
    must have the same `version` of foamfit.
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
        """Size of the content in bytes."""
        return sum(len(part) for part in self.content or () if part)


# Rows of a test, and its files by path if the task has no folder to write.
Outcome = tuple[tuple[Row, ...], Mapping[str, bytes] | None]


def fingerprint(key: str, data: bytes, toml: bytes | None, motion: bytes | None) -> str:
    """Return a hash of everything that determines a result: `Recipe.key` and the files."""
    parts = (data, toml) if motion is None else (data, toml, motion)
    digests = (None if part is None else hashlib.sha256(part).hexdigest() for part in parts)
    return hashlib.sha256(json.dumps([key, *digests]).encode()).hexdigest()


def stored(folder: Path, wanted: str, recipe: Recipe) -> tuple[Row, ...] | None:
    """Return the rows in a test's folder if they have the fingerprint `wanted`, else None.

    If the recipe includes figures, they must exist and have its width.
    """
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        if content["fingerprint"] != wanted:
            return None
        width = content.get("figure_width", inches(TWO)) if content["pages"] else None
        if recipe.pages and width != inches(recipe.width):
            return None
        return tuple(build(Row, row, {}) for row in content["rows"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None  # no record, or one of another version


def work(task: Task) -> Outcome:
    """Fit one test and write its folder at once; an error in the test becomes a row.

    Raises InputError if the result cannot be written.
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
            "rows": plain(rows, {}),
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
                paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
                files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
            return rows, files
        except OSError as error:
            raise InputError(str(error)) from None


def put(files: Mapping[str, bytes], out: Path) -> None:
    """Write the files returned by another process as one folder, all at once."""

    def write(folder: Path) -> None:
        for name, content in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)

    save_whole(out, write, swept=True)


Write = Callable[[Path], None]


def _fitted(task: Task) -> tuple[tuple[Row, ...], Write]:
    """Return the rows of a test, and a function that writes its files into a folder."""
    try:
        with _inputs(task) as (path, toml):
            return _results(task, path, toml)
    except (InputError, SimulationError) as error:
        why = str(error)
    except (MemoryError, OSError):  # a fault of this machine, not of the test
        raise
    except Exception as error:
        why = f"this is a defect of foamfit, please report it ({type(error).__name__}: {error})"
    return (Row(task.name, str(task.path), REFUSED, " ".join(why.split())),), lambda _: None


def _results(task: Task, path: Path, toml: Path) -> tuple[tuple[Row, ...], Write]:
    """Return one row, or one per cycle (a subfolder), and a function that writes the files."""
    recipe, file = task.recipe, str(task.path)
    pictures: Any = {"pages": recipe.pages, "width": recipe.width, "mapped": map}
    if not isinstance(recipe.cycles, tuple):
        test = read_test(path, toml, recipe.cycles, cycles=recipe.history)
        result = fit(test, model=recipe.model, **recipe.options)
        return (row_of(task.name, file, result),), partial(write_result, result, **pictures)
    numbers = recipe.cycles or None
    fits = fit_cycles(path, toml, cycles=numbers, model=recipe.model, **recipe.options)
    rows = list[Row]()
    for number in sorted({*fits.results, *fits.refused}):
        name = f"{task.name}/cycle-{number}"
        if number in fits.results:
            rows.append(row_of(name, file, fits.results[number]))
        else:
            rows.append(Row(name, file, REFUSED, " ".join(fits.refused[number].split())))
    return tuple(rows), partial(fits.write, **pictures)


@contextmanager
def _inputs(task: Task) -> Iterator[tuple[Path, Path]]:
    """Yield test file and TOML, written to a temporary folder if they came with the task."""
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
            message = str(error).replace(str(path), str(task.path))
            raise type(error)(message.replace(str(settings), str(task.toml))) from None
