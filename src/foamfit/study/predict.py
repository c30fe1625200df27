"""Predict a test that was not fitted, with its 95 % band."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array, single_threaded
from foamfit.data.calibration import contradictions
from foamfit.data.csv_file import read_test
from foamfit.data.cycles import cycles_of, loading_rate
from foamfit.data.measurement import Measurement
from foamfit.data.noise import with_noise
from foamfit.errors import InputError, SimulationError, check_whole
from foamfit.fitting import curves
from foamfit.fitting.nuisance import TIME_SHIFT
from foamfit.fitting.problem import Problem, make_problem
from foamfit.fitting.scenes import channel_of
from foamfit.fitting.search import Tracker, descend
from foamfit.parts import ParameterEstimate
from foamfit.report import render
from foamfit.report.folder import Result
from foamfit.report.prediction import COLOURS, PredictedCurve, Prediction
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.study.identified import NORMAL, Population, Source, read_source
from foamfit.text import ASKED
from foamfit.trust import say

DRAWS = 400  # default number of draws of specimens
FEWEST = 40  # least number of draws: fewer do not resolve the ends of a 95 % band
RATE_FACTOR = 1.25  # by which the rate of a test may lie outside the fitted rates
TRIES = 5  # largest number of attempts per draw
BAND = (0.025, 0.975)
FEW_TESTS = 5  # that give no warning; fewer suffice if fewer parameters scatter
# Least fraction of the samples inside the band that gives no warning. It is below 0.95, as an error
# of a parameter moves many samples together.
LEAST_INSIDE = 0.8
ALIGNING = 40  # iterations of the fit of nuisance parameters


@single_threaded
def predict(
    result: Result | str | Path,
    test: Measurement | str | Path,
    *,
    drive: str | None = None,
    extrapolate: bool = False,
    draws: int = DRAWS,
    seed: int = 0,
) -> Prediction:
    """Predict a test that was not fitted, as a `Prediction`.

    Height, area, mass, velocity and the rate for rate laws are those of the test. Quantities that
    its record does not give exactly, such as the contact time and zeros of an impact, are fitted to
    it (`Prediction.aligned`). The 95 % band consists of the uncertainty of the parameters, to first
    order; their scatter between specimens (for a joint result), drawn and simulated; the noise of
    the test and of a driving motion; and model error, which is the part of the residuals of the
    fitted tests beyond their noise. Model error increases with each cycle after the last fitted one
    (`foamfit.trust.best_point.cycle_growth`).

    Parameters
    ----------
    result : FitResult, JointResult, str or Path
        A result of `fit` or `joint`, its folder, or its fit.json or joint.json; all give the same
        numbers.
    test : Measurement, str or Path
        The test, or its file with the TOML next to it.
    drive : str, optional
        "impact", "stress" or "displacement"; by default the drive of the result.
    extrapolate : bool
        Whether the rate of the test may lie outside the fitted rates by more than `RATE_FACTOR`.
    draws, seed : int
        Number of drawn specimens and seed; the same seed gives the same numbers.

    Raises
    ------
    InputError
        If the result or the test cannot be read, the test lacks the data for the drive, or its rate
        lies outside the fitted rates.
    SimulationError
        If the test cannot be simulated with the common values, or with too many of the draws.
    """
    check_whole("draws", draws, FEWEST)
    check_whole("seed", seed, 0)
    source = read_source(result)
    measurement = test if isinstance(test, Measurement) else read_test(test)
    rate = loading_rate(with_noise(measurement))
    outside = _outside(source, rate)
    if outside and not extrapolate:
        raise InputError(
            f"{measurement.name}: {outside}; --extrapolate (extrapolate=True) predicts it "
            "anyway, with a warning"
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
        why = f"{measurement.name} cannot be predicted from {source.where}: {error}"
        raise SimulationError(why) from None
    values, drawn, redrawn = list[Array](), list[dict[str, Array]](), 0
    if population.scattering:
        values, drawn, redrawn = _draw(population, problem, point, draws, seed)
    by_parameters = _by_parameters(population, aligning, point, tuple(aligned))
    halves = {"parameters": by_parameters, "motion": _by_motion(problem, point)}
    bands = dict[str, PredictedCurve]()
    for name in objective.counted:
        parts = {part: of_curves[name] for part, of_curves in halves.items() if name in of_curves}
        bands[name] = _curve(problem, name, simulated.curves[name], drawn, source, parts)
    found = Prediction(
        source=source.name,
        joint=source.joint,
        measurement=problem.measurement,
        model=source.model.name,
        relaxation=source.model.relaxation,
        drive=objective.drive,
        seed=int(seed),
        curves=bands,
        misfit=objective.misfit(simulated),
        parameters=_parameters(population, springs, values),
        rate=rate,
        fitted_rates=source.rates,
        extrapolated=bool(outside),
        draws=len(values),
        redrawn=redrawn,
        held=population.held,
        aligned=aligned,
    )
    same = source.sha256 == measurement.data_sha256
    later = measurement.last_cycle or measurement.cycle
    enough = max(3, min(len(population.scattering), FEW_TESTS))
    nearest = not np.array_equal(springs, population.point)
    told: dict[str, Any] = {"found": found, "source": source, "population": population}
    told |= {"outside": outside, "doubts": _doubts(problem), "nearest": nearest, "enough": enough}
    told |= {"draws": draws, "again": same and later > 1, "least": LEAST_INSIDE}
    told |= {"nuisance": NUISANCE, "unit_of": unit_of}
    sentences = render.sentences("predicted_sentences", **told)
    warnings = render.sentences("predicted_warnings", **told)
    return replace(found, sentences=sentences, warnings=warnings)


def _outside(source: Source, rate: float | None) -> str | None:
    """Return a clause if the rate of a test lies outside the fitted rates, else None."""
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


def _doubts(problem: Problem) -> list[str]:
    """Return what the record of the test contradicts or leaves open, as `foamfit check` does."""
    test, drive = problem.measurement, problem.objective.drive
    every = contradictions(test) if drive == "impact" else ()
    found = [one for one in every if one.quantity != TIME_SHIFT]  # which is fitted, or unknown
    notes = [note for note in test.notes if note.startswith(ASKED)]
    return [*(say("contradiction", "said", one=one, drive=drive) for one in found), *notes]


def _problem(source: Source, measurement: Measurement, drive: str | None) -> Problem:
    """Return the problem of the test with the law of the result."""
    chosen = drive or source.drive or curves.choose_drive(measurement)
    try:
        curves.check_drive(measurement, chosen)
    except InputError as error:
        if drive is not None:
            raise
        raise InputError(
            f"{error}; {source.name} was fitted with this drive, choose another by --drive (drive=)"
        ) from None
    inside, shift = source.interior_mass and chosen == "impact", False
    with suppress(InputError):  # if this record cannot have the time shift of the fitted one
        curves.check_time_shift(measurement, chosen)
        shift = source.time_shift
    more: Any = {"time_shift": shift, "relaxation": source.model.relaxation}
    problem = make_problem(measurement, source.model.name, chosen, None, None, inside, **more)
    objective, same = problem.objective, source.sha256 == measurement.data_sha256
    if not same or source.smoothed is None or chosen != "displacement":
        return problem
    if curves.is_exact(objective.measurement):
        return problem  # nothing is smoothed, but turns between samples are found
    # The fitted record, possibly with other cycles: smooth the motion only if the fit did.
    motion = curves.driving_motion(objective.measurement, objective.time, always=source.smoothed)
    followed = (motion if source.smoothed else None,)
    return replace(problem, objective=replace(objective, followed=followed))


def _before(problem: Problem, source: Source) -> Problem:
    """Return the problem without samples after the last fitted cycle, if any are left."""
    objective, test, last = problem.objective, problem.measurement, source.last_cycle
    ends = [part.stop for number, part in cycles_of(test).items() if last and number <= last]
    if not ends or ends[-1] == objective.time.size:
        return problem
    before = np.arange(objective.time.size) < ends[-1]
    channels = map(channel_of, objective.counted)
    sampled = {channel: before & test.sampled.get(channel, True) for channel in channels}
    test = replace(test, sampled=test.sampled | sampled)
    followed = (objective.scenes.motion,)
    return replace(problem, objective=replace(objective, measurement=test, followed=followed))


def _point(population: Population, problem: Problem) -> Array:
    """Return the common values, or if these are inadmissible the values of the nearest test."""
    for values in population.candidates():
        own = values[: len(problem.model.names)]
        heights = problem.model.heights(own, problem.measurement.specimen.height)
        valid = np.all(np.isfinite(values)) and np.all(heights > 0.0) and own[-1] >= 0.0
        if valid and problem.model.rows(own) is not None:
            return values
    raise SimulationError(
        f"{population.source.where}: neither its common values nor those of any test are an "
        "admissible spring; give the result of a fit as foamfit wrote it"
    )


def _aligned(
    problem: Problem, springs: Array, scattering: tuple[str, ...]
) -> tuple[Array, dict[str, float]]:
    """Return all parameters, and the fitted nuisance parameters with the zeros of the file."""
    # Scattering parameters are fitted too and then discarded: if they were fixed, a stiffer
    # specimen would be mistaken for an earlier contact.
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
    values = dict(zip(problem.names, (point + problem.origins).tolist(), strict=True))
    return point, {name: values[name] for name in names}


def _draw(
    population: Population, problem: Problem, point: Array, draws: int, seed: int
) -> tuple[list[Array], list[dict[str, Array]], int]:
    """Return parameters and curves of drawn specimens, and the number of draws that failed."""
    # Parameters outside the limits of a fit are clipped, as in a fit. Drawing them again would
    # distort the distribution of the other parameters.
    objective, specimens, tried = problem.objective, population.draws(seed), 0
    values, drawn = list[Array](), list[dict[str, Array]]()
    limits = _limits(population, point[: len(population.source.parameters)])
    while len(values) < draws and tried < TRIES * draws:
        tried += 1
        one = np.clip(next(specimens), *limits)
        try:
            simulated = objective.simulate(np.append(one, point[one.size :]))
        except SimulationError:
            continue
        values.append(one)
        drawn.append({name: simulated.curves[name] for name in objective.counted})
    if len(values) < FEWEST:
        raise SimulationError(
            f"{population.source.where}: only {len(values)} of {tried} specimens drawn from its "
            "scatter can be simulated; fix or share the parameters that are not determined"
        )
    return values, drawn, tried - len(values)


def _by_parameters(
    population: Population, aligning: Problem, point: Array, aligned: tuple[str, ...]
) -> dict[str, Array]:
    """Return half the 95 % band (n,) due to the uncertainty of the result, to first order, SI."""
    objective, covariance = aligning.objective, population.covariance
    own = np.flatnonzero(np.diag(covariance) > 0.0)
    places = np.append(own, [aligning.index[name] for name in aligned]).astype(np.int64)
    slopes = objective.simulate(point, places=places).slopes
    if not own.size:
        return {}
    jacobian, out = objective.jacobian(point, places), dict[str, Array]()
    # With other parameters, the aligned nuisance parameters would change as well.
    follow = np.linalg.lstsq(jacobian[:, own.size :], jacobian[:, : own.size], rcond=None)[0]
    for name in objective.counted:
        moved = slopes[name][: own.size] - follow.T @ slopes[name][own.size :]
        variance = np.einsum("in,ij,jn->n", moved, covariance[np.ix_(own, own)], moved)
        out[name] = population.quantile * np.sqrt(np.maximum(variance, 0.0))
    return out


def _by_motion(problem: Problem, point: Array) -> dict[str, Array]:
    """Return half the 95 % band (n,) due to the uncertainty of a driving motion or stress, SI."""
    objective, out = problem.objective, dict[str, Array]()
    channel = "stress" if objective.drive == "stress" else "displacement"
    changes, level = objective.by_motion(point), objective.measurement.noise.of(channel)
    smooth = objective.scenes.smooth
    if changes is None or smooth is None or level is None:
        return out
    size = np.linalg.norm(smooth.modes(objective.time), axis=1)
    share = np.minimum(1.0, level.sigma / np.maximum(size, 1e-300))
    samples = np.arange(objective.time.size)
    for name, part in objective.by_curve(np.linalg.norm(changes, axis=1)).items():
        sigma = np.interp(samples, objective.kept[name], part / objective.factor(name))
        out[name] = NORMAL * share * sigma
    return out


def _curve(
    problem: Problem,
    name: str,
    predicted: Array,
    drawn: list[dict[str, Array]],
    source: Source,
    halves: dict[str, Array],  # of the parts "parameters" and "motion", if known
) -> PredictedCurve:
    """Return one curve with its band: quantiles of the draws, and other parts in quadrature."""
    objective = problem.objective
    channel, n = channel_of(name), predicted.size
    parts = {part: np.zeros(n) for part in COLOURS if part != "motion"} | halves
    low = middle = high = predicted
    if drawn:
        low, high, middle = np.quantile([c[name] for c in drawn], (*BAND, 0.5), axis=0)
        both = 0.5 * (high - low)
        parts["scatter"] = np.sqrt(np.maximum(both**2 - parts["parameters"] ** 2, 0.0))
    sigma, span = objective.noise(name).sigma, float(np.ptp(predicted))
    parts["noise"] = np.full(n, NORMAL * sigma)
    law_error = span * source.law_errors.get(channel, 0.0)
    parts["law_error"] = law_error * np.sqrt(_growth(problem.measurement, source))
    contained = {"scatter", "parameters"} if drawn else {"scatter"}  # in the draws
    more = sum(half**2 for part, half in parts.items() if part not in contained)
    kept = np.zeros(n, dtype=bool)
    kept[objective.kept[name]] = True
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


def _growth(measurement: Measurement, source: Source) -> Array:
    """Return the mean square of the model error over its value in the fitted cycles, (n,)."""
    growth = np.ones(measurement.stress.size)
    last = source.last_cycle or math.inf
    for number, part in cycles_of(measurement).items():
        growth[part] += source.growth * max(number - last, 0.0)
    return growth


def _parameters(
    population: Population, point: Array, drawn: list[Array]
) -> dict[str, ParameterEstimate]:
    """Return each parameter at the test with its 95 % interval, within its limits."""
    half = population.quantile * np.sqrt(np.maximum(np.diag(population.covariance), 0.0))
    ends = np.quantile(drawn, BAND, axis=0) if drawn else np.array([point - half, point + half])
    ends = np.clip(ends, *_limits(population, point))
    rows = zip(population.source.parameters.items(), point.tolist(), *ends.tolist(), strict=True)
    out = dict[str, ParameterEstimate]()
    for (name, one), value, low, high in rows:
        known: Any = {"unit": unit_of(name), "vary": one.kind != "fixed", "kind": one.kind}
        out[name] = ParameterEstimate(value, None, (low, high), systematic=None, **known)
    return out


def _limits(population: Population, point: Array) -> tuple[Array, Array]:
    """Return the limits of the parameters in a fit of the test, widened to contain the point."""
    low, high = np.array([population.limits[name] for name in population.source.parameters]).T
    return np.minimum(low, point), np.maximum(high, point)
