"""What a time shift between force and motion, or a dashpot that was left out, would explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.problem import Problem
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint


def shift_hint(best: BestPoint, determined: list[str]) -> float | None:
    """Time by which the motion channel is late (s), where the test plainly shows it, else None.

    In the residuals: one linear step of all determined parameters and the shift together, accepted
    where the shift is more than four standard errors and a quarter of a sample, and takes a fifth
    of χ². Where a large shift has spoilt the fit, in the balance of the striker's motion. The test
    must have both channels in time; see `fitting.curves.check_time_shift`.
    """
    late = _shift_of_residuals(best, determined)
    return _shift_of_motion(best.problem) if late is None else late


def damping_hint(best: BestPoint, determined: list[str]) -> float | None:
    """Damping (Pa·s) of an only spring that was left out under a driven motion, if it is plain."""
    problem, name = best.problem, "s1_eta"
    held = problem.params[name]
    alone = problem.objective.drive == "displacement" and len(problem.model.kinds) == 1
    if not alone or problem.measurement.time is None or held.vary or held.value != 0.0:
        return None
    column = problem.linear.slopes(best.values, (name,))[:, 0]
    size = float(problem.sizes((name,), best.values)[0])
    eta, error, gained = _one_step(best, determined, column, size)
    return eta if gained and eta > 4.0 * error else None


def _shift_of_residuals(best: BestPoint, determined: list[str]) -> float | None:
    """Time by which the motion is late (s), if one linear step plainly finds it."""
    problem, objective, there = best.problem, best.problem.objective, best.simulated
    assert problem.measurement.time is not None
    step = float(np.median(np.diff(problem.measurement.time)))
    sides = [
        objective.compare(replace(there, curves=objective.shifted(there, side * step)), best.values)
        for side in (-0.5, 0.5)
    ]
    late, error, gained = _one_step(best, determined, (sides[1] - sides[0]) / step, step)
    return late if gained and abs(late) > max(4.0 * error, 0.25 * step) else None


def _one_step(
    best: BestPoint, determined: list[str], column: Array, size: float
) -> tuple[float, float, bool]:
    """One linear step of all determined parameters and one that was left out, with its `column`.

    Returned are its value, its standard error, and whether the step takes a fifth of χ².
    """
    problem, residual = best.problem, best.residual
    columns = [best.names.index(name) for name in determined]
    own = best.jacobian[:, columns] if columns else np.empty((residual.size, 0))
    jacobian = np.column_stack([own, column])
    sizes = np.append(problem.sizes(tuple(determined), best.values), size)
    move = np.linalg.lstsq(jacobian * sizes, -residual, rcond=1e-10)[0]
    left = residual + jacobian @ (sizes * move)
    spread = covariance.covariance(jacobian, left, problem.objective.sizes, sizes)
    gained = float(left @ left) < 0.8 * float(residual @ residual)
    return float(move[-1] * size), float(spread.stderr[-1]), gained


def _shift_of_motion(problem: Problem) -> float | None:
    """Time by which the motion is late (s), if the striker's balance of motion plainly shows it.

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
    step = float(np.median(np.diff(time)))
    return float(shifts[best]) if plain and abs(shifts[best]) > step else None
