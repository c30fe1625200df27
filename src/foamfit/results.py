"""What was identified: the result of a fit and the folder that it is written to."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import interior_channel
from foamfit.errors import InputError
from foamfit.files import reason, replacing

if TYPE_CHECKING:
    import lmfit

    from foamfit.auto import Ladder
    from foamfit.data.measurement import Measurement, Outliers
    from foamfit.springs.chain import Chain
    from foamfit.springs.spring import BistableSpring
    from foamfit.trust.checklist import Check
    from foamfit.trust.identifiability import Insight
    from foamfit.trust.intervals import Intervals

SCHEMA = 1
# All that `FitResult.save` may write.
RESULT_FILES = frozenset(
    {
        "fit.json", "parameters.csv", "curves.csv", "profiles.csv", "ladder.csv", "fit.png",
        "fit.pdf", "report.html",
    }
)  # fmt: skip
DERIVED_POINTS = ("sigma_a", "sigma_c", "eps_star", "eps_hat_a", "eps_hat_c")

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter, in SI.

    `stderr` and `ci95` are None where the test does not determine it; `state` is "determined",
    "weak", "not determined" or "fixed" (fixed by the user or the model), and `why` says so in a
    sentence. `ci95_method` names what made the interval: "local covariance", "profile likelihood",
    "block bootstrap" or "MCMC".
    """

    value: float
    stderr: float | None
    ci95: tuple[float, float] | None
    unit: str
    vary: bool
    state: str
    why: str
    ci95_method: str | None = None


