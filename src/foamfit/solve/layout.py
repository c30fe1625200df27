"""Where everything of a run lies in memory, once for each kind of scene."""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.solve import cache
from foamfit.solve.compiled import run
from foamfit.solve.compiled.run import FREE, MOTION, STRESS, VISCOUS
from foamfit.springs.compiled import compiled, contract
from foamfit.springs.compiled.contract import BY_STRESS, FADES, INTERNAL
from foamfit.springs.laws.record import DRAG, OWN_ETA, OWN_HEIGHT, Law

Memory = tuple[NDArray[np.int64], Array]  # the integers and floats of a run


class Shape(NamedTuple):
    """What decides the layout of a run."""

    laws: tuple[Law, ...]
    terms: int  #: of relaxation
    ends: tuple[int, ...]  #: one past the last spring of each group
    top: int
    damped: bytes  #: whether each spring has a dashpot, booleans
    directions: bytes  #: of the derivatives, integers (p, 2)
    struck: bool  #: whether the drive is an impact
    degree: int  #: of implicit steps; 0 for explicit ones
    integrated: bool  #: whether it takes steps in time

    @property
    def solved(self) -> bool:
        """Whether the rest of the state is computed, or nothing is integrated."""
        return self.degree > 0 or not self.integrated

    @property
    def groups(self) -> list[range]:
        """The springs of each group."""
        return [range(i, j) for i, j in pairwise((0, *self.ends))]


