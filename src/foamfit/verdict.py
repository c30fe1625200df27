"""What to say of the best point: estimates, states, statistics, warnings, and the result itself."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from foamfit import kernels, uncertainty
from foamfit.audit import EnergyAudit, audit
from foamfit.errors import SimulationError
from foamfit.measurement import interior_channel
from foamfit.model import BRANCHES, split_name, unit_of
from foamfit.objective import INTEGRATED, MOTION_CURVES, Objective, Simulated
from foamfit.problem import Problem
from foamfit.result import Correlation, Curves, FitResult, ParameterEstimate, Switch
from foamfit.search import SearchRecord

Array = NDArray[np.float64]

# A curve was not fitted if it is off by more than this share of its own standard deviation; it is
# fitted poorly if it is off by more than this share of its range.
UNACCEPTABLE = 0.5
POOR = 0.05


def conclude(problem: Problem, values: Array, record: SearchRecord) -> FitResult:
    """Assemble the result at the best point."""
    objective, measurement = problem.objective, problem.measurement
    simulated = objective.simulate(values, everything=True)
    residual = objective.residual(values)
    estimates, spread, correlation = _estimate(problem, values, residual)
    misfit = objective.misfit(simulated)
    balance = audit(measurement)
    n_vary = sum(1 for item in estimates.values() if item.vary and item.stderr is not None)
    warnings = _warnings(problem, estimates, misfit, spread, record, balance)
    missed = any(_missed(objective, misfit, name) for name in objective.counted)
    status = "failed" if missed else ("warnings" if warnings else "ok")
    return FitResult(
        measurement=measurement,
        model=problem.model.name,
        drive=objective.drive,
        seed=record.seed,
        status=status,
        warnings=tuple(warnings),
        chain=problem.model.chain(values, measurement.specimen.height, measurement.specimen.area),
        params=problem.params,
        parameters=estimates,
        visited=visited(problem, simulated),
        misfit=misfit,
        weights=objective.weights,
        statistics=_statistics(residual, n_vary, spread, objective, record),
        energy=balance.as_dict() | {"sentences": balance.sentences()},
        runtime_s=time.perf_counter() - record.began,
        curves=Curves(
            time=measurement.time,
            measured_stress=measurement.stress,
            measured_displacement=measurement.displacement,
            stress=simulated.stress_time,
            displacement=simulated.displacement_time,
            stress_along=simulated.stress_strain,
            interior={
                node: (measurement.interior[node], simulated.interior[name])
                for name, node in objective.interior.items()
            },
        ),
        switches=_switches(problem, simulated),
        correlation=correlation,
        notes=_notes(problem, values, simulated),
    )


def _notes(problem: Problem, values: Array, simulated: Simulated) -> tuple[str, ...]:
    """What was left out of the model, and what it would change."""
    objective, specimen = problem.objective, problem.measurement.specimen
    unused = problem.notes + _along_integrated(problem, simulated)
    if len(problem.model.kinds) == 1 and problem.measurement.interior:
        names = ", ".join(map(interior_channel, sorted(problem.measurement.interior)))
        unused += (f"A single spring has no mass inside, so {names} is left out.",)
    if objective.drive == "stress":
        return (
            *unused,
            "The driving stress is smoothed by a parabola over a twenty-fifth of the samples.",
        )
    if len(problem.model.kinds) == 1 or objective.drive != "impact" or objective.interior_mass:
        return unused
    left_out = "The interior masses are left out"
    if specimen.mass is None:
        return (
            *unused,
            f"{left_out}; with [specimen] mass foamfit could say what they would change.",
        )
    heavy = Objective(
        problem.measurement, problem.model, "impact", objective.weights, interior_mass=True
    )
    try:
        other = heavy.simulate(values)
    except SimulationError as error:
        return (*unused, f"{left_out}; with them the simulation ends: {error}.")
    changes = [
        f"{name} by {np.sqrt(np.mean((one - two) ** 2)) / np.ptp(one):.2%}"
        for name, one, two in (
            ("the base stress", simulated.stress_time, other.stress_time),
            ("the displacement", simulated.displacement_time, other.displacement_time),
            *((c.removesuffix("_time"), w, other.curve(c)) for c, w in simulated.interior.items()),
        )
        if one is not None and two is not None
    ]
    return (
        *unused,
        f"{left_out}; the specimen's {specimen.mass * 1e6:.3g} mg between the springs would change "
        f"{' and '.join(changes)} (RMS over range).",
    )


def _along_integrated(problem: Problem, simulated: Simulated) -> tuple[str, ...]:
    """How far the fit is from a motion that was integrated from the force it is fitted to."""
    objective = problem.objective
    names = [name for name in MOTION_CURVES if name not in objective.counted]
    if problem.measurement.motion != INTEGRATED or not names:
        return ()
    off = [
        f"the {name.replace('_', '-')} curve is {share:.1%} of its range off"
        for name in names
        if (share := objective.off(simulated, name)) is not None
    ]
    if not off:
        return ()
    return (
        "The motion was integrated from the force, so it is no second measurement and has no "
        f"misfit; against it {' and '.join(off)}.",
    )


def _estimate(
    problem: Problem, values: Array, residual: Array
) -> tuple[dict[str, ParameterEstimate], uncertainty.Covariance | None, Correlation | None]:
    """Value, uncertainty and state of every parameter; also put into lmfit's parameters."""
    params, objective = problem.params, problem.objective
    lost = unreached(problem, values)
    names = tuple(n for n in problem.model.names if params[n].vary and n not in lost)
    spread = None
    if names:
        sizes = problem.sizes(names, values)
        jacobian = problem.slopes(values, names)
        spread = uncertainty.covariance(jacobian, residual, objective.sizes, sizes)
    out = {}
    for i, name in enumerate(problem.model.names):
        value, parameter = float(values[i]), params[name]
        parameter.stderr = None
        if name in lost and parameter.vary:
            estimate = ParameterEstimate(
                value, None, None, unit_of(name), True, "not determined",
                f"branch {lost[name]} of spring {split_name(name)[0] + 1} was never reached",
            )  # fmt: skip
        elif name not in names:
            why = "held fixed" if parameter.expr is None else f"tied by {parameter.expr}"
            estimate = ParameterEstimate(value, None, None, unit_of(name), False, "fixed", why)
        else:
            assert spread is not None
            estimate = _varied(problem, name, value, spread, names.index(name), sizes)
            parameter.stderr = estimate.stderr
        out[name] = estimate
    return out, spread, None if spread is None else Correlation(names, spread.correlation)


