"""Result of a fit: data only. Saving and drawing are in `report`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import plain
from foamfit.data.calibration import Contradiction
from foamfit.data.cycles import cycles_of, loading_rate
from foamfit.data.measurement import Measurement, interior_channel
from foamfit.parts import Ladder, OfLaw, ParameterEstimate
from foamfit.springs.chain import Chain
from foamfit.springs.spring import Spring

if TYPE_CHECKING:
    import lmfit

    from foamfit.trust.identifiability import Insight

_Stress = TypeVar("_Stress", float, Array)
SCHEMA = 1
# Sources of an uncertainty budget; those in `STATED` have a ± in the TOML and are not fitted.
STATED = ("mass", "height", "area", "calibration")
SOURCES = ("noise", "contact and zero", "velocity", *STATED, "law")


@dataclass(frozen=True, eq=False)
class Curves:
    """Measured and fitted curves, one value per sample of the conditioned test; None if absent.

    `stress` and `displacement` are simulated under the drive (base stress in Pa, top displacement
    in m); `stress_along` is the stress (Pa) of the identified springs along the measured
    displacement. `interior` contains the measured and fitted displacements (m) of the interior
    masses; mass 1 is above spring 1.
    """

    time: Array | None
    measured_stress: Array | None
    measured_displacement: Array | None
    stress: Array | None
    displacement: Array | None
    stress_along: Array | None
    interior: dict[int, tuple[Array, Array]] = field(default_factory=dict)


class Loop(NamedTuple):
    """Measured and fitted stress (Pa) of a test against its strain, or else against time (s)."""

    name: str
    along: Array
    label: str  # of the abscissa
    measured: Array
    fitted: Array | None


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation matrix of the identified parameters and of those that follow from them.

    `stderr` are the local standard errors, SI, including those of undetermined parameters; NaN
    where the data fix only a combination.
    """

    names: tuple[str, ...]
    matrix: Array
    stderr: Array | None = None


@dataclass(frozen=True, eq=False)
class Profile:
    """Profile of a parameter: the least cost at fixed values of it."""

    name: str  # of the parameter
    values: Array  # (m,): its fixed values, ascending, SI, including the best one
    rises: Array  # (m,): rise of the cost as a χ² of one degree of freedom
    points: Array  # (m, n): all parameters of the model
    cut: float  # χ² of the 95 % interval
    ci95: tuple[float, float]  # outermost crossings of the cut, or limits of the parameter
    stopped: str | None = None  # what ended it early: "the time limit" or "Ctrl-C"

    @property
    def complete(self) -> bool:
        """Whether the profile was followed to both ends."""
        return self.stopped is None

    def rows(self) -> Iterator[dict[str, object]]:
        """Yield the rows of profiles.csv, SI."""
        about = {"chi2 of the 95 % cut": self.cut, "complete": self.complete}
        for value, rise in zip(self.values.tolist(), self.rises.tolist(), strict=True):
            yield {"name": self.name, "value": value, "chi2": rise, **about}


@dataclass(frozen=True, eq=False)
class Intervals:
    """The 95 % intervals of a fit and their methods."""

    # Ends and methods of the intervals that are not from the local covariance
    ends: dict[str, tuple[float, float]] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()  # including incomplete ones
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  # why the intervals differ from those requested
    better: Array | None = None  # a point of lower cost from which the fit should continue
    # Values far outside the interval that fit the curves almost as well
    elsewhere: dict[str, float] = field(default_factory=dict)
    # Ends of the ranges that include model error, where there is one
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    ranged: bool = True  # False if the fit was stopped before it computed ranges that it needs
    # Samples of a Markov chain, (walkers, steps) by parameter, SI; kept in `Fit.draws`
    draws: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Snapping:
    """Snapping of the micro-springs of a microscale spring along the fitted curves."""

    fraction: Array  # of micro-springs in the snapped state, one per sample
    stress: Array  # equilibrium stress of the spring, Pa

    @property
    def turn(self) -> int:
        """Sample at which the snapped fraction is largest."""
        return int(np.argmax(self.fraction))

    @property
    def most(self) -> float:
        """Largest snapped fraction; the test gives no information about the other springs."""
        return float(self.fraction[self.turn])

    @property
    def ever(self) -> Array:
        """Fraction that has snapped at least once so far, one per sample."""
        return np.maximum.accumulate(self.fraction)

    @property
    def halves(self) -> tuple[int | None, int | None]:
        """First samples at which half have snapped and half have snapped back; None if never."""
        turn, snapped = self.turn, self.fraction >= 0.5
        if not snapped[turn]:
            return None, None
        back = np.flatnonzero(~snapped[turn:])
        return int(np.argmax(snapped)), turn + int(back[0]) if back.size else None


