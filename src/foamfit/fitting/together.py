"""One fit of several tests: some parameters have one value for all, the others one for each test.

All residuals are minimised as one sum of squares, each test in units of its own noise. A parameter
may also scatter about a common value or follow a law of rate (`fitting.links`). The normal matrix
has a block for each test, and only the shared coordinates couple them: own parameters are
eliminated test by test (Schur complement), so that a step costs as much as the tests one by one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.box import Scales, Space, is_logarithmic
from foamfit.fitting.links import (
    RATES,
    STEEPEST,
    Links,
    Slots,
    law,
    law_slopes,
    log_law,
    log_law_slopes,
    start_of,
)
from foamfit.fitting.problem import Problem
from foamfit.springs.parameters import NUISANCE, any_param, split_name

# Descents end when two steps in a row gain less than this share, or after so many steps.
ENOUGH, ITERATIONS = 1e-5, 80
_LEAST_MOVE, _MOST_DAMPING = 1e-9, 1e8
# Least value of which a scattering parameter has the logarithm, and the largest logarithm.
_TINY, _FAR = 1e-30, 100.0


@dataclass(frozen=True, eq=False)
class Together:
    """Several tests with some parameters in common, at the best point found.

    `shared` are the names of the parameters that follow from what all tests have in common, `own`
    those with a value for each test, scattering ones among them. `values` (n_values,) are those of
    all parameters of each test (SI), `costs` the sum of squares of each, in units of its noise.
    """

    problems: tuple[Problem, ...]
    shared: tuple[str, ...]
    own: tuple[str, ...]
    values: tuple[Array, ...]
    costs: tuple[float, ...]
    steps: int  # Steps of the descent
    links: Links
    # What all tests have in common, SI: the value of a shared parameter, value and slope by a law
    # of rate, common value (its logarithm is the mean of theirs) of a scattering one.
    common: dict[str, tuple[float, ...]]

    @property
    def cost(self) -> float:
        """Sum of squares of all tests."""
        return float(sum(self.costs))

    @property
    def n_vary(self) -> int:
        """Numbers that the fit chose: those of all tests, and one of each test where it varies."""
        laws = sum(self.links.kind(name) in RATES for name in self.shared)
        return len(self.shared) + laws + sum(len(self.own_of(p)) for p in self.problems)

    @property
    def n_data(self) -> int:
        """Samples of all tests."""
        return sum(problem.objective.n_data for problem in self.problems)

    @cached_property
    def misfits(self) -> tuple[dict[str, float | None], ...]:
        """Misfit of each curve of each test, RMS over the measured range."""
        return tuple(
            problem.objective.misfit(problem.objective.simulate(values, everything=True))
            for problem, values in zip(self.problems, self.values, strict=True)
        )

    def own_of(self, problem: Problem) -> tuple[str, ...]:
        """Names of the parameters that one test has of its own."""
        return tuple(name for name in problem.free() if name in self.own)

    def value(self, name: str) -> list[float]:
        """Values of one parameter, one for each test that has it."""
        return [
            float(values[problem.index[name]])
            for problem, values in zip(self.problems, self.values, strict=True)
            if name in problem.index
        ]


def fit_together(
    problems: Sequence[Problem],
    own: Collection[str],
    starts: Sequence[Sequence[Array]],
    *,
    iterations: int = ITERATIONS,
) -> Together:
    """Fit several tests at once, parameters named in `own` for each test, the others for all.

    What a record does not say exactly (`fitting.nuisance`) is one of each test in any case. See
    `fit_linked`, which this calls.
    """
    names = _varying(problems)
    for name in own:
        if name not in names:
            raise InputError(
                f"parameter '{name}' cannot be one of each test; it must be one of "
                f"{', '.join(names)}"
            )
    kinds = {name: "own" if name in own or name in NUISANCE else "shared" for name in names}
    return fit_linked(problems, Links(kinds), starts, iterations=iterations)


def fit_linked(
    problems: Sequence[Problem],
    links: Links,
    starts: Sequence[Sequence[Array]],
    *,
    iterations: int = ITERATIONS,
) -> Together:
    """Fit several tests at once, their parameters linked as `links` say.

    Parameters
    ----------
    problems : sequence of Problem
        Of one model. Drives and noise may differ, and with them the nuisance parameters; a
        parameter that does not vary in one of them keeps its value there.
    links : Links
        What each parameter is to all tests.
    starts : sequence of sequences of (n_values,) arrays
        Each holds a vector of parameters for each test, as its own fit has found; the shared
        parameters start at the median over the tests, laws of rate at their least squares. The
        best end of all starts is returned.
    iterations : int
        Steps of a descent at most.

    Returns
    -------
    Together

    Raises
    ------
    InputError
        If the problems are not of one model.
    SimulationError
        If no start can be simulated.
    """
    layout = _Layout.of(tuple(problems), links)
    best: tuple[float, _Point, int] | None = None
    for start in starts:
        found = _descend(layout, layout.start(start), iterations)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        raise SimulationError(
            f"{problems[0].measurement.name}: no start of the fit of {len(problems)} tests can be "
            "simulated; give values that each test can be simulated with"
        )
    _, point, steps = best
    values = tuple(layout.values(point))
    costs = tuple(float(r @ r) for r in map(_residual, layout.problems, values) if r is not None)
    return Together(
        layout.problems, layout.slots.linked, layout.own, values, costs, steps, links,
        layout.common(point, values),
    )  # fmt: skip


def _varying(problems: Sequence[Problem]) -> tuple[str, ...]:
    """Names of the parameters that vary in some test; all must be of one model."""
    first = problems[0]
    for problem in problems[1:]:
        if problem.model.names != first.model.names:
            raise InputError(
                f"{problem.measurement.name} has other parameters than {first.measurement.name}; "
                "tests that are fitted together need one model"
            )
    free = {name for problem in problems for name in problem.free()}
    return tuple(name for name in (*first.model.names, *NUISANCE) if name in free)


# ------------------------------------------------------------------------------- coordinates


@dataclass(frozen=True, eq=False)
class _Point:
    """Arrays of the shared coordinates (s,) and of the own ones of each test (n, q)."""

    shared: Any
    own: Any

    def moved(self, step: _Point, low: _Point, high: _Point) -> _Point:
        """The point a step away, kept in the box."""
        return _Point(
            np.clip(self.shared + step.shared, low.shared, high.shared),
            np.clip(self.own + step.own, low.own, high.own),
        )


@dataclass(frozen=True, eq=False)
class _Test:
    """The way from the local coordinates of one test, in the order of `names`, to its parameters.

    The box of the search has coordinates in which every point is admissible, some of them relative
    to other parameters. A linked parameter that is relative to one of another value in each test
    (`plain`) would not be one value: its coordinate is the parameter itself, and a point with it
    may not be admissible. What does not vary in this test has a coordinate that does nothing.
    """

    problem: Problem
    space: Space
    names: tuple[str, ...]
    plain: tuple[str, ...]

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        """Where each coordinate of the box stands among the local ones."""
        named = [self.problem.names[one.place] for one in self.space.coordinates]
        return np.array([self.names.index(name) for name in named], dtype=np.intp)

    @cached_property
    def _plain(self) -> NDArray[np.intp]:
        return np.array([self.names.index(name) for name in self.plain], dtype=np.intp)

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        return np.array([self.problem.index[name] for name in self.plain], dtype=np.intp)

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Which of the local coordinates vary in this test."""
        free = set(self.problem.free())
        return np.array([name in free for name in self.names])

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest local coordinates; both zero for what does not vary here."""
        low, high = np.zeros(len(self.names)), np.zeros(len(self.names))
        low[self._order], high[self._order] = self.space.box
        for at, place in zip(self._plain, self._places, strict=True):
            low[at], high[at] = self.space.low[place], self.space.high[place]
            param = self.problem.model.param(self.problem.names[place])
            if param.scale == "one":
                high[at] = min(high[at], param.bounds[1])
        return low, high

    def encode(self, values: Array) -> Array:
        """Local coordinates of parameters, moved into the box."""
        local = np.zeros(len(self.names))
        local[self._order] = self.space.encode(values)
        local[self._plain] = values[self._places]
        return np.clip(local, *self.box)

    def _at(self, local: Array) -> Space:
        """The box with the plain parameters held at their values."""
        if not self.plain:
            return self.space
        values = self.space.values.copy()
        values[self._places] = local[self._plain]
        return replace(self.space, values=values)

    def decode(self, local: Array) -> Array:
        """Parameters at local coordinates, SI."""
        return self._at(local).decode(local[self._order])

    def moves(self, local: Array, values: Array) -> Array:
        """Derivative of the parameters by the local coordinates, (n_values, n_local)."""
        moves = np.zeros((values.size, local.size))
        moves[:, self._order] = self._at(local).slopes(local[self._order], values)
        moves[self._places, self._plain] = 1.0
        return moves


@dataclass(frozen=True, eq=False)
class _Layout:
    """The tests, what links their parameters, and the box of all coordinates.

    Local coordinates of a test are those of the linked parameters, then those of its own ones; the
    linked ones follow from the shared coordinates of all tests.
    """

    problems: tuple[Problem, ...]
    links: Links
    slots: Slots
    own: tuple[str, ...]
    logarithmic: tuple[bool, ...]  # Whether the coordinate of each linked one is its logarithm
    tests: tuple[_Test, ...] = field(default=())

    @classmethod
    def of(cls, problems: tuple[Problem, ...], links: Links) -> _Layout:
        """Check that the tests can be fitted together, and put all of them on one set of scales."""
        names = _varying(problems)
        kinds = {name: links.kind(name) for name in names}
        linked = tuple(name for name in names if kinds[name] not in ("own", "scatter"))
        mine = tuple(name for name in names if name not in linked)
        one_value = {name for name in names if kinds[name] == "shared"}
        plain = tuple(
            name for name in linked
            if _parents(name) & set(names) - one_value or (_parents(name) and kinds[name] in RATES)
        )  # fmt: skip
        every = [problem.scales for problem in problems]
        scales = Scales(
            max(one.stress for one in every),
            max(one.strain for one in every),
            float(np.median([one.rate for one in every])),
            max(one.height for one in every),
        )
        spaces = [problem.space() for problem in problems]
        count = len(problems[0].model.names)  # nuisance parameters have limits of their own
        low = np.min([space.low[:count] for space in spaces], axis=0)
        high = np.max([space.high[:count] for space in spaces], axis=0)
        tests = list[_Test]()
        for problem, space in zip(problems, spaces, strict=True):
            free = problem.free()
            boxed = tuple(name for name in free if name not in plain)
            here = tuple(name for name in plain if name in free)
            space = replace(
                space, scales=scales, free=boxed, low=np.append(low, space.low[count:]),
                high=np.append(high, space.high[count:]),
            )  # fmt: skip
            tests.append(_Test(problem, space, linked + mine, here))
        return cls(
            problems,
            links,
            Slots(linked, tuple(kinds[name] for name in linked),
                  tuple(name for name in mine if kinds[name] == "scatter")),
            mine,
            tuple(is_logarithmic(split_name(name)[1]) for name in linked),
            tuple(tests),
        )  # fmt: skip

    def _x(self, test: int) -> float:
        return 0.0 if self.links.log_rates is None else float(self.links.log_rates[test])

    def through(self, test: int, shared: Array) -> Array:
        """Coordinates of the linked parameters of a test."""
        out = np.empty(len(self.slots.linked))
        for j, (at, kind) in enumerate(zip(self.slots.places, self.slots.kinds, strict=True)):
            out[j] = shared[at]
            if kind in RATES:
                follow = log_law if self.logarithmic[j] else law
                out[j] = follow(kind, shared[at], shared[at + 1], self._x(test))
        return out

    def through_slopes(self, test: int, shared: Array) -> Array:
        """Derivative of these by the shared coordinates, (n_linked, n_shared)."""
        out = np.zeros((len(self.slots.linked), self.slots.count))
        for j, (at, kind) in enumerate(zip(self.slots.places, self.slots.kinds, strict=True)):
            out[j, at] = 1.0
            if kind in RATES and self.logarithmic[j]:
                out[j, at : at + 2] = log_law_slopes(kind, shared[at + 1], self._x(test))
            elif kind in RATES:
                out[j, at : at + 2] = law_slopes(kind, shared[at], shared[at + 1], self._x(test))
        return out

    def local(self, point: _Point) -> list[Array]:
        """Coordinates of each test: the linked ones, then its own."""
        return [
            np.concatenate([self.through(t, point.shared), own]) for t, own in enumerate(point.own)
        ]

    def start(self, vectors: Sequence[Array]) -> _Point:
        """The point that has the own parameters of these vectors, and what is nearest in common."""
        table = np.array([t.encode(v) for t, v in zip(self.tests, vectors, strict=True)])
        first, shared = len(self.slots.linked), np.empty(self.slots.count)
        for j, (at, kind) in enumerate(zip(self.slots.places, self.slots.kinds, strict=True)):
            there = [t for t, test in enumerate(self.tests) if test.present[j]]
            own = table[there, j]
            if kind not in RATES:
                shared[at] = np.median(own)
                continue
            x = np.array([self._x(t) for t in there])
            values = np.exp(own) if self.logarithmic[j] else own
            v, slope = start_of(kind, values, x)
            shared[at : at + 2] = float(np.log(v)) if self.logarithmic[j] else v, slope
        for name, at in zip(self.slots.scatter, self.slots.common, strict=True):
            shared[at] = np.median(
                [_logarithm(p, v, name) for p, v in zip(self.problems, vectors, strict=True)
                 if name in p.free()]
            )  # fmt: skip
        low, high = self.box
        return _Point(np.clip(shared, low.shared, high.shared), table[:, first:])

    @cached_property
    def box(self) -> tuple[_Point, _Point]:
        """Lowest and highest coordinates."""
        first, sides = len(self.slots.linked), list[_Point]()
        for side, far in ((0, -1.0), (1, 1.0)):
            ends = np.array([test.box[side] for test in self.tests])
            there = np.array([test.present for test in self.tests])
            shared = np.full(self.slots.count, far * _FAR)
            for j, (at, kind) in enumerate(zip(self.slots.places, self.slots.kinds, strict=True)):
                shared[at] = np.median(ends[there[:, j], j])
                if kind in RATES:
                    shared[at + 1] = far * STEEPEST
            sides.append(_Point(shared, ends[:, first:]))
        return sides[0], sides[1]

    def values(self, point: _Point) -> list[Array]:
        """Parameters of each test at a point, SI."""
        return [
            test.decode(local) for test, local in zip(self.tests, self.local(point), strict=True)
        ]

    def common(self, point: _Point, values: Sequence[Array]) -> dict[str, tuple[float, ...]]:
        """What all tests have in common at a point, SI; see `Together.common`."""
        out = dict[str, tuple[float, ...]]()
        for j, (name, at) in enumerate(zip(self.slots.linked, self.slots.places, strict=True)):
            t = next(t for t, test in enumerate(self.tests) if test.present[j])
            value = float(values[t][self.problems[t].index[name]])
            if self.slots.kinds[j] not in RATES:
                out[name] = (value,)
                continue
            slope = float(point.shared[at + 1])
            out[name] = value / law(self.slots.kinds[j], 1.0, slope, self._x(t)), slope
        for name, at in zip(self.slots.scatter, self.slots.common, strict=True):
            out[name] = (float(np.exp(point.shared[at])),)
        return out

    def pull(self, test: int, name: str) -> float:
        """Root of the weight that draws a scattering parameter of a test to its common value."""
        pulls = self.links.pulls.get(name)
        there = pulls is not None and name in self.problems[test].free()
        return float(pulls[test]) if there and pulls is not None else 0.0

    def pulled(self, test: int, point: _Point, values: Array) -> Array:
        """Residuals of the scattering parameters of a test, (n_scatter,)."""
        return np.array([
            pull * (_logarithm(self.problems[test], values, name) - point.shared[at])
            if (pull := self.pull(test, name)) else 0.0
            for name, at in zip(self.slots.scatter, self.slots.common, strict=True)
        ])  # fmt: skip

    def pulled_slopes(self, test: int, values: Array, moves: Array) -> Array:
        """Derivative of these by the coordinates along which the parameters move, (·, m).

        The first coordinates are the shared ones.
        """
        out = np.zeros((len(self.slots.scatter), moves.shape[1]))
        for j, (name, at) in enumerate(zip(self.slots.scatter, self.slots.common, strict=True)):
            pull, place = self.pull(test, name), self.problems[test].index[name]
            if pull and abs(values[place]) > _TINY:
                out[j] = pull * moves[place] / values[place]
                out[j, at] -= pull
        return out


def _logarithm(problem: Problem, values: Array, name: str) -> float:
    """Logarithm of the size of a parameter."""
    return float(np.log(max(abs(float(values[problem.index[name]])), _TINY)))


def _parents(name: str) -> set[str]:
    """Names of the parameters that the coordinate of this one is relative to."""
    spring, short = split_name(name)
    of = () if name in NUISANCE else any_param(short).of
    return {f"s{spring + 1}_{parent}" for parent in of}


# ------------------------------------------------------------------------------- the descent


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal matrices (n, p, p) and gradients (n, p) of the tests; s parameters are shared."""

    matrices: Array
    gradients: Array
    s: int

    def step(self, damping: float, held: _Point) -> _Point:
        """Damped Gauss-Newton step of what is not held; own parameters are eliminated first."""
        s, n = self.s, len(self.matrices)
        q = self.matrices.shape[1] - s
        diagonal = np.diagonal(self.matrices, axis1=1, axis2=2)
        least = 1e-12 * max(float(diagonal.sum()), 1e-300)
        free_s, free_q = ~held.shared.astype(bool), ~held.own.astype(bool)
        top = self.matrices[:, :s, :s].sum(axis=0)
        top += damping * np.diag(np.maximum(np.diag(top), least))
        right = -self.gradients[:, :s].sum(axis=0)
        corner = self.matrices[:, s:, s:] * (free_q[:, :, None] & free_q[:, None, :])
        extra = np.where(free_q, damping * np.maximum(diagonal[:, s:], least), 1.0)
        corner = corner + extra[:, :, None] * np.eye(q)
        side = self.matrices[:, :s, s:] * free_q[:, None, :]
        own = -self.gradients[:, s:] * free_q
        if q:
            solved = np.linalg.solve(corner, np.concatenate([side.mT, own[:, :, None]], axis=2))
            top = top - np.sum(side @ solved[:, :, :s], axis=0)
            right = right - np.sum(side @ solved[:, :, s:], axis=0)[:, 0]
        step = np.zeros(s)
        if free_s.any():
            step[free_s] = np.linalg.solve(top[np.ix_(free_s, free_s)], right[free_s])
        if not q:
            return _Point(step, np.zeros((n, 0)))
        return _Point(step, solved[:, :, s] - solved[:, :, :s] @ step)

    def expected(self, moved: _Point) -> float:
        """Gain of the cost that is expected of a move."""
        count = len(moved.own)
        local = np.concatenate([np.tile(moved.shared, (count, 1)), moved.own], axis=1)
        curved = np.einsum("ij,ijk,ik->", local, self.matrices, local)
        return -float(2.0 * np.sum(self.gradients * local) + curved)

    def pressed(self, point: _Point, box: tuple[_Point, _Point]) -> _Point:
        """What lies at a limit and is pressed outwards."""
        low, high = box
        total = self.gradients[:, : self.s].sum(axis=0)
        own = self.gradients[:, self.s :]
        return _Point(
            _outwards(point.shared, total, low.shared, high.shared),
            _outwards(point.own, own, low.own, high.own),
        )


