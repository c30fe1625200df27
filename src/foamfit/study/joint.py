"""Joint fits of several tests, from a study file to a result."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median_low

import lmfit
import numpy as np
from scipy import stats

from foamfit.arrays import Array, single_threaded
from foamfit.data.csv_file import read_test
from foamfit.data.cycles import loading_rate
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError, naming
from foamfit.fitting.curves import choose_drive
from foamfit.fitting.objective import Spent
from foamfit.fitting.problem import Problem, fix_and_vary, make_params
from foamfit.fitting.search import Tracker, descend
from foamfit.fitting.together import Links, Together, fit_linked
from foamfit.one_model import Options, Progress, identify
from foamfit.options import KINDS, RATES
from foamfit.springs.model import Model
from foamfit.study.joint_fit import Vectors, fit_jointly
from foamfit.study.joint_result import Alternative, JointResult, result_of
from foamfit.study.study_file import AUTO, Study, read_study
from foamfit.text import counted
from foamfit.trust import covariance, settle

SEARCHED = 3  # tests fitted by a full search; the others start at the results of these
# A test is searched as well if its reduced χ² exceeds the largest of those by this factor.
FAR = 2.0
STEPS = 60  # of a descent from the result of another test
ONE_FOR_ALL = 2  # tests whose values are tried as start values of the joint fit for all tests
SAME_RATE = 0.02  # rates with a smaller relative difference count as equal


@dataclass(frozen=True, eq=False)
class _Test:
    """One test of a study, and its fit by itself."""

    name: str
    file: Path
    problem: Problem
    rate: float | None  # 1/s
    values: Array = field(default_factory=lambda: np.empty(0))  # Parameters of the fit, SI
    cost: float = math.nan  # χ² per sample

    def fitted(self, problem: Problem, tracker: Tracker, values: Array) -> _Test:
        """Return it with the result of a search or a descent, whose evaluations do not count."""
        objective = replace(problem.objective, spent=Spent())
        problem, cost = replace(problem, objective=objective), tracker.best_cost / objective.n_data
        return replace(self, problem=problem, values=values, cost=cost)


@single_threaded
def joint(
    path: str | Path | Study, *, seed: int | None = None, progress: Progress = lambda *_: None
) -> JointResult:
    """Fit the tests of a study together; returns a `JointResult`.

    Parameters
    ----------
    path : str, Path or Study
        STUDY.toml, or the result of `read_study`: tests, model, drive, and for each parameter its
        kind ("shared", "own", "scatter", "log rate", "power rate" or "auto") or a fixed value.
    seed : int, optional
        Seed of the search; by default the seed of the study, or 0.
    progress : callable, optional
        Called with the completed fraction and the name of the current step.

    Raises
    ------
    InputError
        If the study cannot be used; the message names the file and the key. A single test that
        cannot be read or fitted is only listed in `refused`, with the error message.
    SimulationError
        If no start of the joint fit can be simulated.
    """
    began, study = time.perf_counter(), path if isinstance(path, Study) else read_study(path)
    study = study if seed is None else replace(study, seed=seed)
    keys = ("drive", "seed", "starts", "relaxation")
    options = Options(**{key: getattr(study, key) for key in keys})
    tests, refused = _read(study, options, progress)
    _links(study, tests)  # rejects invalid kinds before anything is fitted
    tests, alone = _own_fits(study, options, tests, refused, progress)
    links, starts = _links(study, tests), alone.starts(ONE_FOR_ALL)
    rates = [test.rate for test in tests]
    # The evidence is not computed for scatter, nor for rate laws if all rates are equal.
    kinds = ["shared", "own", *(RATES if None not in rates and _several(rates) else ())]
    progress(0.5, "together")
    auto = [name for name, kind in study.kinds.items() if kind == AUTO and name in alone.own]
    if auto:
        links = choose_kinds(alone, links, auto, starts, kinds)
    fit = fit_jointly(alone.problems, links, starts)
    progress(0.9, "evidence")
    every = (*fit.found.shared, *fit.found.own)
    compared = [name for name in every if links.kind(name) in RATES or name in auto]
    tried, slopes = evidence(fit.found, compared, kinds, alone)
    files, took = {test.name: test.file for test in tests}, time.perf_counter() - began
    about = {"evidence": tried, "refused": refused, "runtime_s": took, "rate0": _median_rate(rates)}
    return result_of(study, files, rates, fit, alone, slopes, **about)


def _read(study: Study, options: Options, tell: Progress) -> tuple[list[_Test], dict[str, str]]:
    """Return the tests, and the error messages of those that cannot be used, by file."""
    found, refused = list[tuple[str, Path, Measurement]](), dict[str, str]()
    for i, (name, path, specimen) in enumerate(study.tests):
        tell(0.1 * i / len(study.tests), "reading")
        try:
            test = read_test(path, specimen, study.cycle, cycles=study.cycles)
            if test.priors:
                why = "a joint fit accepts no [priors]; leave them out of the TOML of the test"
                raise InputError(f"{path}: {why}")
            options.problem(test, study.model)
            for _, twin, other in found:
                if other.data_sha256 == test.data_sha256:
                    why = f"its rows are those of {twin.name}; leave one of them out"
                    raise InputError(f"{path}: {why}")
            found.append((name, path, test))
        except (InputError, SimulationError) as error:
            refused[str(path)] = str(error)
    _check_two(study, len(found), refused)
    tests, every = list[_Test](), _params(study, [test for _, _, test in found])
    for (name, path, test), params in zip(found, every, strict=True):
        problem = options.problem(test, study.model, params)
        tests.append(_Test(name, path, problem, loading_rate(test)))
    return tests, refused


def _check_two(study: Study, count: int, refused: Mapping[str, str]) -> None:
    if count < 2:
        raise InputError(
            f"{study.path}: {counted(count, 'test')} of {len(study.tests)} can be used, but a "
            f"joint fit needs two: {'; '.join(list(refused.values())[:2])}"
        )


def _params(study: Study, tests: Sequence[Measurement]) -> list[lmfit.Parameters]:
    """Return the parameters; a named one varies where it does by default, or else in all tests."""
    model = Model.parse(study.model, study.relaxation)
    drives = [study.drive or choose_drive(test, study.kinds) for test in tests]
    every = [make_params(test, model, by) for test, by in zip(tests, drives, strict=True)]
    for name in (*study.kinds, *study.held):
        varies = [params[name].vary for params in every if name in params]
        if not varies:
            why = f"{name} is a parameter of none of these tests; leave it out"
            raise InputError(f"{study.path}: [parameters] {why}")
        fix = {name: study.held[name]} if name in study.held else {}
        for params in every:
            if name in params and (fix or not any(varies)):
                with naming(f"{study.path}: [parameters]"):
                    fix_and_vary(params, study.model, fix, () if fix else (name,))
    return every


def _links(study: Study, tests: Sequence[_Test]) -> Links:
    """Return the links of the parameters; InputError if the tests do not allow a kind."""
    rates = [test.rate for test in tests]
    for name, kind in study.kinds.items():
        where = f'{study.path}: [parameters] {name} = "{kind}"'
        free = [test for test in tests if name in test.problem.free()]
        if kind == "scatter" and len(free) < 2:
            raise InputError(
                f"{where} needs two or more tests in which it varies, but it varies in "
                f"{counted(len(free), 'test')}"
            )
        if kind not in RATES:
            continue
        if untimed := [test.file for test in free if test.rate is None]:
            why = f"{where} needs the strain rate of every test, but {untimed[0]} has no time"
            raise InputError(why)
        if not _several([test.rate for test in free]):
            rate = f"{free[0].rate:.3g} 1/s" if free else "none"
            raise InputError(
                f"{where} needs tests at two or more rates, and all have one ({rate}); make it "
                '"shared" or "own", or add tests'
            )
    if (middle := _median_rate(rates)) is None:
        return Links(study.kinds)
    return Links(study.kinds, np.log([(rate or middle) / middle for rate in rates]))


def _median_rate(rates: Sequence[float | None]) -> float | None:
    known = [rate for rate in rates if rate is not None]
    return median_low(known) if known else None


def _several(rates: Sequence[float | None]) -> bool:
    """Return whether there are at least two different rates."""
    known = [rate for rate in rates if rate is not None]
    return len(known) > 1 and max(known) > (1.0 + SAME_RATE) * min(known)


def _own_fits(
    study: Study, options: Options, tests: list[_Test], refused: dict[str, str], tell: Progress
) -> tuple[list[_Test], Together]:
    """Return the tests that can be fitted, and the results of their separate fits."""
    # A few tests, spread over the rates, are searched; the others descend from their results.
    order = sorted(range(len(tests)), key=lambda t: (tests[t].rate or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(SEARCHED, len(order))).astype(int))
    first = [order[place] for place in places]
    found, near, worst = dict[int, _Test](), list[Array](), math.inf
    for i, t in enumerate([*first, *(t for t in order if t not in first)]):
        if i == len(first) and found:
            near, worst = [x.values for x in found.values()], max(x.cost for x in found.values())
        try:
            found[t] = _own_fit(tests[t], study.model, options, near)
            if found[t].cost > FAR * worst:
                found[t] = _own_fit(tests[t], study.model, options, ())
        except SimulationError as error:
            if t not in found:
                refused[str(tests[t].file)] = str(error)
        tell(0.1 + 0.4 * (i + 1) / len(tests), "each test")
    _check_two(study, len(found), refused)
    kept = [found[t] for t in sorted(found)]
    problems, values = [test.problem for test in kept], [test.values for test in kept]
    return kept, Together.of_own_fits(problems, values)


def _own_fit(test: _Test, model: str, options: Options, near: Sequence[Array]) -> _Test:
    """Fit one test, starting from the points `near` it or else by a search."""
    measurement, params = test.problem.measurement, test.problem.told()
    if not near:
        found = identify(measurement, model, params, options, lambda *_: None)
        return test.fitted(found.problem, found.tracker, found.best().values)
    problem = options.problem(measurement, model, params)
    space, tracker = problem.space(), Tracker(problem.objective)
    for start in near:
        end = descend(tracker, space, space.encode(problem.with_springs(start)), STEPS)[1]
        tracker.ends.append(space.decode(end))
    if tracker.best_values is None:
        return _own_fit(test, model, options, ())
    *_, (problem, _) = settle.steps(problem, tracker, options.vary, params)
    return test.fitted(problem, tracker, tracker.best_values)


def evidence(
    fit: Together, names: Sequence[str], kinds: Sequence[str], alone: Together
) -> tuple[tuple[Alternative, ...], dict[str, float]]:
    """Compare these kinds of each of these parameters; also return each `open_slope` too wide."""
    found, wide = list[Alternative](), dict[str, float]()
    for name in names:
        present = fit.links.kind(name)
        fits, half = _of_kinds(fit, name, kinds, alone)
        wide |= {name: half} if half > covariance.WEAK else {}
        for kind, one in fits.items():
            bic = one.bic(alone.n_eff)
            found.append(Alternative(name, kind, kind == present, bic, one.n_vary, one.cost))
    return tuple(found), wide


def choose_kinds(
    alone: Together, links: Links, names: list[str], starts: Sequence[Vectors], kinds: list[str]
) -> Links:
    """Return links in which these parameters have the kinds of least BIC, at first all shared."""
    best = fit_linked(alone.problems, links.having(**dict.fromkeys(names, "shared")), starts)
    now = None
    while best is not now:
        now = best
        trials = [one for n in names for one in _of_kinds(now, n, kinds, alone)[0].values()]
        best = min([now, *trials], key=lambda fit: fit.bic(alone.n_eff))
    return best.links


def _of_kinds(
    fit: Together, name: str, kinds: Sequence[str], alone: Together
) -> tuple[dict[str, Together], float]:
    """Return fits with each kind of a parameter that the tests allow, and its `open_slope` or 0."""
    present, half, out = fit.links.kind(name), 0.0, dict[str, Together]()
    for kind in sorted({present, *kinds}, key=KINDS.index):
        if kind in RATES and kind != present and half > covariance.WEAK:
            continue
        with suppress(SimulationError):
            links, near = fit.links.having(**{name: kind}), [fit.values, alone.values]
            out[kind] = fit if kind == present else fit_linked(fit.problems, links, near)
            if kind == "own" and {*RATES} & {*kinds}:
                half = open_slope(out[kind], name)
    return out, half


def open_slope(fit: Together, name: str) -> float:
    """Return half the 95 % interval of the slope b of a parameter, from its own values.

    The errors of a fit with a rate law do not include the scatter of specimens about the law. With
    b = 1 a power law is proportional to the rate.
    """
    free = [name in problem.free() for problem in fit.problems]
    values = np.array(fit.value(name))[free]
    level = float(np.median(values))
    if fit.links.log_rates is None or values.size < 3 or level == 0.0:
        return math.inf
    x = fit.links.log_rates[free]
    if not np.ptp(x) > 0.0:
        return math.inf
    logs = np.log(values / level) if np.all(values / level > 0.0) else values / level
    return covariance.half_width(float(stats.linregress(x, logs).stderr), values.size - 2)
