"""What a candidate test would add to what is known about the parameters of a foam.

A fit with residuals r, slopes J and noise of covariance Σ has the covariance H⁻¹ (JᵀΣJ) H⁻¹ with
H = JᵀJ (`trust.covariance`), with contact time and zeros eliminated from J. H and JᵀΣJ of several
tests add up. Where the law misses the record, the range due to model error is expected by the rule
of `trust.ranges`: all values whose cost rises by at most `tolerance`, to first order, times the
factor by which the ranges of the tests at hand exceed this.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from foamfit.arrays import Array, Mask
from foamfit.data.rig import Candidate, Rig
from foamfit.data.units import parse_quantity
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.branches import unreached
from foamfit.fitting.problem import Problem, make_params, make_problem
from foamfit.report.studies.plan import Expected
from foamfit.solve.simulation import simulate
from foamfit.springs.chain import Impact
from foamfit.springs.parameters import NUISANCE
from foamfit.study.identified import NORMAL
from foamfit.trust.checklist import may_vanish
from foamfit.trust.covariance import NOTHING, WEAK
from foamfit.trust.intervals import FAR, HARDLY_WORSE
from foamfit.trust.ranges import ALIKE

TINY, ROUNDING = 1e-6, 1e-12  # least information on a scaled parameter, and over the largest one
LONGEST = 30.0  # longest contact, in times that the striker takes over the height of the specimen
TIMED = 20  # number of draws from which the duration of an impact is taken
UNKNOWN = 2.0 * NOTHING  # half an interval where a branch is not reached, in scales
# Quantities of `Target`; the absorbed energy is that up to the largest strain.
UNITS = {"peak_force": "N", "absorbed_energy": "J", "dissipated_energy": "J", "peak_strain": ""}


@dataclass(frozen=True, eq=False)
class Known:
    """What the tests at hand say about the k varied parameters of the springs.

    Parameters are scaled by `sizes` (k,). `draws` (d, n) are vectors of parameters that follow the
    tests about equally well, `bread` (d, k, k) is JᵀJ there and `meat` JᵀΣJ: slopes in a draw may
    differ much from those of the fit. `missed` is the sum of squares of the model error, `share`
    its RMS over the range of each curve, `stretch` (k,) the ranges of the fits over those to first
    order, at least 1, `reached` (d, k) whether the branch of each parameter was reached.
    `explained` (m, n) are springs in series that explain the tests in other ways, see `draws`.
    """

    problem: Problem
    values: Array
    names: tuple[str, ...]
    sizes: Array
    bread: Array
    meat: Array
    missed: float
    share: dict[str, float]
    stretch: Array
    reached: Mask
    draws: Array
    explained: Array | None = None

    @cached_property
    def drawn_sizes(self) -> Array:
        """Scale of each parameter in each draw over `sizes`, (d, k)."""
        return np.array([self.problem.sizes(self.names, one) for one in self.draws]) / self.sizes

    @property
    def places(self) -> list[int]:
        """Places of the parameters in a vector of all."""
        return [self.problem.index[name] for name in self.names]

    def with_springs(self, drawn: Array, problem: Problem) -> Array:
        """Return the parameters of another test: drawn springs, and its nuisance parameters."""
        count = len(self.problem.model.names)
        return np.append(drawn[:count], problem.vector()[count:])


class Refit(NamedTuple):
    """Other springs fitted to the records of a drawn foam; see `others`."""

    values: Array  # (k,), scaled
    rise: float  # of the sum of squares
    reached: Mask  # (k,)


@dataclass(frozen=True, eq=False)
class Seen:
    """What a test would show in each of d draws; nothing where it exceeds a limit."""

    bread: Array  # (d, k, k)
    meat: Array  # (d, k, k)
    reached: Mask  # (d, k)
    broken: Mask  # (d,): whether a limit was exceeded
    missed: Array  # (d,): sum of squares of the model error
    force: float  # median of the largest force, N
    apart: dict[str, float] = field(default_factory=dict)  # χ² by which it excludes each rival
    others: tuple[tuple[Refit, ...], ...] = ()  # that follow the records of each draw as well


def rows_of(problem: Problem, values: Array, names: tuple[str, ...], sizes: Array) -> Array:
    """Return slopes by the nuisance parameters, then by scaled parameters, (n, q + k)."""
    own = tuple(name for name in problem.free() if name in NUISANCE)
    return problem.slopes(values, (*own, *names)) * np.append(problem.sizes(own, values), sizes)


def without_nuisance(rows: Array, k: int) -> Array:
    """Return the last k columns without their part along the others (Frisch & Waugh 1933)."""
    others = np.linalg.qr(rows[:, :-k])[0]
    return np.asarray(rows[:, -k:] - others @ (others.T @ rows[:, -k:]))


def roots_of(problem: Problem, weight: float) -> Array:
    """Return the factors of residuals whose samples have some weight; priors have none."""
    objective = problem.objective
    return np.repeat([weight**0.5, 1.0], [objective.n_data, len(objective.priors)])


def information(rows: Array, root: Array) -> tuple[Array, Array]:
    """Return JᵀJ and JᵀΣJ (k, k) of a test without nuisance parameters.

    `root` (k,) are the standard errors of its fit over those of JᵀJ, so that the covariance of this
    test alone is that of its fit, D (JᵀJ)⁻¹ D.
    """
    bread = rows.T @ rows
    alone = np.linalg.pinv(bread, rcond=1e-12, hermitian=True) * np.outer(root, root)
    return bread, bread @ alone @ bread


def problem_for(
    known: Known, candidate: Candidate, rig: Rig, *, with_motion: bool = False
) -> Problem:
    """Return the problem of a candidate with the law of the tests at hand.

    With `with_motion` the motion counts even if the rig does not record it.
    """
    problem, test = known.problem, known.problem.measurement
    lasts, peak, impact = 0.0, problem.scales.stress, candidate.drive == "impact"
    if impact:
        lasts, peak = _duration_and_peak(known, candidate, peak)
    record = candidate.recorded(test, rig, lasts, peak, with_motion=with_motion)
    inside = problem.objective.interior_mass and impact
    law, terms = problem.model.name, problem.model.relaxation
    params = make_params(record, law, candidate.drive, relaxation=terms)
    for name, one in problem.params.items():
        if one.expr:
            params[name].expr = one.expr
    return make_problem(record, law, candidate.drive, params, None, inside, relaxation=terms)


def _duration_and_peak(known: Known, candidate: Candidate, usual: float) -> tuple[float, float]:
    """Return a time (s) that covers the contact in nine of ten draws, and the median peak (Pa)."""
    specimen, model = known.problem.measurement.specimen, known.problem.model
    mass, velocity = candidate.mass or math.nan, candidate.velocity or math.nan
    limit, ends, peaks = LONGEST * specimen.height / velocity, list[float](), list[float]()
    for drawn in known.draws[:TIMED]:
        try:
            chain = model.chain(drawn[: len(model.names)], specimen.height, specimen.area)
            found = simulate(chain, Impact(mass, velocity), np.linspace(0.0, limit, 200), 1e-3)
        except (SimulationError, InputError):
            continue
        ends.append(found.contact_end or limit)
        peaks.append(float(found.base_stress.max()))
    if not ends:
        return 0.2 * limit, usual
    return 1.1 * float(np.quantile(ends, 0.9)), float(np.median(peaks))


def look(
    known: Known, candidate: Candidate, rig: Rig, rivals: Mapping[str, Known] | None = None
) -> Seen:
    """Simulate a candidate for every draw, with exact derivatives."""
    problem = problem_for(known, candidate, rig)
    objective, test = problem.objective, known.problem.measurement
    each, counted = candidate.weight(objective.time, test, rig), objective.counted
    weigh = roots_of(problem, each)
    own = [objective.noise(c).sigma * objective.factor(c) for c in counted]
    noise = np.repeat([*own, objective.unit], [*objective.sizes, len(objective.priors)])
    k, d = len(known.names), len(known.draws)
    bread, meat = np.zeros((2, d, k, k))
    reached, broken = np.zeros((d, k), dtype=bool), np.ones(d, dtype=bool)
    missed, forces, apart = np.zeros(d), list[float](), dict[str, list[float]]()
    usual = max(known.share.values(), default=0.0)  # of curves that no test at hand has
    made = {n: _excess_over(one, candidate, rig, each) for n, one in (rivals or {}).items()}
    others = {name: excess for name, excess in made.items() if excess is not None}
    for i, drawn in enumerate(known.draws):
        values = known.with_springs(drawn, problem)
        try:
            shown = objective.simulate(values, everything=True)
        except SimulationError:
            continue
        forces.append(float(shown.motion.base_stress.max()) * test.specimen.area)
        most = float(shown.motion.displacement[-1].max())
        limits = rig.force, rig.displacement, rig.largest_strain
        broken[i] = np.any(np.array([forces[-1], most, most / test.specimen.height]) > limits)
        if broken[i]:  # no record
            continue
        rows = rows_of(problem, values, known.names, known.sizes) * weigh[:, None]
        rows = without_nuisance(rows, k)
        bread[i], meat[i] = rows.T @ rows, (noise[:, None] * rows).T @ (noise[:, None] * rows)
        silent = unreached(problem, shown)
        reached[i] = [name not in silent for name in known.names]
        for curve, size in zip(counted, objective.sizes, strict=True):
            share = known.share.get(curve, usual)
            off = share * float(np.ptp(shown.curves[curve]))
            missed[i] += each * size * (off * objective.factor(curve)) ** 2
        for name, excess in others.items():
            found = excess(objective.compare(shown, values)) / (1.0 + missed[i])
            apart.setdefault(name, []).append(found)
    told = {name: float(np.median(found)) for name, found in apart.items()}
    force = float(np.median(forces)) if forces else math.nan
    return Seen(bread, meat, reached, broken, missed, force, told)


def _excess_over(
    known: Known, candidate: Candidate, rig: Rig, weight: float
) -> Callable[[Array], float] | None:
    """Return the χ² of residuals that remains after a fit of another law, to first order.

    The law is simulated at its best point for a candidate; None if it cannot be.
    """
    k = len(known.names)
    try:
        problem = problem_for(known, candidate, rig)
        values = known.with_springs(known.values, problem)
        shown = problem.objective.simulate(values)
    except SimulationError:
        return None
    n = problem.objective.n_data
    rows = math.sqrt(weight) * rows_of(problem, values, known.names, known.sizes)[:n]
    root = np.linalg.cholesky(known.bread[0] + TINY * np.eye(k)).T
    rows = np.vstack([rows, np.hstack([np.zeros((k, rows.shape[1] - k)), root])])
    own = problem.objective.compare(shown, values)[:n]

    def excess(residual: Array) -> float:
        if residual.size < n:
            return 0.0
        apart = np.append(math.sqrt(weight) * (residual[:n] - own), np.zeros(k))
        left = apart - rows @ np.linalg.lstsq(rows, apart, rcond=1e-10)[0]
        return float(left @ left)

    return excess


def covariance(known: Known, seen: Sequence[Seen], floor: float = TINY) -> tuple[Array, Array]:
    """Return covariances (d, k, k), scaled: due to noise, and of the range due to model error.

    `floor` is the least information on each parameter over its scale.
    """
    scale = known.drawn_sizes[:, :, None] * known.drawn_sizes[:, None, :]
    bread = scale * sum((one.bread for one in seen), known.bread)
    meat = scale * sum((one.meat for one in seen), known.meat)
    missed = sum((one.missed for one in seen), np.full(len(known.draws), known.missed))
    power, axes = np.linalg.eigh(bread)
    least = np.maximum(power, np.maximum(floor, ROUNDING * power[:, -1:]))
    inner = np.einsum("dji,djk,dkl->dil", axes, meat, axes)
    inner += np.eye(power.shape[1]) * np.maximum(least - power, 0.0)[:, :, None]
    axes = axes / least[:, None, :]
    noise = np.einsum("dij,djk,dlk->dil", axes, inner, axes) * scale
    law = np.einsum("dij,dj,dkj->dik", axes, least, axes) * scale
    law = law * np.outer(known.stretch, known.stretch)
    return noise, (ALIKE**2 - 1.0) * missed[:, None, None] * law


def expected(known: Known, seen: Sequence[Seen]) -> dict[str, Expected]:
    """Return the expected interval and state of every parameter after some further tests.

    One that may vanish is weak in the draws in which its interval or range would contain zero.
    """
    noise, law = (np.diagonal(one, axis1=1, axis2=2) for one in covariance(known, seen))
    halves, ranges = (np.sqrt(np.maximum(one, 0.0)) for one in (NORMAL**2 * noise, law))
    wider, values = np.maximum(halves, ranges), known.draws[:, known.places] / known.sizes
    clear, limits = np.abs(values) > wider, [known.problem.params[n] for n in known.names]
    least, most = np.array([(one.min, one.max) for one in limits]).T / known.sizes
    # As in a fit, an interval ends at the limits of its parameter.
    low, high, elsewhere = _with_others(known, seen, values, halves)
    widths = np.minimum(high, most) - np.maximum(low, least)
    shares = 0.5 * (high - low) / known.drawn_sizes
    wide = np.maximum(wider / known.drawn_sizes, shares)  # and, to one side, another minimum
    side = np.maximum(wide, np.maximum(high - values, values - low) / known.drawn_sizes)
    reached = np.broadcast_to(known.reached, halves.shape)
    for one in seen:
        reached = reached | one.reached
    out = dict[str, Expected]()
    for i, name in enumerate(known.names):
        shown = reached[:, i]
        sure = ~elsewhere[:, i] & (clear[:, i] if may_vanish(name) else True)
        chance = float(np.mean(shown & (side[:, i] <= WEAK) & sure))
        some = float(np.mean(shown & (wide[:, i] <= NOTHING)))
        state = "determined" if chance >= 0.5 else "weak" if some >= 0.5 else "not determined"
        ends, share = np.full(3, math.nan), math.nan
        if state != "not determined":
            ends = known.sizes[i] * np.quantile(widths[shown, i], (0.1, 0.5, 0.9))
            share = float(np.median(shares[shown, i]))
        low, middle, high = ends.tolist()
        out[name] = Expected(middle, state, (low, high), chance, share)
    return out


def _with_others(
    known: Known, seen: Sequence[Seen], values: Array, halves: Array
) -> tuple[Array, Array, Mask]:
    """Return the ends of intervals, and whether values far outside fit almost as well, (d, k).

    The rule is that of a joint fit (`joint_fit`); intervals extend to other springs that noise
    could make the best. Of several tests, the one that these follow least counts.
    """
    low, high, elsewhere = values - halves, values + halves, np.zeros(values.shape, dtype=bool)
    shown = [one for one in seen if one.others]
    for i in range(len(values)) if shown else ():
        meat = known.meat[i] + sum(one.meat[i] for one in shown)
        noise = np.trace(meat) / np.trace(known.bread[i] + sum(one.bread[i] for one in shown))
        followed = zip(*(one.others[i] for one in shown if one.others[i]), strict=True)
        worst = [max(each, key=lambda x: x.rise) for each in followed]
        near = [(x, x.rise / (NORMAL**2 * noise)) for x in worst]
        for other, rise in near:
            if rise < 1.0:
                half = np.where(other.reached, halves[i] * math.sqrt(1.0 - rise), UNKNOWN)
                low[i] = np.minimum(low[i], other.values - half)
                high[i] = np.maximum(high[i], other.values + half)
        for other, rise in near:
            if rise <= HARDLY_WORSE**2:
                apart = np.maximum(low[i] - other.values, other.values - high[i])
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
        striker = known.problem.measurement.striker
        mass = (striker and striker.mass) or (rig.masses[0] if rig.masses else None)
        if mass is None or velocity <= 0.0:
            raise InputError(f"quantity {text!r} needs a striker; give its mass in the rig")
        problem = problem_for(known, Candidate("impact", mass, velocity), rig, with_motion=True)
        found = [cls._in_draw(name, known, problem, drawn) for drawn in known.draws]
        values, slopes = zip(*found, strict=True)
        return cls(text, UNITS[name], np.array(values), np.array(slopes))

    @staticmethod
    def _in_draw(name: str, known: Known, problem: Problem, drawn: Array) -> tuple[float, Array]:
        """Return the quantity in a draw, SI, and its slopes."""
        objective, specimen = problem.objective, problem.measurement.specimen
        values = known.with_springs(drawn, problem)
        try:
            curves = objective.simulate(values, everything=True).curves
        except SimulationError:
            return math.nan, np.full(len(known.names), math.nan)
        parts = objective.by_curve(problem.slopes(values, known.names) * known.sizes)
        by = {curve: part.T / objective.factor(curve) for curve, part in parts.items()}
        stress, moved = curves["stress_time"], curves["displacement_time"]
        by_stress, by_motion = by["stress_time"], by["displacement_time"]
        if name == "peak_force":
            at = int(np.argmax(stress))
            return float(stress[at]) * specimen.area, by_stress[:, at] * specimen.area
        if name == "peak_strain":
            at = int(np.argmax(moved))
            return float(moved[at]) / specimen.height, by_motion[:, at] / specimen.height
        end = int(np.argmax(moved)) + 1 if name == "absorbed_energy" else moved.size
        stress, moved, by_stress = stress[:end], moved[:end], by_stress[:, :end]
        middle = 0.5 * (stress[1:] + stress[:-1]) * specimen.area
        slopes = np.trapezoid(by_stress, moved, axis=1) * specimen.area
        slopes += np.diff(by_motion[:, :end], axis=1) @ middle
        return float(middle @ np.diff(moved)), slopes

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
