"""A material card for finite elements, and what it loses of the fit that it is made of."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array, single_threaded
from foamfit.cards.curves import (
    REPLAYS,
    Curves,
    Motion,
    Unloading,
    fit_unloading,
    fitted_rates,
    follow,
    guessed,
    loading_curves,
    unloading_curve,
)
from foamfit.cards.records import Record, draw, read_records
from foamfit.data.units import factor
from foamfit.errors import InputError
from foamfit.files import check_file, write_file
from foamfit.report.figures import image, laid_out
from foamfit.report.render import environment
from foamfit.results import law_in_words, plain
from foamfit.study.identified import HasContent, read_source

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
        units = ((stress, "Pa"), (f"{mass}/{length}^3", "kg/m^3"), (f"1/{time}", "1/s"))
        pa, dense, per_time = (1.0 / (factor(*one) or math.nan) for one in units)
        rates, stresses = self._written()
        slopes = pa * np.diff(self.curves.stress) / np.diff(self.curves.strain)
        values = {
            **{"card": self, "mass": mass, "length": length, "time": time, "stress": stress},
            "version": version("foamfit"),
            "density": unknown if self.density is None else dense * self.density,
            "modulus": float(slopes[:, : self.curves.measured - 1].max()),
            "stiffest": float(slopes.max()),
            "rates": (per_time * rates).tolist(),
            "strain": self.curves.strain.tolist(),
            "stresses": (pa * stresses).tolist(),
        }
        told = _words("comments", **values).encode("ascii", "replace").decode()
        lines = [line for one in told.splitlines() for line in textwrap.wrap(one, _LINE)]
        values["comments"] = "\n".join(f"{sign} {line}" for line in lines)
        template = _templates().get_template(f"{self.format}{ending}")
        return f"{template.render(values).rstrip()}\n"

    def _written(self) -> tuple[Array, Array]:
        """Rates and stresses of the curves in the file: of Abaqus with the unloading curve."""
        rates, stress = self.curves.rates, self.curves.stress
        if self.format != "abaqus":
            return rates, stress
        # Abaqus refuses curves that meet; beyond the last rate it takes the last curve.
        kept = [0, *(1 + np.flatnonzero(np.any(np.diff(stress, axis=0) > 0.0, axis=1)))]
        apart = np.cumprod([[1.0], *[[1.001]] * (len(kept) - 1)], axis=0)
        loading = apart * np.maximum.accumulate(stress[kept] / apart, axis=0)
        back = unloading_curve(self.curves, self.unloading)
        return np.array([-rates[0], *rates[kept]]), np.vstack([back, loading])

    def __repr__(self) -> str:
        """Tell what the card is and what it loses, as the command prints it."""
        return _words("terminal", card=self)

    def save(self, path: str | Path) -> Path:
        """Write the card, PATH.json, PATH.png and PATH.pdf; returns the path.

        Raises InputError if one of them cannot be written; nothing is written then.
        """
        path = Path(path)
        files = [path, *(path.with_name(f"{path.name}.{form}") for form in ("json", "png", "pdf"))]
        for one in files:
            check_file(one)
        figure = draw(f"{self.name} as {self.format}", self.misfit, self.records, self.curves)
        with laid_out(figure):
            pictures = (image(figure, "png"), image(figure, "pdf"))
        told = json.dumps(self.to_json_dict(), indent=2, allow_nan=False) + "\n"
        contents = (self.text.encode(), told.encode(), *pictures)
        for done, (one, content) in enumerate(zip(files, contents, strict=True)):
            try:
                write_file(one, content)
            except InputError:
                for written in files[:done]:
                    written.unlink()
                raise
        return path


@single_threaded
def card(
    result: HasContent | str | Path,
    *,
    format: str,
    units: str = "kg-mm-ms",
    rates: float | Iterable[float | str] | None = None,
    out: str | Path | None = None,
) -> Card:
    r"""Make a material card of a fitted law, a `Card`.

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result of `fit` or `joint`, or its folder.
    format : str
        "mat083" (LS-DYNA \*MAT_FU_CHANG_FOAM), "mat057" (\*MAT_LOW_DENSITY_FOAM), "law90"
        (Radioss), "abaqus" (\*LOW DENSITY FOAM) or "csv" (the curves alone).
    units : str
        "kg-mm-ms", "t-mm-s" or "SI".
    rates : float or iterable of float, optional
        Strain rates of the loading curves, 1/s; by default those of the fitted tests.
    out : str or Path, optional
        File to write; FILE.json, FILE.png and FILE.pdf stand beside it.

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
            "unloading; make the card of a fit with a hysteretic one"
        )
    records = read_records(result)
    asked = asked or fitted_rates(source) or [1.0]
    chosen = [asked[(len(asked) - 1) // 2]] if format == "mat057" else asked
    curves, crossed = loading_curves(source, chosen, max(one.motion.max() for one in records))
    replays = [REPLAYS[format](curves, Motion.of(one.motion, one.time)) for one in records]
    laws = [follow(source, one.rate, one.motion, one.time).base_stress for one in records]
    targets = [  # a card has no tension
        np.where(one.motion > 0.0, law, 0.0) for one, law in zip(records, laws, strict=True)
    ]
    unloading = fit_unloading(replays, targets, expon=format != "mat057")
    records = [
        dataclasses.replace(one, card=replay(unloading))
        for one, replay in zip(records, replays, strict=True)
    ]
    known = [one.density for one in records if one.density is not None]
    told = _words(
        "warnings",
        source=source,
        format=format,
        asked=asked,
        chosen=chosen,
        crossed=crossed,
        guessed=guessed(source, curves),
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
            "fit": _rms(one.misfit for one in records),
            "card": _rms(one.misfit_of_card for one in records),
        },
        density=float(np.mean(known)) if known else None,
        warnings=tuple(told.splitlines()),
        records=tuple(records),
    )
    if out is not None:
        found.save(out)
    return found


def check(format: str, units: str, rates: float | Iterable[float | str] | None) -> list[float]:
    """Return the rates, ascending; InputError for an unknown format, units or rates."""
    for name, value, known in (("format", format, FORMATS), ("units", units, UNITS)):
        if value not in known:
            raise InputError(f"{name} = {value!r} is unknown; it must be one of {', '.join(known)}")
    if rates is None:
        return []
    given = [rates] if isinstance(rates, str | int | float) else list(rates)
    try:
        found = sorted({float(rate) for rate in given})
    except (TypeError, ValueError):
        found = []
    if not found or not all(0.0 < rate < math.inf for rate in found):
        told = ",".join(map(str, given))
        raise InputError(f"rates = {told} must be positive numbers in 1/s, like 0.01,1,100")
    return found


def _rms(values: Iterable[float | None]) -> float | None:
    """Root mean square of what is known."""
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _templates() -> Any:
    from jinja2 import PackageLoader

    made = environment().overlay(loader=PackageLoader("foamfit.cards"))
    made.filters["field"] = _field
    return made


def _words(name: str, **values: Any) -> str:
    """Return a text of a template, without empty lines."""
    told = _templates().get_template(f"{name}.txt").render(**values)
    return "\n".join(line for line in told.splitlines() if line.strip())


def _field(value: float | str, width: int = 10) -> str:
    """Write a number right-aligned into a field of a fixed width, a blank before it."""
    for digits in range(9, 0, -1):
        text = value if isinstance(value, str) else f"{value:.{digits}G}"
        text += ".0" if isinstance(value, float) and text.lstrip("-").isdigit() else ""
        if len(text) < width:
            return text.rjust(width)
    raise ValueError(f"{value} has no room in {width} columns")
