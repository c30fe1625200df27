"""Whether the clocks of force and motion agree: what a time shift between them would explain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from foamfit.trust import covariance

if TYPE_CHECKING:
    from foamfit.fitting.problem import Problem
    from foamfit.results import ParameterEstimate

Array = NDArray[np.float64]


def shift_hint(
    problem: Problem,
    values: Array,
    residual: Array,
    estimates: Mapping[str, ParameterEstimate],
) -> float | None:
    """Time by which the motion channel is late (s), where the test plainly shows it, else None.

    In the residuals: one linear step of all determined parameters and the shift together, told
    where the shift is more than four standard errors and a quarter of a sample, and takes a fifth
    of χ². Where a large shift has spoilt the fit, in the balance of the striker's motion. The test
    must have both channels in time; see `fitting.objective.check_time_shift`.
    """
    late = _shift_of_residuals(problem, values, residual, estimates)
    return _shift_of_motion(problem) if late is None else late


def _shift_of_residuals(
    problem: Problem,
    values: Array,
    residual: Array,
    estimates: Mapping[str, ParameterEstimate],
) -> float | None:
    """Time by which the motion is late (s), if one linear step plainly finds it."""
    assert problem.measurement.time is not None
    step = float(np.median(np.diff(problem.measurement.time)))
    shifted = replace(problem.objective, time_shift=True, loss="linear")
    sides = [shifted.differences(np.append(values, side * step)) for side in (-0.5, 0.5)]
    names = tuple(name for name, item in estimates.items() if item.stderr is not None)
    plain = problem.linear
    slope = (sides[1] - sides[0]) / step
    jacobian = np.column_stack([plain.slopes(values, names), slope]) if names else slope[:, None]
    sizes = np.append(plain.sizes(names, values), step)
    move = np.linalg.lstsq(jacobian * sizes, -residual, rcond=1e-10)[0]
    left = residual + jacobian @ (sizes * move)
    spread = covariance.covariance(jacobian, left, shifted.sizes, sizes)
    late, error = float(move[-1] * step), float(spread.stderr[-1])
    gained = float(left @ left) < 0.8 * float(residual @ residual)
    return late if gained and abs(late) > max(4.0 * error, 0.25 * step) else None


def _shift_of_motion(problem: Problem) -> float | None:
    """Time by which the motion is late (s), if the striker's balance of motion plainly shows it.

    m w'' = -F: the force, integrated twice, must give the motion, but for its scale and for where
    its zero lies. Told where a shift of a sample or more takes half of what is left, down to the
    noise, or nine tenths.
    """
    test, striker = problem.measurement, problem.measurement.striker
    time, stress, motion = test.time, test.stress, test.displacement
    if problem.objective.drive != "impact" or time is None or stress is None or motion is None:
        return None
    assert striker is not None
    assert striker.velocity is not None
    dt = np.diff(time, prepend=min(time[0], 0.0))
    slowed = np.cumsum(dt * (stress - 0.5 * np.diff(stress, prepend=0.0)))
    braked = np.cumsum(dt * (slowed - 0.5 * np.diff(slowed, prepend=0.0)))
    shifts = np.linspace(-0.1, 0.1, 401) * float(time[-1])
    left = []
    for late in shifts:
        when = time - late
        columns = np.column_stack([np.interp(when, time, braked), np.ones(time.size)])
        free = motion - striker.velocity * when
        left.append(float(np.linalg.lstsq(columns, free, rcond=None)[1].sum()))
    best, none = int(np.argmin(left)), left[shifts.size // 2]
    floor = 4.0 * problem.objective.noise("displacement_time").sigma ** 2 * time.size
    plain = 0 < best < shifts.size - 1 and left[best] < (0.5 if left[best] < floor else 0.1) * none
    step = float(np.median(np.diff(time)))
    return float(shifts[best]) if plain and abs(shifts[best]) > step else None
