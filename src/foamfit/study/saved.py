"""`foamfit.load`: read a result folder."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import lmfit
import numpy as np

from foamfit.api import FitResult
from foamfit.arrays import Array
from foamfit.codec import build, reading
from foamfit.errors import InputError
from foamfit.files import read_whole, reason
from foamfit.report.folder import SAMPLES, load_result, read_samples
from foamfit.report.listing import read_table
from foamfit.results import KEPT
from foamfit.springs.model import Model
from foamfit.study.cycles import CycleFits
from foamfit.study.joint_result import JointResult
from foamfit.trust.identifiability import Insight

if TYPE_CHECKING:
    import pandas as pd


def load(folder: str | Path) -> FitResult | JointResult | CycleFits | pd.DataFrame:
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


def _joint(folder: Path) -> JointResult:
    content = load_result(folder / "joint.json")
    with reading(f"{folder / 'joint.json'}"):
        given = content | {"model": Model.of_result(content).name}
        made: JointResult = build(JointResult, given | {"results": {}}, {})
    return replace(made, results={name: _fit(folder / name) for name in made.tests})


def _cycles(folder: Path) -> CycleFits:
    content = load_result(folder / "cycles.json")
    with reading(f"{folder / 'cycles.json'}"):
        made: CycleFits = build(CycleFits, content | {"results": {}}, {})
        names = content["fitted"]
    return replace(made, results={n: _fit(folder / f"cycle-{n}") for n in names})


def with_record(fit: FitResult, folder: str | Path) -> FitResult:
    """Return a fit with the path of its record as found from the folder of the result."""
    path = fit.measurement.path
    if path is None:
        return fit
    # It is relative to the current directory of the fit, which usually contains the folder.
    places = (place / path for place in Path(folder).resolve().parents)
    path = next((place for place in places if place.is_file()), path)
    return replace(fit, measurement=replace(fit.measurement, path=path))
