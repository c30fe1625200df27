"""Several tests in one fit: what the study says of each parameter, from files to joint.json."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import lmfit
import numpy as np

from foamfit.arrays import Array
from foamfit.data.csv_file import read_test
from foamfit.data.measurement import Measurement
from foamfit.errors import InputError, SimulationError
from foamfit.fitting.box import scale_in_words
from foamfit.fitting.links import KINDS, RATES, Links
from foamfit.fitting.problem import Problem, make_params
from foamfit.fitting.search import Tracker, descend
from foamfit.one_model import Options, Progress, identify
from foamfit.report.folder import check_target
from foamfit.report.studies.joint import save_joint
from foamfit.springs.model import Model
from foamfit.springs.parameters import unit_of
from foamfit.study.joint_fit import (
    Alternative,
    JointFit,
    Map,
    choose_kinds,
    evidence,
    fit_jointly,
    samples_of,
)
from foamfit.study.joint_result import JointData, JointParameter, TestValue
from foamfit.study.study_file import AUTO, Study, read_study
from foamfit.study.workers import workers
from foamfit.text import counted, listed, percent
from foamfit.trust import covariance
from foamfit.trust.checklist import POOR, UNACCEPTABLE

# Tests that are searched as a fit of their own is; the others start at what these have found.
SEARCHED = 3
# Up to so many tests are fitted in this process: each takes some tenths of a second.
FEW = 20
# Up to so many result folders are written in this process: each takes a second or two.
FEW_FOLDERS = 3
# Reduced χ² of a test over the largest of those, past which it is searched as well.
FAR = 2.0
# Steps of a descent from what another test has found.
STEPS = 60
# Starts of the joint fit besides the own fits: what one test has found, for all.
ONE_FOR_ALL = 2
# Rates that differ by less than this share are one.
SAME_RATE = 0.02
# Share of χ² from which on one test of many is named.
DOMINANT = 0.5


class JointResult(JointData):
    """Everything that a joint fit found, and how it is written; its fields are `JointData`'s."""

    def save(self, folder: str | Path, *, jobs: int | None = None, reports: bool = True) -> Path:
        """Write joint.json, joint.html, joint.png and a result folder per test; returns the folder.

        An older result there is replaced as a whole, at the end. The folders of the tests are made
        by `jobs` processes (by default one for each core), without `reports` with tables alone.
        """
        check_target(folder)
        with workers(jobs, len(self.tests), FEW_FOLDERS) as each:
            return save_joint(self, folder, each, reports=reports)


@dataclass(frozen=True, eq=False)
class _Test:
    """One test of a study, ready to be fitted."""

    name: str
    file: Path
    problem: Problem
    params: lmfit.Parameters  # Before any fit
    rate: float | None


def joint(
    path: str | Path,
    *,
    jobs: int | None = None,
    out: str | Path | None = None,
    seed: int | None = None,
    reports: bool = True,
    progress: Progress | None = None,
) -> JointResult:
    """Fit the tests of a study together.

    Parameters
    ----------
    path : str or Path
        STUDY.toml: tests, model, drive, and what each parameter is: "shared", "own", "scatter",
        "log rate", "power rate" or "auto", or a number that it is held at.
    jobs : int, optional
        Processes; by default one for each core. The numbers are the same with any.
    out : str or Path, optional
        Folder to write the result to, as `JointResult.save` does, with or without `reports`.
    seed : int, optional
        Of the search; by default that of the study, or 0.
    progress : callable, optional
        Told the fraction done and what is going on.

    Returns
    -------
    JointResult

    Raises
    ------
    InputError
        If the study cannot be used: the message names the file and the key. A single test that
        cannot be read or fitted is in `refused` with its sentence.
    SimulationError
        If no start of the joint fit can be simulated.
    """
    began, study, tell = time.perf_counter(), read_study(path), progress or (lambda *_: None)
    if out is not None:
        check_target(out)
    seed = study.seed if seed is None else seed
    options = Options(
        drive=study.drive, seed=seed, starts=study.starts, relaxation=study.relaxation
    )
    tests, refused = _read(study, options, tell)
    with workers(jobs, len(tests), FEW) as each:
        vectors = _own_fits(study, options, tests, each, tell)
        problems, links = [test.problem for test in tests], _links(study, tests)
        starts, n_eff = _starts(problems, vectors), samples_of(problems, vectors)
        tell(0.5, "together")
        links = _chosen(study, problems, links, starts, n_eff)
        fit = fit_jointly(problems, links, starts, each=each)
    tell(0.9, "evidence")
    alternatives = _evidence(study, fit, n_eff, vectors)
    result = _conclude(study, seed, tests, fit, alternatives, n_eff, refused, began)
    tell(1.0, "done")
    if out is not None:
        result.save(out, jobs=jobs, reports=reports)
    return result


