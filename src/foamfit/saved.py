"""`foamfit.load`: read a result folder."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lmfit
import numpy as np

from foamfit.api import FitResult
from foamfit.arrays import Array
from foamfit.codec import build, decode, reading
from foamfit.errors import InputError
from foamfit.files import read_whole, reason
from foamfit.report.folder import load_result
from foamfit.report.samples import FILE as SAMPLES
from foamfit.report.samples import read_samples
from foamfit.report.shown import JointViews
from foamfit.report.studies.batch import read_table
from foamfit.report.studies.cycles import CycleFits
from foamfit.report.studies.joint import JointParameter
from foamfit.results import KEPT, Loop
from foamfit.study.joint_result import JointResult
from foamfit.trust.identifiability import Insight

if TYPE_CHECKING:
    import pandas as pd


def load(folder: str | Path) -> FitResult | SavedJoint | CycleFits | pd.DataFrame:
    """Return the result in the folder of a fit, a joint fit, several cycles or a batch.

    It equals the result that was saved, and saving it again writes the same files. For a batch it
    is the summary that `foamfit.batch` returns.

    Raises
    ------
    InputError
        If there is no result in the format of this version, or one of its files is damaged.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{folder} is not a folder; name a result folder of foamfit")
    if (place / "joint.json").is_file():
        return _joint(place)
    if (place / "cycles.json").is_file():
        return _cycles(place)
    if (place / "summary.csv").is_file():
        return read_table(place / "summary.csv")
    return _fit(place)


def _fit(folder: Path) -> FitResult:
    """Read fit.json and curves.csv."""
    content = load_result(folder)
    if not isinstance(content.get("load"), Mapping):
        raise InputError(
            f"{folder / 'fit.json'} is of foamfit {content.get('foamfit')}, which did not keep all "
            "that load needs; fit the test again"
        )
    kept = content | content["load"]
    columns = _columns(folder / "curves.csv", kept.get("samples"))
    with reading(f"{folder}: fit.json"):
        kept["measurement"] = content | content["data"] | kept["measurement"]
        given = {name: kept[name] for name in KEPT if name in kept}
        result: FitResult = build(FitResult, given, columns, lmfit=lmfit, Insight=Insight)
    result.draws.update(read_samples(folder / SAMPLES))
    return result


def _columns(path: Path, samples: object) -> dict[str, Array]:
    """Read curves.csv, which must have `samples` rows."""
    try:
        head, *lines = read_whole(path).decode(errors="replace").splitlines() or [""]
    except OSError as error:
        raise InputError(f"{path} cannot be read: {reason(error)}") from None
    if len(lines) != samples:
        raise InputError(f"{path} is damaged: it has {len(lines)} rows of {samples}")
    names = next(csv.reader([head]), [])
    try:
        values = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, len(names)))
        return dict(zip(names, values.T, strict=True))
    except ValueError as error:
        raise InputError(f"{path} is damaged: {str(error).partition(';')[0]}") from None


@dataclass(frozen=True, eq=False, repr=False)
class SavedJoint(JointViews):
    """A joint fit read from its folder; the fields are those of joint.json."""

    name: str
    model: str
    status: str
    warnings: tuple[str, ...]
    sentences: tuple[str, ...]
    tests: tuple[str, ...]
    rates: tuple[float | None, ...]  #: Mean strain rate on loading of each test, 1/s
    rate0: float | None  #: Rate of the median test, 1/s
    parameters: dict[str, JointParameter]  #: SI; `tests` of each has its values by test
    results: dict[str, FitResult]  #: Result of each test at the joint fit
    content: dict[str, Any]  #: All of joint.json

    @property
    def loops(self) -> tuple[Loop, ...]:
        """The measured and fitted loop of each test."""
        found = ((name, one.loop) for name, one in self.results.items())
        return tuple(loop._replace(name=name) for name, loop in found if loop is not None)

    save = JointResult.save

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of joint.json."""
        return self.content

    def test_fits(self) -> Iterator[FitResult]:
        """Iterate over the results of the tests, in the order of `tests`."""
        return map(self.results.__getitem__, self.tests)


def _joint(folder: Path) -> SavedJoint:
    """Read joint.json and the folders of its tests."""
    content = load_result(folder / "joint.json")
    with reading(f"{folder / 'joint.json'}"):
        tests = content["tests"]
        given = content | {"content": content, "results": {}, "tests": list(tests)}
        given["rates"] = [one["rate"] for one in tests.values()]
        made: SavedJoint = build(SavedJoint, given, {})
    made.results.update({name: _fit(folder / name) for name in made.tests})
    return made


def _cycles(folder: Path) -> CycleFits:
    """Read cycles.json and the folders of its cycles."""
    content = load_result(folder / "cycles.json")
    with reading(f"{folder / 'cycles.json'}"):
        names = content["fitted"]
        refused = decode(dict[int, str], content["refused"], {})
        given = content["test"], content["model"], tuple(content["recorded"])
        made = content.get("data_sha256", ""), content.get("options")
    return CycleFits(*given, {n: _fit(folder / f"cycle-{n}") for n in names}, refused, *made)
