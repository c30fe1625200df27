"""What a fit found: data only. Saving and drawing are in `report`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.codec import encode
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement, interior_channel
from foamfit.data.rate import loading_rate
from foamfit.springs.chain import Chain
from foamfit.springs.options import OPTIONS
from foamfit.springs.spring import Spring
from foamfit.text import counted, listed

if TYPE_CHECKING:
    import lmfit

    from foamfit.trust.identifiability import Insight

SCHEMA = 1
# Of an uncertainty budget.
STATED = ("mass", "height", "area", "calibration")  # by their ± in the TOML, not fitted
SOURCES = ("noise", "contact and zero", "velocity", *STATED, "law")


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter, in SI.

    `stderr` and `ci95` are None where the test does not determine it; `state` is "determined",
    "weak", "not determined" or "fixed" (fixed by the user or the model), and `why` says so in a
    sentence. `ci95_method` is the source of the interval: "local covariance", "profile likelihood",
    "MCMC" or "other minima" (of the search, which noise could have made the best). `range` includes
    model error: the values that fit almost equally well; None where the residuals are noise.
    `systematic` is one standard deviation from the ± of height, area, mass and calibration in the
    TOML; it is not in `stderr` and `ci95`, and is 0 where no ± is stated or the test does not
    determine the parameter.
    """

    value: float
    stderr: float | None
    ci95: tuple[float, float] | None
    unit: str
    vary: bool
    state: str
    why: str
    ci95_method: str | None = None
    range: tuple[float, float] | None = None
    systematic: float = 0.0

    def counted_from(self, zero: float) -> ParameterEstimate:
        """Count value, interval and range from another zero."""
        ends = (self.ci95, self.range)
        ci95, span = (one and (one[0] - zero, one[1] - zero) for one in ends)
        return replace(self, value=self.value - zero, ci95=ci95, range=span)


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


class Loop(NamedTuple):
    """The stress (Pa) of a test, measured and fitted, along its strain, or else its time (s)."""

    name: str
    along: Array
    label: str  # of what it is along
    measured: Array
    fitted: Array | None


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation matrix of the identified parameters, in the order of `names`.

    `stderr` are the local standard errors, SI, also of those that the test does not determine; NaN
    where the data fix only a combination.
    """

    names: tuple[str, ...]
    matrix: Array
    stderr: Array | None = None


@dataclass(frozen=True, eq=False)
class Profile:
    """Least cost along one parameter."""

    name: str  # The parameter
    values: Array  # (m,): Where it was held, ascending, SI; the best point is among them
    rises: Array  # (m,): Rise of the cost there as a χ² of one degree of freedom
    points: Array  # (m, n): All parameters of the model at each
    cut: float  # χ² of the 95 % interval
    # Outermost crossings of the cut, or a limit of the parameter
    ci95: tuple[float, float]
    # Whether the cost stays below the cut on that side
    open_low: bool
    open_high: bool
    # What ended it early: "the time limit", "Ctrl-C"
    stopped: str | None = None

    @property
    def complete(self) -> bool:
        """Whether it was followed to both ends."""
        return self.stopped is None

    def rows(self) -> Iterator[dict[str, object]]:
        """Give its rows of profiles.csv, SI."""
        about = {"chi2 of the 95 % cut": self.cut, "complete": self.complete}
        for value, rise in zip(self.values.tolist(), self.rises.tolist(), strict=True):
            yield {"name": self.name, "value": value, "chi2": rise, **about}


@dataclass(frozen=True, eq=False)
class Intervals:
    """The 95 % intervals of a fit, and how they were made."""

    # Ends of the intervals that are not those of the local covariance, and how each was made.
    ends: dict[str, tuple[float, float]] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()  # All profiles that were followed, whole or not
    # Parameters with a local interval although the cost along them is not a parabola
    doubtful: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  # Why they differ from what was asked for
    better: Array | None = None  # A point of lower cost from which the fit should continue
    # Values, far outside the interval, with which the curves fit almost as well
    elsewhere: dict[str, float] = field(default_factory=dict)
    # Ends of the ranges that include the error of the law, where there is one
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    # Samples of a Markov chain, (walkers, steps) by parameter, SI; kept in `Fit.draws`
    draws: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Snapping:
    """How many of its micro-springs a microscale spring snapped along the fitted curves."""

    fraction: Array  # that has snapped, one per sample
    stress: Array  # of the spring in equilibrium, Pa

    @property
    def turn(self) -> int:
        """Sample at which most have snapped."""
        return int(np.argmax(self.fraction))

    @property
    def most(self) -> float:
        """Largest fraction that has snapped; the test says nothing about the others."""
        return float(self.fraction[self.turn])

    @property
    def ever(self) -> Array:
        """Fraction that has ever snapped, one per sample."""
        return np.maximum.accumulate(self.fraction)

    @property
    def halves(self) -> tuple[int | None, int | None]:
        """First samples at which half have snapped, and half have snapped back; None if never."""
        turn, snapped = self.turn, self.fraction >= 0.5
        if not snapped[turn]:
            return None, None
        back = np.flatnonzero(~snapped[turn:])
        return int(np.argmax(snapped)), turn + int(back[0]) if back.size else None


@dataclass(frozen=True)
class Budget:
    """Uncertainty budget of a fit (after JCGM 100:2008, the GUM).

    `contributions` holds for each determined parameter of the springs one standard deviation of
    each source, in SI:

    - "noise": of the samples; together with the next two this is the standard error.
    - "contact and zero", "velocity": what fitting the contact time and the zeros of the channels,
      and the striker's velocity and mass and a delay within their ±, adds to it.
    - "mass", "height", "area", "calibration": from their ± in the TOML; together `systematic`.
    - "law": half of the parameter's `range` over 1.96, as if that were a 95 % interval.

    `scales` (SI) are those of the parameters, mostly their values.
    """

    contributions: dict[str, dict[str, float]]
    scales: dict[str, float]

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources that contribute to any parameter, in their order."""
        rows = self.contributions.values()
        return tuple(one for one in SOURCES if any(row[one] > 0.0 for row in rows))

    @property
    def telling(self) -> bool:
        """Whether it has more than the standard errors and ranges of the parameters."""
        return bool(set(self.sources) - {"noise", "law"})

    def combined(self, name: str) -> float:
        """Combine all contributions to a parameter by their squares, SI."""
        return math.hypot(*self.contributions[name].values())

    def rows(self) -> Iterator[dict[str, object]]:
        """Give the rows of budget.csv: SI, but for the last column."""
        for name, row in self.contributions.items():
            total, scale = self.combined(name), self.scales[name]
            parts = {source: plain(row[source]) for source in SOURCES}
            sums = {"combined": total, "scale": scale, "combined over scale": total / scale}
            yield {"name": name, **parts, **sums}


