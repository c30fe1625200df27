"""A material card for finite elements: its text, misfit, warnings and figure."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array, single_threaded
from foamfit.cards import loading
from foamfit.codec import plain
from foamfit.data.cycles import loading_rate
from foamfit.data.units import factor
from foamfit.errors import InputError
from foamfit.files import check_file, write_file
from foamfit.parts import law_in_words
from foamfit.report.figures import BLUE, SEEN, TWO, VERMILION, images
from foamfit.report.folder import Result
from foamfit.report.panels import AXES, Line, Panel
from foamfit.report.plots import panelled
from foamfit.report.render import environment, sentences
from foamfit.results import Fit
from foamfit.study.identified import load, read_source
from foamfit.study.joint_result import JointResult
from foamfit.text import percent, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Labels and styles of the curves of a record.
LOOKS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("measured", SEEN),
    ("fitted", {"color": VERMILION, "lw": 0.9}),
    ("card", {"color": BLUE, "lw": 1.0, "ls": (0, (5, 1.2))}),
)
MOST = 2  # records drawn: the slowest and the fastest
# File suffix, comment sign and placeholder of an unknown density of each format. The placeholder is
# an undefined parameter, which the solvers reject.
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
_LINE = 78  # most characters of a comment


@dataclass(frozen=True, eq=False)
class Record:
    """The record of a fitted test, SI, with the stress that the card has along its motion."""

    rate: float | None  # mean strain rate on loading, 1/s
    time: Array
    strain: Array  # measured, or fitted if only the force was measured
    stress: Array  # measured
    motion: Array  # strain history of law and card: fitted for an impact, otherwise measured
    fitted: Array  # stress of the fit along `motion`
    misfit: float | None  # of the fit
    density: float | None
    card: Array = field(default_factory=lambda: np.empty(0))

    @property
    def misfit_of_card(self) -> float:
        """RMS of card minus measured stress over the measured range."""
        return float(np.sqrt(np.mean((self.card - self.stress) ** 2)) / np.ptp(self.stress))

    @classmethod
    def of(cls, result: Fit) -> Record:
        """Return the record of a fit without its fitted zeros, scale of the force and delay."""
        test, c, impact = result.measurement, result.curves, result.drive == "impact"
        measured, specimen = c.measured_displacement, test.specimen
        moved = c.displacement if measured is None else measured
        if c.measured_stress is None or moved is None:
            raise InputError(f"{test.name} has no measured loop; a card needs force and motion")
        fitted = c.stress if impact else c.stress_along
        stress, fitted = (
            result.nuisance("force_scale", 1.0) * (one - result.zero_of("stress"))
            for one in (c.measured_stress, c.measured_stress if fitted is None else fitted)
        )
        strain, motion = (
            (one - result.zero_of("displacement")) / specimen.height
            for one in (moved, c.displacement if impact and c.displacement is not None else moved)
        )
        late, time = result.nuisance("time_shift"), c.time
        if late and time is not None:
            strain, motion = (np.interp(time + late, time, one) for one in (strain, motion))
        # The law of a record without time does not depend on time.
        steps = np.abs(np.diff(motion, prepend=motion[0])) + 1e-9
        mass, volume = specimen.mass, specimen.height * specimen.area
        return cls(
            rate=loading_rate(test),
            time=np.cumsum(steps) if c.time is None else c.time,
            strain=strain,
            stress=stress,
            motion=motion,
            fitted=fitted,
            misfit=result.misfit["stress_time" if impact else "stress_strain"],
            density=None if mass is None else mass / volume,
        )


def read_records(result: object) -> list[Record]:
    """Return the records of the fitted tests of a result of `fit` or `joint`, or of its folder."""
    if isinstance(result, str | Path):
        path = Path(result)
        return read_records(load(path if path.is_dir() else path.parent))
    if isinstance(result, JointResult):
        return [Record.of(one) for one in result.results.values()]
    if isinstance(result, Fit):
        return [Record.of(result)]
    raise InputError(f"a card needs a result of fit or joint, not {result!r}")


@dataclass(frozen=True, eq=False)
class Card:
    """A material card; only its text is in `units`, everything else is in SI."""

    name: str
    format: str
    units: str
    law: str
    curves: loading.Curves
    unloading: loading.Unloading
    misfit: dict[str, float | None]  #: RMS over the measured range of fit and card, over all tests
    density: float | None
    warnings: tuple[str, ...]
    records: tuple[Record, ...]

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of FILE.json; curves in SI, engineering, compression positive."""
        c = self.curves
        curves = [
            {"rate": rate, "strain": c.strain, "stress": one, "measured_to": c.measured_to}
            for rate, one in zip(c.rates, c.stress, strict=True)
        ]
        parameters = self.unloading._asdict()
        content: dict[str, Any] = {"format": self.format, "misfit": self.misfit}
        content |= {"parameters": parameters, "curves": curves, "warnings": self.warnings}
        return dict(plain(content))

    @property
    def text(self) -> str:
        """The text of the card, in its units."""
        mass, length, time, stress = UNITS[self.units]
        ending, sign, unknown = FORMATS[self.format]
        units = ((stress, "Pa"), (f"{mass}/{length}^3", "kg/m^3"), (f"1/{time}", "1/s"))
        pa, dense, per_time = (1.0 / (factor(*one) or math.nan) for one in units)
        rates, stresses = self._written()
        slopes = pa * np.diff(self.curves.stress) / np.diff(self.curves.strain)
        values = {
            **{"card": self, "mass": mass, "length": length, "time": time, "stress": stress},
            "density": unknown if self.density is None else dense * self.density,
            "modulus": float(slopes[:, : self.curves.measured - 1].max()),
            "stiffest": float(slopes.max()),
            "rates": (per_time * rates).tolist(),
            "strain": self.curves.strain.tolist(),
            "stresses": (pa * stresses).tolist(),
        }
        text = (one.encode("ascii", "replace").decode() for one in sentences("comments", **values))
        lines = (line for one in text for line in textwrap.wrap(one, _LINE))
        values["comments"] = "\n".join(f"{sign} {line}" for line in lines)
        template = environment().get_template(f"{self.format}{ending}")
        return f"{template.render(values).rstrip()}\n"

    def _written(self) -> tuple[Array, Array]:
        """Return rates and stresses of the curves in the file; for Abaqus also the unloading."""
        rates, stress = self.curves.rates, self.curves.stress
        if self.format != "abaqus":
            return rates, stress
        # Abaqus rejects curves that meet; beyond the last rate it uses the last curve.
        kept = [0, *(1 + np.flatnonzero(np.any(np.diff(stress, axis=0) > 0.0, axis=1)))]
        apart = np.cumprod([[1.0], *[[1.001]] * (len(kept) - 1)], axis=0)
        loaded = apart * np.maximum.accumulate(stress[kept] / apart, axis=0)
        back = loading.unloading_curve(self.curves, self.unloading)
        return np.array([-rates[0], *rates[kept]]), np.vstack([back, loaded])

    def __repr__(self) -> str:
        """Return a summary of the card and its warnings, as the command prints them."""
        return "\n".join(sentences("terminal", card=self))

    def save(self, path: str | Path) -> Path:
        """Write the card, PATH.json, .png and .pdf; InputError first if one cannot be written."""
        path = Path(path)
        files = [path, *(Path(f"{path}.{form}") for form in ("json", "png", "pdf"))]
        for one in files:
            check_file(one)
        _check_own(path, files[1])
        figure = draw(self)
        text = json.dumps(self.to_json_dict(), indent=2, allow_nan=False) + "\n"
        contents = (self.text.encode(), text.encode(), *images(figure, "png", "pdf"))
        for one, content in zip(files, contents, strict=True):
            write_file(one, content)
        return path


