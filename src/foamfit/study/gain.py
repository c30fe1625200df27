"""What a candidate test would add to what is known about the parameters of a foam.

A fit with residuals r, slopes J and noise of covariance Σ has the covariance H⁻¹ (JᵀΣJ) H⁻¹ with
H = JᵀJ (`trust.covariance`), with contact time and zeros eliminated from J. H and JᵀΣJ of several
tests add up. Where the law misses the record, the range due to model error is expected by the rule
of `trust.refits`: all values whose cost rises by at most `tolerance`, to first order, times the
factor by which the ranges of the tests at hand exceed this.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from foamfit.api import FitResult
from foamfit.arrays import Array, Mask
from foamfit.data.measurement import Measurement
from foamfit.data.rig import Candidate, Rig
from foamfit.data.units import parse_quantity
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.objective import Simulated
from foamfit.fitting.problem import Problem, make_params, make_problem
from foamfit.report.plan import Expected
from foamfit.solve.simulation import simulate
from foamfit.springs.chain import Impact
from foamfit.springs.parameters import NUISANCE
from foamfit.study.identified import NORMAL
from foamfit.trust.best_point import unreached
from foamfit.trust.checklist import may_vanish
from foamfit.trust.covariance import NOTHING, WEAK
from foamfit.trust.intervals import FAR, HARDLY_WORSE
from foamfit.trust.refits import ALIKE

TINY, ROUNDING = 1e-6, 1e-12  # least information on a scaled parameter, and over the largest one
LONGEST = 30.0  # longest contact, in times that the striker takes over the height of the specimen
TIMED = 20  # number of draws from which the duration of an impact is taken
UNKNOWN = 2.0 * NOTHING  # half an interval where a branch is not reached, in scales
# Quantities of `Target`; the absorbed energy is that up to the largest strain.
UNITS = {"peak_force": "N", "absorbed_energy": "J", "dissipated_energy": "J", "peak_strain": ""}


@dataclass(frozen=True, eq=False)
class Test:
    """A test at hand or a candidate: its problem and parameters, and the weight of its samples."""

    problem: Problem
    values: Array
    fit: FitResult | None = None  # of a measured test
    study: str = ""  # name of the joint fit that it belongs to
    weight: float = 1.0  # samples that the rig records per simulated sample

    def with_springs(self, drawn: Array) -> Array:
        """Return its parameters with drawn springs."""
        count = len(self.problem.model.names)
        return np.append(drawn[:count], self.values[count:])

    @property
    def roots(self) -> Array:
        """Roots of the weights of its residuals, (n,); priors have none."""
        objective = self.problem.objective
        return np.repeat([self.weight**0.5, 1.0], [objective.n_data, len(objective.priors)])

    def rows(self, values: Array, names: tuple[str, ...], sizes: Array, *more: Array) -> Array:
        """Return slopes of the residuals by scaled parameters, and `more` columns, (n, k + …).

        The part along the slopes by nuisance parameters is taken off (Frisch & Waugh 1933,
        Econometrica 1, 387).
        """
        problem = self.problem
        own = tuple(name for name in problem.free() if name in NUISANCE)
        scales = np.append(problem.sizes(own, values), sizes)
        rows = np.column_stack((problem.slopes(values, (*own, *names)) * scales, *more))
        rows *= self.roots[:, None]
        others, rows = np.linalg.qr(rows[:, : len(own)])[0], rows[:, len(own) :]
        return np.asarray(rows - others @ (others.T @ rows))

    def reached(self, shown: Simulated, names: Sequence[str]) -> Mask:
        """Return whether the branch of each parameter was reached in a simulation, (k,)."""
        never = unreached(self.problem, shown)
        return np.array([name not in never for name in names], dtype=bool)


@dataclass(frozen=True, eq=False)
class Draw:
    """Parameters of the tests at hand that follow them about as well as the best ones."""

    vectors: tuple[Array, ...]  # of each test
    sizes: Array  # (k,)
    bread: Array  # (k, k): JᵀJ by the k varied parameters of the springs over their `sizes`
    meat: Array  # (k, k): JᵀΣJ, as slopes may differ much from those of the fit
    reached: Mask  # (k,): whether the branch of each parameter was reached
    others: tuple[Other, ...] = ()  # springs in series that give nearly the same records

    @property
    def springs(self) -> Array:
        """A vector of parameters with its springs."""
        return self.vectors[0]


@dataclass(frozen=True, eq=False)
class Known:
    """What the tests at hand say about the k varied parameters of the springs.

    Draws after the first `informed` ones only tell how probably a limit of the rig is exceeded.
    """

    problem: Problem
    names: tuple[str, ...]
    drawn: tuple[Draw, ...]
    informed: int  # number of draws with their own information
    missed: float  # sum of squares of the model error
    share: float  # RMS of the model error over the ranges of the curves
    stretch: Array  # (k,): ranges of the fits over those to first order, at least 1
    explained: tuple[Array, ...] = ()  # other explanations of the tests by springs in series

    @property
    def draws(self) -> tuple[Draw, ...]:
        """The d draws in which the information is known."""
        return self.drawn[: self.informed]

    def of_draws(self, name: str) -> Array:
        """Return a field of these draws as an array, (d, …)."""
        return np.array([getattr(one, name) for one in self.draws])

    def first(self, count: int) -> Known:
        """Return the same with the first draws only, and without other springs."""
        drawn = tuple(replace(one, others=()) for one in self.drawn[:count])
        return replace(self, drawn=drawn, informed=min(count, self.informed))

    @property
    def places(self) -> list[int]:
        """Places of the parameters in a vector of all."""
        return [self.problem.index[name] for name in self.names]

    @property
    def values(self) -> Array:
        """The parameters in these draws, (d, k)."""
        return np.array([one.springs[self.places] for one in self.draws])


class Other(NamedTuple):
    """Other springs, and what some tests show of their difference from a drawn foam."""

    springs: Array
    # (k + 1, k + 1): products of the slopes by scaled parameters and, as a last column, of the
    # differences of the residuals; NaN if a test cannot be simulated. Those of tests add up.
    inner: Array
    reached: Mask  # (k,)

    @classmethod
    def together(cls, seen: Sequence[Other]) -> Other:
        """Return what several tests show."""
        springs, inner, reached = zip(*seen, strict=True)
        return cls(springs[0], np.sum(inner, axis=0), np.asarray(np.any(reached, axis=0)))

    def refit(self, known: Known, sizes: Array) -> tuple[Array, float]:
        """Return scaled parameters (k,) after a fit, to first order, and the rise of χ²."""
        bread, gradient = self.inner[:-1, :-1], self.inner[:-1, -1]
        step = np.linalg.solve(bread + np.eye(gradient.size) / NOTHING**2, gradient)
        rise = max(float(self.inner[-1, -1] - gradient @ step), 0.0)
        return self.springs[known.places] / sizes - step, rise


@dataclass(frozen=True, eq=False)
class Seen:
    """What a test would show in each of d draws; nothing where it exceeds a limit."""

    bread: Array  # (d, k, k)
    meat: Array  # (d, k, k)
    reached: Mask  # (d, k)
    broken: Mask  # (m,): whether a limit was exceeded
    missed: Array  # (d,): sum of squares of the model error
    force: float  # median of the largest force, N
    apart: dict[str, float] = field(default_factory=dict)  # χ² by which it excludes each rival
    others: tuple[tuple[Other, ...], ...] = ()  # as in `Known`, in this test


def difference(known: Known, springs: Array, sizes: Array, test: Test, residual: Array) -> Other:
    """Return what a test shows of the difference of springs from a foam with a residual."""
    objective, values = test.problem.objective, test.with_springs(springs)
    try:
        shown = objective.simulate(values, everything=True)
    except SimulationError:
        k = len(known.names)
        return Other(springs, np.full((k + 1, k + 1), math.nan), np.zeros(k, dtype=bool))
    apart = objective.compare(shown, values)
    # A rival of fewer springs shows the motion of fewer masses.
    n = min(objective.n_data, residual.size - len(objective.priors))
    apart[:n] -= residual[:n]
    apart[n:] = 0.0
    rows = test.rows(values, known.names, sizes, apart)
    return Other(springs, rows.T @ rows, test.reached(shown, known.names))


def as_test(
    known: Known,
    candidate: Candidate,
    rig: Rig,
    *,
    record: Measurement | None = None,
    with_motion: bool = False,  # whether the motion counts even if the rig does not record it
) -> Test:
    """Return a candidate with the law of the tests at hand, or one whose `record` is given."""
    problem, test, impact = known.problem, known.problem.measurement, candidate.drive == "impact"
    if record is None:
        timed = _duration_and_peak(known, candidate) if impact else (0.0, problem.scales.stress)
        record = candidate.recorded(test, rig, *timed, with_motion=with_motion)
    inside = problem.objective.interior_mass and impact
    law, terms = problem.model.name, problem.model.relaxation
    params = make_params(record, law, candidate.drive, relaxation=terms)
    for name, one in problem.params.items():
        if one.expr:
            params[name].expr = one.expr
    made = make_problem(record, law, candidate.drive, params, None, inside, relaxation=terms)
    weight = candidate.weight(made.objective.time, test, rig)
    return Test(made, made.vector(), weight=weight)


def _duration_and_peak(known: Known, candidate: Candidate) -> tuple[float, float]:
    """Return a time (s) that covers the contact in nine of ten draws, and the median peak (Pa)."""
    specimen, model = known.problem.measurement.specimen, known.problem.model
    mass, velocity = candidate.mass or math.nan, candidate.velocity or math.nan
    limit, ends, peaks = LONGEST * specimen.height / velocity, list[float](), list[float]()
    for drawn in known.draws[:TIMED]:
        try:
            springs = drawn.springs[: len(model.names)]
            chain = model.chain(springs, specimen.height, specimen.area)
            found = simulate(chain, Impact(mass, velocity), np.linspace(0.0, limit, 200), 1e-3)
        except (SimulationError, InputError):
            continue
        ends.append(found.contact_end or limit)
        peaks.append(float(found.base_stress.max()))
    if not ends:
        return 0.2 * limit, known.problem.scales.stress
    return 1.1 * float(np.quantile(ends, 0.9)), float(np.median(peaks))


def look(
    known: Known, candidate: Candidate, rig: Rig, rivals: Mapping[str, Known] = MappingProxyType({})
) -> Seen:
    """Simulate a candidate for every draw, with exact derivatives."""
    test, d, k = as_test(known, candidate, rig), len(known.draws), len(known.names)
    objective, specimen = test.problem.objective, known.problem.measurement.specimen
    own = [objective.noise(c).sigma * objective.factor(c) for c in objective.counted]
    noise = np.repeat([*own, objective.unit], [*objective.sizes, len(objective.priors)])[:, None]
    record = test.problem.measurement  # a rival is compared sample by sample
    laws = {n: (one, as_test(one, candidate, rig, record=record)) for n, one in rivals.items()}
    bread, meat = np.zeros((2, d, k, k))
    reached, broken = np.zeros((d, k), dtype=bool), np.ones(len(known.drawn), dtype=bool)
    missed, forces, apart = np.zeros(d), list[float](), dict[str, list[float]]()
    others = [tuple[Other, ...]()] * d
    for i, drawn in enumerate(known.drawn):
        values = test.with_springs(drawn.springs)
        try:
            shown = objective.simulate(values, everything=True)
        except SimulationError:
            continue
        forces.append(float(shown.motion.base_stress.max()) * specimen.area)
        farthest = min(rig.displacement, rig.largest_strain * specimen.height)
        broken[i] = forces[-1] > rig.force or shown.motion.displacement[-1].max() > farthest
        if broken[i] or i >= d:  # no record
            continue
        rows = test.rows(values, known.names, drawn.sizes)
        bread[i], meat[i] = rows.T @ rows, (noise * rows).T @ (noise * rows)
        reached[i] = test.reached(shown, known.names)
        ranges = [np.ptp(shown.curves[c]) * objective.factor(c) for c in objective.counted]
        missed[i] = test.weight * known.share**2 * (np.square(ranges) @ objective.sizes)
        residual = objective.compare(shown, values)
        springs = (one.springs for one in drawn.others)
        others[i] = tuple(difference(known, x, drawn.sizes, test, residual) for x in springs)
        for name, (law, of_law) in laws.items():
            best = law.drawn[0]
            known_of_it = Other(best.springs, np.pad(best.bread, (0, 1)), best.reached)
            one = difference(law, best.springs, best.sizes, of_law, residual)
            rise = Other.together((known_of_it, one)).refit(law, best.sizes)[1]
            apart.setdefault(name, []).append(rise / (1.0 + missed[i]))
    told = {name: float(np.median(found)) for name, found in apart.items()}
    told = {name: found for name, found in told.items() if math.isfinite(found)}
    force = float(np.median(forces)) if forces else math.nan
    return Seen(bread, meat, reached, broken, missed, force, told, tuple(others))


def covariance(known: Known, seen: Sequence[Seen], floor: float = TINY) -> tuple[Array, Array]:
    """Return covariances (d, k, k), scaled: due to noise, and of the range due to model error."""
    bread = known.of_draws("bread") + sum(one.bread for one in seen)
    meat = known.of_draws("meat") + sum(one.meat for one in seen)
    missed = known.missed + sum(one.missed for one in seen) * np.ones(len(bread))
    least = np.maximum(floor, ROUNDING * np.trace(bread, axis1=1, axis2=2))
    prior = least[:, None, None] * np.eye(len(known.names))
    inverse = np.linalg.inv(bread + prior)
    law = (ALIKE**2 - 1.0) * missed[:, None, None] * inverse
    return inverse @ (meat + prior) @ inverse, law * np.outer(known.stretch, known.stretch)


def expected(known: Known, seen: Sequence[Seen]) -> dict[str, Expected]:
    """Return the expected interval and state of every parameter after some further tests."""
    noise, law = (np.diagonal(one, axis1=1, axis2=2) for one in covariance(known, seen))
    halves, ranges = (np.sqrt(np.maximum(one, 0.0)) for one in (NORMAL**2 * noise, law))
    sizes, reached = known.of_draws("sizes"), known.of_draws("reached")
    wider, values = np.maximum(halves, ranges), known.values / sizes
    clear, limits = np.abs(values) > wider, [known.problem.params[n] for n in known.names]
    least, most = np.array([(one.min, one.max) for one in limits]).T
    # As in a fit, an interval ends at the limits of its parameter.
    low, high, elsewhere = _with_others(known, seen, values, halves)
    widths = np.minimum(high * sizes, most) - np.maximum(low * sizes, least)
    shares = 0.5 * (high - low)
    wide = np.maximum(wider, shares)  # and, to one side, another minimum
    side = np.maximum(wide, np.maximum(high - values, values - low))
    reached = np.any([reached, *(one.reached for one in seen)], axis=0)
    out = dict[str, Expected]()
    for i, name in enumerate(known.names):
        shown = reached[:, i]
        # One that may vanish is weak where its interval or range would contain zero.
        sure = ~elsewhere[:, i] & (clear[:, i] if may_vanish(name) else True)
        chance = float(np.mean(shown & (side[:, i] <= WEAK) & sure))
        some = float(np.mean(shown & (wide[:, i] <= NOTHING)))
        state = "determined" if chance >= 0.5 else "weak" if some >= 0.5 else "not determined"
        ends, share = np.full(3, math.nan), math.nan
        if state != "not determined":
            ends = np.quantile(widths[shown, i], (0.1, 0.5, 0.9))
            share = float(np.median(shares[shown, i]))
        low, middle, high = ends.tolist()
        out[name] = Expected(middle, state, (low, high), chance, share)
    return out


def _with_others(
    known: Known, seen: Sequence[Seen], values: Array, halves: Array
) -> tuple[Array, Array, Mask]:
    """Return the ends of intervals by the rule of `joint_fit`, and where others fit too, (d, k)."""
    low, high, elsewhere = values - halves, values + halves, np.zeros(values.shape, dtype=bool)
    for i, drawn in enumerate(known.draws):
        meat = drawn.meat + sum(one.meat[i] for one in seen)
        noise = np.trace(meat) / np.trace(drawn.bread + sum(one.bread[i] for one in seen))
        near, shown = list[Array](), (one.others[i] for one in seen if one.others[i])
        for each in zip(drawn.others, *shown, strict=True):
            other = Other.together(each)
            there, rise = other.refit(known, drawn.sizes)
            if (rise := rise / (NORMAL**2 * noise)) < 1.0:
                half = np.where(other.reached, halves[i] * math.sqrt(1.0 - rise), UNKNOWN)
                low[i] = np.minimum(low[i], there - half)
                high[i] = np.maximum(high[i], there + half)
            near += [there] if rise <= HARDLY_WORSE**2 else []
        for there in near:
            apart = np.maximum(low[i] - there, there - high[i])
            elsewhere[i] |= apart > FAR * (high[i] - low[i])
    return low, high, elsewhere


@dataclass(frozen=True, eq=False)
class Target:
    """A quantity of another impact that the foam is needed for, in each draw."""

    text: str
    unit: str
    values: Array  # (d,); NaN where the impact cannot be simulated
    slopes: Array  # (d, k), by scaled parameters

    @classmethod
    def of(cls, text: str, known: Known, rig: Rig) -> Target:
        """Return a quantity like "peak_force at 3 m/s"; InputError if it is unknown."""
        name, _, speed = (part.strip() for part in text.partition(" at "))
        if name not in UNITS:
            raise InputError(
                f"quantity {text!r} is unknown; give {', '.join(UNITS)} at a velocity, like "
                '"peak_force at 3 m/s"'
            )
        velocity = parse_quantity(speed, "m/s", f"quantity {text!r}", "peak_force at 3 m/s")
        if velocity <= 0.0:
            raise InputError(f"quantity {text!r} needs a positive velocity, like {name} at 3 m/s")
        striker = known.problem.measurement.striker
        mass = (striker and striker.mass) or (rig.masses[0] if rig.masses else None)
        if mass is None:
            raise InputError(f"quantity {text!r} needs a striker; give its mass in the rig")
        asked = as_test(known, Candidate("impact", mass, velocity), rig, with_motion=True)
        found = [cls._in_draw(name, known, asked, drawn.springs) for drawn in known.draws]
        values, slopes = zip(*found, strict=True)
        return cls(text, UNITS[name], np.array(values), np.array(slopes))

    @staticmethod
    def _in_draw(name: str, known: Known, asked: Test, drawn: Array) -> tuple[float, Array]:
        """Return the quantity in a draw, SI, and its slopes."""
        problem, values = asked.problem, asked.with_springs(drawn)
        specimen, sizes = problem.measurement.specimen, known.problem.sizes(known.names, drawn)
        moves = problem.moves(values, known.names) * sizes
        places = np.flatnonzero(moves.any(axis=1))
        try:
            shown = problem.objective.simulate(values, everything=True, places=places)
        except SimulationError:
            return math.nan, np.full(len(known.names), math.nan)
        stress, moved = (  # the curve, then its slopes
            np.vstack((shown.curves[name], moves[places].T @ shown.slopes[name]))
            for name in ("stress_time", "displacement_time")
        )
        force = specimen.area * stress
        if name in ("peak_force", "peak_strain"):
            curve = force if name == "peak_force" else moved / specimen.height
            found = curve[:, np.argmax(curve[0])]
            return float(found[0]), found[1:]
        end = int(np.argmax(moved[0])) + 1 if name == "absorbed_energy" else len(moved[0])
        force, moved = force[:, :end], moved[:, :end]
        found = np.trapezoid(force, moved[0]) + np.trapezoid(force[0], moved)
        return float(0.5 * found[0]), np.asarray(found[1:])

    def error(self, known: Known, seen: Sequence[Seen]) -> float:
        """Return the standard error of the quantity after some tests, RMS of the draws, over it."""
        noise, law = covariance(known, seen, 1.0 / NOTHING**2)
        total = noise + law / NORMAL**2
        variance = np.einsum("di,dij,dj->d", self.slopes, total, self.slopes)
        return math.sqrt(max(float(np.nanmean(variance)), 0.0)) / (abs(self.middle) or math.nan)

    @property
    def middle(self) -> float:
        """Median of the quantity over the draws, SI."""
        return float(np.nanmedian(self.values))
