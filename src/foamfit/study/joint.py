"""Several tests in one fit: what the study says of each parameter, from files to joint.json."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import lmfit
import numpy as np

from foamfit.arrays import Array, single_threaded
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Measurement
from foamfit.data.rate import loading_rate, rate_error
from foamfit.errors import InputError, SimulationError, naming
from foamfit.fitting.links import KINDS, RATES, Links
from foamfit.fitting.problem import Problem, fix_and_vary, make_params
from foamfit.fitting.search import Tracker, descend
from foamfit.fitting.together import Together
from foamfit.one_model import Options, Progress, identify, weigh_motion
from foamfit.report.folder import try_target
from foamfit.springs.model import Model
from foamfit.study import joint_fit
from foamfit.study.joint_fit import Map, fit_jointly
from foamfit.study.joint_result import (
    FEW_FOLDERS,
    JointResult,
    common_covariance,
    parameters_of,
    with_words,
)
from foamfit.study.processes import begin, workers
from foamfit.study.study_file import AUTO, Study, read_study
from foamfit.text import counted

# Tests that are searched as a fit of their own is; the others start at what these have found.
SEARCHED = 3
# Up to so many tests are fitted in this process: most take less than a tenth of a second each.
FEW = 100
# A test whose reduced χ² is so many times the largest of those is searched as well.
FAR = 2.0
# Steps of a descent from what another test has found.
STEPS = 60
# Starts of the joint fit besides the own fits: what one test has found, for all.
ONE_FOR_ALL = 2
# Rates that differ by less than this share are one.
SAME_RATE = 0.02


@dataclass(frozen=True, eq=False)
class _Test:
    """One test of a study, ready to be fitted."""

    name: str
    file: Path
    problem: Problem
    params: lmfit.Parameters  # Before any fit
    rate: float | None
    rate_error: float = 0.0  # Of its logarithm


@single_threaded
def joint(
    path: str | Path | Study,
    *,
    jobs: int | None = None,
    out: str | Path | None = None,
    seed: int | None = None,
    report: bool = True,
    progress: Progress | None = None,
) -> JointResult:
    """Fit the tests of a study together; returns a `JointResult`.

    Parameters
    ----------
    path : str, Path or Study
        STUDY.toml, or what `read_study` has read of it: tests, model, drive, and what each
        parameter is: "shared", "own", "scatter", "log rate", "power rate" or "auto", or a number
        that it is held at.
    jobs : int, optional
        Processes; by default one for each core. The numbers are the same with any.
    out : str or Path, optional
        Folder to write the result to, as `JointResult.save` does, with or without `report`.
    seed : int, optional
        Of the search; by default that of the study, or 0.
    progress : callable, optional
        Told the fraction done and what is going on.

    Raises
    ------
    InputError
        If the study cannot be used: the message names the file and the key. A single test that
        cannot be read or fitted is in `refused` with its sentence.
    SimulationError
        If no start of the joint fit can be simulated.
    """
    began, tell = time.perf_counter(), progress or (lambda *_: None)
    study = path if isinstance(path, Study) else read_study(path)
    study = study if seed is None else replace(study, seed=seed)
    if out is not None:
        try_target(out)
        if report:
            begin(jobs, len(study.tests), FEW_FOLDERS)
    options = Options(
        drive=study.drive, seed=study.seed, starts=study.starts, relaxation=study.relaxation
    )
    tests, refused = _read(study, options, tell)
    _links(study, tests)  # refuses what cannot be, before anything is fitted
    with workers(jobs, len(tests), FEW) as each:
        tests, alone = _own_fits(study, options, tests, refused, each, tell)
        links, starts = _links(study, tests), alone.starts(ONE_FOR_ALL)
        names, rates = tuple(test.name for test in tests), tuple(test.rate for test in tests)
        # There is no evidence for a law of rate but from several rates, nor for a scatter.
        kinds = [kind for kind in KINDS if kind not in ("scatter", *RATES)]
        kinds += RATES if None not in rates and _several(rates) else ()
        tell(0.5, "together")
        auto = [name for name, kind in study.kinds.items() if kind == AUTO and name in alone.own]
        if auto:
            links = joint_fit.choose_kinds(alone.problems, links, auto, starts, alone.n_eff, kinds)
        fit = fit_jointly(alone.problems, links, starts, each=each)
        tell(0.9, "evidence")
        every = (*fit.found.shared, *fit.found.own)
        asked = [name for name in every if fit.found.links.kind(name) in RATES or name in auto]
        tried = joint_fit.evidence(fit.found, asked, alone.n_eff, kinds, [alone.values])
        result = JointResult(
            study=study,
            tests=names,
            files=tuple(test.file for test in tests),
            rates=rates,
            rate0=_median_rate(rates),
            fit=fit,
            parameters=parameters_of(fit, names),
            covariance=common_covariance(fit),
            evidence=tried[0],
            open_slopes=tried[1],
            alone=alone,
            refused=refused,
            runtime_s=time.perf_counter() - began,
        )
        result = with_words(result)
    tell(1.0, "done")
    if out is not None:
        result.save(out, jobs=jobs, report=report)
    return result


def _read(study: Study, options: Options, tell: Progress) -> tuple[list[_Test], dict[str, str]]:
    """Read all tests; those that cannot be used are refused, each with its sentence."""
    found, refused = list[tuple[str, Path, Measurement]](), dict[str, str]()
    for i, (name, path, specimen) in enumerate(study.tests):
        tell(0.1 * i / len(study.tests), "reading")
        try:
            test = read_test(path, specimen, study.cycle, cycles=study.cycles)
            if test.priors:
                raise InputError(
                    f"{path}: [priors] are those of one test, and a joint fit takes none; leave "
                    "them out of its TOML"
                )
            options.problem(test, study.model)
            found.append((name, path, test))
        except (InputError, SimulationError) as error:
            refused[str(path)] = str(error)
    if len(found) < 2:
        _too_few(study, len(found), refused)
    params = _params(study, [test for _, _, test in found])
    out = list[_Test]()
    for (name, path, test), own in zip(found, params, strict=True):
        problem = options.problem(test, study.model, own)
        rate, doubt = loading_rate(test), rate_error(problem.measurement)
        out.append(_Test(name, path, problem, own, rate, doubt))
    return out, refused


def _too_few(study: Study, count: int, refused: Mapping[str, str]) -> NoReturn:
    told = "; ".join(list(refused.values())[:2])
    raise InputError(
        f"{study.path}: {counted(count, 'test')} of {len(study.tests)} can be used, a joint fit "
        f"needs two: {told}"
    )


def _params(study: Study, tests: Sequence[Measurement]) -> list[lmfit.Parameters]:
    """Parameters of each test; what is named varies where it does so by itself, or else in all."""
    model = Model.parse(study.model, study.relaxation)
    every = [make_params(test, model, study.drive) for test in tests]
    for name in (*study.kinds, *study.held):
        there = [params[name].vary for params in every if name in params]
        if not there:
            told = f"{name} is a parameter of none of these tests; leave it out"
            raise InputError(f"{study.path}: [parameters] {told}")
        fix = {name: study.held[name]} if name in study.held else {}
        for params in every:
            if name in params and (fix or not any(there)):
                with naming(f"{study.path}: [parameters]"):
                    fix_and_vary(params, study.model, fix, () if fix else (name,))
    return every


def _links(study: Study, tests: Sequence[_Test]) -> Links:
    """What each parameter is to the tests, and ln(rate/rate0) where a law of rate needs it."""
    rates = [test.rate for test in tests]
    for name, kind in study.kinds.items():
        where = f'{study.path}: [parameters] {name} = "{kind}"'
        there = [test for test in tests if name in test.problem.free()]
        if kind == "scatter" and len(there) < 2:
            raise InputError(
                f"{where} needs two or more tests in which it varies, and there is "
                f"{counted(len(there), 'test')}"
            )
        if kind not in RATES:
            continue
        if untimed := [test.file for test in there if test.rate is None]:
            raise InputError(
                f"{where} needs the strain rate of every test, and {untimed[0]} has no time"
            )
        if not _several([test.rate for test in there]):
            rate = f"{there[0].rate:.3g} 1/s" if there else "none"
            raise InputError(
                f"{where} needs tests at two or more rates, and all have one ({rate}); make it "
                '"shared" or "own", or add tests'
            )
    middle = _median_rate(rates)
    if middle is None:
        return Links(study.kinds)
    return Links(
        study.kinds,
        np.log([(rate or middle) / middle for rate in rates]),
        rate_errors=np.array([test.rate_error for test in tests]),
    )


def _median_rate(rates: Sequence[float | None]) -> float | None:
    """Rate of the median test of those that have one; of an even number that of the slower one."""
    known = sorted(rate for rate in rates if rate is not None)
    return known[(len(known) - 1) // 2] if known else None


def _several(rates: Sequence[float | None]) -> bool:
    """Whether there are tests at two rates."""
    known = [rate for rate in rates if rate is not None]
    return len(known) > 1 and max(known) > (1.0 + SAME_RATE) * min(known)


def _own_fits(
    study: Study,
    options: Options,
    tests: list[_Test],
    refused: dict[str, str],
    each: Map,
    tell: Progress,
) -> tuple[list[_Test], Together]:
    """Tests that can be fitted, and what a fit of each alone finds.

    A few, spread over the rates, are searched; the others descend from what these have found, and
    are searched too where that does not follow them as well.
    """
    order = sorted(range(len(tests)), key=lambda t: (tests[t].rate or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(SEARCHED, len(order))).astype(int))
    first = [order[place] for place in places]
    found = dict[int, tuple[Array, float]]()

    def do(chosen: Sequence[int], near: tuple[Array, ...], done: float) -> None:
        work = [
            (tests[t].problem.measurement, study.model, tests[t].params, options, near)
            for t in chosen
        ]
        made = each(_own_fit, *zip(*work, strict=True)) if work else ()
        for i, (t, own) in enumerate(zip(chosen, made, strict=True)):
            if isinstance(own, str):
                refused[str(tests[t].file)] = own
            else:
                found[t] = own
            tell(done + 0.2 * (i + 1) / len(chosen), "each test")

    do(first, (), 0.1)
    near = tuple(found[t][0] for t in first if t in found)
    do([t for t in order if t not in first], near, 0.3)
    worst = max((found[t][1] for t in first if t in found), default=math.inf)
    do([t for t in order if t not in first and t in found and found[t][1] > FAR * worst], (), 0.3)
    there = sorted(found)
    if len(there) < 2:
        _too_few(study, len(there), refused)
    vectors = tuple(found[t][0] for t in there)
    for t, own in zip(there, vectors, strict=True):
        objective = tests[t].problem.objective
        objective.weigh_motion(own)
        if objective.drive == "impact" and tests[t].rate is not None:
            # The rate is that of the fitted motion: the fit's errors already include its error.
            moved = objective.simulate(own, everything=True).curves["displacement_time"]
            rate = loading_rate(tests[t].problem.measurement, moved)
            tests[t] = replace(tests[t], rate=rate, rate_error=0.0)
    kept = [tests[t] for t in there]
    return kept, Together.of_own_fits([test.problem for test in kept], vectors)


def _own_fit(
    measurement: Measurement,
    model: str,
    params: lmfit.Parameters,
    options: Options,
    near: tuple[Array, ...],
) -> tuple[Array, float] | str:
    """Fit one test from points nearby, or search: its vector and χ² per sample, or why not."""
    if not near:
        try:
            found = identify(measurement, model, params, options, lambda *_: None)
        except SimulationError as error:
            return str(error)
        return found.best().values, found.tracker.best_cost / found.problem.objective.n_data
    problem = options.problem(measurement, model, params)
    space, tracker = problem.space(), Tracker(problem.objective)
    for start in near:
        descend(tracker, space, space.encode(problem.with_springs(start)), STEPS)
    if tracker.best_values is None:
        return _own_fit(measurement, model, params, options, ())
    weigh_motion(problem, tracker)
    return tracker.best_values, tracker.best_cost / problem.objective.n_data