@dataclass(frozen=True)
class Budget:
    """Uncertainty budget of a fit (after JCGM 100:2008, the GUM).

    For each determined parameter of the springs, `contributions` contains one standard deviation
    from each source, in SI:

    - "noise": noise of the samples.
    - "contact and zero": added by fitting the contact time and the zeros of the channels.
    - "velocity": added by fitting the striker's velocity and mass, and a delay, within their ±.
      These first three combine to the standard error.
    - "mass", "height", "area", "calibration": from their ± in the TOML; combined, `systematic`.
    - "law": half of the parameter's `range` over 1.96, as if the range were a 95 % interval.

    `scales` (SI) are the scales of the parameters, mostly their values.
    """

    contributions: dict[str, dict[str, float]]
    scales: dict[str, float]

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources that contribute to any parameter, in the order of `SOURCES`."""
        rows = self.contributions.values()
        return tuple(source for source in SOURCES if any(row[source] > 0.0 for row in rows))

    @property
    def telling(self) -> bool:
        """Whether the budget adds anything to the standard errors and ranges."""
        return bool(set(self.sources) - {"noise", "law"})

    def combined(self, name: str) -> float:
        """Return the root sum of squares of all contributions to a parameter, SI."""
        return math.hypot(*self.contributions[name].values())

    def rows(self) -> Iterator[dict[str, object]]:
        """Yield the rows of budget.csv, in SI except for the last column."""
        for name, row in self.contributions.items():
            total, scale = self.combined(name), self.scales[name]
            parts = {source: plain(row[source]) for source in SOURCES}
            sums = {"combined": total, "scale": scale, "combined over scale": total / scale}
            yield {"name": name, **parts, **sums}


@dataclass(frozen=True)
class Switch:
    """A change of branch in the fitted response: spring, time, and place on the curves."""

    spring: int  # 1 at the base
    source: str  # branch before
    target: str  # branch after
    time: float | None  # s
    displacement: float  # of the top, m
    stress: float  # Pa


@dataclass(frozen=True)
class Check:
    """One question of the checklist, phrased so that "yes" is good."""

    key: str  # short name
    question: str
    answer: bool | None  # None if unknown
    sentence: str  # evidence for the answer
    warnings: tuple[str, ...] = ()  # shown if the answer is negative
    fatal: bool = False  # whether a "no" means that no acceptable fit was found


def stamp() -> dict[str, Any]:
    """Return the entries with which every result file begins."""
    return {"schema": SCHEMA, "foamfit": version("foamfit")}


def flags_of(test: Measurement) -> dict[str, Array]:
    """Return columns of flags: which samples are left out as outliers, and which are measured."""
    left = {f"outliers of {name} left out": one.left_out for name, one in test.outliers.items()}
    seen = {f"{name} is measured": sampled for name, sampled in test.sampled.items()}
    return {name: flags.astype(int) for name, flags in (left | seen).items()}


@dataclass(frozen=True, eq=False)
class Fit(OfLaw):
    """Result of a fit."""

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
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)  # of each fitted curve
    intervals: Intervals | None = None
    ladder: Ladder | None = None
    relaxation: int = 0  # terms of each hysteretic spring
    interior_mass: bool = False  # whether the specimen's mass was placed between the springs
    budget: Budget | None = None
    # Mean and standard deviation of the priors, SI
    priors: dict[str, tuple[float, float]] = field(default_factory=dict)
    # The model and the options that change the numbers, apart from defaults; None if unknown
    options: dict[str, Any] | None = None
    # Samples of a Markov chain, (walkers, steps) by parameter, SI; empty without a chain
    draws: dict[str, Array] = field(default_factory=dict)
    contradictions: tuple[Contradiction, ...] = ()  # of the record, which the fit does not settle
    # All parameters at which the weights due to an uncertain motion were found, SI; empty without
    weighed_at: tuple[float, ...] = ()
    # The problem of the fit, and what the fit cost (`trust.conclude`); not in its folder
    problem: Any = field(default=None, repr=False)
    effort: Any = None

    def __post_init__(self) -> None:
        """Set the correlations of lmfit's parameters."""
        if self.correlation is None:
            return
        names = self.correlation.names
        for name, row in zip(names, self.correlation.matrix, strict=True):
            pairs = zip(names, row.tolist(), strict=True)
            shown = {other: c for other, c in pairs if other != name and math.isfinite(c)}
            if (one := self.params.get(name)) is not None and one.stderr is not None:
                one.correl = shown

    @property
    def springs(self) -> dict[str, Spring]:
        """The springs of the chain by their prefix, "s1" at the base."""
        return {f"s{i}": spring for i, spring in enumerate(self.chain.springs, start=1)}

    @property
    def words(self) -> str:
        """The model as `--model` takes it."""
        from foamfit.springs.model import Model  # drawing needs no compiler

        return Model.parse(self.model).words

    @property
    def by_cycle(self) -> dict[int, dict[str, Any]]:
        """Misfit, energy and snapping of each cycle of a history fitted under a driven motion.

        The misfit is over the cycle's own range. The dissipated energy is measured and fitted
        (J/m³). "ever_snapped" is the fraction of each spring's micro-springs that has snapped at
        least once by the end of the cycle. Empty for a single cycle and for the other drives.
        """
        c, strain, out = self.curves, self.strain, dict[int, dict[str, Any]]()
        fitted, measured, snapping = c.stress, c.measured_stress, self.snapping
        if self.drive != "displacement" or strain is None or fitted is None or measured is None:
            return out
        for number, part in cycles_of(self.measurement).items():
            rms = float(np.sqrt(np.mean((fitted - measured)[part] ** 2)))
            out[number] = {
                "misfit": rms / float(np.ptp(measured[part])),
                "dissipated_measured": float(np.trapezoid(measured[part], strain[part])),
                "dissipated_fitted": float(np.trapezoid(fitted[part], strain[part])),
                "ever_snapped": {n: float(one.ever[part][-1]) for n, one in snapping.items()},
            }
        return out

    @property
    def profiles(self) -> list[Profile]:
        """The profiles, with times and zeros counted from those of the file, as `parameters`."""
        moved = list[Profile]()
        for one in self.intervals.profiles if self.intervals else ():
            by = self.measurement.origins.get(one.name, 0.0)
            low, high = one.ci95
            moved.append(replace(one, values=one.values + by, ci95=(low + by, high + by)))
        return moved

    @property
    def at_noise(self) -> bool | None:
        """Whether the residuals are at the noise level; None if unknown."""
        return next((check.answer for check in self.checklist if check.key == "noise"), None)

    @property
    def strain(self) -> Array | None:
        """Overall strain along the fitted curves; None if neither simulated nor measured."""
        c = self.curves
        moved = c.measured_displacement if c.displacement is None else c.displacement
        return None if moved is None else moved / self.measurement.specimen.height

    def nuisance(self, name: str, exact: float = 0.0) -> float:
        """Return a nuisance parameter of the measured curves, SI; `exact` if it was not fitted.

        Zeros and times are counted from those that the preparation has taken off.
        """
        fitted = self.parameters.get(name)
        return fitted.value - self.measurement.origins.get(name, 0.0) if fitted else exact

    def zero_of(self, channel: str) -> float:
        """Return the fitted zero of a channel in the measured curves, Pa or m; 0 if exact."""
        return self.nuisance(f"{channel}_zero")

    def as_read(self, stress: _Stress) -> _Stress:
        """Return a stress as the measured curves show it: with its fitted scale and zero, Pa."""
        return stress / self.nuisance("force_scale", 1.0) + self.zero_of("stress")

    @property
    def loop(self) -> Loop | None:
        """The loop against strain, or else against time; None if neither was measured."""
        test, fitted = self.measurement, self.curves
        if test.displacement is not None and fitted.stress_along is not None:
            strain = test.displacement / test.specimen.height
            return Loop(test.name, strain, "strain", test.stress, fitted.stress_along)
        if test.time is None:
            return None
        return Loop(test.name, test.time, "time (s)", test.stress, fitted.stress)

    @property
    def snapping(self) -> dict[str, Snapping]:
        """Snapping of each microscale spring along the fitted curves, where it is known.

        For a single spring it follows from the strain; in a chain it follows from the stress if
        all springs are in equilibrium and there is no striker.
        """
        springs, strain, out = self.springs, self.strain, dict[str, Snapping]()
        if strain is not None and (zero := self.zero_of("displacement")):
            strain = np.maximum(strain - zero / self.measurement.specimen.height, 0.0)
        viscous = any(one.eta or one.relaxation or one.law.is_viscous for one in springs.values())
        stress = self.curves.measured_stress if self.drive == "stress" else self.curves.stress
        stress = None if viscous or self.drive == "impact" else stress
        for name, spring in springs.items():
            if not spring.law.remembers:
                continue
            own = stress
            if len(springs) == 1:
                own = None if strain is None else np.asarray(spring.stress(strain))
            if own is not None and np.all(np.isfinite(own)):
                fraction = spring.fraction_along(own)
                if fraction is not None:
                    out[name] = Snapping(fraction, own)
        return out

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``fit.json``: SI, plain types, null for absent values."""
        from foamfit.springs.model import Model  # drawing needs no compiler

        def own(*names: str) -> dict[str, Any]:
            return {name: getattr(self, name) for name in names}

        test, model = self.measurement, Model.parse(self.model)
        optional = {"budget": self.budget and self.budget.contributions}
        optional |= own("correlation", "ladder", "by_cycle", "priors", "options", "contradictions")
        content = {
            **stamp(),
            "test": test.name,
            "data_sha256": test.data_sha256,
            "data": {
                **asdict(test.rows),
                "cycle": test.cycle,
                "last_cycle": test.last_cycle,
                "cycles": len(test.cycles),
                "start_strain": test.start_strain,
                "origins": test.origins,
                "rate": loading_rate(test),
                "notes": test.notes,
            },
            "specimen": test.specimen,
            **own("model", "relaxation", "drive", "interior_mass", "seed", "status", "stopped"),
            **own("warnings", "notes"),
            **model.options,
            "model": model.words,
            **own("checklist", "parameters"),
            "derived": self._derived(),
            **own("visited", "misfit", "weights", "statistics", "noise", "energy"),
            "outliers": {
                channel: {name: getattr(found, name) for name in ("at", "values", "clipped_at")}
                for channel, found in test.outliers.items()
            },
            "runtime_s": self.runtime_s,
            **{name: value for name, value in optional.items() if value},
        }
        encoded: dict[str, Any] = plain(content)
        columns = self.columns
        fields = {name: plain(getattr(self, name), columns) for name in KEPT}
        rest = _without(encoded, fields)
        rest["measurement"] = _without(encoded | encoded["data"], fields["measurement"])
        length = max((column.size for column in columns.values()), default=0)
        return encoded | {"load": {"samples": length, **rest}}

    @property
    def columns(self) -> dict[str, Array]:
        """The columns of curves.csv: measured and fitted values, SI, one per sample."""
        c, test = self.curves, self.measurement
        columns: dict[str, Array | None] = {
            "time (s)": c.time,
            "measured stress (Pa)": c.measured_stress,
            "fitted stress (Pa)": c.stress,
            "measured displacement (m)": c.measured_displacement,
            "fitted displacement (m)": c.displacement,
            "stress along measured displacement (Pa)": c.stress_along,
            "measured deceleration (m/s^2)": test.acceleration,
        }
        for node, (measured, fitted) in c.interior.items():
            columns[f"measured {interior_channel(node)} (m)"] = measured
            columns[f"fitted {interior_channel(node)} (m)"] = fitted
        known = {name: column for name, column in columns.items() if column is not None}
        return known | flags_of(test)

    def _derived(self) -> dict[str, dict[str, Any]]:
        """Return the derived points of the springs, and their largest snapped fraction."""
        derived, snapping, strain = dict[str, dict[str, Any]](), self.snapping, self.strain
        for name, spring in self.springs.items():
            points = {one.attribute: getattr(spring, one.attribute) for one in spring.law.points}
            if (snapped := snapping.get(name)) is not None:
                turn = snapped.turn
                points |= {"p_max": snapped.most, "p_max_stress": snapped.stress[turn]}
                points["p_max_strain"] = None if strain is None else strain[turn]
                points["snap_strain"] = getattr(spring, "snap_strain", None)
            if points:
                derived[name] = points
        return derived


# Fields of a fit in fit.json and curves.csv: the samples of a chain have a file of their own, and
# problem and effort are those of this process.
BESIDE = ("draws", "problem", "effort")
KEPT = tuple(name for name in Fit.__dataclass_fields__ if name not in BESIDE)


def _without(content: Mapping[str, Any], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that `content` does not already have with the same value."""
    return {k: value for k, value in fields.items() if k not in content or value != content[k]}