@dataclass(frozen=True)
class Switch:
    """A change of branch in the fitted response: which spring, when, and where on the curves."""

    spring: int  # 1 at the base
    source: str  # name of a branch
    target: str
    time: float | None  # s
    displacement: float  # of the top, m
    stress: float  # Pa


@dataclass(frozen=True)
class Check:
    """One question of the checklist, put so that "yes" is good."""

    key: str  # Short name
    question: str
    answer: bool | None  # None where the test or the search cannot tell
    sentence: str  # What the answer rests on
    warnings: tuple[str, ...] = ()  # What a reader must know if the answer is no
    fatal: bool = False  # Whether a "no" means that no acceptable fit was found


def rung_name(model: str, damping: str, relaxation: int = 0) -> str:
    """Model, relaxation and damping in words."""
    words, more = _in_words(model)
    if relaxation:
        more.append("relaxation" if relaxation == 1 else counted(relaxation, "relaxation term"))
    if not more:
        return words if damping == "none" else f"{words} {damping} damping"
    more += ["damping"] * (damping == "with")
    return f"{words} with {listed(more)}{', without damping' if damping == 'without' else ''}"


def _in_words(model: str) -> tuple[str, list[str]]:
    """Return a model as `--model` takes it, and what its springs have beside."""
    from foamfit.springs.model import Model  # drawing needs no compiler

    if model == "auto":
        return model, []
    read = Model.parse(model)
    asked = (name for name, there in read.options.items() if there)
    return read.words, [word for name in asked for word in OPTIONS[name].names]


@dataclass(frozen=True)
class Rung:
    """One model that was tried and the evidence for it."""

    model: str  # Springs from the base up
    # "with", "without" (every dashpot held at zero) or "none" (the drive has none to vary)
    damping: str
    misfit: dict[str, float | None]  # As `Fit.misfit`
    chisqr: float  # Sum of the squared residuals
    n_vary: int  # Parameters that were varied
    rank: int  # How many combinations of them the curves fix: what AICc and BIC count
    # Effective samples by its own residuals; AICc and BIC use `Ladder.n_eff`
    n_eff: float
    # Infinite if there are too few effective samples for so many parameters
    aicc: float
    bic: float
    # p-value of the runs test: the chance that noise without structure has as few runs.
    runs_p: float
    # p-value of the neighbours test, which goes by size, the runs test by sign
    neighbours_p: float
    # Parameters in these states; by the 95 % intervals alone if it was not chosen
    not_determined: tuple[str, ...]
    weak: tuple[str, ...]
    seconds: float  # Run time
    stopped: str | None  # What ended the search before its time
    chosen: bool  # Whether the result is that of this model
    why: str  # Why it was chosen or not
    relaxation: int = 0  # Terms of each hysteretic spring
    # RMS over the range of samples that were held back in blocks; None if there was no time
    predicted_misfit: float | None = None
    # By what share that is below the one of `gain_over`, if any
    gain: float | None = None
    # The best of the models before with no more parameters; None for the first
    gain_over: str | None = None

    @property
    def name(self) -> str:
        """Model, relaxation and damping in words."""
        return rung_name(self.model, self.damping, self.relaxation)


