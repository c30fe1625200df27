"""What a fit found: data only. Saving and drawing are in `report`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.measurement import Measurement
from foamfit.data.rate import loading_rate
from foamfit.springs.chain import Chain
from foamfit.springs.laws import BistableSpring, MicroscaleSpring
from foamfit.text import counted

if TYPE_CHECKING:
    import lmfit

    from foamfit.trust.identifiability import Insight

SCHEMA = 1
# Of an uncertainty budget.
SOURCES = (
    "noise", "contact and zero", "velocity", "mass", "height", "area", "calibration", "law",
)  # fmt: skip
STATED = ("mass", "height", "area", "calibration")  # by their ± in the TOML, not fitted
DERIVED_POINTS = ("sigma_a", "sigma_c", "eps_star", "eps_hat_a", "eps_hat_c")


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter, in SI.

    `stderr` and `ci95` are None where the test does not determine it; `state` is "determined",
    "weak", "not determined" or "fixed" (fixed by the user or the model), and `why` says so in a
    sentence. `ci95_method` names what made the interval: "local covariance", "profile likelihood",
    "block bootstrap", "MCMC" or "other minima" (ends of
    the search's descents that noise could have made the best). `range` is the hull of its values
    over descriptions that follow the curves about as well, which the error of the law leaves open;
    None where only noise is left of the curves. `systematic` is one standard deviation from height,
    area, mass and calibration, whose ± the TOML states; it is not in `stderr` and `ci95`, and is 0
    where none is stated or the test does not determine the parameter.
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

        def moved(ends: tuple[float, float] | None) -> tuple[float, float] | None:
            return None if ends is None else (ends[0] - zero, ends[1] - zero)

        if zero == 0.0:
            return self
        ci95, span = moved(self.ci95), moved(self.range)
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


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlation matrix of the identified parameters, in the order of `names`."""

    names: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True, eq=False)
class Profile:
    """Least cost along one parameter."""

    name: str  # The parameter
    values: Array  # (m,): Where it was held, ascending, SI; the best point is among them
    rises: Array  # (m,): Rise of the cost there as a χ² of one degree of freedom
    points: Array  # (m, n): All parameters of the model at each
    cut: float  # χ² of the 95 % interval
    # Outermost crossings of the cut; a limit of the parameter where there is none.
    ci95: tuple[float, float]
    # Whether the cost does not reach the cut on that side.
    open_low: bool
    open_high: bool
    # What ended it before its end on both sides: "the time limit", "Ctrl-C".
    stopped: str | None = None

    @property
    def complete(self) -> bool:
        """Whether it was followed to its end on both sides."""
        return self.stopped is None


@dataclass(frozen=True, eq=False)
class Intervals:
    """The 95 % intervals of a fit, and how they were made."""

    # Ends of the intervals that are not those of the local covariance, and how each was made.
    ends: dict[str, tuple[float, float]] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()  # All profiles that were followed, whole or not
    # Parameters along which the cost is no parabola and whose interval is local all the same.
    doubtful: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  # Why they are not, or hardly, what was asked for
    better: Array | None = None  # A point of lower cost: the fit should go on from there
    # Values, far outside of the interval, at minima that are hardly worse than the best.
    elsewhere: dict[str, float] = field(default_factory=dict)
    # Ends of the ranges that the error of the law leaves open; none where there is no such error.
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)


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
        """Largest fraction that has snapped; the test tells nothing of the ranks above."""
        return float(self.fraction[self.turn])

    @property
    def halves(self) -> tuple[int | None, int | None]:
        """Samples from which on half have snapped, and half have snapped back; None if never."""
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
        """Whether it says more than the standard errors and ranges of the parameters."""
        return bool(set(self.sources) - {"noise", "law"})

    def combined(self, name: str) -> float:
        """Root of the sum of the squares of all contributions to a parameter, SI."""
        return math.hypot(*self.contributions[name].values())

    def rows(self) -> Iterator[list[object]]:
        """Rows of budget.csv, the header first: SI, but for what is over the scale."""
        yield ["name", *SOURCES, "combined", "scale", "combined over scale"]
        for name, row in self.contributions.items():
            total, scale = self.combined(name), self.scales[name]
            yield [name, *(plain(row[source]) for source in SOURCES), total, scale, total / scale]


