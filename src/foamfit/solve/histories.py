"""Stress and strain of one spring along a history, without its dashpot and relaxation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.solve import along, cache, loop, static
from foamfit.solve.layout import Shape, lay_out
from foamfit.solve.scene import DONE, MOTION, STRESS
from foamfit.springs.compiled import compiled
from foamfit.springs.compiled.contract import INTERNAL
from foamfit.springs.spring import Spring

_ONE, _NO_LOG = np.ones(1), np.empty((0, 5))
TOL = 1e-12  # of a law with internal variables


def _given(spring: Spring, history: Array, top: int, out: Array) -> tuple[list[Any], bool]:
    """Return the arguments that all runs have in common, and whether they integrate in time.

    Time is the number of the sample; it stands still for the law.
    """
    row, integrated = spring.row.copy(), compiled(spring.law).kind == INTERNAL
    row[0] = 0.0  # no dashpot
    shape = Shape((spring.law,), 0, (1,), top, b"\0", b"", False, 0, not integrated)
    layout = lay_out(shape, integrated)
    most = float(np.abs(history).max())
    scales = (most, np.abs(np.diff(history)).max(initial=0.0), most, 0.0)
    if top == STRESS:
        scales = 1e-3, 0.0, 1e-3, most
    reals = np.array((0.0, 0.0, 0.0 if integrated else TOL, TOL, 1e9, 0.0, 0.0, *scales))
    time = np.arange(history.size, dtype=float)
    memory = layout.words, np.empty_like(layout.words), np.zeros(layout.floats)
    return [*memory, row[None, :], _ONE, _ONE, reals, history, time, out], integrated


def stress_along(spring: Spring, strain: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return stresses (Pa) and numbers of branches along a strain history from rest, (n,)."""
    out, branches = np.empty((1, 2, strain.size)), np.zeros(strain.size, np.int64)
    given, integrated = _given(spring, strain, MOTION, out)
    cache.announce(along.follow, "the laws of springs")
    if not integrated:
        along.follow(*given, _NO_LOG, np.zeros((strain.size, 2)), branches, np.empty(strain.size))
        return out[0, 0], branches
    log, endings = np.empty((4 * strain.size + 64, 5)), np.empty(loop.ENDINGS)
    loop.integrate(*given, log, endings)
    for at, _, _, entered, _ in log[: int(endings[loop.SWITCHES])].tolist():
        branches[int(np.searchsorted(given[8], at, "right")) :] = int(entered)
    if endings[loop.OUTCOME] != DONE:
        out[0, 0, int(np.searchsorted(given[8], endings[loop.ENDED])) :] = np.inf
    return out[0, 0], branches


def strain_along(spring: Spring, stress: Array) -> Array:
    """Return strains along a stress history (Pa) from rest, (n,); not finite without a strain."""
    out = np.empty((1, 2, stress.size))
    given, integrated = _given(spring, stress, STRESS, out)
    if not integrated:
        strain = np.empty((1, stress.size))
        static.balance(*given, _NO_LOG, strain, np.empty((1, stress.size), np.int64))
        return np.asarray(strain[0])
    endings = np.empty(loop.ENDINGS)
    loop.integrate(*given, _NO_LOG, endings)
    if endings[loop.OUTCOME] != DONE:
        out[0, 1, :] = np.nan
    return np.asarray(out[0, 1])


def slope_along(spring: Spring, strain: Array) -> Array:
    """Return slopes dσ/dε (Pa) along a strain history, (n,), each on the branch of its sample."""
    given, integrated = _given(spring, strain, MOTION, np.empty((1, 2, strain.size)))
    if not integrated:
        slopes, branches = np.empty(strain.size), np.empty(strain.size, np.int64)
        along.follow(*given, _NO_LOG, np.zeros((strain.size, 2)), branches, slopes)
        return slopes
    # Differences over the last thousandth of the way to each sample; a sample without a way has the
    # slope of the one before it.
    moves = np.diff(strain, prepend=math.nan) != 0.0
    moved = strain[moves]
    step = 1e-3 * np.diff(moved, prepend=0.0)
    step[step == 0.0] = 1e-9  # the first
    ways = (moved[:, None] - step[:, None] * np.array((2.0, 1.0, 0.0))).ravel()
    stress = stress_along(spring, ways)[0].reshape(-1, 3)
    found = (stress[:, 0] - 4.0 * stress[:, 1] + 3.0 * stress[:, 2]) / (2.0 * step)
    return np.asarray(found[np.cumsum(moves) - 1])
