"""A material card for finite elements, and what it loses of the fit that it is made of."""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from foamfit.arrays import Array
from foamfit.cards.curves import Curves, fitted_rates, follow, guessed, loading_curves
from foamfit.cards.figure import draw
from foamfit.cards.replay import REPLAYS, Unloading, fit_unloading, rate_of, unloading_curve
from foamfit.data.units import factor
from foamfit.errors import InputError
from foamfit.files import check_file, write_file
from foamfit.report.figures import image, laid_out
from foamfit.report.folder import load_result
from foamfit.report.render import environment
from foamfit.results import Fit, law_in_words, plain
from foamfit.study.joint_result import JointData
from foamfit.study.prediction.identified import HasContent, Source, read_source

# Of each format: ending of its file, what begins a comment, and what stands for a density that is
# not known, a parameter that is nowhere defined: the solvers refuse it.
FORMATS = {
    "mat083": (".k", "$", "&RHO"),
    "mat057": (".k", "$", "&RHO"),
    "law90": (".rad", "#", "&RHO"),
    "abaqus": (".inp", "**", "<RHO>"),
    "csv": (".csv", "#", ""),
}
# Mass, length, time and stress of the unit systems.
UNITS = {
    "kg-mm-ms": ("kg", "mm", "ms", "GPa"),
    "t-mm-s": ("t", "mm", "s", "MPa"),
    "SI": ("kg", "m", "s", "Pa"),
}
_LINE = 78  # characters of a comment
_COLUMNS = (
    *("time (s)", "measured stress (Pa)"),
    *("measured displacement (m)", "fitted displacement (m)"),
)


@dataclass(frozen=True, eq=False)
class Record:
    """A fitted test with the stress (Pa) of law and card along its record."""

    rate: float | None  # mean on loading, 1/s
    strain: Array  # measured; fitted where the test has only the force
    stress: Array  # measured
    motion: Array  # strain along which the law is followed: fitted; measured where that drives
    law: Array  # along `motion`
    card: Array  # along `strain`


