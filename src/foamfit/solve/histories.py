"""Stress and strain of one spring along a history, without its dashpot and relaxation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.solve import cache, explicit, links, runs
from foamfit.solve.scene import MOTION, STRESS
from foamfit.springs.compiled import compiled
from foamfit.springs.compiled.contract import INTERNAL, RESULTS, results_of
from foamfit.springs.spring import Spring

_ONE, _NO_SYSTEMS = np.ones(1), np.zeros(4, np.int64)
_END = np.array([1])
TOL = 1e-12  # of a law with internal variables
_NONE = np.empty((0, 2), np.int64)


def _packed(spring: Spring, history: Array, top: int) -> tuple[list[Any], Any]:
    """Return the arguments of a run along a history, and the compiled law."""
    law = compiled(spring.law)
    row = spring.row.copy()
    row[0] = 0.0  # no dashpot
    place, results = RESULTS, results_of(law.derivatives, law.internal)
    at = place + results
    sizes = 1, 1, 0, 0, top, 1, place, at, at + law.columns, links.RATES
    sizes += links.CHANGE, explicit.EXPLICIT_STEP, 0
    floats, integers = runs.room(sizes, law.internal)
    time, out = np.arange(history.size, dtype=float), np.empty((1, 2, history.size))
    packed = [
        np.array(sizes), np.array([(*law.addresses, law.kind, law.derivatives, law.internal)]),
        _END, _NONE, row[None, :], _ONE, _ONE, np.array((0.0, 0.0, TOL, 1e9, 0.0, 0.0)), history, time,
        out, np.empty(integers, np.int64), np.empty(floats),
    ]  # fmt: skip
    return packed, law


def stress_along(spring: Spring, strain: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return stresses (Pa) and numbers of branches along a strain history from rest, (n,)."""
    packed, law = _packed(spring, strain, MOTION)
    cache.announce(runs.follow, "the laws of springs")
    branches = np.empty(strain.size, np.int64)
    if law.kind == INTERNAL:
        return _integrated(packed, branches)
    follow = packed[:11], (branches, np.empty(strain.size)), packed[11:]
    runs.follow(*follow[0], *follow[1], *follow[2], np.zeros((strain.size, 2)))
    return packed[10][0, 0], branches


def _integrated(packed: list[Any], branches: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return the same for a law with internal variables, whose branches a log tells."""
    values, time, out = packed[8:11]
    log, endings = np.empty((4 * values.size + 64, 5)), np.zeros(runs.ENDINGS)
    rate, most = np.abs(np.diff(values)).max(initial=0.0), np.abs(values).max()
    runs.integrate(*packed[:11], log, *packed[11:], np.array((most, rate, most, 0.0)), endings, _NO_SYSTEMS)
    branches[:] = 0
    for at, _, _, entered, _ in log[: int(endings[runs.SWITCHES])].tolist():
        branches[int(np.searchsorted(time, at, "right")) :] = int(entered)
    if endings[runs.OUTCOME]:
        out[0, 0, int(np.searchsorted(time, endings[runs.ENDED])) :] = np.inf
    return out[0, 0], branches


def strain_along(spring: Spring, stress: Array) -> Array:
    """Return strains along a stress history (Pa) from rest, (n,); not finite without a strain."""
    packed, law = _packed(spring, stress, STRESS)
    if law.kind == INTERNAL:
        return _strain_of_internal(packed)
    strain, branches, endings = np.empty((1, stress.size)), np.empty((1, stress.size), int), np.zeros(runs.ENDINGS)
    runs.balance(*packed[:11], branches, *packed[11:], strain, endings)
    return np.asarray(strain[0])


def _strain_of_internal(packed: list[Any]) -> Array:
    """Return strains of a law with internal variables."""
    stress, _, out = packed[8:11]
    log, endings = np.empty((0, 5)), np.zeros(runs.ENDINGS)
    scales = np.array((1e-3, 0.0, 1e-3, np.abs(stress).max()))
    runs.integrate(*packed[:11], log, *packed[11:], scales, endings, _NO_SYSTEMS)
    if endings[runs.OUTCOME]:
        out[0, 1, :] = np.nan
    return np.asarray(out[0, 1])


def slope_along(spring: Spring, strain: Array) -> Array:
    """Return slopes dσ/dε (Pa) along a strain history, (n,), each on the branch of its sample."""
    packed, law = _packed(spring, strain, MOTION)
    slopes, branches = np.empty(strain.size), np.empty(strain.size, np.int64)
    if law.kind != INTERNAL:
        runs.follow(*packed[:11], branches, slopes, *packed[11:], np.zeros((strain.size, 2)))
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