# ------------------------------------------------------------------------------- reading


def _read(study: Study, options: Options, tell: Progress) -> tuple[list[_Test], dict[str, str]]:
    """Read all tests; those that cannot be used are refused, each with its sentence."""
    found, refused = list[tuple[str, Path, Measurement]](), dict[str, str]()
    pairs = list(zip(study.tests, study.specimens, strict=True))
    for i, ((name, path), specimen) in enumerate(pairs):
        tell(0.1 * i / len(pairs), "reading")
        try:
            test = read_test(path, specimen, study.cycle)
            options.problem(test, study.model)
            found.append((name, path, test))
        except (InputError, SimulationError) as error:
            refused[str(path)] = str(error)
    if len(found) < 2:
        told = "; ".join(list(refused.values())[:2])
        raise InputError(
            f"{study.path}: {counted(len(found), 'test')} of {len(pairs)} can be used, a joint fit "
            f"needs two: {told}"
        )
    params = _params(study, [test for _, _, test in found])
    return [
        _Test(name, path, options.problem(test, study.model, own), own, strain_rate(test))
        for (name, path, test), own in zip(found, params, strict=True)
    ], refused


def strain_rate(test: Measurement) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time."""
    if test.time is None or test.displacement is None:
        return None
    peak = int(np.argmax(test.displacement))
    duration = float(test.time[peak] - test.time[0])
    if duration <= 0.0:
        return None
    rise = float(test.displacement[peak] - test.displacement[0])
    return rise / test.specimen.height / duration


def _params(study: Study, tests: Sequence[Measurement]) -> list[lmfit.Parameters]:
    """Parameters of each test, varied and held as the study says.

    What is named varies where it does so by itself, and if it does nowhere, then in every test.
    """
    model = Model.parse(study.model, study.relaxation)
    every = [make_params(test, model, study.drive) for test in tests]
    for name in (*study.kinds, *study.held):
        where = f"{study.path}: [parameters] {name}"
        tied = [params[name].expr for params in every if params[name].expr is not None]
        if tied:
            raise InputError(f"{where} follows from others ({tied[0]}); name those instead")
        if name in study.held:
            for params in every:
                params[name].set(value=study.held[name], vary=False, min=-math.inf, max=math.inf)
        elif not any(params[name].vary for params in every):
            if name.endswith("_height"):
                raise InputError(f"{where} is given by [specimen] heights; leave one of them out")
            for params in every:
                params[name].set(vary=True)
    return every


def _links(study: Study, tests: Sequence[_Test]) -> Links:
    """What each parameter is to the tests, and ln(rate/rate0) where a law of rate needs it."""
    rates = [test.rate for test in tests]
    by_rate = [name for name, kind in study.kinds.items() if kind in RATES]
    for name in by_rate:
        where = f'{study.path}: [parameters] {name} = "{study.kinds[name]}"'
        there = [test for test in tests if test.problem.params[name].vary]
        for test in there:
            if test.rate is None:
                raise InputError(
                    f"{where} needs the strain rate of every test, and {test.file} has no time"
                )
        if not _several([test.rate for test in there]):
            rate = f"{there[0].rate:.3g} 1/s" if there else "none"
            raise InputError(
                f"{where} needs tests at two or more rates, and all have one ({rate}); make it "
                '"shared" or "own", or add tests'
            )
    for name, kind in study.kinds.items():
        there = [test for test in tests if test.problem.params[name].vary]
        if kind == "scatter" and len(there) < 2:
            raise InputError(
                f'{study.path}: [parameters] {name} = "scatter" needs two or more tests in which '
                f"it varies, and there is {counted(len(there), 'test')}"
            )
    if any(rate is None for rate in rates):
        return Links(study.kinds)
    known = np.array(rates, dtype=float)
    return Links(study.kinds, np.log(known / float(_median_rate(known))))


def _median_rate(rates: Array) -> float:
    """Rate of the median test; of an even number of tests that of the slower one."""
    return float(np.sort(rates)[(rates.size - 1) // 2])


def _several(rates: Sequence[float | None]) -> bool:
    known = [rate for rate in rates if rate is not None]
    return len(known) > 1 and max(known) > (1.0 + SAME_RATE) * min(known)


# ------------------------------------------------------------------------------- own fits


def _own_fits(
    study: Study, options: Options, tests: Sequence[_Test], each: Map, tell: Progress
) -> list[Array]:
    """Vectors of parameters that a fit of each test alone finds.

    A few tests, spread over the rates, are searched as `fit` searches them. The others descend from
    what these have found, and are searched too where that does not follow them as well.
    """
    order = sorted(range(len(tests)), key=lambda t: (tests[t].rate or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(SEARCHED, len(order))).astype(int))
    first = [order[place] for place in places]
    found = dict[int, tuple[Array, float]]()

    def do(chosen: Sequence[int], near: tuple[Array, ...], done: float) -> None:
        work = [(tests[t].problem.measurement, study.model, tests[t].params, options, near)
                for t in chosen]  # fmt: skip
        for i, (t, own) in enumerate(
            zip(chosen, each(_own_fit, *zip(*work, strict=True)) if work else (), strict=True)
        ):
            found[t] = own
            tell(done + 0.2 * (i + 1) / len(chosen), "each test")

    do(first, (), 0.1)
    near, worst = tuple(found[t][0] for t in first), max(found[t][1] for t in first)
    do([t for t in order if t not in found], near, 0.3)
    do([t for t in order if found[t][1] > FAR * worst], (), 0.3)
    return [found[t][0] for t in range(len(tests))]


def _own_fit(
    measurement: Measurement, model: str, params: lmfit.Parameters, options: Options,
    near: tuple[Array, ...],
) -> tuple[Array, float]:  # fmt: skip
    """Fit one test from points nearby, or search; returns its vector and χ² per sample."""
    if not near:
        found = identify(measurement, model, params, options, lambda *_: None)
        values, cost, n = found.best().values, found.tracker.best_cost, found.problem
        return values, cost / n.objective.n_data
    problem = options.problem(measurement, model, params)
    space, tracker = problem.space(), Tracker(problem.objective)
    for start in near:
        held = space.values.copy()
        free = [problem.index[name] for name in problem.free()]
        held[free] = start[free]
        descend(tracker, space, space.encode(space.complete(held)), STEPS)
    if tracker.best_values is None:
        return _own_fit(measurement, model, params, options, ())
    return tracker.best_values, tracker.best_cost / problem.objective.n_data


def _starts(problems: Sequence[Problem], vectors: Sequence[Array]) -> list[list[Array]]:
    """Where the joint fit starts: at the own fits, and at those of single tests for all."""
    n = len(vectors)
    chosen = np.unique(np.linspace(0, n - 1, min(n, ONE_FOR_ALL)).astype(int))
    return [list(vectors), *([_as(p, vectors[i]) for p in problems] for i in chosen)]


def _as(problem: Problem, vector: Array) -> Array:
    """A vector with the values of another test where this one varies."""
    values = problem.vector()
    free = [problem.index[name] for name in problem.free()]
    values[free] = vector[free]
    return problem.space().complete(values)


# ------------------------------------------------------------------------------- kinds


def _chosen(
    study: Study, problems: Sequence[Problem], links: Links, starts: list[list[Array]], n_eff: int
) -> Links:
    """Links with the kinds of the parameters that evidence is to choose."""
    free = {name for problem in problems for name in problem.free()}
    names = [name for name, kind in study.kinds.items() if kind == AUTO and name in free]
    if not names:
        return links
    return choose_kinds(problems, links, names, starts, n_eff, _choices(links))


def _choices(links: Links) -> tuple[str, ...]:
    """Kinds between which there can be evidence: laws of rate only where there are several."""
    rated = links.log_rates is not None and float(np.ptp(links.log_rates)) > math.log1p(SAME_RATE)
    return tuple(kind for kind in KINDS if kind != "scatter" and (rated or kind not in RATES))


def _evidence(
    study: Study, fit: JointFit, n_eff: int, vectors: Sequence[Array]
) -> tuple[Alternative, ...]:
    """Every parameter with a law of rate, or of which evidence was to choose, as other kinds."""
    found = fit.found
    names = [
        name for name in (*found.shared, *found.own)
        if found.links.kind(name) in RATES or study.kinds.get(name) == AUTO
    ]  # fmt: skip
    return tuple(evidence(found, names, n_eff, _choices(found.links), [list(vectors)]))


# ------------------------------------------------------------------------------- the result


def _conclude(
    study: Study, seed: int, tests: Sequence[_Test], fit: JointFit,
    alternatives: tuple[Alternative, ...], n_eff: int, refused: Mapping[str, str], began: float,
) -> JointResult:  # fmt: skip
    """Assemble the result."""
    names = tuple(test.name for test in tests)
    parameters = {name: _parameter(fit, names, name) for name in tests[0].problem.names}
    rates = tuple(test.rate for test in tests)
    known = np.array([rate for rate in rates if rate is not None])
    result = JointResult(
        study=study,
        seed=seed,
        tests=names,
        files=tuple(test.file for test in tests),
        rates=rates,
        rate0=_median_rate(known) if known.size == len(tests) else None,
        fit=fit,
        parameters=parameters,
        covariance=_common_covariance(fit),
        evidence=alternatives,
        n_eff=n_eff,
        refused=refused,
        status="ok",
        warnings=(),
        sentences=(),
        runtime_s=time.perf_counter() - began,
    )
    lost, warnings = _warnings(result)
    status = "failed" if lost else "warnings" if warnings else "ok"
    sentences = tuple(_sentences(result))
    return replace(result, status=status, warnings=tuple(warnings), sentences=sentences)


def _common_covariance(fit: JointFit) -> tuple[tuple[str, ...], Array]:
    """Covariance of the common values and slopes, SI; see `JointData.to_json_dict`."""
    spread, scales = fit.covariance, []
    for name in spread.names:
        one = fit.spreads.get(name)
        value = math.exp(one.mean) if one else fit.found.common.get(name, (1.0,))[0]
        before = spread.of_common(name)[0]
        factor = one.stderr / before if one and before > 0.0 else 1.0
        scales.append(value * factor if fit.found.links.kind(name) == "scatter" else 1.0)
    return spread.names, spread.matrix * np.outer(scales, scales)


def _parameter(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """One parameter of the joint fit."""
    found = fit.found
    kind, values, unit = found.links.kind(name), found.value(name), unit_of(name)
    there = [t for t, problem in enumerate(found.problems) if problem.params[name].vary]
    if not there:
        value = float(np.median(values))
        return JointParameter("fixed", value, unit, state="fixed", why="held fixed")
    if kind == "own":
        return JointParameter(
            kind, float(np.median([values[t] for t in there])), unit,
            why="one value for each test; this is their median",
            tests=_values(fit, tests, name),
        )  # fmt: skip
    if kind == "scatter":
        return _scattering(fit, tests, name)
    first = found.problems[there[0]]
    (value, *slope) = found.common[name]
    stderr, freedom = fit.covariance.of_common(name)
    judged = _judged(first, name, value, stderr, freedom, found.values[there[0]])
    words = f"one value for {counted(len(there), 'test')}"
    if not slope:
        return _estimate(kind, value, unit, judged, words)
    b_error, b_freedom = fit.covariance.of_common(f"{name}:b")
    half = covariance.half_width(b_error, b_freedom)
    known = math.isfinite(half)
    one = _estimate(kind, value, unit, judged, f"at the rate of the median test; {words}")
    return replace(
        one, tests=_values(fit, tests, name), b=slope[0], b_stderr=b_error if known else None,
        b_ci95=(slope[0] - half, slope[0] + half) if known else None,
    )  # fmt: skip


def _scattering(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """One parameter that scatters between specimens."""
    unit, spread = unit_of(name), fit.spreads.get(name)
    values = _values(fit, tests, name)
    if spread is None:
        (common,) = fit.found.common[name]
        why = "too few tests determine it to tell its common value"
        return JointParameter(
            "scatter", common, unit, state="not determined", why=why, tests=values
        )
    sign = -1.0 if next(iter(values.values())).value < 0.0 else 1.0
    value, ends = sign * math.exp(spread.mean), [sign * math.exp(end) for end in spread.ci95]
    half = 0.5 * abs(ends[1] - ends[0])
    state, why = covariance.state(value, half, abs(value), -math.inf, math.inf)
    known = state != "not determined"
    return JointParameter(
        "scatter", value, unit, abs(value) * spread.stderr if known else None,
        (min(ends), max(ends)) if known else None, state,
        f"common value of {counted(spread.count, 'test')}: {why}", values,
        spread.tau, spread.tau_stderr, spread.tau_ci95,
    )  # fmt: skip


_Judged = tuple[float | None, tuple[float, float] | None, str, str]


def _estimate(kind: str, value: float, unit: str, judged: _Judged, words: str) -> JointParameter:
    stderr, ci95, state, why = judged
    return JointParameter(kind, value, unit, stderr, ci95, state, f"{words}: {why}")


def _judged(
    problem: Problem, name: str, value: float, stderr: float, freedom: float, values: Array
) -> _Judged:
    """Standard error, interval, state and reason of a value; see `trust.covariance.RULE`."""
    parameter = problem.params[name]
    low, high = float(parameter.min), float(parameter.max)
    size = float(problem.sizes((name,), values)[0])
    half = covariance.half_width(stderr, freedom)
    of = scale_in_words(name, value, size)
    state, why = covariance.state(value, half, size, low, high, of)
    if not half <= covariance.NOTHING * size:
        return None, None, state, why
    return stderr, (max(value - half, low), min(value + half, high)), state, why


def _values(fit: JointFit, tests: tuple[str, ...], name: str) -> dict[str, TestValue]:
    """A parameter in each test."""
    out, found = dict[str, TestValue](), fit.found
    for t, (test, problem) in enumerate(zip(tests, found.problems, strict=True)):
        values = found.values[t]
        value = float(values[problem.index[name]])
        if not problem.params[name].vary:
            out[test] = TestValue(value, None, None, "fixed", "held fixed")
            continue
        branch = fit.point.bests[t].unreached.get(name)
        if branch is not None and found.links.kind(name) == "own":
            why = f"branch {branch} was never reached"
            out[test] = TestValue(value, None, None, "not determined", why)
            continue
        error, freedom = fit.covariance.of_test(t, name)
        out[test] = TestValue(value, *_judged(problem, name, value, error, freedom, values))
    return out


# ------------------------------------------------------------------------------- in words


def _warnings(result: JointData) -> tuple[bool, list[str]]:
    """Whether some test is not followed acceptably, and what a reader must know."""
    out, lost, large = list[str](), list[str](), list[str]()
    for file, why in result.refused.items():
        out.append(f"{Path(file).name} is left out: {why.rstrip('.')}.")
    for t, (test, problem) in enumerate(zip(result.tests, result.problems, strict=True)):
        for curve in problem.objective.counted:
            off, measured = result.fit.found.misfits[t][curve], problem.objective.measured[curve]
            most = UNACCEPTABLE * float(np.std(measured) / np.ptp(measured))
            if off is None or not off <= most:
                lost.append(test)
            elif off > POOR:
                large.append(f"{test} ({curve} {percent(off)})")
    if lost:
        out.append(f"The misfit of {listed(dict.fromkeys(lost))} is not acceptable.")
    if large:
        more = f" and {len(large) - 3} more" if len(large) > 3 else ""
        out.append(f"The misfit is large in {', '.join(large[:3])}{more}.")
    top = int(np.argmax(result.shares))
    if len(result.tests) > 3 and result.shares[top] > DOMINANT:
        out.append(
            f"{result.tests[top]} holds {percent(result.shares[top])} of χ²: the law, or the noise "
            "that it states, does not fit it as the others."
        )
    for name, one in result.parameters.items():
        if one.kind not in ("own", "fixed") and one.state != "determined":
            out.append(f"{name} ({one.kind}) is {one.state}: {one.why}.")
    for name in dict.fromkeys(one.parameter for one in result.evidence):
        tried = [one for one in result.evidence if one.parameter == name]
        mine, best = next(o for o in tried if o.chosen), min(tried, key=lambda one: one.bic)
        if best.bic < mine.bic - 2.0:
            out.append(
                f'The evidence on {name} is for "{best.kind}" rather than "{mine.kind}" '
                f"(BIC {mine.bic - best.bic:.1f} lower)."
            )
    return bool(lost), out


def _sentences(result: JointData) -> Iterator[str]:
    """What the fit says."""
    kinds = dict[str, list[str]]()
    for name, one in result.parameters.items():
        kinds.setdefault(one.kind, []).append(name)
    parts = [f"{listed(names)} {kind}" for kind, names in kinds.items() if kind != "fixed"]
    found = result.fit.found
    yield (
        f"{counted(len(result.tests), 'test')} fitted with {counted(found.n_vary, 'number')} "
        f"({'; '.join(parts)})."
    )
    for name, one in result.parameters.items():
        if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None:
            low, high = one.scatter_ci95
            yield (
                f"Between specimens {name} scatters by {percent(one.scatter)} (standard deviation "
                f"of its logarithm; 95 %: {percent(low)} to {percent(high)}), errors of "
                "measurement taken off."
            )
        if one.b is not None and one.b_ci95 is not None:
            low, high = one.b_ci95
            what = "rises" if one.b > 0.0 else "falls"
            sure = "" if low > 0.0 or high < 0.0 else ", which zero is consistent with"
            yield (
                f"{name} {what} with the rate: b = {one.b:.4g} (95 %: {low:.4g} to {high:.4g})"
                f"{sure}."
            )