def place_state(
    shape: Shape, numbers: np.recarray, nodes: int
) -> tuple[list[int], NDArray[np.int64]]:
    """Give every component its place; return the kinds, and groups of those with derivatives."""
    damped, count = np.frombuffer(shape.damped, bool), len(shape.laws)
    more = run.SCALES + count + 2 * nodes
    kinds, groups_of = list(range(run.SCALES + count, more)), [k // 2 for k in range(2 * nodes)]
    for g, springs in enumerate(shape.groups):
        last = g == len(shape.ends) - 1
        several = len(springs) > 1 or (last and shape.top in (STRESS, VISCOUS))
        for i in springs:
            own = numbers[i]
            own.eps_at = own.x_at = -1
            own.fixed = several and not damped[i]
            if several and damped[i]:
                own.eps_at = len(kinds)
                kinds.append(run.SCALES + i)
            own.z_at = len(kinds)
            kinds += [run.OF_SIGMA] * shape.terms
            if own.internal:
                own.x_at, inside = len(kinds), int(own.internals)
                kinds += range(more, more + inside)
                more += inside
            groups_of += [g] * (len(kinds) - len(groups_of))
    for i, own in enumerate(numbers if not shape.solved else ()):
        if own.fixed:
            own.eps_at = len(kinds)
            kinds.append(run.SCALES + i)
        if own.by_stress:
            own.x_at = len(kinds)
            kinds.append(run.OF_SIGMA)
    return kinds, np.array(groups_of, np.int64)


def order(groups_of: NDArray[np.int64], groups: int) -> tuple[NDArray[np.int64], int]:
    """Return the place of each component, ordered by groups; closer than the reach they couple."""
    places = np.argsort(np.argsort(groups_of, kind="stable"))
    sizes = [0, *np.bincount(groups_of, minlength=groups)]
    return places, int(max(a + b for a, b in pairwise(sizes))) - 1


def _functions(
    shape: Shape, several: bool, internal: bool, fades: bool, relaxes: bool
) -> tuple[int, ...]:
    """Return the addresses of the functions that a run needs, 0 for others (see run.ADDRESSES)."""
    integrated = shape.integrated
    if integrated:
        from foamfit.solve.compiled import loop

        cache.announce(loop.integrate, "the solver")
    functions = (
        ("motion", "compute_rates", True), ("groups", "group_values", several),
        ("internal", "inside_task", internal), ("events", "enter_branch", True),
        ("implicit" if shape.degree else "explicit", "step", integrated),
        ("loop", "advance", integrated), ("loop", "next_piece", integrated and not shape.struck),
        ("samples", "sample_task", integrated), ("internal", "fade", fades),
        ("explicit", "relaxing_step", relaxes),
    )  # fmt: skip
    # A module is imported, and a function compiled, when its address is first asked for.
    return tuple(
        getattr(import_module(f"foamfit.solve.compiled.{module}"), name).address if needed else 0
        for module, name, needed in functions
    )


@lru_cache(maxsize=1024)
def lay_out(shape: Shape) -> tuple[NDArray[np.int64], int]:
    """Return the integers of a run, with places instead of addresses, and the number of floats."""
    made = [compiled(law) for law in shape.laws]
    directions = np.frombuffer(shape.directions, np.int64).reshape(-1, 2).tolist()
    count, groups, p = len(made), len(shape.ends), len(directions)
    nodes = groups if shape.top in (FREE, VISCOUS) else groups - 1
    of_springs = [
        (*one.addresses, one.kind == BY_STRESS, one.kind == INTERNAL, one.derivatives, one.internal,
         *(0,) * 4)  # places
        for one in made
    ]  # fmt: skip
    numbers = np.array(of_springs, [(name, np.int64) for name in run.NUMBERS]).view(np.recarray)
    kinds, groups_of = place_state(shape, numbers, nodes)
    carries, base, internals = len(groups_of), len(kinds), sum(one.internal for one in made)
    n = base + carries * p
    results = max(contract.results_of(one.derivatives, one.internal, p) for one in made)
    wide = -4 * (-n // 4)
    row = contract.RESULTS + results
    width = row + max(one.columns for one in made)
    size = carries if shape.degree else 0
    places, reach = order(groups_of, groups) if size else ((), 0)
    parameters = max(one.derivatives for one in made)
    internal = any(one.kind == INTERNAL for one in made)
    fades = not shape.integrated and made[0].flows == FADES
    relaxes = shape.terms > 0 and shape.degree == 0 and shape.integrated and not internal
    relaxes = relaxes and groups == 1 and shape.top in (MOTION, STRESS) and not any(shape.damped)
    aside = relaxes * count * (4 + 8 * shape.terms), count + 1
    lengths = {
        "springs": count * width, "per_mass": groups, "drive": len(run.DRIVE), "carried": groups,
        "held": 2 * count * p, "part": 2 * count * p,
        "common": (groups + 3) * p, "strain": count * p,
        "scales": run.SCALES + count + 2 * nodes + internals,
        "now": len(run.NOW), "stage": run.STAGES * wide, "line": run.LINE * wide, "y": wide,
        "new": wide, "state": wide, "f": wide, "nil": wide, "errors": 2 * wide,
        "batch": run.BATCH * (6 + contract.BY + parameters) + 2 * p + 8 * contract.MOST_TERMS + 8,
        "aside": max(fades * made[0].internal * (27 + 4 * p), *aside),
        "jacobian": size * (2 * reach + 1), "alive": 2 * groups if size else 0,
        "largest": p if size else 0, "kept": count * width + groups if size and p else 0,
        "systems": 2 * run.SYSTEMS * size * (3 * reach + 1),
        "right": 2 * run.SYSTEMS * size,
    }  # fmt: skip
    arrays = (
        numbers.view(np.int64).tolist(), [0, *shape.ends], *_owners(directions, count), kinds,
        [0] * (run.SYSTEMS * size), places, groups_of[:size],
    )  # fmt: skip
    at = np.cumsum([0, *(lengths[name] for name in run.FLOATS)])
    whole = np.cumsum([run.WORDS, *map(len, arrays)])
    several = any(len(springs) > 1 for springs in shape.groups)
    several = several or shape.top in (STRESS, VISCOUS)
    words = [
        *at[:-1], *whole[:-1], *([0] * len(run.GIVEN)),
        *_functions(shape, several, internal, fades, relaxes),
        row, width, count, groups, nodes, p, base, carries, shape.terms, shape.top,
        int(shape.solved), wide, shape.degree, reach, 0, 0, 0, 0,
    ]  # fmt: skip
    return np.array([*words, *(k for one in arrays for k in one)], np.int64), int(at[-1])


def _owners(directions: list[list[int]], count: int) -> tuple[list[int], list[int], list[int]]:
    """Return the directions, what each is of each spring, and own derivatives; see `INTEGERS`."""
    named = [*([i, what] for i in range(count) for what in (OWN_HEIGHT, OWN_ETA)), [-1, DRAG]]
    own = np.array([float(one == other) for one in named for other in directions])
    owned = [what if k == i else -1 for i in range(count) for k, what in directions]
    return [k for pair in directions for k in pair], owned, own.view(np.int64).tolist()


def memory_of(shape: Shape) -> Memory:
    """Return the memory of a new run."""
    words, floats = lay_out(shape)
    return words.copy(), np.zeros(floats)
