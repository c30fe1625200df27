"""Compiled loops that follow springs of any law by the functions of their records.

The loops are compiled for the laws of a chain, in their order, and cached. A spring is a row and a
state of numbers (`laws.record`). `step` takes a spring to a strain within a time and returns its
total stress: law, relaxation terms and dashpot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64, njit, types
from numpy.typing import ArrayLike, NDArray

from foamfit.arrays import Array
from foamfit.springs import kernels
from foamfit.springs import microscale_kernels as micro
from foamfit.springs.law import MICROSCALE
from foamfit.springs.laws.record import BRANCH, EPS, SIGMA, Functions, Law

Compiled = Callable[..., Any]
compiled = njit(**kernels.PLAIN)
# For functions that only compiled ones call.
inner = njit(**kernels.PLAIN | {"no_cpython_wrapper": True})
MOST_SWITCHES = 10_000  # largest number of switches of a spring in one step


# ---------------------------------------------------------------- built-in laws


@kernels.compiled
def _begin_on_branch(row: Array, state: Array) -> None:
    """Set the state at rest of a spring that is not a microscale spring."""
    state[:] = 0.0
    branch = kernels.first_branch(row)
    state[BRANCH] = branch
    state[micro.LOW], state[micro.HIGH] = kernels.interval(row, branch)


@kernels.compiled
def _leaves_branch(row: Array, state: Array, eps: float) -> bool:
    """Return whether the spring leaves its branch before it reaches a strain."""
    return eps > state[micro.HIGH] if eps > state[EPS] else eps < state[micro.LOW]


@kernels.compiled
def _settle_on_branch(row: Array, state: Array, eps: float) -> None:
    """Move the spring to a strain on its branch."""
    state[EPS], state[SIGMA] = eps, kernels.stress_on(row, int(state[BRANCH]), eps)


@kernels.compiled
def _switch_branch(row: Array, state: Array, up: bool) -> None:
    """Change to the next branch, at the end of this one."""
    branch = int(state[BRANCH])
    state[EPS] = state[micro.HIGH] if up else state[micro.LOW]
    branch = kernels.above(branch) if up else kernels.below(branch)
    state[BRANCH] = branch
    state[micro.LOW], state[micro.HIGH] = kernels.interval(row, branch)
    state[SIGMA] = kernels.stress_on(row, branch, state[EPS])


@kernels.compiled
def _begin(row: Array, state: Array) -> None:
    """Set the state of a spring at rest."""
    if row[kernels.KIND] == MICROSCALE:
        micro.begin(row, state, 0.0)
    else:
        _begin_on_branch(row, state)


@kernels.compiled
def _leaves(row: Array, state: Array, eps: float) -> bool:
    """Return whether a spring leaves its branch before it reaches a strain."""
    if row[kernels.KIND] == MICROSCALE:
        return micro.leaves(state, eps)
    return _leaves_branch(row, state, eps)


@kernels.compiled
def _settle(row: Array, state: Array, eps: float) -> None:
    """Move a spring to a strain on its branch."""
    if row[kernels.KIND] == MICROSCALE:
        micro.settle(row, state, eps)
    else:
        _settle_on_branch(row, state, eps)


@kernels.compiled
def _switch(row: Array, state: Array, up: bool) -> None:
    """Change to the next branch, at the end of this one or at a turn of the strain."""
    if row[kernels.KIND] == MICROSCALE:
        micro.switch(row, state, up)
    else:
        _switch_branch(row, state, up)


_FILL = {
    "bistable": kernels.fill_bistable,
    "microscale": kernels.fill_microscale,
    "microscale, stiffening": kernels.fill_microscale,
    "microscale, mullins": kernels.fill_microscale,
    "microscale, stiffening, mullins": kernels.fill_microscale,
    "linear": kernels.fill_linear,
    "unilateral": kernels.fill_unilateral,
}


def functions_of(kind: str) -> Functions:
    """Return the functions of a built-in law; those of a microscale law follow any built-in law.

    The other laws have functions of their own, because the microscale code takes long to compile.
    """
    if kind.startswith("microscale"):
        return Functions(_FILL[kind], _begin, _leaves, _switch, _settle)
    return Functions(
        _FILL[kind], _begin_on_branch, _leaves_branch, _switch_branch, _settle_on_branch
    )


# ---------------------------------------------------------------- loops for any laws


@cache
def _ready(function: Any, compiler: Compiled) -> Any:
    """Return a compiled function; laws that share a function share its compiled form."""
    return compiler(function) if function and not hasattr(function, "py_func") else function


@cache
def compiled_functions(law: Law) -> Functions:
    """Return the compiled functions of a law."""
    fill, *followed = law.loaded_functions()
    return Functions(_ready(fill, compiled), *(_ready(one, inner) for one in followed))


def sizes_of(law: Law) -> tuple[int, int]:
    """Return the lengths of a row and of a state."""
    if law.kind in _FILL:
        return kernels.N_COLUMNS, micro.STATE
    return law.columns or len(law.params), law.states


def row_of(law: Law, values: ArrayLike) -> Array | None:
    """Return the row of a spring from its parameters (and eta); None if not admissible."""
    row = np.zeros(sizes_of(law)[0])
    own = np.array(values, dtype=float)[: len(law.params)]
    return row if compiled_functions(law).fill(own, row) else None


def solver_row(law: Law, values: Array, terms: ArrayLike, room: int) -> Array | None:
    """Return the row of a built-in law for the solver; None if it is not admissible.

    `values` are the parameters and eta; `room` is the number of relaxation terms in the row.
    """
    row, pairs = np.zeros(kernels.N_COLUMNS + 2 * room), np.ravel(terms)
    own, relaxing = row[: kernels.N_COLUMNS], row[kernels.N_COLUMNS :]
    fine = compiled_functions(law).fill(values[:-1], own) and values[-1] >= 0.0
    own[kernels.ETA] = values[-1]
    relaxing[1::2] = np.inf  # unused terms
    relaxing[: pairs.size] = pairs
    for g, tau in pairs.reshape(-1, 2).tolist():
        fine = fine and 0.0 <= g < math.inf and 0.0 < tau < math.inf
    return row if fine else None


# Columns of a relaxation term: strength g, time τ (s), and its state y (see `solve.relaxation`).
STRENGTH, TIME, MEMORY = range(3)
AT_START = -1.0  # as the time of a step: at the first sample every relaxation term is zero


class Springs(NamedTuple):
    """Springs in series: rows, states (springs, …), terms (springs, n, 3), heights, m, η."""

    rows: Array
    states: Array
    terms: Array
    heights: Array
    eta: Array


class Loops(NamedTuple):
    """Compiled loops for springs of some laws; i is the spring, 0 at the base.

    start(i, row, state, 0) sets it to rest. step(i, springs, strain, h) takes it to a strain within
    the time h (s; 0 for a jump, AT_START to start there in equilibrium) and returns its total
    stress, Pa; relaxation terms assume a stress linear in time. to_stress(i, springs, stress, h) is
    the inverse. Both return NaN without a solution. delayed(i, row, state, (rate, h)) is the stress
    that depends on time.
    """

    start: Compiled
    step: Compiled
    to_stress: Compiled
    delayed: Compiled


@cache
def _own_loops(law: Law) -> tuple[Compiled, Compiled, Compiled]:
    """Return loops that set a spring to rest, take it to a strain, and give its viscous stress.

    Rows and states may be longer than those of the law.
    """
    _, begin, leaves, switch, settle, viscous = compiled_functions(law)
    columns, states = sizes_of(law)

    @inner
    def start(rows: Array, whole: Array, eps: float) -> float:
        whole[:] = 0.0
        begin(rows[:columns], whole[:states])
        return eps

    @inner
    def walk(rows: Array, whole: Array, eps: float) -> float:
        row, state = rows[:columns], whole[:states]
        for _ in range(MOST_SWITCHES):
            if not leaves(row, state, eps):
                settle(row, state, eps)
                return state[SIGMA]
            switch(row, state, eps > state[EPS])
        return math.nan

    @inner
    def none(rows: Array, whole: Array, pace: tuple[float, float]) -> float:
        return 0.0

    @inner
    def delayed(rows: Array, whole: Array, pace: tuple[float, float]) -> float:
        return float(viscous(rows[:columns], whole[:states], *pace))  # type: ignore[misc]

    return start, walk, none if viscous is None else delayed


def _chosen(functions: Sequence[Compiled]) -> Compiled:
    """Combine functions of several springs into one that takes the index i of a spring."""
    first = functions[0]

    @inner
    def alone(i: int, row: Array, state: Array, given: Any) -> float:
        return first(row, state, given)

    if len(functions) == 1:
        return alone
    rest = _chosen(functions[1:])

    @inner
    def choose(i: int, row: Array, state: Array, given: Any) -> float:
        return first(row, state, given) if i == 0 else rest(i - 1, row, state, given)

    return choose


def inverse(value_at: Compiled) -> Compiled:
    """Return a root finder for value_at(given, x) = target, where value_at never falls with x.

    find(given, start, pace, size, target) searches from `start` with steps of `pace`, to rounding
    of x or of `size`, and returns NaN without a root.
    """

    @inner
    def find(given: Any, start: float, pace: float, size: float, target: float) -> float:
        low = high = start
        least = most = value_at(given, start)
        for _ in range(200):  # bracket the root
            if least <= target <= most:
                break
            up = target > most
            x = high + pace if up else low - pace
            now = value_at(given, x)
            if up:
                low, least, high, most = high, most, x, now if now == now else math.inf
            else:
                low, least, high, most = x, now if now == now else -math.inf, low, least
            pace *= 2.0
        if not least <= target <= most:
            return math.nan
        x = high
        for turn in range(200):  # false position, every third step a bisection
            x = 0.5 * (low + high)
            if turn % 3 and most - least < math.inf and most > least:
                x = low + (high - low) * (target - least) / (most - least)
            now = value_at(given, x)
            if now < target:
                low, least = x, now
            else:
                high, most = x, now
            if now == target or high - low <= 1e-15 * max(abs(low), abs(high), size):
                break
        return x

    return find


@inner
def trial_of(springs: Springs) -> Springs:
    """Return the springs with a copy of their states, for trial steps."""
    states, terms = springs.states.copy(), springs.terms.copy()
    return Springs(springs.rows, states, terms, springs.heights, springs.eta)


@cache
def loops_of(laws: tuple[Law, ...]) -> Loops:
    """Return the loops for springs of these laws, base first."""
    start, walk, delayed = map(_chosen, zip(*map(_own_loops, laws), strict=True))

    @inner
    def step(i: int, springs: Springs, eps: float, h: float) -> float:
        row, state = springs.rows[i], springs.states[i]
        before, from_eps = state[SIGMA], state[EPS]
        sigma = walk(i, row, state, eps)
        out = sigma
        for term in springs.terms[i]:
            if h < 0.0:
                term[MEMORY] = -sigma
                continue
            x = h / term[TIME]
            decay, late = math.exp(-x), 0.5 * x
            if x > 1e-4:
                late = 1.0 + math.expm1(-x) / x
            early = -math.expm1(-x) - late
            term[MEMORY] = decay * term[MEMORY] - early * before - late * sigma
            out += term[STRENGTH] * (sigma + term[MEMORY])
        if h > 0.0:
            rate = (eps - from_eps) / h
            out += delayed(i, row, state, (rate, h)) + springs.eta[i] * rate
        return out

    @inner
    def beside(given: Any, eps: float) -> float:
        """Return the stress at a strain without moving the spring."""
        i, springs, h = given
        return step(i, trial_of(springs), eps, h)

    find = inverse(beside)

    @inner
    def to_stress(i: int, springs: Springs, sigma: float, h: float) -> float:
        eps = find((i, springs, h), springs.states[i, EPS], 1e-3, 1e-3, sigma)
        if math.isfinite(eps):
            step(i, springs, eps, h)
        return eps

    return Loops(start, step, to_stress, delayed)


@cache
def _along(law: Law) -> Compiled:
    """Return a loop that follows one spring from rest along a strain history, without time."""
    start, walk, _ = _own_loops(law)

    @compiled
    def along(
        row: Array, state: Array, strain: Array, out: Array, branches: NDArray[np.int64]
    ) -> None:
        start(row, state, 0.0)
        for j in range(strain.size):
            out[j] = walk(row, state, strain[j])
            branches[j] = int(state[BRANCH])

    return along


@cache
def _sloping(law: Law) -> Compiled:
    """Return a loop that writes the slopes of one spring along a strain history from rest.

    Each is a difference over small steps that continue the motion which led to the sample or, at
    the end of a branch, over the last steps before it: never across a switch or a turn.
    """
    start, walk, _ = _own_loops(law)
    leaves = compiled_functions(law).leaves

    @inner
    def beside(row: Array, state: Array, eps: float) -> float:
        return walk(row, state.copy(), eps)

    @compiled
    def slopes(row: Array, state: Array, strain: Array, step: float, out: Array) -> None:
        start(row, state, 0.0)
        before, way = state.copy(), step
        for j in range(strain.size):
            eps, moved = strain[j], strain[j] - state[EPS]
            if moved != 0.0:
                way = math.copysign(step, moved)
                before[:] = state
            sigma = walk(row, state, eps)
            side, origin, end = way, state, eps + 2.0 * way
            ends = leaves(row, state, end) or not math.isfinite(beside(row, state, end))
            if ends and abs(eps - before[EPS]) > 2.0 * step:
                side, origin = -way, before
            one, two = beside(row, origin, eps + side), beside(row, origin, eps + 2.0 * side)
            out[j] = (4.0 * one - 3.0 * sigma - two) / (2.0 * side)

    return slopes


@cache
def _back(law: Law) -> Compiled:
    """Return a loop that follows one spring of height 1 along a stress history, without time."""
    start, _, to_stress, _ = loops_of((law,))

    @compiled
    def back(springs: Springs, stress: Array, out: Array) -> None:
        base = len(springs.heights) - 1  # for the constant 0 numba would compile another version
        start(base, springs.rows[base], springs.states[base], 0.0)
        for j in range(stress.size):
            out[j] = to_stress(base, springs, stress[j], 0.0)

    return back


def compile_delayed(law: Law) -> None:
    """Compile the time-dependent stress of a law; raises the errors of the compiler."""
    numbers = types.Array(float64, 1, "C")
    _own_loops(law)[2].compile((numbers, numbers, types.UniTuple(float64, 2)))  # type: ignore


def _row_and_state(law: Law, values: ArrayLike) -> tuple[Array, Array]:
    row = row_of(law, values)
    assert row is not None
    return row, np.empty(sizes_of(law)[1])


def stress_along(law: Law, values: ArrayLike, strain: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return stress (Pa) and branch number along a strain history (n,), from rest."""
    out, branches = np.empty(strain.size), np.empty(strain.size, np.int64)
    _along(law)(*_row_and_state(law, values), strain, out, branches)
    return out, branches


def slope_along(law: Law, values: ArrayLike, strain: Array) -> Array:
    """Return the slope dσ/dε (Pa) along a strain history (n,), from rest."""
    step, out = 1e-6 * max(float(np.abs(strain).max()), 1e-9), np.empty(strain.size)
    _sloping(law)(*_row_and_state(law, values), strain, step, out)
    return out


def strain_along(law: Law, values: ArrayLike, stress: Array) -> Array:
    """Return the strain along a stress history (n,), Pa, from rest; NaN without a solution."""
    out, (row, state) = np.empty(stress.size), _row_and_state(law, values)
    springs = Springs(row[None], state[None], np.empty((1, 0, 3)), np.ones(1), np.zeros(1))
    _back(law)(springs, stress, out)
    return out
