"""The work on one test of a batch, done in another process: read, fit, and write its folder.

All arguments and results can be pickled, and a test depends only on its task.
"""

from __future__ import annotations

import hashlib
import json
import platform
import threading
from collections.abc import Callable, Mapping
from contextlib import chdir
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from foamfit.api import fit
from foamfit.codec import build, plain
from foamfit.data.csv_file import read_test
from foamfit.data.toml_file import motion_file
from foamfit.errors import InputError, SimulationError
from foamfit.files import read_whole
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import save_whole, write_json, write_result
from foamfit.report.listing import REFUSED, Row, row_of
from foamfit.springs import laws
from foamfit.study.cycles import fit_cycles

SCHEMA, VERSION = 1, version("foamfit")
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

    @property
    def key(self) -> str:
        """Settings and version that determine the results; `stored` checks pages and width."""
        parts = asdict(replace(self, pages=True)) | {"foamfit": VERSION}
        del parts["width"]
        texts = parts.pop("laws")
        if any(laws.is_registered(kind) for kind in self.model.split("+")):
            parts["laws"] = sorted(texts.values())
        return json.dumps(parts, sort_keys=True)


@dataclass(frozen=True)
class Task:
    """One test to be fitted; `out` is the folder to write.

    Relative paths count from `where`. `fingerprint` is that of the files as the caller sees them.
    """

    name: str
    path: Path
    toml: Path
    recipe: Recipe
    fingerprint: str
    out: Path
    where: Path = field(default_factory=Path.cwd)


def fingerprint(recipe: Recipe, path: Path, toml: Path) -> str:
    """Return a hash of everything that determines a result: settings, version and files."""
    try:
        parts = [read_whole(path)]
        for other in (toml, motion_file(toml)):
            if other is not None and other.is_file():
                parts.append(other.read_bytes())
    except OSError:  # the fit reads the test again, with a better error message
        parts = []
    digests = (hashlib.sha256(part).hexdigest() for part in parts)
    return hashlib.sha256(json.dumps([recipe.key, *digests]).encode()).hexdigest()


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


def work(task: Task) -> tuple[Row, ...]:
    """Fit one test, write its folder at once and return its rows; an error becomes a row.

    Raises InputError if the result cannot be written, and RuntimeError on a machine where the test
    or foamfit is not that of the caller.
    """
    with _ALONE:
        laws.load_texts(task.recipe.laws)
        if task.where.is_dir():
            with chdir(task.where):
                if fingerprint(task.recipe, task.path, task.toml) == task.fingerprint:
                    return _written(task)
    raise RuntimeError(
        f"{platform.node()} does not see the same files or has another version of foamfit; every "
        "worker must see the file system of the call"
    )


def _written(task: Task) -> tuple[Row, ...]:
    """Fit one test, write its folder and return its rows."""
    rows, write = _fitted(task)
    record = {
        "schema": SCHEMA,
        "foamfit": VERSION,
        "fingerprint": task.fingerprint,
        "pages": task.recipe.pages,
        "figure_width": inches(task.recipe.width),
        "rows": plain(rows, {}),
    }

    def fill(folder: Path) -> None:
        write(folder)
        write_json(folder / RECORD, record)

    save_whole(task.out, fill, swept=True)
    return rows


Write = Callable[[Path], None]


def _fitted(task: Task) -> tuple[tuple[Row, ...], Write]:
    """Return the rows of a test, and a function that writes its files into a folder."""
    try:
        return _results(task)
    except (InputError, SimulationError) as error:
        why = str(error)
    except (MemoryError, OSError):  # a fault of this machine, not of the test
        raise
    except Exception as error:
        why = f"this is a defect of foamfit, please report it ({type(error).__name__}: {error})"
    return (Row(task.name, str(task.path), REFUSED, " ".join(why.split())),), lambda _: None


def _results(task: Task) -> tuple[tuple[Row, ...], Write]:
    """Return one row, or one per cycle (a subfolder), and a function that writes the files."""
    recipe, path, file = task.recipe, task.path, str(task.path)
    pictures: Any = {"pages": recipe.pages, "width": recipe.width}
    if not isinstance(recipe.cycles, tuple):
        test = read_test(path, task.toml, recipe.cycles, cycles=recipe.history)
        result = fit(test, model=recipe.model, **recipe.options)
        return (row_of(task.name, file, result),), partial(write_result, result, **pictures)
    numbers = recipe.cycles or None
    fits = fit_cycles(path, task.toml, cycles=numbers, model=recipe.model, **recipe.options)
    rows = list[Row]()
    for number in sorted({*fits.results, *fits.refused}):
        name = f"{task.name}/cycle-{number}"
        if number in fits.results:
            rows.append(row_of(name, file, fits.results[number]))
        else:
            rows.append(Row(name, file, REFUSED, " ".join(fits.refused[number].split())))
    return tuple(rows), partial(fits.write, **pictures)