def _varied(
    problem: Problem,
    name: str,
    value: float,
    spread: uncertainty.Covariance,
    column: int,
    sizes: Array,
) -> ParameterEstimate:
    """Estimate of a parameter that was varied and whose branch was reached."""
    low, high = problem.params[name].min, problem.params[name].max
    stderr = float(spread.stderr[column])
    half = uncertainty.half_width(stderr, spread.effective - len(sizes))
    verdict, why = uncertainty.state(value, half, float(sizes[column]), low, high)
    if verdict == "determined" and problem.objective.interior_mass:
        verdict, why = "weak", "the ringing of the interior mass leaves other valleys; " + why
    if verdict == "not determined":
        return ParameterEstimate(value, None, None, unit_of(name), True, verdict, why)
    ci95 = (max(value - half, low), min(value + half, high))
    return ParameterEstimate(value, stderr, ci95, unit_of(name), True, verdict, why)


def _statistics(
    residual: Array,
    n_vary: int,
    spread: uncertainty.Covariance | None,
    objective: Objective,
    record: SearchRecord,
) -> dict[str, float | int | None]:
    """Statistics as lmfit defines them (chi-square, AIC, BIC), and what the search cost."""
    n = residual.size
    chisqr = float(residual @ residual)
    log_likelihood = n * math.log(max(chisqr, 1e-300) / n)
    aic = log_likelihood + 2 * n_vary
    room = n - n_vary - 1
    return {
        "n_data": n,
        "n_effective": None if spread is None else spread.effective,
        "n_vary": n_vary,
        "chisqr": chisqr,
        "redchi": chisqr / max(n - n_vary, 1),
        "aic": aic,
        "aicc": aic + 2 * n_vary * (n_vary + 1) / room if room > 0 else None,
        "bic": log_likelihood + n_vary * math.log(n),
        "nfev": objective.evaluations,
        "n_failed": objective.failures,
        "n_starts": record.starts,
        "n_descents": len(record.costs),
        "n_agreeing": record.agreeing,
    }