@dataclass(frozen=True, eq=False)
class Card:
    """A material card, in SI but for its text.

    `misfit` of fit and card is the RMS over the measured range, over all tests.
    """

    name: str
    format: str
    units: str
    law: str
    curves: Curves
    unloading: Unloading
    misfit: dict[str, float | None]
    density: float | None
    warnings: tuple[str, ...]
    records: tuple[Record, ...]

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of FILE.json; curves in SI, engineering, compression positive."""
        c = self.curves
        made: dict[str, Any] = plain(
            {
                "format": self.format,
                "misfit": self.misfit,
                "parameters": self.unloading._asdict(),
                "curves": [
                    {"rate": rate, "strain": c.strain, "stress": one, "measured_to": c.measured_to}
                    for rate, one in zip(c.rates, c.stress, strict=True)
                ],
                "warnings": self.warnings,
            }
        )
        return made

    @property
    def text(self) -> str:
        """The card in its units."""
        mass, length, time, stress = UNITS[self.units]
        ending, sign, unknown = FORMATS[self.format]
        pa, dense = _per(stress, "Pa"), _per(f"{mass}/{length}^3", "kg/m^3")
        rates, stresses = self._written()
        slopes = pa * np.diff(self.curves.stress) / np.diff(self.curves.strain)
        values = {
            **{"card": self, "mass": mass, "length": length, "time": time, "stress": stress},
            "version": version("foamfit"),
            "density": unknown if self.density is None else dense * self.density,
            "modulus": float(slopes[:, : self.curves.measured - 1].max()),
            "stiffest": float(slopes.max()),
            "rates": (_per(f"1/{time}", "1/s") * rates).tolist(),
            "strain": self.curves.strain.tolist(),
            "stresses": (pa * stresses).tolist(),
        }
        environ = environment().overlay(loader=_loader())
        environ.filters["field"] = _field
        told = environ.get_template("comments.txt").render(values)
        told = told.encode("ascii", "replace").decode()
        lines = [line for one in told.splitlines() for line in textwrap.wrap(one, _LINE) or [""]]
        comments = "\n".join(f"{sign} {line}".rstrip() for line in lines)
        template = environ.get_template(f"{self.format}{ending}")
        return template.render(values, comments=comments) + "\n"

    def _written(self) -> tuple[Array, Array]:
        """Rates and stresses of the curves in the file: of Abaqus with the unloading curve.

        Abaqus refuses curves that meet; beyond the last rate it takes the last curve.
        """
        rates, stress = self.curves.rates, self.curves.stress
        if self.format != "abaqus":
            return rates, stress
        kept = [0, *(1 + np.flatnonzero(np.any(np.diff(stress, axis=0) > 0.0, axis=1)))]
        apart = np.cumprod([[1.0], *[[1.001]] * (len(kept) - 1)], axis=0)
        loading = apart * np.maximum.accumulate(stress[kept] / apart, axis=0)
        back = unloading_curve(self.curves, self.unloading)
        return np.array([-rates[0], *rates[kept]]), np.vstack([back, loading])

    def summary(self) -> str:
        """What the command prints of it."""
        return _words("terminal", card=self)

    def save(self, path: str | Path) -> Path:
        """Write the card, PATH.json, PATH.png and PATH.pdf; returns the path.

        Raises
        ------
        InputError
            If one of them cannot be written; nothing is written then.
        """
        path = Path(path)
        files = [path, *(path.with_name(f"{path.name}.{form}") for form in ("json", "png", "pdf"))]
        for one in files:
            check_file(one)
        figure = draw(self)
        with laid_out(figure):
            pictures = (image(figure, "png"), image(figure, "pdf"))
        told = json.dumps(self.to_json_dict(), indent=2, allow_nan=False) + "\n"
        for one, content in zip(files, (self.text.encode(), told.encode(), *pictures), strict=True):
            write_file(one, content)
        return path


def card(
    result: HasContent | str | Path,
    *,
    format: str,
    units: str = "kg-mm-ms",
    rates: Iterable[float | str] | None = None,
    out: str | Path | None = None,
) -> Card:
    r"""Make a material card of a fitted law.

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result of `fit` or `joint`, or its folder.
    format : str
        "mat083" (LS-DYNA \*MAT_FU_CHANG_FOAM), "mat057" (\*MAT_LOW_DENSITY_FOAM), "law90"
        (Radioss), "abaqus" (\*LOW DENSITY FOAM) or "csv" (the curves alone).
    units : str
        "kg-mm-ms", "t-mm-s" or "SI".
    rates : iterable of float, optional
        Strain rates of the loading curves, 1/s; by default those of the fitted tests.
    out : str or Path, optional
        File to write; FILE.json, FILE.png and FILE.pdf stand beside it.

    Returns
    -------
    Card
        `text`, `misfit`, `unloading`, `curves`, `warnings`; `save` writes it.

    Raises
    ------
    InputError
        If the result cannot be read or has no hysteretic spring, format or units are unknown, a
        rate is not positive, or `out` cannot be written.
    SimulationError
        If the law cannot be followed along a curve or a record.
    """
    asked = check(format, units, rates)
    source = read_source(result)
    if not any(law.hysteretic for law in source.model.laws):
        raise InputError(
            f"{source.where} has no hysteretic spring (model {source.model.words}), so it has no "
            "unloading; fit a bistable or a microscale spring"
        )
    tests = [_Test.of(*one) for one in _contents(result, source)]
    asked = asked or fitted_rates(source) or [1.0]
    chosen = [asked[(len(asked) - 1) // 2]] if format == "mat057" else asked
    measured_to = max(float(one.strain.max()) for one in tests)
    curves, crossed = loading_curves(source, chosen, measured_to)

    def replayed(strain: Array, time: Array) -> Any:
        return REPLAYS[format](curves, np.maximum(strain, 0.0), rate_of(strain, time))

    laws = [follow(source, one.rate, one.motion, one.time).base_stress for one in tests]
    unloading = fit_unloading(
        [replayed(one.motion, one.time) for one in tests], laws, expon=format != "mat057"
    )
    records = tuple(
        Record(
            one.rate,
            one.strain,
            one.stress,
            one.motion,
            law,
            replayed(one.strain, one.time)(unloading),
        )
        for one, law in zip(tests, laws, strict=True)
    )
    known = [one.density for one in tests if one.density is not None]
    told = _words(
        "warnings",
        source=source,
        format=format,
        asked=asked,
        chosen=chosen,
        crossed=crossed,
        untold=guessed(source, curves),
        density=bool(known),
    )
    found = Card(
        name=source.name,
        format=format,
        units=units,
        law=law_in_words(source.model.name, source.model.relaxation),
        curves=curves,
        unloading=unloading,
        misfit={
            "fit": _rms(one.misfit for one in tests),
            "card": _rms(_rms(one.card - one.stress) / np.ptp(one.stress) for one in records),
        },
        density=float(np.mean(known)) if known else None,
        warnings=tuple(told.splitlines()),
        records=records,
    )
    if out is not None:
        found.save(out)
    return found


def check(format: str, units: str, rates: Iterable[float | str] | None) -> list[float]:
    """Return the rates, ascending; InputError for an unknown format, units or rates."""
    for name, value, known in (("format", format, FORMATS), ("units", units, UNITS)):
        if value not in known:
            raise InputError(f"{name} = {value!r} is unknown; it must be one of {', '.join(known)}")
    given = (
        None if rates is None else [rates] if isinstance(rates, str | float | int) else list(rates)
    )
    try:
        found = sorted({float(rate) for rate in given or ()})
    except (TypeError, ValueError):
        found = [math.nan]
    if given == [] or not all(math.isfinite(rate) and rate > 0.0 for rate in found):
        told = ",".join(map(str, given or ()))
        raise InputError(f"rates = {told!r} must be positive numbers in 1/s, like 0.01,1,100")
    return found


def default_file(source: Source, format: str) -> Path:
    """Where the command writes a card: cards/<test>-<format> under the current directory."""
    name = re.sub(r"[^\w.+-]+", "-", source.name).strip("-.") or "card"
    return Path("cards", f"{name}-{format}{FORMATS[format][0]}")


# ------------------------------------------------------------------------------- the fitted tests


def _contents(
    result: object, source: Source
) -> Iterator[tuple[str, Mapping[str, Any], Sequence[Array | None]]]:
    """Give of each fitted test where it stands, the content of its fit.json, and `_COLUMNS`."""
    if isinstance(result, JointData):
        for one in result.test_fits():
            yield from _contents(one.fit(), source)
    elif isinstance(result, Fit):
        c = result.curves
        columns = (c.time, c.measured_stress, c.measured_displacement, c.displacement)
        yield result.measurement.name, result.to_json_dict(), columns
    elif isinstance(result, str | Path):
        folder = Path(result) if Path(result).is_dir() else Path(result).parent
        names = load_result(folder / "joint.json")["tests"] if source.joint else [""]
        for place in (folder / name for name in names):
            try:
                table = pd.read_csv(place / "curves.csv")
            except (OSError, ValueError) as error:
                raise InputError(f"{place / 'curves.csv'} cannot be read: {error}") from None
            there = [table[name].to_numpy(float) if name in table else None for name in _COLUMNS]
            yield str(place), load_result(place), there


@dataclass(frozen=True, eq=False)
class _Test:
    """A fitted test, SI; `strain`, `stress`, `motion` and `rate` as in `Record`."""

    rate: float | None
    time: Array
    strain: Array
    stress: Array
    motion: Array
    misfit: float | None
    density: float | None

    @classmethod
    def of(cls, where: str, content: Mapping[str, Any], columns: Sequence[Array | None]) -> _Test:
        """Make it of the content of fit.json and `_COLUMNS`; `where` is for messages."""
        time, stress, measured, fitted = columns
        specimen, misfit = content.get("specimen"), content["misfit"]
        strain, motion = (fitted, fitted) if measured is None else (measured, fitted)
        if specimen is None or stress is None or strain is None:
            lack = "height of the specimen" if specimen is None else "measured loop"
            raise InputError(f"{where} has no {lack}, which a card needs; fit the test again")
        height = specimen["height"]
        strain, motion = strain / height, (strain if motion is None else motion) / height
        if time is None:  # the law depends on none
            time = np.cumsum(np.abs(np.diff(motion, prepend=motion[0])) + 1e-9)
        off = [misfit[name] for name in ("stress_strain", "stress_time") if misfit.get(name)]
        mass = specimen["mass"]
        density = None if mass is None else mass / (height * specimen["area"])
        rate = content["data"].get("rate")
        return cls(rate, time, strain, stress, motion, off[0] if off else None, density)


def _rms(values: Iterable[float | None]) -> float | None:
    """Root mean square of what is known."""
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


# ------------------------------------------------------------------------------- the text


def _loader() -> Any:
    from jinja2 import PackageLoader

    return PackageLoader("foamfit.cards")


def _words(name: str, **values: Any) -> str:
    """Return a text of a template, without empty lines."""
    told = environment().overlay(loader=_loader()).get_template(f"{name}.txt").render(**values)
    return "\n".join(line for line in told.splitlines() if line.strip())


def _field(value: float | str, width: int = 10) -> str:
    """Write a number right-aligned into a field of a fixed width, a blank before it."""
    for digits in range(9, 0, -1):
        text = value if isinstance(value, str) else f"{value:.{digits}G}"
        text += ".0" if isinstance(value, float) and text.lstrip("-").isdigit() else ""
        if len(text) < width:
            return text.rjust(width)
    raise ValueError(f"{value} has no room in {width} columns")


def _per(unit: str, si: str) -> float:
    """Return how many of a unit one SI unit is."""
    one = factor(unit, si)
    assert one is not None
    return 1.0 / one