@dataclass(frozen=True, eq=False)
class Curves:
    """Measured and fitted curves, one row per sample of the conditioned test; None = not there.

    `stress` and `displacement` are what the drive gives (base stress in Pa, top displacement in m);
    `stress_along` is the stress (Pa) that the identified springs give along the measured
    displacement. `interior` holds measured and fitted displacement (m) of masses inside, 1 above
    spring 1.
    """

    time: Array | None
    measured_stress: Array | None
    measured_displacement: Array | None
    stress: Array | None
    displacement: Array | None
    stress_along: Array | None
    interior: dict[int, tuple[Array, Array]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation matrix of the identified parameters, in the order of `names`."""

    names: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True)
class Switch:
    """A change of branch in the fitted response: which spring, when, and where on the curves."""

    spring: int  # 1 at the base
    source: str  # "a", "d", "c", "e"
    target: str
    time: float | None  # s
    displacement: float  # of the top, m
    stress: float  # Pa


@dataclass(frozen=True, eq=False)
class FitResult:
    """Everything that a fit found; `save` writes it as a folder."""

    measurement: Measurement
    model: str
    drive: str
    seed: int
    status: str
    warnings: tuple[str, ...]
    chain: Chain
    params: lmfit.Parameters
    parameters: dict[str, ParameterEstimate]
    visited: dict[str, tuple[str, ...]]
    misfit: dict[str, float | None]
    weights: dict[str, float]
    statistics: dict[str, float | int | None]
    energy: dict[str, Any]
    runtime_s: float
    curves: Curves
    switches: tuple[Switch, ...]
    correlation: Correlation | None = None
    notes: tuple[str, ...] = ()
    checklist: tuple[Check, ...] = ()
    insight: Insight | None = None
    stopped: str | None = None  # what ended the search early: "the time limit", "Ctrl-C"
    loss: str = "linear"
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)  # of each counted curve
    intervals: Intervals | None = None
    ladder: Ladder | None = None

    @property
    def bistable_springs(self) -> dict[str, BistableSpring]:
        """The bistable springs of the chain by their prefix, "s1" at the base."""
        from foamfit.springs.spring import BistableSpring

        return {
            f"s{i}": spring
            for i, spring in enumerate(self.chain.springs, start=1)
            if isinstance(spring, BistableSpring)
        }

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``fit.json``: SI, plain types, null for what is not there.

        Returns
        -------
        dict
            Serialisable with ``allow_nan=False``; a number that is not finite becomes None.
        """
        derived = {
            name: {point: getattr(spring, point) for point in DERIVED_POINTS}
            for name, spring in self.bistable_springs.items()
        }
        content: dict[str, Any] = _plain(
            {
                "schema": SCHEMA,
                "foamfit": version("foamfit"),
                "test": self.measurement.name,
                "data_sha256": self.measurement.data_sha256,
                "data": asdict(self.measurement.rows) | {"notes": self.measurement.notes},
                "model": self.model,
                "drive": self.drive,
                "seed": self.seed,
                "status": self.status,
                "stopped": self.stopped,
                "loss": self.loss,
                "warnings": self.warnings,
                "notes": self.notes,
                "checklist": [
                    {"question": c.question, "answer": c.answer, "sentence": c.sentence}
                    for c in self.checklist
                ],
                "parameters": {name: asdict(p) for name, p in self.parameters.items()},
                **({"correlation": vars(self.correlation)} if self.correlation else {}),
                "derived": derived,
                "visited": self.visited,
                "misfit": self.misfit,
                "weights": self.weights,
                "statistics": self.statistics,
                "noise": self.noise,
                "outliers": {
                    channel: {
                        "at": found.at,
                        "values": found.values,
                        "clipped_at": found.clipped_at,
                    }
                    for channel, found in self.measurement.outliers.items()
                },
                "energy": self.energy,
                "runtime_s": self.runtime_s,
                **({"ladder": self.ladder.as_dict()} if self.ladder else {}),
            }
        )
        return content

    def save(self, folder: str | Path) -> Path:
        """Write the result folder whole, replacing an older one at the end.

        Parameters
        ----------
        folder : str or Path
            Where to; made with its parents. What stood there must be empty or a result folder that
            holds nothing else.

        Returns
        -------
        Path
            The folder, with ``fit.json``, ``parameters.csv``, ``curves.csv``, ``fit.png``,
            ``fit.pdf`` and ``report.html``; with profiles also ``profiles.csv``, of a ladder also
            ``ladder.csv``.

        Raises
        ------
        InputError
            If something else stands there or it cannot be written; nothing is changed then.
        """
        folder = Path(folder)
        check_target(folder)
        try:
            with replacing(folder.resolve()) as fresh:
                _write(self, fresh)
                check_target(folder)  # what has been put there in the meantime stays
        except OSError as error:
            raise InputError(
                f"the result cannot be written to {folder}: {reason(error)}; choose another folder"
            ) from error
        return folder


def check_target(folder: str | Path) -> None:
    """Raise InputError unless `folder` is free, empty or an older result that may be replaced."""
    folder = Path(folder)
    try:
        place = folder.resolve()
        here = Path.cwd()
        if place.exists() and any(place.samefile(at) for at in (here, *here.parents)):
            raise InputError(
                f"{folder} is the current directory or holds it, and a result folder is replaced "
                "as a whole; choose a folder of its own"
            )
        if place.is_dir():
            _check_replaceable(folder, place)
        elif os.path.lexists(place):
            raise InputError(f"{folder} is a file; choose a new or an empty folder")
        there = next(path for path in place.parents if path.exists())
        if not there.is_dir():
            raise InputError(
                f"{folder} cannot be written: {there} is a file; choose another folder"
            )
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(
                f"{folder} cannot be written: Permission denied in {there}; choose another folder"
            )
    except (OSError, RuntimeError) as error:  # also a link to itself
        raise InputError(
            f"{folder} cannot be written: {reason(error)}; choose another folder"
        ) from error


def _check_replaceable(folder: Path, place: Path) -> None:
    """Refuse a folder that is there, at `place`, and must not or cannot be replaced."""
    if place.is_mount():
        raise InputError(f"{folder} is a mount point and cannot be replaced; name a folder in it")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"{folder} cannot be written: Permission denied; choose another folder")
    there = sorted(place.iterdir())
    if there and not _is_of_fit(place / "fit.json"):
        raise InputError(
            f"{folder} is not empty and holds no foamfit result (no fit.json of foamfit), so it is "
            "not replaced; choose a new or an empty folder"
        )
    for path in there:
        if not is_written(path):
            raise InputError(
                f"{folder} holds {path.name}, which foamfit did not write, so it is not replaced; "
                "move that or choose another folder"
            )


def is_written(path: Path) -> bool:
    """Whether something in a result folder is what a fit writes there."""
    return path.name in RESULT_FILES and path.is_file() and not path.is_symlink()


