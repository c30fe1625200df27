"""Histories that need no integration in time: of one spring, and of springs in equilibrium."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.solve import cache
from foamfit.solve.compiled import along, groups, loop
from foamfit.solve.compiled.run import DONE, ENDED, MOTION, OUTCOME, STRESS, SWITCHES
from foamfit.solve.layout import Shape, memory_of
from foamfit.springs.compiled import compiled
from foamfit.springs.compiled.contract import FLOWS, INTERNAL
from foamfit.springs.laws.record import MOVED, OWN_ETA, OWN_HEIGHT, Law

NO_SWITCHES = np.empty((0, 5))
_ONE = np.ones(1)
TOL = 1e-12  # of a law with internal variables


def _given(law: Law, row: Array, history: Array, top: int) -> tuple[list[Any], bool]:
    """Return the arguments that all runs have in common, and whether they integrate in time."""
    row, made = row.copy(), compiled(law)
    integrated = made.kind == INTERNAL and (made.flows == FLOWS or top == STRESS)
    row[0] = 0.0  # no dashpot
    memory = memory_of(Shape((law,), 0, (1,), top, b"\0", b"", False, 0, integrated))
    most = float(np.abs(history).max())
    scales = (most, np.abs(np.diff(history)).max(initial=0.0), most, 0.0)
    if top == STRESS:
        scales = 1e-3, 0.0, 1e-3, most
    reals = np.array((0.0, 0.0, 0.0 if integrated else TOL, TOL, 1e9, 0.0, 0.0, *scales))
    # The number of the sample; time stands still for the law.
    time = np.arange(history.size, dtype=float)
    out = np.empty((1, 2, history.size))
    return [*memory, row[None, :], _ONE, _ONE, reals, history, time, out], integrated


def stress_along(law: Law, row: Array, strain: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return stresses (Pa) and branches along a strain history from rest, (n,); no relaxation."""
    given, integrated = _given(law, row, strain, MOTION)
    told, time, stress = given[1], given[-2], given[-1][0, 0]
    cache.announce(along.follow, "the laws of springs")
    if not integrated:
        samples = np.empty((strain.size, 4))
        along.follow(*given, NO_SWITCHES, samples)
        return stress, samples[:, 2].astype(np.int64)
    branches, log = np.zeros(strain.size, np.int64), np.empty((4 * strain.size + 64, 5))
    loop.integrate(*given, log)
    for at, _, _, entered, _ in log[: int(told[SWITCHES])].tolist():
        branches[int(np.searchsorted(time, at, "right")) :] = int(entered)
    if told[OUTCOME] != DONE:
        stress[int(np.searchsorted(time, told[ENDED])) :] = np.inf
    return stress, branches


def strain_along(law: Law, row: Array, stress: Array) -> Array:
    """Return strains along a stress history (Pa) from rest, (n,); not finite without a strain."""
    given, integrated = _given(law, row, stress, STRESS)
    if not integrated:
        history = np.empty((2, 1, stress.size))
        groups.balance(*given, NO_SWITCHES, history)
        return np.asarray(history[0, 0])
    loop.integrate(*given, NO_SWITCHES)
    strain = given[-1][0, 1]
    return np.asarray(strain if given[1][OUTCOME] == DONE else np.full_like(strain, np.nan))


def slope_along(law: Law, row: Array, strain: Array) -> Array:
    """Return slopes dσ/dε (Pa) along a strain history, (n,), each on the branch of its sample."""
    given, integrated = _given(law, row, strain, MOTION)
    if not integrated:
        samples = np.empty((strain.size, 4))
        along.follow(*given, NO_SWITCHES, samples)
        return samples[:, 3]
    # Differences over the last thousandth of the way to each sample; a sample without a way has the
    # slope of the one before it.
    moves = np.diff(strain, prepend=math.nan) != 0.0
    moved = strain[moves]
    step = 1e-3 * np.diff(moved, prepend=0.0)
    step[step == 0.0] = 1e-9  # the first
    ways = (moved[:, None] - step[:, None] * np.array((2.0, 1.0, 0.0))).ravel()
    stress = stress_along(law, row, ways)[0].reshape(-1, 3)
    found = (stress[:, 0] - 4.0 * stress[:, 1] + 3.0 * stress[:, 2]) / (2.0 * step)
    return np.asarray(found[np.cumsum(moves) - 1])


# ---------------------------------------------------------------- scenes in closed form


def add_dashpot(
    out: Array, time: Array, strain: Array, eta: float, height: float, own: list[int],
    samples: Array,
) -> None:  # fmt: skip
    """Add the stress of the dashpot of one spring, and its derivatives in directions `own`."""
    if time.size == 1 or not (eta > 0.0 or OWN_ETA in own):
        return
    rate = np.gradient(strain, time)
    out[0, 0] += eta * rate
    for p, what in enumerate(own):
        if what == OWN_ETA:
            out[1 + p, 0] += rate
        elif what == OWN_HEIGHT:
            out[1 + p, 0] -= eta * rate / height
        elif what == MOVED:
            shift = samples[:, 0] + samples[:, 1] * strain
            out[1 + p, 0] += eta / height * np.gradient(shift, time)


def switches(time: Array, strain: Array, branches: Array) -> Array:
    """Return the changes of branch between samples, at the later sample; (springs, n) are given."""
    at, spring = np.nonzero(np.diff(branches, axis=1).T)
    left, entered = branches[spring, at], branches[spring, at + 1]
    return np.column_stack([time[at + 1], spring, left, entered, strain[spring, at + 1]])
