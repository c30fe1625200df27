"""The best point of a fit: curves, residual, Jacobian and covariance.

The uncertainty, checklist and report of a fit all use this; it needs one plain simulation and one
with sensitivities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from foamfit.arrays import Array
from foamfit.data.calibration import Contradiction, contradictions
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import FROM_VELOCITY
from foamfit.fitting.nuisance import CONTACT_TIME, POSITIVE, TIME_SHIFT, open_zero
from foamfit.fitting.objective import Simulated
from foamfit.fitting.problem import Problem
from foamfit.parts import covered
from foamfit.springs.parameters import split_name
from foamfit.trust import covariance
from foamfit.trust.covariance import Block, Covariance, Ends, Uncertainty
from foamfit.trust.residuals import CurveError, basis_of, curve_errors, parts

# Largest leverage of a cycle along a direction; at 1 its residual would be zero there.
MOST_TAKEN = 0.99
LOADED = 0.02  # share of the peak stress above which a specimen is under load


@dataclass(frozen=True, eq=False)
class BestPoint:
    """A point of the parameters (SI), usually the best one, with its local properties.

    `chosen` are the k parameters whose uncertainty is wanted; by default those that vary and whose
    branch was reached.
    """

    problem: Problem
    values: Array
    chosen: tuple[str, ...] | None = None

    @cached_property
    def simulated(self) -> Simulated:
        """All simulated curves."""
        return self.problem.objective.simulate(self.values, everything=True)

    @cached_property
    def residual(self) -> Array:
        """Residual of curves and priors."""
        return self.problem.objective.compare(self.simulated, self.values)

    @cached_property
    def cost(self) -> float:
        """Sum of squares of the residual."""
        return float(self.residual @ self.residual)

    @cached_property
    def unreached(self) -> dict[str, str]:
        """Parameters whose branch was never reached, and that branch."""
        return unreached(self.problem, self.simulated)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters on which the curves depend."""
        if self.chosen is not None:
            return self.chosen
        seen, model = visited(self.problem, self.simulated), self.problem.model

        def moves(name: str) -> bool:
            return model.param(name).moves in covered(seen[name.partition("_")[0]])

        return tuple(n for n in self.problem.free() if n not in self.unreached or moves(n))

    @property
    def index(self) -> dict[str, int]:
        """Place of each parameter in `values`."""
        return self.problem.index

    @cached_property
    def places(self) -> NDArray[np.intp]:
        """Places of the k parameters in `values`."""
        return np.array([self.index[name] for name in self.names], dtype=np.intp)

    @cached_property
    def sizes(self) -> Array:
        """Scales of the k parameters, (k,)."""
        return self.problem.sizes(self.names, self.values)

    def value(self, name: str) -> float:
        """Value of a parameter, SI."""
        return float(self.values[self.index[name]])

    def size(self, name: str) -> float:
        """Scale of a parameter, SI."""
        return float(self.problem.sizes((name,), self.values)[0])

    def limits(self, name: str) -> Ends:
        """Limits of a parameter, SI."""
        parameter = self.problem.params[name]
        return float(parameter.min), float(parameter.max)

    def at_limits(self, name: str) -> list[float]:
        """Return the limits at which a parameter lies, SI."""
        near = covariance.AT_LIMIT * self.size(name)
        return [x for x in self.limits(name) if abs(self.value(name) - x) <= near]

    def local(self, name: str) -> Ends:
        """Ends of the local 95 % interval of one of the k parameters, not cut at its limits."""
        value, half = self.value(name), float(self.halves[self.names.index(name)])
        return value - half, value + half

    @cached_property
    def box(self) -> Array:
        """Lower and upper limits of the k parameters, SI, (2, k)."""
        return np.reshape([self.limits(name) for name in self.names], (-1, 2)).T

    @cached_property
    def jacobian(self) -> Array:
        """Derivative of `residual` by the k parameters, (n_data, k)."""
        return self.problem.slopes(self.values, self.names)

    @cached_property
    def errors(self) -> tuple[CurveError, ...]:
        """Noise and model error in the residual of each fitted curve."""
        return self.judged()

    @cached_property
    def scaled(self) -> Array:
        """Derivative of `residual` by the scaled parameters, (n_data, k)."""
        return np.asarray(self.jacobian * self.sizes)

    def judged(self, taken: Array | None = None) -> tuple[CurveError, ...]:
        """Return the `errors` if a fit of several tests has absorbed `taken` of the noise."""
        objective = self.problem.objective
        # Noise of a driving stress that explains the residual has slow waves, as has that of a
        # velocity before its integration.
        by_stress = objective.drive == "stress" and objective.explained
        slow = set(range(len(objective.sizes))) if by_stress else set[int]()
        if objective.drive == "impact" and self.problem.measurement.motion == FROM_VELOCITY:
            every = "stress" in self.problem.measurement.derived
            motion = "displacement_time"
            slow = {i for i, curve in enumerate(objective.counted) if every or curve == motion}
        return curve_errors(self.residual, self.scaled, objective.sizes, taken, slow)

    @cached_property
    def contradictions(self) -> tuple[Contradiction, ...]:
        """Numbers that the record contradicts and that the fit does not settle.

        It settles them by a parameter or its value; of a time shift, only what is left counts.
        """
        problem, usual = self.problem, self.problem.objective.usual
        values = usual | dict(zip(problem.names, self.values.tolist(), strict=True))
        free = set(problem.free()) - {prior.name for prior in problem.objective.priors}
        speed, mass, scale = (values[name] / usual[name] for name in POSITIVE)
        settling = {"velocity": (speed,), "force_scale": (scale / mass,)}
        # Between masses within the specimen the force is late without a fault of the clocks.
        inert = problem.objective.interior_mass and len(problem.model.kinds) > 1
        out = list[Contradiction]()
        for one in contradictions(problem.measurement):
            if one.quantity == TIME_SHIFT:
                one = replace(one, ratio=one.ratio - values[TIME_SHIFT])
                agrees = inert or abs(one.ratio) <= one.limit
            else:
                ratios = settling.get(one.quantity, (1.0 / speed, mass / scale))
                agrees = all(abs(one.ratio / ratio - 1.0) <= one.limit for ratio in ratios)
            if not (agrees or one.is_settled(free)):
                out.append(one)
        return tuple(out)

    @property
    def misfits(self) -> bool:
        """Whether there is model error in some curve."""
        return any(error.found for error in self.errors)

    def block(self, errors: Sequence[CurveError]) -> Block:
        """Return the block of this test in a covariance; `errors` are those of its curves."""
        noise, through = [error.noise for error in errors], np.eye(self.sizes.size)
        errs = any(error.found for error in errors)
        return Block(
            self.scaled, self.problem.objective.sizes, noise, through,
            gradient=self.gradient if errs else None,
            shifts=self.shifts if self.problem.kept else None,
            modes=self.modes if errs else None,
            of_priors=self.problem.objective.unit**2,
        )  # fmt: skip

    @cached_property
    def shifts(self) -> Array:
        """Change of the residual by one standard error of each held parameter, (n_data, q).

        A zero of the motion that is its value at the contact is off together with the contact. The
        zero of a driven test's stress counts as held where no rows before contact show it.
        """
        kept, zero = self.problem.kept, "displacement_zero"
        slopes = self.problem.slopes(self.values, tuple(kept)).T
        out = {one.name: one.sigma * row for one, row in zip(kept.values(), slopes, strict=True)}
        at_rest = any(prior.name == zero for prior in self.problem.objective.priors)
        if {zero, CONTACT_TIME} <= out.keys() and not at_rest:
            out[zero] = out[zero] + out.pop(CONTACT_TIME)
        objective, force = self.problem.objective, "stress_zero"
        error = open_zero(self.problem.measurement, glued=bool(objective.glued))
        if error and objective.driven and force not in (*out, *self.names):
            out[force] = error * self.problem.slopes(self.values, (force,))[:, 0]
        return np.reshape([*out.values()], (-1, self.residual.size)).T

    @cached_property
    def modes(self) -> Array:
        """Change of the residual by one standard deviation of each mode of what drives, (n, q)."""
        objective = self.problem.objective
        if (modes := objective.by_motion(self.values)) is None:
            return np.empty((self.residual.size, 0))
        modes = modes if objective.weighing is None else objective.weighing(modes)
        return np.pad(modes, ((0, len(objective.priors)), (0, 0)))

    def gradient(self, step: Array) -> Array:
        """Return half the gradient of the cost after a step of the k parameters.

        Step and gradient are scaled; the step is cut at the limits of the parameters.
        """
        values = self.values.copy()
        values[self.places] = np.clip(values[self.places] + step * self.sizes, *self.box)
        slopes = self.problem.slopes(values, self.names) * self.sizes
        return np.asarray(slopes.T @ self.problem.objective.residual(values))

    @cached_property
    def spread(self) -> Covariance:
        """Local covariance of the k parameters."""
        return Uncertainty((self.block(self.errors),), self.sizes).covariance

    @cached_property
    def quantiles(self) -> Array:
        """Student's t of the 95 % interval of each parameter, (k,)."""
        return np.array([covariance.half_width(1.0, freedom) for freedom in self.spread.freedom])

    @cached_property
    def halves(self) -> Array:
        """Half of each local 95 % interval, (k,)."""
        return self.quantiles * self.spread.stderr

    @cached_property
    def known(self) -> list[str]:
        """Parameters that are determined or weak by their local interval."""
        known = np.flatnonzero(self.halves <= covariance.NOTHING * self.sizes)
        return [self.names[i] for i in known]

    def answer(self, change: Array) -> Array:
        """Return the steps (k, q), SI, of the k parameters after changes (n_data, q) of `residual`.

        They are Gauss-Newton steps, zero along directions that the curves do not determine, and of
        parameters at a limit.
        """
        scaled = self.scaled * [not self.at_limits(name) for name in self.names]
        return -self.sizes[:, None] * (np.linalg.pinv(scaled, rcond=1e-10) @ change)

    def added(self, curve: str, values: Array) -> Array:
        """Return the change of the residual by `values` added to a simulated curve, (n_data,)."""
        objective, out = self.problem.objective, np.zeros(self.residual.size)
        part = parts(objective.sizes)[objective.counted.index(curve)]
        out[part] = objective.factor(curve) * values[objective.kept[curve]]
        if objective.weighing is not None:
            out[: objective.n_data] = objective.weighing(out[: objective.n_data])
        return out

    def with_effect(self, column: Array, size: float) -> tuple[float, Array] | None:
        """Return the size of an omitted effect, and all parameters with it, by a linear step.

        `column` is the derivative of the residual by the effect, `size` its scale. None unless the
        effect exceeds four standard errors and lowers χ² by at least a fifth.
        """
        sure = np.isfinite(self.spread.stderr)
        jacobian = np.column_stack([self.jacobian[:, sure], column])
        sizes = np.append(self.sizes[sure], size)
        move = sizes * np.linalg.lstsq(jacobian * sizes, -self.residual, rcond=1e-10)[0]
        left = self.residual + jacobian @ move
        if left @ left >= 0.8 * self.cost:
            return None
        error = covariance.covariance(jacobian, left, self.problem.objective.sizes, sizes).stderr
        values = self.values.copy()
        at, (low, high) = self.places[sure], self.box[:, sure]
        values[at] = np.clip(values[at] + move[:-1], low, high)
        return (float(move[-1]), values) if abs(move[-1]) > 4.0 * error[-1] else None

    @cached_property
    def friction(self) -> tuple[float, Array] | None:
        """Friction in the rig (Pa) that the residuals of a driven test show, and all parameters.

        It adds to the stress on loading and subtracts from it on unloading; see `with_effect`.
        """
        objective, test = self.problem.objective, self.problem.measurement
        curve = next((name for name in objective.counted if name.startswith("stress")), None)
        if not objective.driven or test.displacement is None or curve is None or not self.misfits:
            return None
        least = LOADED * float(test.stress.max())
        speed = gaussian_filter1d(test.displacement, max(test.stress.size / 200, 1.0), order=1)
        rubs = np.sign(speed) * (test.stress > least)
        found = self.with_effect(self.added(curve, rubs), least)
        return found if found is not None and found[0] > 0.0 else None

    def rises(self, residual: Array) -> Array:
        """Return the rise of the cost at another point as the χ² of each parameter, (k,)."""
        return np.asarray((float(residual @ residual) - self.cost) / self.spread.inflation)