def _is_of_fit(path: Path) -> bool:
    """Whether a fit.json is that of a fit, of this version or another one."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # neither UTF-8 nor JSON
        return False
    return isinstance(content, dict) and {"schema", "foamfit"} <= content.keys()


def load_result(folder: str | Path) -> dict[str, Any]:
    """Read the ``fit.json`` of a result folder.

    Parameters
    ----------
    folder : str or Path
        The result folder, or its ``fit.json``.

    Returns
    -------
    dict
        The content of ``fit.json``; values are SI.

    Raises
    ------
    InputError
        If there is no ``fit.json`` that this version of foamfit understands.
    """
    path = Path(folder)
    if path.is_dir():
        path = path / "fit.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{folder} is not a result folder: {path.name} cannot be read "
            f"({error.strerror or error})"
        ) from error
    except ValueError as error:  # neither UTF-8 nor JSON
        raise InputError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(content, dict) or "schema" not in content:
        raise InputError(f"{path} is not the result of a fit (it has no schema number)")
    if content["schema"] != SCHEMA:
        raise InputError(
            f"{path} has schema {content['schema']}, this foamfit reads schema {SCHEMA}"
        )
    return content


def _write(result: FitResult, folder: Path) -> None:
    from foamfit.report.page import render_report
    from foamfit.report.plots import image, laid_out, plot_fit

    text = json.dumps(result.to_json_dict(), indent=2, ensure_ascii=False, allow_nan=False)
    # A name that is no UTF-8 keeps its bytes as an escape of JSON.
    (folder / "fit.json").write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
    _write_table(folder / "parameters.csv", _parameter_rows(result.parameters))
    _write_table(folder / "curves.csv", _curve_rows(result.curves, result.measurement.outliers))
    if result.intervals is not None and result.intervals.profiles:
        _write_table(folder / "profiles.csv", _profile_rows(result.intervals))
    if result.ladder is not None:
        _write_table(folder / "ladder.csv", result.ladder.rows())
    figure = plot_fit(result)
    with laid_out(figure):
        png, pdf = image(figure, "png"), image(figure, "pdf")
    (folder / "fit.png").write_bytes(png)
    (folder / "fit.pdf").write_bytes(pdf)
    page = render_report(result, fit_png=png)
    (folder / "report.html").write_text(page, encoding="utf-8", errors="replace")


def _write_table(path: Path, rows: Iterable[Iterable[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def _parameter_rows(parameters: Mapping[str, ParameterEstimate]) -> Iterator[list[object]]:
    yield [
        "name", "value", "stderr", "ci95_low", "ci95_high", "unit", "state", "why", "ci95_method"
    ]  # fmt: skip
    for name, p in parameters.items():
        low, high = p.ci95 or (None, None)
        numbers = (_plain(number) for number in (p.value, p.stderr, low, high))
        yield [name, *numbers, p.unit, p.state, p.why, p.ci95_method]


def _profile_rows(intervals: Intervals) -> Iterator[Iterable[object]]:
    yield ["name", "value", "chi2", "chi2 of the 95 % cut", "complete"]
    for profile in intervals.profiles:
        for value, rise in zip(profile.values.tolist(), profile.rises.tolist(), strict=True):
            yield [profile.name, value, rise, profile.cut, profile.complete]


def _curve_rows(curves: Curves, outliers: Mapping[str, Outliers]) -> Iterator[Iterable[object]]:
    columns: dict[str, Array | None] = {
        "time (s)": curves.time,
        "measured stress (Pa)": curves.measured_stress,
        "fitted stress (Pa)": curves.stress,
        "measured displacement (m)": curves.measured_displacement,
        "fitted displacement (m)": curves.displacement,
        "stress along measured displacement (Pa)": curves.stress_along,
    }
    for node, (measured, fitted) in curves.interior.items():
        columns[f"measured {interior_channel(node)} (m)"] = measured
        columns[f"fitted {interior_channel(node)} (m)"] = fitted
    for channel, found in outliers.items():
        columns[f"outliers of {channel} left out"] = found.left_out.astype(int)
    there = {name: column for name, column in columns.items() if column is not None}
    yield there.keys()
    # Python floats are written with as many digits as they have, numpy's with their type's name.
    yield from zip(*(column.tolist() for column in there.values()), strict=True)


def _plain(value: Any) -> Any:
    """Return `value` in the types of JSON, with None for every number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