@dataclass(frozen=True)
class Ladder:
    """The models that were tried, and what the comparison says."""

    rungs: tuple[Rung, ...]  # In the order in which they were tried, from the simplest up
    n_eff: float  # Effective samples that AICc and BIC use
    noise_from: str  # The model of the least chi-square, whose residuals are taken as noise
    ended: str  # Why the comparison ended
    stopped: str | None  # "the time limit" or "Ctrl-C" if that ended it
    skipped: tuple[str, ...]  # Models that could not be tried, and why
    sentences: tuple[str, ...]  # What the comparison says
    cautions: tuple[str, ...]  # Those of them that are warnings
    # Whether models were compared by their predictions, as none reaches the noise, not by AICc, BIC
    by_prediction: bool = False

    @property
    def chosen(self) -> Rung:
        """The model whose result was taken."""
        return next(rung for rung in self.rungs if rung.chosen)

    def rows(self) -> Iterator[dict[str, object]]:
        """Give the rows of ladder.csv; a list of names is joined by blanks."""
        misfits = [rung.misfit for rung in self.rungs]
        curves = [name for name in misfits[0] if any(one.get(name) is not None for one in misfits)]
        for rung in self.rungs:
            row: dict[str, Any] = plain(rung)
            off = {f"misfit_{name}": row["misfit"].get(name) for name in curves}
            cells = {"model": row.pop("model"), "damping": row.pop("damping"), **off}
            del row["misfit"]
            cells |= {k: " ".join(v) if isinstance(v, list) else v for k, v in row.items()}
            yield cells


def loop_of(test: Measurement, along: Array | None, over_time: Array | None) -> Loop | None:
    """The loop of a test, fitted along its displacement, or else over time; None without stress."""
    if test.stress is not None and test.displacement is not None and along is not None:
        strain = test.displacement / test.specimen.height
        return Loop(test.name, strain, "strain", test.stress, along)
    if test.stress is None or test.time is None:
        return None
    return Loop(test.name, test.time, "time (s)", test.stress, over_time)


def law_in_words(model: str, relaxation: int) -> str:
    """Model, what its springs remember, and relaxation in words."""
    words, more = _in_words(model)
    more += [counted(relaxation, "relaxation term")] if relaxation else []
    return f"{words} with {listed(more)}" if more else words