def cycle_growth(best: BestPoint) -> float | None:
    """Return `growth` from the last fitted cycle to the next; None for a single cycle."""
    objective, spans = best.problem.objective, cycles_of(best.problem.measurement)
    if len(spans) < 2 or not best.names:
        return None
    last = spans[max(spans)]
    kept = np.concatenate([objective.kept[name] for name in objective.counted])
    rows = np.flatnonzero((kept >= last.start) & (kept < last.stop))
    return growth(best.jacobian, best.residual, rows)


def growth(jacobian: Array, residual: Array, rows: NDArray[np.intp]) -> float:
    """Return the relative increase of the mean square residual from a fitted cycle to a new one.

    The fitted cycle has the samples `rows` and the part H of the hat matrix. If errors differ from
    cycle to cycle, the residuals r have covariance I - H in a fitted cycle and I + H in a similar
    new one; the sum of squares r'r of the former becomes r'(I + H)(I - H)⁻¹r. Leaving the fitted
    cycle out, with residuals (I - H)⁻¹r, would overestimate this, as one cycle fewer is fitted.
    """
    onto, share, _ = np.linalg.svd(basis_of(jacobian)[rows], full_matrices=False)
    hat, left = np.minimum(share**2, MOST_TAKEN), residual[rows]
    return float(2.0 * hat / (1.0 - hat) @ (onto.T @ left) ** 2 / max(left @ left, 1e-300))