def _check_own(path: Path, beside: Path) -> None:
    """Raise InputError if the file exists and is not a card, which has a FILE.json beside it."""
    with suppress(OSError, ValueError, AttributeError):
        if not path.is_file() or {"format", "curves"} <= json.loads(beside.read_bytes()).keys():
            return
    raise InputError(f"{path} exists and is not a card of foamfit; choose another name")


def draw(card: Card) -> Figure:
    """Draw the records with law and card along them, and the complete loading curves."""
    misfits = (f"{name} {percent(rms)}" for name, rms in card.misfit.items() if rms is not None)
    shown, curves = sorted(card.records, key=lambda one: one.rate or 0.0), card.curves
    if len(shown) > MOST:
        shown = [shown[0], shown[-1]]
    axes, panels = AXES["stress-strain"], list[Panel]()
    for one in shown:
        pairs = ((one.strain, one.stress), (one.motion, one.fitted), (one.motion, one.card))
        lines = [Line(*pair, *look) for pair, look in zip(pairs, LOOKS, strict=True)]
        rate = "rate not known" if one.rate is None else f"{significant(one.rate, 3)} 1/s"
        panels.append(Panel("record", *axes, lines, title=rate))
    inside, lines = curves.measured, []
    for shade, stress in zip(np.linspace(0.4, 1.0, len(curves.rates)), curves.stress, strict=True):
        style = {"color": BLUE, "alpha": float(shade), "lw": 1.0}
        lines.append(Line(curves.strain[:inside], stress[:inside], "_measured", style))
        beyond = slice(inside - 1, None)
        lines.append(Line(curves.strain[beyond], stress[beyond], "_beyond", style | {"ls": ":"}))
    panels.append(Panel("loading", *axes, lines, title="loading; dotted: extrapolated"))
    about = f"{card.name} as {card.format}", f"misfit: {', '.join(misfits)}"
    return panelled(panels, TWO, *about)