def _outwards(at: Array, gradient: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    pressed = ((at <= low) & (gradient > 0)) | ((at >= high) & (gradient < 0)) | (low == high)
    return np.asarray(pressed)


def _residual(problem: Problem, values: Array) -> Array | None:
    """Residual of one test; None where it cannot be simulated."""
    failures = problem.objective.failures
    residual = problem.objective.residual(values)
    return residual if problem.objective.failures == failures else None


def _residuals(layout: _Layout, point: _Point) -> list[Array] | None:
    """Residual of each test, and of what its scattering parameters are drawn by.

    None where one cannot be simulated.
    """
    found = []
    for t, (problem, values) in enumerate(zip(layout.problems, layout.values(point), strict=True)):
        residual = _residual(problem, values)
        if residual is None:
            return None
        found.append(np.concatenate([residual, layout.pulled(t, point, values)]))
    return found


def _normal(layout: _Layout, point: _Point, residuals: Sequence[Array]) -> _Normal:
    """Normal matrix and gradient of each test; no Jacobian is kept."""
    matrices, gradients = [], []
    first, locals_ = len(layout.slots.linked), layout.local(point)
    for t, (test, local, residual) in enumerate(zip(layout.tests, locals_, residuals, strict=True)):
        values = test.decode(local)
        own = test.moves(local, values)
        moves = np.hstack([own[:, :first] @ layout.through_slopes(t, point.shared), own[:, first:]])
        jacobian = test.problem.objective.jacobian_along(values, moves)
        jacobian = np.vstack([jacobian, layout.pulled_slopes(t, values, moves)])
        matrices.append(jacobian.T @ jacobian)
        gradients.append(jacobian.T @ residual)
    return _Normal(np.array(matrices), np.array(gradients), layout.slots.count)


def _cost(residuals: Sequence[Array]) -> float:
    return float(sum(residual @ residual for residual in residuals))


def _descend(layout: _Layout, point: _Point, iterations: int) -> tuple[float, _Point, int] | None:
    """Levenberg-Marquardt inside the box; the cost of the end, the end, and the steps.

    The damping follows the gain ratio as in `levenberg.descend`; a point that cannot be simulated
    is refused as one that gains nothing. None if the start cannot be simulated.
    """
    residuals = _residuals(layout, point)
    if residuals is None:
        return None
    cost, damping, growth, small, count = _cost(residuals), 1e-3, 2.0, 0, 0
    normal = _normal(layout, point, residuals)
    low, high = layout.box
    while count < iterations:
        count += 1
        step = normal.step(damping, normal.pressed(point, layout.box))
        trial = point.moved(step, low, high)
        moved = _Point(trial.shared - point.shared, trial.own - point.own)
        size = max(float(np.max(np.abs(part), initial=0.0)) for part in (moved.shared, moved.own))
        if size < _LEAST_MOVE:
            break
        found = _residuals(layout, trial)
        gain = -1.0 if found is None else cost - _cost(found)
        if found is None or gain <= 0.0:
            damping, growth = damping * growth, 2.0 * growth
            if damping > _MOST_DAMPING:
                break
            continue
        small = small + 1 if gain < ENOUGH * cost else 0
        ratio = gain / max(normal.expected(moved), 1e-300)
        damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
        growth, cost, point = 2.0, cost - gain, trial
        if small == 2:
            break
        normal = _normal(layout, point, found)
    return cost, point, count