@dataclass(frozen=True)
class Switch:
    """A change of branch in the fitted response: which spring, when, and where on the curves."""

    spring: int  # 1 at the base
    source: str  # "a", "d", "c", "e", or "snap-through", … of a microscale spring
    target: str
    time: float | None  # s
    displacement: float  # of the top, m
    stress: float  # Pa


@dataclass(frozen=True)
class Check:
    """One question to a fit."""

    key: str  # Short name
    question: str  # Put so that "yes" is good
    answer: bool | None  # None where the test or the search does not allow to tell
    sentence: str  # What the answer rests on
    # What a reader must know if the answer is no, one sentence each; empty otherwise.
    warnings: tuple[str, ...] = ()
    fatal: bool = False  # Whether a "no" means that no acceptable fit was found


def rung_name(model: str, damping: str, relaxation: int = 0) -> str:
    """Model, relaxation and damping in words."""
    if not relaxation:
        return model if damping == "none" else f"{model} {damping} damping"
    rest = {"with": " and damping", "without": ", without damping"}.get(damping, "")
    return f"{model} with relaxation{rest}"


@dataclass(frozen=True)
class Rung:
    """One model that was tried and the evidence for it."""

    model: str  # Springs from the base up
    # "with", "without" (every dashpot held at zero) or "none" where the drive has none to vary.
    damping: str
    misfit: dict[str, float | None]  # As `Fit.misfit`
    chisqr: float  # Sum of the squared residuals
    n_vary: int  # Parameters that were varied
    rank: int  # How many combinations of them the curves fix: what AICc and BIC count
    # Effective samples by its own residuals. AICc and BIC use `Ladder.n_eff`, one for all.
    n_eff: float
    # Infinite where there are too few effective samples for so many parameters.
    aicc: float
    bic: float
    # p-value of the runs test: the chance that noise without structure has as few runs.
    runs_p: float
    # p-value of the neighbours test: the same by size, where the runs test goes by sign.
    neighbours_p: float
    # Names of the parameters in these states, by the 95 % intervals alone where it was not chosen.
    not_determined: tuple[str, ...]
    weak: tuple[str, ...]
    seconds: float  # Run time
    stopped: str | None  # What ended the search before its time
    chosen: bool  # Whether the result is that of this model
    why: str  # Why it was chosen or not
    relaxation: int = 0  # Terms of each hysteretic spring
    # RMS over the range, all counted curves together, of samples that were held back in blocks;
    # None where the time did not allow it.
    predicted_misfit: float | None = None
    # By what share that is below the one of `gain_over`; None where that is none.
    gain: float | None = None
    # The model that was the best of those with no more parameters; None of the first.
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
    noise_from: str  # The model of the least chi-square: its residuals are taken for the noise
    ended: str  # Why the comparison ended
    stopped: str | None  # "the time limit" or "Ctrl-C" if that ended it
    skipped: tuple[str, ...]  # Models that could not be tried, and why
    sentences: tuple[str, ...]  # What the comparison says
    cautions: tuple[str, ...]  # Those of them that are warnings
    # Whether models were compared by what they predict, because none reaches the noise; else by
    # AICc and BIC.
    by_prediction: bool = False

    @property
    def chosen(self) -> Rung:
        """The model whose result was taken."""
        return next(rung for rung in self.rungs if rung.chosen)

    def rows(self) -> Iterator[list[object]]:
        """Rows of ladder.csv, the header first; a list of names is joined by blanks."""
        misfits = [rung.misfit for rung in self.rungs]
        curves = [name for name in misfits[0] if any(one.get(name) is not None for one in misfits)]
        rest = [n for n in Rung.__dataclass_fields__ if n not in ("model", "damping", "misfit")]
        yield ["model", "damping", *(f"misfit_{name}" for name in curves), *rest]
        for rung in self.rungs:
            cells = (plain(getattr(rung, name)) for name in rest)
            told = (" ".join(cell) if isinstance(cell, list) else cell for cell in cells)
            yield [rung.model, rung.damping, *(rung.misfit.get(name) for name in curves), *told]


