"""What a time shift between force and motion, or a dashpot, would explain if it were fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.problem import Problem
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint


def shift_hint(best: BestPoint, determined: Sequence[str]) -> float | None:
    """Time (s) by which the motion channel is late, where the test plainly shows it, else None.

    Read off the residuals by one linear step, accepted above a quarter of a sample; where a large
    shift has spoilt the fit, off the balance of the striker's motion. The test must have both
    channels in time; see `fitting.curves.check_time_shift`.
    """
    objective, there = best.problem.objective, best.simulated
    gap = float(np.median(np.diff(objective.time)))
    early, late = (
        objective.compare(replace(there, curves=objective.shifted(there, side * gap)), best.values)
        for side in (-0.5, 0.5)
    )
    found = _one_step(best, determined, (late - early) / gap, gap)
    if found is not None and abs(found) > 0.25 * gap:
        return found
    return _shift_of_motion(best.problem)


def damping_hint(best: BestPoint, determined: Sequence[str]) -> float | None:
    """Damping (Pa·s) that a single spring lacks under a driven motion, where it is plain."""
    problem, name = best.problem, "s1_eta"
    held = problem.params[name]
    alone = problem.objective.drive == "displacement" and len(problem.model.kinds) == 1
    if not alone or problem.measurement.time is None or held.vary or held.value != 0.0:
        return None
    column = problem.linear.slopes(best.values, (name,))[:, 0]
    size = float(problem.sizes((name,), best.values)[0])
    eta = _one_step(best, determined, column, size)
    return eta if eta is not None and eta > 0.0 else None


def _one_step(
    best: BestPoint, determined: Sequence[str], column: Array, size: float
) -> float | None:
    """Value of a parameter that was left out, by one linear step of it and all determined ones.

    `column` is the slope of the residual by it, `size` its scale. None unless it is more than four
    standard errors and the step takes a fifth of χ².
    """
    problem, residual = best.problem, best.residual
    jacobian = np.column_stack([best.jacobian[:, [*map(best.names.index, determined)]], column])
    sizes = np.append(problem.sizes(tuple(determined), best.values), size)
    move = sizes * np.linalg.lstsq(jacobian * sizes, -residual, rcond=1e-10)[0]
    left = residual + jacobian @ move
    if left @ left >= 0.8 * float(residual @ residual):
        return None
    spread = covariance.covariance(jacobian, left, problem.objective.sizes, sizes)
    return float(move[-1]) if abs(move[-1]) > 4.0 * spread.stderr[-1] else None


def _shift_of_motion(problem: Problem) -> float | None:
    """Time (s) by which the motion is late, where the striker's balance of motion plainly shows it.

    m w'' = -F: the force, integrated twice, gives the motion but for its scale and its zero.
    Accepted where a shift of a sample or more halves what is left, down to the noise, or takes nine
    tenths.
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
    gap = float(np.median(np.diff(time)))
    return float(shifts[best]) if plain and abs(shifts[best]) > gap else None