# ---------------------------------------------------------------- branches along a run


def visited(problem: Problem, simulated: Simulated) -> dict[str, tuple[str, ...]]:
    """Return the branches that each spring has visited, in the order of the first visit.

    Each spring starts at rest, even if it is on another branch at the first sample.
    """
    laws = problem.model.laws
    seen = [[next(iter(law.branches))] for law in laws]
    for _, spring, *numbers, _ in simulated.motion.switches:
        seen[int(spring)] += [laws[int(spring)].named_branch(int(number)) for number in numbers]
    return {f"s{i}": tuple(dict.fromkeys(names)) for i, names in enumerate(seen, 1)}


def unreached(problem: Problem, simulated: Simulated) -> dict[str, str]:
    """Return the parameters without a prior whose branch was never reached, and that branch."""
    seen = {spring: covered(names) for spring, names in visited(problem, simulated).items()}
    known = {one.name for one in problem.objective.priors}
    own = [n for n in problem.model.names if n not in known and split_name(n)[0] >= 0]
    branches = {name: problem.model.param(name).branch for name in own}
    return {n: b for n, b in branches.items() if b and b not in seen[n.partition("_")[0]]}


def _along(
    problem: Problem, simulated: Simulated, words: Callable[[dict[int, str]], str]
) -> NDArray[np.object_]:
    """Return `words` for the branches of the hysteretic springs (0 = base) at each sample, (n,)."""
    laws, clock = problem.model.laws, problem.objective.time
    state = {i: next(iter(law.branches)) for i, law in enumerate(laws) if law.hysteretic}
    out = np.full(clock.size, words(state), dtype=object)
    for when, spring, _, entered, _ in simulated.motion.switches:
        if int(spring) in state:
            state[int(spring)] = laws[int(spring)].named_branch(int(entered))
            out[int(np.searchsorted(clock, when)) :] = words(state)
    return out


def sections(problem: Problem, simulated: Simulated) -> list[str]:
    """Return the branches at each sample, base first ("d", "a·c"), or free flight."""
    out = _along(problem, simulated, lambda state: "·".join(state.values()) or "line")
    if np.isfinite(end := simulated.motion.contact_end):
        out[int(np.searchsorted(problem.objective.time, end, side="right")) :] = "free flight"
    return list(map(str, out))


def branch_of_samples(problem: Problem, simulated: Simulated) -> NDArray[np.str_]:
    """Return the branches of the springs at each sample in words, (n,).

    For example "loading, spring 1 on d". Loading ends at the peak of the measured stress.
    """

    def words(state: dict[int, str]) -> str:
        return " and ".join(f"spring {i + 1} on {branch}" for i, branch in state.items())

    loading = np.arange(problem.objective.time.size) <= np.argmax(problem.measurement.stress)
    ways = np.where(loading, "loading, ", "unloading, ").astype(object)
    return np.asarray(ways + _along(problem, simulated, words), dtype=str)