@dataclass(frozen=True, eq=False)
class Fit:
    """Everything that a fit found."""

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
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)  # of each counted curve
    intervals: Intervals | None = None
    ladder: Ladder | None = None
    relaxation: int = 0  # terms of each hysteretic spring
    interior_mass: bool = False  # whether the specimen's mass sat between the springs
    budget: Budget | None = None
    # Mean and standard deviation of what was known of parameters before, SI
    priors: dict[str, tuple[float, float]] = field(default_factory=dict)
    # Samples of a Markov chain, (walkers, steps) by parameter, SI; empty if none was made
    draws: dict[str, Array] = field(default_factory=dict)

    @property
    def springs(self) -> dict[str, Spring]:
        """The springs of the chain by their prefix, "s1" at the base."""
        return {f"s{i}": one for i, one in enumerate(self.chain.springs, start=1)}

    @property
    def words(self) -> str:
        """The model as `--model` takes it."""
        return _in_words(self.model)[0]

    @property
    def by_cycle(self) -> dict[int, dict[str, Any]]:
        """Each of several cycles that are one history; {} of one cycle, or of another drive.

        Misfit over the cycle's own range, dissipated energy measured and fitted (J/m³), and the
        fraction of each spring's micro-springs that has ever snapped by its end.
        """
        c, strain, out = self.curves, self.strain, dict[int, dict[str, Any]]()
        fitted, measured = c.stress, c.measured_stress
        if self.drive != "displacement" or strain is None or fitted is None or measured is None:
            return out
        for number, part in cycles_of(self.measurement).items():
            off = float(np.sqrt(np.mean((fitted - measured)[part] ** 2)))
            out[number] = {
                "misfit": off / float(np.ptp(measured[part])),
                "dissipated_measured": float(np.trapezoid(measured[part], strain[part])),
                "dissipated_fitted": float(np.trapezoid(fitted[part], strain[part])),
                "ever_snapped": {
                    name: float(one.ever[part][-1]) for name, one in self.snapping.items()
                },
            }
        return out

    @property
    def at_noise(self) -> bool | None:
        """Whether the residuals are at the estimated noise; None where that is not known."""
        return next((check.answer for check in self.checklist if check.key == "noise"), None)

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model, self.relaxation)

    @property
    def strain(self) -> Array | None:
        """Overall strain along the fitted curves; None if neither simulated nor measured."""
        c = self.curves
        moved = c.displacement if c.displacement is not None else c.measured_displacement
        return None if moved is None else moved / self.measurement.specimen.height

    @property
    def loop(self) -> Loop | None:
        """The loop measured and fitted; over time where no strain was measured."""
        return loop_of(self.measurement, self.curves.stress_along, self.curves.stress)

    @property
    def snapping(self) -> dict[str, Snapping]:
        """How each spring of micro-springs snapped along the fitted curves, where that is known.

        That of a single spring follows from its strain; in a chain it follows from the stress if
        all springs are in equilibrium and no striker is part of the motion.
        """
        springs, strain, out = self.springs, self.strain, dict[str, Snapping]()
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
        """Return the content of ``fit.json``: SI, plain types, null for what is not there."""
        from foamfit.springs.model import Model  # drawing needs no compiler

        test = self.measurement
        asked = ("model", "relaxation", "drive", "interior_mass", "seed", "status", "stopped")
        found = ("visited", "misfit", "weights", "statistics", "noise", "energy")
        model = Model.parse(self.model)
        optional = {
            "correlation": self.correlation,
            "budget": self.budget and self.budget.contributions,
            "ladder": self.ladder,
            "by_cycle": self.by_cycle,
            "priors": self.priors,
        }
        content = {
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "test": test.name,
            "data_sha256": test.data_sha256,
            "data": asdict(test.rows)
            | {
                "cycle": test.cycle,
                "last_cycle": test.last_cycle,
                "cycles": len(test.cycles),
                "start_strain": test.start_strain,
                "origins": test.origins,
                "rate": loading_rate(test),
                "notes": test.notes,
            },
            "specimen": test.specimen,
            **{name: getattr(self, name) for name in (*asked, "warnings", "notes")},
            **model.options,
            "model": model.words,
            **{name: getattr(self, name) for name in ("checklist", "parameters")},
            "derived": self._derived(),
            **{name: getattr(self, name) for name in found},
            "outliers": {
                channel: {name: getattr(found, name) for name in ("at", "values", "clipped_at")}
                for channel, found in test.outliers.items()
            },
            "runtime_s": self.runtime_s,
            **{name: one for name, one in optional.items() if one},
        }
        made: dict[str, Any] = plain(content)
        columns = self.columns
        kept = vars(self)
        fields = {name: encode(kept[name], columns) for name in KEPT}
        rest = _without(made, fields)
        rest["measurement"] = _without(made | made["data"], fields["measurement"])
        length = max((column.size for column in columns.values()), default=0)
        return made | {"load": {"samples": length, **rest}}

    @property
    def columns(self) -> dict[str, Array]:
        """The columns of curves.csv: what is measured and fitted, SI, one value per sample."""
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
        for channel, found in test.outliers.items():
            columns[f"outliers of {channel} left out"] = found.left_out.astype(int)
        for channel, taken in test.sampled.items():
            columns[f"{channel} is measured"] = taken.astype(int)
        return {name: column for name, column in columns.items() if column is not None}

    def _derived(self) -> dict[str, dict[str, Any]]:
        """Return derived points of the springs, and how far they snapped."""
        found = dict[str, dict[str, Any]]()
        for name, spring in self.springs.items():
            points = {one.attribute: getattr(spring, one.attribute) for one in spring.law.points}
            if (snapped := self.snapping.get(name)) is not None:
                points["p_max"] = snapped.most
                points["p_max_stress"] = snapped.stress[snapped.turn]
                points["p_max_strain"] = None if self.strain is None else self.strain[snapped.turn]
                points["snap_strain"] = getattr(spring, "snap_strain", None)
            if points:
                found[name] = points
        return found


# What fit.json and curves.csv keep of a fit; samples have a file of their own.
KEPT = tuple(name for name in Fit.__dataclass_fields__ if name != "draws")


def _without(told: Mapping[str, Any], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that fit.json does not have elsewhere."""
    return {name: one for name, one in fields.items() if name not in told or one != told[name]}


def plain(value: Any) -> Any:
    """Return `value` in the types of JSON, with None for every number that is not finite."""
    return encode(value)