def _missed(objective: Objective, misfit: Mapping[str, float | None], name: str) -> bool:
    """Whether a counted curve was not fitted at all."""
    measured = objective.measured[name]
    assert measured is not None
    return (misfit[name] or 0.0) * float(np.ptp(measured)) > UNACCEPTABLE * float(np.std(measured))


def _switches(problem: Problem, simulated: Simulated) -> tuple[Switch, ...]:
    """Place the switches of the fitted response on its curves."""
    measurement, motion = problem.measurement, simulated.motion
    clock = problem.objective.time
    top, stress = motion.displacement[-1], motion.base_stress
    out = []
    for when, spring, left, entered, _ in motion.switches:
        out.append(
            Switch(
                spring=int(spring) + 1,
                source=kernels.BRANCH_NAMES[int(left)],
                target=kernels.BRANCH_NAMES[int(entered)],
                time=None if measurement.time is None else float(when),
                displacement=float(np.interp(when, clock, top)),
                stress=float(np.interp(when, clock, stress)),
            )
        )
    return tuple(out)


def _warnings(
    problem: Problem,
    estimates: Mapping[str, ParameterEstimate],
    misfit: Mapping[str, float | None],
    spread: uncertainty.Covariance | None,
    record: SearchRecord,
    balance: EnergyAudit,
) -> list[str]:
    """List what a reader must know before trusting the numbers, worst first."""
    objective = problem.objective
    out = []
    if record.stopped is not None:
        out.append(
            f"The search was stopped by {record.stopped}; this is the best point until then."
        )
    for name in objective.counted:
        off = misfit[name] or 0.0
        if off > POOR:
            word = "is not acceptable" if _missed(objective, misfit, name) else "is large"
            out.append(f"The misfit of {name} is {off:.1%} of its range, which {word}.")
    for verdict in ("not determined", "weak"):
        names = [name for name, item in estimates.items() if item.state == verdict]
        if names:
            reasons = sorted({estimates[name].why for name in names if verdict != "weak"})
            because = f": {'; '.join(reasons)}" if reasons else ""
            out.append(f"{verdict.capitalize()}: {', '.join(names)}{because}.")
    if objective.failures > 0.5 * max(objective.evaluations, 1):
        out.append(
            f"{objective.failures} of {objective.evaluations} trials could not be simulated; "
            "the bounds may be wrong."
        )
    if record.agreeing == 1 and record.stopped is None:
        out.append("Only one of the descents reached the best point; try more starts.")
    if spread is not None and max(spread.tau) > 5.0:
        out.append(
            "The residuals are structured: they follow each other over "
            f"{max(spread.tau):.0f} samples, and the intervals count that."
        )
    if objective.interior_mass and len(problem.model.kinds) > 1:
        out.append(
            "With interior masses the cost has a valley for every cycle of their ringing: trust no "
            "parameter that other seeds, or the fit without them, do not confirm."
        )
    out.extend(balance.warnings())
    return out


def visited(problem: Problem, simulated: Simulated) -> dict[str, tuple[str, ...]]:
    """Branches that each spring went through, in the order of the first visit."""
    seen = {
        i: ["a" if kind == "bistable" else "line"] for i, kind in enumerate(problem.model.kinds)
    }
    for _, spring, _, entered, _ in simulated.motion.switches:
        name = kernels.BRANCH_NAMES[int(entered)]
        if name not in seen[int(spring)]:
            seen[int(spring)].append(name)
    return {f"s{i + 1}": tuple(names) for i, names in seen.items()}


def unreached(problem: Problem, values: Array) -> dict[str, str]:
    """Parameters whose branch was never reached, and that branch."""
    seen = visited(problem, problem.objective.simulate(values, everything=True))
    out = {}
    for name in problem.model.names:
        spring, short = split_name(name)
        branch = BRANCHES.get(short)
        bistable = branch and problem.model.kinds[spring] == "bistable"
        if branch and bistable and branch not in seen[f"s{spring + 1}"]:
            out[name] = branch
    return out
