"""Results as Python and notebooks show them, and the folders that keep them."""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, ClassVar
from zipfile import BadZipFile

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import plain
from foamfit.errors import InputError
from foamfit.files import csv_bytes, is_left, read_whole, reason, replacing
from foamfit.report.figures import TWO, inches, write_both
from foamfit.report.plots import figures_of
from foamfit.report.render import Readable, numbers_of, parameters_tex, with_head
from foamfit.report.summary import render_report
from foamfit.results import SCHEMA, Fit
from foamfit.text import counted, wrapped

SAMPLES = "samples.npz"
# Files of each kind of result, by the file that identifies it. They include files that only older
# versions wrote, so that older folders can be replaced.
_OLDER = {"fit.csv", "residuals.csv", "sensitivities.csv", "residuals.pdf", "information.pdf"}
_OLDER |= {"snapping.pdf", "profiles.pdf", "ladder.csv", "samples.nc"}
_TABLES = {"fit.json", "parameters.csv", "curves.csv", "profiles.csv", "budget.csv"}
_DRAWN = {"fit.png", "fit.pdf", "report.html"}
_KINDS = ("json", "csv", "html", "tex", "png", "pdf")
FILES = {
    "fit.json": {*_TABLES, *_DRAWN, *_OLDER, "table.tex", SAMPLES},
    "cycles.json": {*(f"cycles.{kind}" for kind in _KINDS), "cycles-plotted.csv", "table.tex"},
    "joint.json": {f"{name}.{kind}" for name in ("joint", "parameters") for kind in _KINDS}
    | {"table.tex"},
    "batch.json": {*(f"summary.{kind}" for kind in _KINDS), "batch.json"},
    "prediction.json": {f"prediction.{kind}" for kind in _KINDS},
    "plan.json": {*(f"plan.{kind}" for kind in _KINDS), "next.toml", "joint.toml"},
}
_OF_FITS = "fit.json", "cycles.json", "batch.json"  # of fits of one record, one by one


class Result:
    """A result that Python shows in a few lines and a folder keeps."""

    _kind: ClassVar[str]  # the file that identifies it, one of `FILES`

    def write(self, folder: Path, *, pages: bool, width: str) -> None:
        """Write all files into an existing folder; pages and figures only with `pages`."""
        raise NotImplementedError

    @property
    def failed(self) -> bool:
        """Whether no acceptable fit was found."""
        return getattr(self, "status", "") == "failed"

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints; only that of a fit may be `verbose`."""
        raise NotImplementedError

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file of the result: SI, plain types, None if missing."""
        raise NotImplementedError

    def printed(self) -> dict[str, Any]:
        """Return what the command prints as JSON."""
        return self.to_json_dict()

    def save(
        self,
        folder: str | Path,
        *,
        report: bool = True,
        figure_width: str = TWO,
        force: bool = False,
    ) -> Path:
        """Write the result folder and return its path; an older folder is replaced at the end.

        A result of another kind, such as a joint fit, is replaced only with `force`. Without
        `report`, neither pages nor figures are written. `figure_width` is "one" or "two" columns,
        or a length ("85 mm"); ", untitled" after it omits the titles.
        """
        inches(figure_width)  # rejects an invalid width
        check_target(folder, of=None if force else self._kind)
        return save_whole(folder, partial(self.write, pages=report, width=figure_width))


def brief(title: str, line: str, rows: Sequence[Readable]) -> str:
    """Return a result in a few lines: a line about it, and its parameters."""
    marks = {"weak": " (weak)", "not determined": " (not determined)"}
    values = (f"{p.told}{marks.get(p.state, '')}" for p in rows)
    return "\n".join([*wrapped(f"{title}: {line}", 2), *wrapped(", ".join(values), 2)])


