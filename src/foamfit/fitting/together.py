"""One fit of several tests: some parameters have one value for all, the others one for each test.

All residuals are minimised as one sum of squares, each test in units of its own noise. The normal
matrix has a block for each test, and only the shared parameters couple them: own parameters are
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
from foamfit.fitting.box import LAST_STRAIN, Scales, Space
from foamfit.fitting.problem import Problem
from foamfit.springs.parameters import split_name

# What a coordinate of the box is relative to, by the short names of the parameters.
RELATIVE_TO = {"eps_star": ("k0", "kc"), "eps_c": ("eps_a",), "dsigma": ("k0", "eps_a")}
# Descents end when two steps in a row gain less than this share, or after so many steps.
ENOUGH, ITERATIONS = 1e-5, 80
_LEAST_MOVE, _MOST_DAMPING = 1e-9, 1e8


@dataclass(frozen=True, eq=False)
class Together:
    """Several tests with some parameters in common, at the best point found.

    `shared` and `own` are the names of the parameters that vary, `values` (n_values,) those of all
    parameters of each test (SI), `costs` the sum of squares of each, in units of its noise.
    """

    problems: tuple[Problem, ...]
    shared: tuple[str, ...]
    own: tuple[str, ...]
    values: tuple[Array, ...]
    costs: tuple[float, ...]
    steps: int  # Steps of the descent

    @property
    def cost(self) -> float:
        """Sum of squares of all tests."""
        return float(sum(self.costs))

    @property
    def n_vary(self) -> int:
        """Parameters that vary, those of one test counted for each."""
        return len(self.shared) + len(self.own) * len(self.problems)

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

    def value(self, name: str) -> list[float]:
        """Values of one parameter, one for each test."""
        return [
            float(values[problem.index[name]])
            for problem, values in zip(self.problems, self.values, strict=True)
        ]


def fit_together(
    problems: Sequence[Problem],
    own: Collection[str],
    starts: Sequence[Sequence[Array]],
    *,
    iterations: int = ITERATIONS,
) -> Together:
    """Fit several tests at once, parameters named in `own` for each test, the others for all.

    Parameters
    ----------
    problems : sequence of Problem
        Of one model, with the same parameters varying.
    own : collection of str
        Names of parameters with a value for each test; all others that vary are shared.
    starts : sequence of sequences of (n_values,) arrays
        Each holds a vector of parameters for each test, as its own fit has found; the shared
        parameters start at the median over the tests. The best end of all starts is returned.
    iterations : int
        Steps of a descent at most.

    Returns
    -------
    Together

    Raises
    ------
    InputError
        If the problems have not the same parameters, or `own` names one that does not vary.
    SimulationError
        If no start can be simulated.
    """
    layout = _Layout.of(tuple(problems), own)
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
    values = tuple(
        test.decode(local) for test, local in zip(layout.tests, point.local, strict=True)
    )
    costs = tuple(float(r @ r) for r in map(_residual, layout.problems, values) if r is not None)
    return Together(layout.problems, layout.shared, layout.own, values, costs, steps)


# ------------------------------------------------------------------------------- coordinates


@dataclass(frozen=True, eq=False)
class _Point:
    """Arrays of the shared coordinates (s,) and of the own ones of each test (n, q)."""

    shared: Any
    own: Any

    @property
    def local(self) -> list[Array]:
        """Coordinates of each test: the shared ones, then its own."""
        return [np.concatenate([self.shared, own]) for own in self.own]

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
    to other parameters. A shared parameter that is relative to an own one in that box (`plain`)
    would not be one value: its coordinate is the parameter itself, and a point with it may not be
    admissible.
    """

    problem: Problem
    space: Space
    names: tuple[str, ...]
    plain: tuple[str, ...]

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        """Where each coordinate of the box stands among the local ones."""
        named = [self.problem.names[place] for place, _, _ in self.space.coordinates]
        return np.array([self.names.index(name) for name in named], dtype=np.intp)

    @cached_property
    def _plain(self) -> NDArray[np.intp]:
        return np.array([self.names.index(name) for name in self.plain], dtype=np.intp)

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        return np.array([self.problem.index[name] for name in self.plain], dtype=np.intp)

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest local coordinates."""
        low, high = np.empty(len(self.names)), np.empty(len(self.names))
        low[self._order], high[self._order] = self.space.box
        for at, place in zip(self._plain, self._places, strict=True):
            low[at], high[at] = self.space.low[place], self.space.high[place]
            if split_name(self.problem.names[place])[1] != "dsigma":
                high[at] = min(high[at], LAST_STRAIN)
        return low, high

    def encode(self, values: Array) -> Array:
        """Local coordinates of parameters, moved into the box."""
        local = np.empty(len(self.names))
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
    """The tests, their shared and own parameters, and the box of all coordinates."""

    problems: tuple[Problem, ...]
    shared: tuple[str, ...]
    own: tuple[str, ...]
    tests: tuple[_Test, ...] = field(default=())

    @classmethod
    def of(cls, problems: tuple[Problem, ...], own: Collection[str]) -> _Layout:
        """Check that the tests can be fitted together, and put all of them on one set of scales."""
        first = problems[0]
        names = first.free()
        for problem in problems[1:]:
            if problem.names != first.names or problem.free() != names:
                raise InputError(
                    f"{problem.measurement.name} has other parameters than "
                    f"{first.measurement.name}; tests that are fitted together need one model with "
                    "the same parameters varying"
                )
        for name in own:
            if name not in names:
                raise InputError(
                    f"parameter '{name}' cannot be one of each test; it must be one of "
                    f"{', '.join(names)}"
                )
        shared = tuple(name for name in names if name not in own)
        mine = tuple(name for name in names if name in own)
        plain = tuple(name for name in shared if _parents(name) & set(mine))
        every = [problem.scales for problem in problems]
        scales = Scales(
            max(one.stress for one in every),
            max(one.strain for one in every),
            float(np.median([one.rate for one in every])),
            max(one.height for one in every),
        )
        spaces = [problem.space() for problem in problems]
        low = np.min([space.low for space in spaces], axis=0)
        high = np.max([space.high for space in spaces], axis=0)
        boxed = tuple(name for name in names if name not in plain)
        tests = tuple(
            _Test(
                problem,
                replace(space, scales=scales, low=low, high=high, free=boxed),
                shared + mine,
                plain,
            )
            for problem, space in zip(problems, spaces, strict=True)
        )
        return cls(problems, shared, mine, tests)

    def split(self, locals_: Sequence[Array]) -> _Point:
        """Coordinates of all tests as one point, the shared ones at their median."""
        table, s = np.array(locals_), len(self.shared)
        return _Point(np.median(table[:, :s], axis=0), table[:, s:])

    def start(self, vectors: Sequence[Array]) -> _Point:
        """The point that has the own parameters of these vectors, and the median of the others."""
        return self.split([t.encode(v) for t, v in zip(self.tests, vectors, strict=True)])

    @cached_property
    def box(self) -> tuple[_Point, _Point]:
        """Lowest and highest coordinates."""
        low, high = zip(*(test.box for test in self.tests), strict=True)
        return self.split(low), self.split(high)

    def values(self, point: _Point) -> list[Array]:
        """Parameters of each test at a point, SI."""
        return [test.decode(local) for test, local in zip(self.tests, point.local, strict=True)]


def _parents(name: str) -> set[str]:
    """Names of the parameters that the coordinate of this one is relative to."""
    spring, short = split_name(name)
    return {f"s{spring + 1}_{parent}" for parent in RELATIVE_TO.get(short, ())}


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
        local = np.array(moved.local)
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
    """Residual of each test; None where one cannot be simulated."""
    found = []
    for problem, values in zip(layout.problems, layout.values(point), strict=True):
        residual = _residual(problem, values)
        if residual is None:
            return None
        found.append(residual)
    return found


def _normal(layout: _Layout, point: _Point, residuals: Sequence[Array]) -> _Normal:
    """Normal matrix and gradient of each test; no Jacobian is kept."""
    matrices, gradients = [], []
    for test, local, residual in zip(layout.tests, point.local, residuals, strict=True):
        values = test.decode(local)
        jacobian = test.problem.objective.jacobian_along(values, test.moves(local, values))
        matrices.append(jacobian.T @ jacobian)
        gradients.append(jacobian.T @ residual)
    return _Normal(np.array(matrices), np.array(gradients), len(layout.shared))


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
