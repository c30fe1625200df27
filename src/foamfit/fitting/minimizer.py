"""A fit as lmfit's objects: its residual as a Minimizer, its numbers as a MinimizerResult.

`lmfit.fit_report`, `lmfit.conf_interval` and `lmfit.conf_interval2d` take them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import lmfit
import numpy as np
from lmfit.minimizer import MinimizerResult

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.fitting.problem import Problem, make_problem
from foamfit.results import Fit

METHOD = "foamfit, multi-start Levenberg-Marquardt"
SAME = 1e-6  # largest relative difference between the χ² of a result and that of its own residual
INSIDE = 1e-3  # distance of a value from its limit, in standard errors


def problem_of(fit: Fit) -> Problem:
    """Return the problem of a result, rebuilt if the result was read from its folder.

    Raises InputError if the folder does not say how the residual was weighted.
    """
    if fit.problem is not None:
        made: Problem = fit.problem
        return made
    made = make_problem(
        fit.measurement, fit.model, fit.drive, fit.params, fit.weights, fit.interior_mass,
        time_shift="time_shift" in fit.params, relaxation=fit.relaxation, priors=fit.priors,
    )  # fmt: skip
    smoothed = (one.get("motion_smoothed", True) for one in fit.noise.values())
    if fit.drive == "displacement" and not all(smoothed):
        made = replace(made, objective=replace(made.objective, followed=(None,)))
    if fit.weighed_at:
        made.objective.weigh_motion(np.array(fit.weighed_at))
    was = float(fit.statistics["chisqr"] or 0.0)
    for objective in (made.objective, replace(made.objective, erring=True)):
        residual = objective.residual(made.vector())
        if math.isclose(float(residual @ residual), was, rel_tol=SAME, abs_tol=1e-9):
            return replace(made, objective=objective)
    raise InputError(
        f"{fit.measurement.name}: the folder does not say how the samples of this fit were "
        "weighted; fit the test again to use it with lmfit"
    )


def minimizer_of(fit: Fit) -> lmfit.Minimizer:
    """Return the minimizer of a result, for `lmfit.conf_interval`."""
    problem = problem_of(fit)

    def off(params: lmfit.Parameters) -> Array:
        return problem.objective.residual(problem.vector(params) - problem.origins)

    def slopes(params: lmfit.Parameters) -> Array:
        names = tuple(name for name, one in params.items() if one.vary)
        return problem.slopes(problem.vector(params) - problem.origins, names)

    return lmfit.Minimizer(off, lmfit_params(fit), Dfun=slopes, nan_policy="raise")


def lmfit_params(fit: Fit) -> lmfit.Parameters:
    """Return the parameters of a result; those without a standard error are held.

    At a limit lmfit's transformation of the parameter has no slope, and its descents stand still:
    such a value is moved inside by a small part of its standard error.
    """
    params = fit.params.copy()
    for name, one in fit.params.items():
        params[name].correl, params[name].init_value = one.correl, None
        if one.vary and one.stderr is None:
            params[name].vary = False
        elif one.vary:
            room = min(INSIDE * one.stderr, 0.5 * (one.max - one.min))
            params[name].value = min(max(one.value, one.min + room), one.max - room)
            params[name].stderr = one.stderr
    return params


def result_of(fit: Fit) -> MinimizerResult:
    """Return the numbers of a result as those of lmfit."""
    params, numbers, found = lmfit_params(fit), fit.statistics, fit.correlation
    names = [name for name, one in params.items() if one.vary]
    sizes = np.array([params[name].stderr for name in names], dtype=float)
    places = [found.names.index(name) for name in names] if found else []
    matrix = found.matrix[np.ix_(places, places)] if found else np.empty((0, 0))
    out = MinimizerResult(
        params=params,
        var_names=names,
        covar=matrix * np.outer(sizes, sizes),
        errorbars=bool(names),
        method=METHOD,
        ndata=numbers["n_data"],
        nvarys=numbers["n_vary"],
        nfree=int(numbers["n_data"] or 0) - int(numbers["n_vary"] or 0),
        **{name: numbers[name] for name in ("chisqr", "redchi", "aic", "bic", "nfev")},
        success=fit.stopped is None,
        aborted=fit.stopped is not None,
        message="; ".join(fit.warnings) or "Fit succeeded.",
        init_vals=[],
        init_values={},
    )
    if (problem := fit.problem) is not None:
        out.residual = problem.objective.residual(problem.vector(fit.params) - problem.origins)
    return out
