"""Predict a test that was not fitted, with its 95 % band."""

from __future__ import annotations

import math
from dataclasses import replace
from numbers import Integral
from pathlib import Path

import numpy as np

from foamfit.arrays import Array, single_threaded
from foamfit.data.csv_file import read_test
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.data.noise import with_noise
from foamfit.data.rate import loading_rate
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.curves import check_drive, check_time_shift, choose_drive, driving_motion
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.search import Tracker, descend
from foamfit.report import render
from foamfit.report.studies.prediction import (
    COLOURS,
    PredictedCurve,
    PredictedParameter,
    Prediction,
)
from foamfit.springs.parameters import unit_of
from foamfit.study.identified import NORMAL, HasContent, Population, Source, read_source
from foamfit.text import engineering

# Draws of specimens: by default, and at least, as fewer do not resolve the ends of a 95 % band.
DRAWS, FEWEST = 400, 40
# Factor by which the rate of a test may lie outside the fitted rates.
RATE_FACTOR = 1.25
# Most draws that are tried for each one wanted.
TRIES = 5
BAND = (0.025, 0.975)
# So many tests are not said to be few; fewer suffice where fewer parameters change.
FEW_TESTS = 5
ALIGNING = 40  # steps of the fit of what a record does not say exactly


@single_threaded
def predict(
    result: HasContent | str | Path,
    test: Measurement | str | Path,
    *,
    drive: str | None = None,
    extrapolate: bool = False,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """Predict a test that was not fitted, as a `Prediction`.

    Height, area, mass and velocity are those of the test, and so is the rate at which laws of rate
    are evaluated. What its record does not say exactly, such as the contact time and zeros of an
    impact, is fitted to it (`Prediction.aligned`). The 95 % band has these parts: what the
    result leaves uncertain of the parameters, to first order; their scatter between specimens (of a
    joint result), drawn and simulated; the noise of the test and that of a motion that drives; and
    what the law has missed of the fitted tests beyond their noise, which grows with each cycle
    after the last of a fitted history (`foamfit.trust.best_point.cycle_growth`).

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result of `fit` or `joint`, its folder, or its fit.json or joint.json; the file gives the
        same numbers.
    test : Measurement, str or Path
        The test, or its file with its TOML beside it.
    drive : str, optional
        "impact", "stress" or "displacement"; by default that of the result.
    extrapolate : bool
        Whether the rate of the test may lie outside the fitted rates by more than `RATE_FACTOR`.
    draws, seed : int
        Draws of specimens; same seed, same numbers.

    Raises
    ------
    InputError
        If the result or the test cannot be read, the test cannot feed the drive, or its rate lies
        outside the fitted ones.
    SimulationError
        If the test cannot be simulated with the common values, or with too few of the draws.
    """
    for name, value, least in (("draws", draws, FEWEST), ("seed", seed, 0)):
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise InputError(f"{name} = {value!r} must be a whole number, at least {least}")
    source = read_source(result)
    measurement = test if isinstance(test, Measurement) else read_test(test)
    rate = loading_rate(with_noise(measurement))
    outside = _outside(source, rate)
    if outside and not extrapolate:
        raise InputError(
            f"{measurement.name}: {outside}; --extrapolate (extrapolate=True) predicts it all the "
            "same, with a warning"
        )
    problem = _problem(source, measurement, drive)
    objective = problem.objective
    limits = {name: (one.min, one.max) for name, one in problem.params.items()}
    population = Population(source, problem.measurement.specimen, rate, limits)
    springs, aligning = _point(population, problem), _before(problem, source)
    try:
        point, aligned = _aligned(aligning, springs, population.scattering)
        simulated = objective.simulate(point, everything=True)
    except SimulationError as error:
        raise SimulationError(
            f"{measurement.name} cannot be predicted from {source.where}: {error}"
        ) from None
    values, drawn, redrawn = list[Array](), list[dict[str, Array]](), 0
    if population.scattering:
        values, drawn, redrawn = _draw(population, problem, point, draws, seed)
    known = {"parameters": _by_parameters(population, aligning, point, tuple(aligned))}
    known |= {"motion": _by_motion(problem, point)}
    curves = dict[str, PredictedCurve]()
    for name in objective.counted:
        parts = {part: sides[name] for part, sides in known.items() if name in sides}
        curves[name] = _curve(problem, name, simulated.curves[name], drawn, source, parts)
    changing, count = population.scattering, population.fewest if population.scattering else 0
    warnings = render.sentences(
        "predicted_warnings",
        source=source,
        test=measurement.name,
        rate=rate,
        outside=outside,
        drive=objective.drive,
        nearest=not np.array_equal(springs, population.point),
        few=count if changing and count < max(3, min(len(changing), FEW_TESTS)) else None,
        scattering=changing,
        held=population.held,
        untold=[one.channel for one in curves.values() if one.channel not in source.misses],
        drawn=len(values) if changing else draws,
        draws=draws,
    )
    sentences = render.sentences(
        "predicted_sentences",
        curves=curves.values(),
        scattering=changing,
        trends=population.trends,
        aligned=[
            f"{name.replace('_', ' ')} {engineering(value, unit_of(name)).replace('-', '−')}"
            for name, value in aligned.items()
        ],
    )
    return Prediction(
        source=source.name,
        joint=source.joint,
        measurement=problem.measurement,
        model=source.model.name,
        relaxation=source.model.relaxation,
        drive=objective.drive,
        seed=int(seed),
        curves=curves,
        misfit=objective.misfit(simulated),
        parameters=_parameters(population, springs, values),
        rate=rate,
        fitted_rates=source.rates,
        extrapolated=bool(outside),
        draws=len(values),
        redrawn=redrawn,
        held=population.held,
        sentences=sentences,
        warnings=warnings,
        aligned=aligned,
    )


def _outside(source: Source, rate: float | None) -> str | None:
    """Say how the rate of a test lies outside the fitted ones; None if it does not."""
    if rate is None or not source.rates:
        return None
    low, high = min(source.rates), max(source.rates)
    if low / RATE_FACTOR <= rate <= high * RATE_FACTOR:
        return None
    fitted = f"{low:.3g} 1/s" if low == high else f"{low:.3g} to {high:.3g} 1/s"
    return (
        f"its rate, {rate:.3g} 1/s, lies outside the fitted rates, {fitted}, by more than a factor "
        f"of {RATE_FACTOR}"
    )


def _problem(source: Source, measurement: Measurement, drive: str | None) -> Problem:
    """The scene of the test under the law of the result."""
    chosen = drive or source.drive or choose_drive(measurement)
    try:
        check_drive(measurement, chosen)
    except InputError as error:
        if drive is not None:
            raise
        raise InputError(
            f"{error}; {source.name} was fitted in this drive, --drive (drive=) chooses another"
        ) from None
    inside, late = source.interior_mass and chosen == "impact", source.time_shift
    if late:
        try:
            check_time_shift(measurement, chosen)
        except InputError:  # it was that of another record
            late = False
    law, terms = source.model.name, source.model.relaxation
    problem = make_problem(
        measurement, law, chosen, None, None, inside, time_shift=late, relaxation=terms
    )
    objective, same = problem.objective, source.sha256 == measurement.data_sha256
    if not same or source.smoothed is None or chosen != "displacement":
        return problem
    # More or other cycles of the record that was fitted: its motion is what it was then.
    motion = driving_motion(objective.measurement, objective.time, always=source.smoothed)
    followed = (motion if source.smoothed else None,)
    return replace(problem, objective=replace(objective, followed=followed))


def _before(problem: Problem, source: Source) -> Problem:
    """The problem without the cycles that come after the last fitted one, if others are left."""
    objective, test, last = problem.objective, problem.measurement, source.last_cycle
    ends = [part.stop for number, part in cycles_of(test).items() if last and number <= last]
    if not ends or ends[-1] == objective.time.size:
        return problem
    before = np.arange(objective.time.size) < ends[-1]
    channels = map(objective.channel, objective.counted)
    sampled = {one: before & test.sampled.get(one, True) for one in channels}
    test = replace(test, sampled=test.sampled | sampled)
    followed = (objective.motion,)
    return replace(problem, objective=replace(objective, measurement=test, followed=followed))


def _point(population: Population, problem: Problem) -> Array:
    """The common values; where they are not admissible together, those of the nearest test."""
    for values in population.candidates():
        own = values[: len(problem.model.names)]
        heights = problem.model.heights(own, problem.measurement.specimen.height)
        known = np.all(np.isfinite(values)) and np.all(heights > 0.0) and own[-1] >= 0.0
        if known and problem.model.rows(own) is not None:
            return values
    raise SimulationError(
        f"{population.source.where}: its common values are no admissible spring, nor are those of "
        "a test; give the result of a fit as foamfit wrote it"
    )


def _aligned(
    problem: Problem, springs: Array, scattering: tuple[str, ...]
) -> tuple[Array, dict[str, float]]:
    """The springs and what of the record fits them best, and that in the numbers of its file."""
    # Parameters that change from specimen to specimen are fitted with it and then given up: held,
    # a stiffer specimen would be taken for one that is touched earlier.
    params = problem.params.copy()
    for name, value in zip(problem.model.names, springs.tolist(), strict=True):
        one = params[name]
        free = name in scattering and one.vary and not name.endswith("_height")
        if free and one.min < value < one.max:
            one.set(value=value)
        else:
            one.set(value=value, vary=False, expr="", min=-math.inf, max=math.inf)
    held = replace(problem, params=params)
    point = held.vector()
    names = [name for name in held.free() if name in problem.objective.nuisance]
    if not names:
        return point, {}
    problem.objective.simulate(point)
    space, tracker = held.space(), Tracker(problem.objective)
    descend(tracker, space, space.encode(point), ALIGNING)
    assert tracker.best_values is not None  # the first point can be simulated
    point = np.append(springs, tracker.best_values[springs.size :])
    told = dict(zip(problem.names, (point + problem.origins).tolist(), strict=True))
    return point, {name: told[name] for name in names}


def _draw(
    population: Population, problem: Problem, point: Array, draws: int, seed: int
) -> tuple[list[Array], list[dict[str, Array]], int]:
    """Draw and simulate: parameters, curves, and how many more were drawn as not admissible."""
    # What lies beyond the limits of a fit of the test is moved there, as a fit does: to draw it
    # again would leave one side of all other parameters out.
    objective, specimens, tried = problem.objective, population.draws(seed), 0
    values, curves = list[Array](), list[dict[str, Array]]()
    limits = _limits(population, point[: len(population.source.parameters)])
    while len(values) < draws and tried < TRIES * draws:
        tried += 1
        one = np.clip(next(specimens), *limits)
        try:
            simulated = objective.simulate(np.append(one, point[one.size :]))
        except SimulationError:
            continue
        values.append(one)
        curves.append({name: simulated.curves[name] for name in objective.counted})
    if len(values) < FEWEST:
        raise SimulationError(
            f"{population.source.where}: only {len(values)} of {tried} specimens drawn from its "
            "scatter can be simulated; hold or share what it leaves undetermined"
        )
    return values, curves, tried - len(values)


def _by_parameters(
    population: Population, aligning: Problem, point: Array, aligned: tuple[str, ...]
) -> dict[str, Array]:
    """Half of the 95 % band (n,), SI, by what the result leaves uncertain, to first order."""
    objective, covariance = aligning.objective, population.covariance
    own = np.flatnonzero(np.diag(covariance) > 0.0)
    places = np.append(own, [aligning.index[name] for name in aligned]).astype(np.int64)
    slopes = objective.simulate(point, places=places).slopes
    if not own.size or slopes is None:
        return {}
    jacobian, out = objective.jacobian(point, places), dict[str, Array]()
    # What is aligned to the record would follow the parameters.
    follow = np.linalg.lstsq(jacobian[:, own.size :], jacobian[:, : own.size], rcond=None)[0]
    for name in objective.counted:
        moved = slopes[name][: own.size] - follow.T @ slopes[name][own.size :]
        variance = np.einsum("in,ij,jn->n", moved, covariance[np.ix_(own, own)], moved)
        out[name] = population.quantile * np.sqrt(np.maximum(variance, 0.0))
    return out


def _by_motion(problem: Problem, point: Array) -> dict[str, Array]:
    """Half of the 95 % band (n,), SI, by what stays uncertain of a driving motion."""
    objective, out = problem.objective, dict[str, Array]()
    changes, level = objective.by_motion(point), objective.measurement.noise.of("displacement")
    if changes is None or objective.motion is None or level is None:
        return out
    apart = np.linalg.norm(objective.motion.modes(objective.time), axis=1)
    share = np.minimum(1.0, level.sigma / np.maximum(apart, 1e-300))
    samples = np.arange(objective.time.size)
    for name, part in objective.by_curve(np.linalg.norm(changes, axis=1)).items():
        size = np.interp(samples, objective.kept(name), part / objective.factor(name))
        out[name] = NORMAL * share * size
    return out


def _curve(
    problem: Problem,
    name: str,
    predicted: Array,
    drawn: list[dict[str, Array]],
    source: Source,
    known: dict[str, Array],
) -> PredictedCurve:
    """One curve with its band: quantiles of the draws, all other parts added in quadrature."""
    objective = problem.objective
    channel, n = objective.channel(name), predicted.size
    parts = {part: np.zeros(n) for part in COLOURS if part != "motion"} | known
    low = middle = high = predicted
    if drawn:
        ends = np.quantile([curves[name] for curves in drawn], (*BAND, 0.5), axis=0)
        low, high, middle = ends
        both = 0.5 * (high - low)
        parts["scatter"] = np.sqrt(np.maximum(both**2 - parts["parameters"] ** 2, 0.0))
    sigma, span = objective.noise(name).sigma, float(np.ptp(predicted))
    parts["noise"] = np.full(n, NORMAL * sigma)
    missed = source.law_error(channel, sigma / float(np.ptp(objective.measured[name])))
    parts["law_error"] = missed * span * np.sqrt(_grown(problem.measurement, source))
    within = {"scatter", "parameters"} if drawn else {"scatter"}  # of the draws
    more = sum(parts[part] ** 2 for part in parts.keys() - within)
    kept = np.zeros(n, dtype=bool)
    kept[objective.kept(name)] = True
    return PredictedCurve(
        channel=channel,
        unit="m" if channel.startswith("displacement") else "Pa",
        measured=objective.measured[name],
        predicted=predicted,
        lo=middle - np.sqrt((middle - low) ** 2 + more),
        hi=middle + np.sqrt((high - middle) ** 2 + more),
        parts={part: parts[part] for part in COLOURS if part in parts},
        kept=kept,
    )


def _grown(measurement: Measurement, source: Source) -> Array:
    """Mean square of the law's error over that of the fitted cycles, (n,); each later one adds."""
    assert measurement.stress is not None
    grown = np.ones(measurement.stress.size)
    last = source.last_cycle or math.inf
    for number, part in cycles_of(measurement).items():
        grown[part] += source.growth * max(number - last, 0.0)
    return grown


def _parameters(
    population: Population, point: Array, drawn: list[Array]
) -> dict[str, PredictedParameter]:
    """Each parameter at the test and its 95 % interval, within its limits."""
    half = population.quantile * np.sqrt(np.maximum(np.diag(population.covariance), 0.0))
    ends = np.array([point - half, point + half])
    if drawn:
        ends = np.quantile(drawn, BAND, axis=0)
    ends = np.clip(ends, *_limits(population, point))
    rows = zip(population.source.parameters, point.tolist(), *ends.tolist(), strict=True)
    known = population.source.parameters
    return {name: PredictedParameter(known[name].kind, *row) for name, *row in rows}


def _limits(population: Population, point: Array) -> tuple[Array, Array]:
    """Limits of the parameters in a fit of the test, which hold the point."""
    low, high = np.array([population.limits[name] for name in population.source.parameters]).T
    return np.minimum(low, point), np.maximum(high, point)