def snapping_of(chain: Chain, strain: Array | None, stress: Array | None) -> dict[str, Snapping]:
    """How each microscale spring snaps along an overall strain and a base stress (Pa).

    A single spring's snapping follows from its strain. In a chain it follows from the stress, if
    all springs are in equilibrium under it, else there is none.
    """
    out, springs = {}, chain.springs
    plain = not any(spring.eta or spring.relaxation for spring in springs)
    for i, spring in enumerate(springs, start=1):
        if not isinstance(spring, MicroscaleSpring):
            continue
        own = stress if plain else None
        if len(springs) == 1:
            own = None if strain is None else np.asarray(spring.stress(strain))
        if own is not None and np.all(np.isfinite(own)):
            out[f"s{i}"] = Snapping(spring.fraction_along(own), own)
    return out


def law_in_words(model: str, relaxation: int) -> str:
    """Model and relaxation in words."""
    return f"{model} with {counted(relaxation, 'relaxation term')}" if relaxation else model


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
    loss: str = "linear"
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)  # of each counted curve
    intervals: Intervals | None = None
    ladder: Ladder | None = None
    relaxation: int = 0  # terms of each hysteretic spring
    interior_mass: bool = False  # whether the specimen's mass sat between the springs
    budget: Budget | None = None

    @property
    def bistable_springs(self) -> dict[str, BistableSpring]:
        """The bistable springs of the chain by their prefix, "s1" at the base."""
        springs = enumerate(self.chain.springs, start=1)
        return {f"s{i}": one for i, one in springs if isinstance(one, BistableSpring)}

    @property
    def microscale_springs(self) -> dict[str, MicroscaleSpring]:
        """The microscale springs of the chain by their prefix, "s1" at the base."""
        springs = enumerate(self.chain.springs, start=1)
        return {f"s{i}": one for i, one in springs if isinstance(one, MicroscaleSpring)}

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
    def snapping(self) -> dict[str, Snapping]:
        """How each microscale spring snapped, where that is known; see `snapping_of`."""
        stress = self.curves.measured_stress if self.drive == "stress" else self.curves.stress
        return snapping_of(self.chain, self.strain, None if self.drive == "impact" else stress)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``fit.json``: SI, plain types, null for what is not there."""
        content: dict[str, Any] = plain(
            {
                "schema": SCHEMA,
                "foamfit": version("foamfit"),
                "test": self.measurement.name,
                "data_sha256": self.measurement.data_sha256,
                "data": asdict(self.measurement.rows)
                | {
                    "cycle": self.measurement.cycle,
                    "cycles": len(self.measurement.cycles),
                    "start_strain": self.measurement.start_strain,
                    "rate": loading_rate(self.measurement),
                    "notes": self.measurement.notes,
                },
                "model": self.model,
                "relaxation": self.relaxation,
                "drive": self.drive,
                "interior_mass": self.interior_mass,
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
                **({"budget": self.budget.contributions} if self.budget else {}),
                "derived": {
                    name: {point: getattr(spring, point) for point in DERIVED_POINTS}
                    for name, spring in self.bistable_springs.items()
                }
                | {
                    name: {
                        "p_max": snapped.most,
                        "p_max_stress": float(snapped.stress[snapped.turn]),
                        "p_max_strain": None if self.strain is None else self.strain[snapped.turn],
                        "snap_strain": self.microscale_springs[name].snap_strain,
                    }
                    for name, snapped in self.snapping.items()
                },
                "visited": self.visited,
                "misfit": self.misfit,
                "weights": self.weights,
                "statistics": self.statistics,
                "noise": self.noise,
                "outliers": {
                    channel: {name: getattr(found, name) for name in ("at", "values", "clipped_at")}
                    for channel, found in self.measurement.outliers.items()
                },
                "energy": self.energy,
                "runtime_s": self.runtime_s,
                **({"ladder": asdict(self.ladder)} if self.ladder else {}),
            }
        )
        return content


def plain(value: Any) -> Any:
    """Return `value` in the types of JSON, with None for every number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