@single_threaded
def card(
    result: Result | str | Path,
    *,
    format: str,
    units: str = "kg-mm-ms",
    rates: float | Iterable[float | str] | None = None,
    out: str | Path | None = None,
) -> Card:
    r"""Make a material card (`Card`) of a fitted law.

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result of `fit` or `joint`, or its folder.
    format : str
        "mat083" (LS-DYNA \*MAT_FU_CHANG_FOAM), "mat057" (\*MAT_LOW_DENSITY_FOAM), "law90"
        (Radioss), "abaqus" (\*LOW DENSITY FOAM) or "csv" (only the curves).
    units : str
        "kg-mm-ms", "t-mm-s" or "SI".
    rates : float or iterable of float, optional
        Strain rates of the loading curves, 1/s; by default those of the fitted tests.
    out : str or Path, optional
        File to write; FILE.json, FILE.png and FILE.pdf are written next to it.

    Raises
    ------
    InputError
        If the result cannot be read or has no hysteretic spring, format or units are unknown, a
        rate is not positive, or `out` cannot be written.
    SimulationError
        If the law cannot be simulated along a curve or a record.
    """
    requested = check(format, units, rates)
    source = read_source(result)
    if not any(law.hysteretic for law in source.model.laws):
        raise InputError(
            f"{source.where} has no hysteretic spring (model {source.model.words}), so it has no "
            "unloading; a card needs a fit with a hysteretic spring"
        )
    records = read_records(result)
    requested = requested or loading.fitted_rates(source) or [1.0]
    chosen = [requested[(len(requested) - 1) // 2]] if format == "mat057" else requested
    measured_to = max(one.motion.max() for one in records)
    curves, crossed = loading.curves_at(source, chosen, measured_to)
    motions = (loading.Motion.of(one.motion, one.time) for one in records)
    replays = [loading.REPLAYS[format](curves, motion) for motion in motions]
    laws = (loading.follow(source, one.rate, one.motion, one.time).base_stress for one in records)
    pairs = zip(records, laws, strict=True)
    targets = [np.where(one.motion > 0.0, law, 0.0) for one, law in pairs]  # cards have no tension
    unloading = loading.fit_unloading(replays, targets, expon=format != "mat057")
    each = zip(records, replays, strict=True)
    records = [replace(one, card=replay(unloading)) for one, replay in each]
    densities = [one.density for one in records if one.density is not None]
    told = {"source": source, "format": format, "requested": requested, "chosen": chosen}
    told |= {"guessed": loading.guessed(source, curves), "density": bool(densities)}
    made = Card(
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
        density=float(np.mean(densities)) if densities else None,
        warnings=sentences("warnings", crossed=crossed, **told),
        records=tuple(records),
    )
    if out is not None:
        made.save(out)
    return made


def check(format: str, units: str, rates: float | Iterable[float | str] | None) -> list[float]:
    """Return the rates, ascending; InputError for an unknown format or units, or invalid rates."""
    for name, value, known in (("format", format, FORMATS), ("units", units, UNITS)):
        if value not in known:
            raise InputError(f"{name} = {value!r} is unknown; it must be one of {', '.join(known)}")
    if rates is None:
        return []
    given = [rates] if isinstance(rates, str | int | float) else list(rates)
    found = list[float]()
    with suppress(TypeError, ValueError):
        found = sorted({float(rate) for rate in given})
    if not found or not all(0.0 < rate < math.inf for rate in found):
        raise InputError(
            f"rates = {','.join(map(str, given))} must be positive numbers in 1/s, like 0.01,1,100"
        )
    return found


def _rms(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None