def save_whole(folder: str | Path, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a new folder, which replaces an older result when complete; return it.

    Parent folders are created. If `folder` must not be replaced (see `check_target`) or cannot be
    written, InputError is raised and nothing is changed.
    """
    folder = Path(folder)
    check_target(folder)
    try:
        with replacing(folder.resolve()) as fresh:
            write(fresh)
            check_target(folder)  # keep files that were added in the meantime
    except OSError as error:
        why = f"the result cannot be written to {folder}: {reason(error)}; choose another folder"
        raise InputError(why) from error
    return folder


def save_somewhere(save: Callable[..., object], folder: Path, *, report: bool) -> None:
    """Call `save` with a folder and `report`.

    If `folder` cannot be written, save the result next to it, in the current directory or among
    temporary files. If the report fails, which is a defect, save the numbers without it.

    Raises
    ------
    InputError
        If `folder` cannot be written; the message names the folder used instead.
    """
    try:
        save(folder, report=report)
        return
    except InputError as error:
        message = str(error)
    except Exception:
        with suppress(Exception):
            save(folder, report=False)
        raise
    for place in (folder.parent, Path(), Path(tempfile.gettempdir())):
        other = place / f"{folder.resolve().name}-{time.strftime('%Y%m%d-%H%M%S')}"
        with suppress(InputError):
            save(other, report=report)
            message = f"{message.removesuffix('; choose another folder')}; it is in {other} instead"
            break
    raise InputError(message)


def check_target(folder: str | Path, *, of: str | None = None, kept: bool = False) -> None:
    """Raise InputError unless `folder` is free, or foamfit wrote all that is in it.

    With `of`, one of `FILES`, only results of this kind may be replaced. A folder that is `kept`,
    that of a batch, is not replaced: the folders of its tests are written into it.
    """
    folder = Path(folder)
    try:
        place = folder.resolve()
        if place.is_dir():
            if not kept:
                _check_replaceable(folder, place, of)
            if other := _foreign(place, kept):
                raise InputError(
                    f"{folder} holds {other}, which foamfit did not write, so it is kept; move "
                    "that or choose another folder"
                )
        elif os.path.lexists(place):
            raise InputError(f"{folder} is a file; choose a new or an empty folder")
        above = next(path for path in place.parents if path.exists())  # a kept folder stays in it
        for path in (place,) if kept and place.is_dir() else (place, above):
            if path.exists() and not path.is_dir():
                raise NotADirectoryError(0, f"{path} is a file")
            if path.exists() and not os.access(path, os.W_OK | os.X_OK):
                raise PermissionError(0, f"Permission denied in {path}")
    except (OSError, RuntimeError) as error:  # RuntimeError: a link to itself
        why = f"{folder} cannot be written: {reason(error)}; choose another folder"
        raise InputError(why) from error


def check_same(folder: str | Path, data_sha256: str, options: Mapping[str, Any]) -> None:
    """Raise InputError if `folder` has a result of other data or other options (`Fit.options`)."""
    place = Path(folder).resolve()
    contents = ((name, _content(place / name)) for name in FILES)
    name, content = next(((name, one) for name, one in contents if one), ("", {}))
    made = content.get("options")
    if not content or (made == options and content.get("data_sha256") == data_sha256):
        return
    if name not in ("fit.json", "cycles.json"):
        what = f"a {Path(name).stem} result"
    elif content.get("data_sha256") != data_sha256:
        what = "a result of other data"
    elif isinstance(made, dict):
        every = dict.fromkeys([*options, *made])
        differing = [one for one in every if options.get(one) != made.get(one)]
        what = f"a result made with other options ({', '.join(differing)})"
    else:
        what = "a result that does not say with which options it was made"
    raise InputError(
        f"{folder} holds {what}, so it is not replaced; name another folder with --out, or replace "
        "it with --force"
    )


def _check_replaceable(folder: Path, place: Path, of: str | None) -> None:
    """Raise InputError if the existing folder at `place` must not or cannot be replaced."""
    here = Path.cwd()
    if any(place.samefile(at) for at in (here, *here.parents)):
        raise InputError(
            f"{folder} is or contains the current directory and cannot be replaced; choose a "
            "separate folder"
        )
    if os.path.ismount(place):  # Path.is_mount is missing on Windows before Python 3.12
        raise InputError(f"{folder} is a mount point and cannot be replaced; name a folder in it")
    kinds = [name for name in FILES if _content(place / name)]
    if any(place.iterdir()) and not kinds:
        raise InputError(
            f"{folder} is not empty and contains no foamfit result (such as fit.json), so it is "
            "not replaced; choose a new or an empty folder"
        )
    own = _OF_FITS if of in _OF_FITS else (of,)
    if of is not None and (other := [name for name in kinds if name not in own]):
        raise InputError(
            f"{folder} holds {other[0]}, which does not belong to a {Path(of).stem}, so it is "
            "not replaced; choose a new or an empty folder"
        )


def _foreign(folder: Path, batch: bool) -> str:
    """Return the first path in a folder that foamfit did not write, or ""."""
    tests = _content(folder / "joint.json").get("tests")  # folders of a joint fit
    tests = tests if isinstance(tests, dict) else {}
    for path in sorted(folder.iterdir()):
        of_batch = path.name in FILES["batch.json"] and path.is_file()
        if batch and (of_batch or is_left(path.name)):
            continue
        if batch and path.is_dir() and not path.is_symlink():
            inside = [one.name for one in path.iterdir()]
            foreign = [name for name in inside if not _is_written(path / name)]
            if foreign or (inside and not any(name in FILES for name in inside)):
                return "/".join([path.name, *foreign[:1]])
        elif batch or not _is_written(path, tests):
            return path.name
    return ""


def _is_written(path: Path, tests: Collection[str] = ()) -> bool:
    """Return whether foamfit writes such a path; `tests` are the folders of a joint fit."""
    if path.is_symlink():
        return False
    if path.is_dir() and (re.fullmatch(r"cycle-\d+", path.name) or path.name in tests):
        return all(one.name in FILES["fit.json"] and _is_written(one) for one in path.iterdir())
    return any(path.name in names for names in FILES.values()) and path.is_file()


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a result file of any version, or {} if it is not a result file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):  # neither UTF-8 nor JSON
        return {}
    return content if isinstance(content, dict) and {"schema", "foamfit"} <= content.keys() else {}


def load_result(folder: str | Path) -> dict[str, Any]:
    """Return the content of ``fit.json`` (SI), by path or folder; InputError if unreadable."""
    path = Path(folder)
    if path.is_dir():
        inside = sorted(str(one.parent) for one in path.glob("*/fit.json"))
        path = path / "fit.json"
        if inside and not path.is_file():
            why = f"{folder} contains {counted(len(inside), 'fit')}; name one, like {inside[0]}"
            raise InputError(why)
    try:
        content = json.loads(read_whole(path))
    except OSError as error:
        raise InputError(
            f"{folder} is not a result folder: {path.name} cannot be read "
            f"({error.strerror or error})"
        ) from error
    except (ValueError, RecursionError) as error:  # not UTF-8 or JSON, or nested too deeply
        raise InputError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(content, dict) or "schema" not in content:
        raise InputError(f"{path} is not the result of a fit (it has no schema number)")
    if content["schema"] != SCHEMA:
        why = f"{path} has schema {content['schema']}, but this version of foamfit reads {SCHEMA}"
        raise InputError(why)
    return content


def write_result(result: Fit, folder: Path, *, pages: bool = True, width: str = TWO) -> None:
    """Write all files of a result into an existing folder; report and figures only with `pages`."""
    write_json(folder / "fit.json", result.to_json_dict())
    texts = ("unit", "state", "why", "ci95_method")
    parameters = (
        {"name": name, **plain(numbers_of(p)), **{key: getattr(p, key) for key in texts}}
        for name, p in result.parameters.items()
    )
    write_table(folder / "parameters.csv", parameters)
    write_text(folder / "table.tex", parameters_tex(result.parameters))
    write_columns(folder / "curves.csv", result.columns)
    if profiles := result.profiles:
        write_table(folder / "profiles.csv", (row for one in profiles for row in one.rows()))
    if result.draws:
        samples: Any = result.draws  # NumPy types the names of arrays as its options
        np.savez(folder / SAMPLES, **samples)
    if pages and result.budget is not None and result.budget.telling:
        write_table(folder / "budget.csv", result.budget.rows())
    if pages:
        drawn = figures_of(result, width)
        svg = write_both(drawn["fit"], folder / "fit")
        write_text(folder / "report.html", render_report(result, drawn, svg))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object as JSON; a non-UTF-8 name keeps its bytes as a JSON escape."""
    form: Any = {"ensure_ascii": False, "allow_nan": False}
    text = json.dumps({k: v for k, v in content.items() if k != "load"}, indent=2, **form)
    if "load" in content:  # one line at the end, as it is not meant for readers
        text = f'{text[:-2]},\n  "load": {json.dumps(content["load"], **form)}\n}}'
    path.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def write_text(path: Path, content: str) -> None:
    """Write a text; replace characters that are not UTF-8."""
    path.write_text(content, encoding="utf-8", errors="replace")


def write_table(path: Path, rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows with identical columns as CSV."""
    path.write_bytes(csv_bytes(with_head(rows)))


def write_columns(path: Path, columns: Mapping[str, Array]) -> None:
    """Write columns as CSV, with their names in the first row."""
    # As Python floats, because NumPy floats would be written with the name of their type.
    samples = zip(*(column.tolist() for column in columns.values()), strict=True)
    path.write_bytes(csv_bytes([columns, *samples]))


def read_samples(path: Path) -> dict[str, Array]:
    """Return the samples (chain, draw) of each parameter in SI; empty if there is no file."""
    if not path.is_file():
        return {}
    try:
        with np.load(path) as file:
            return dict(file)
    except (OSError, ValueError, BadZipFile) as error:
        raise InputError(f"{path} is damaged: {error}") from None
