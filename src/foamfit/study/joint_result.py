"""The result of a joint fit: values, intervals, states, sentences, and the file joint.json."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.data.calibration import contradictions
from foamfit.fitting.links import RATES
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.fitting.together import Together
from foamfit.report import render
from foamfit.report.figures import TWO, inches
from foamfit.report.folder import check_target
from foamfit.report.shown import Joint, JointViews
from foamfit.report.studies.joint import JointParameter, TestValue, save_joint
from foamfit.results import SCHEMA, Fit, Loop, ParameterEstimate, loop_of, plain
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE, unit_of
from foamfit.study.joint_fit import Alternative, JointFit
from foamfit.study.processes import workers
from foamfit.study.study_file import Study
from foamfit.text import counted, listed, percent
from foamfit.trust import covariance
from foamfit.trust.best_point import BestPoint
from foamfit.trust.checklist import POOR, UNACCEPTABLE, status_of, warnings_of
from foamfit.trust.conclude import conclude, noise_of
from foamfit.trust.contested import judged, settle, unsettled
from foamfit.trust.covariance import Ends

# Largest number of result folders written in this process: each takes a second or two.
FEW_FOLDERS = 3
# Items of the checklist that apply only to a search.
_OF_A_SEARCH = ("ended", "agree")
LARGEST = 300.0  # largest logarithm of a common value that the tests do not determine
DOMINANT = 0.5  # a test with at least this share of χ² causes a warning


def fit_of_test(
    problem: Problem, values: Array, parameters: dict[str, ParameterEstimate], note: str, seed: int
) -> Fit:
    """Return the result of a test in a joint fit; `systematic` is from this test alone."""
    problem.put(values)
    alone = conclude(BestPoint(problem, values), SearchRecord(seed, 0, time.perf_counter()))
    checklist = tuple(check for check in alone.checklist if check.key not in _OF_A_SEARCH)
    own = {
        name: replace(one, systematic=alone.parameters.get(name, one).systematic)
        for name, one in parameters.items()
    }
    return replace(
        alone,
        parameters=own,
        notes=(note, *alone.notes),
        checklist=checklist,
        status=status_of(checklist),
        warnings=warnings_of(checklist),
        budget=None,
    )


@dataclass(frozen=True, eq=False, repr=False)
class JointResult(JointViews):
    """The result of a joint fit; sequences are in the order of `tests`."""

    study: Study
    tests: tuple[str, ...]
    files: tuple[Path, ...]
    rates: tuple[float | None, ...]  # Mean strain rate on loading, 1/s
    rate0: float | None  # Rate of the median test, 1/s
    fit: JointFit
    parameters: Mapping[str, JointParameter]
    covariance: tuple[tuple[str, ...], Array]  # Names and matrix, SI; see `to_json_dict`
    evidence: tuple[Alternative, ...]
    alone: Together  # The separate fits of the tests
    refused: Mapping[str, str]  # Files that were not used, with error messages
    open_slopes: Mapping[str, float] = field(default_factory=dict)
    status: str = "ok"
    warnings: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()
    runtime_s: float = 0.0

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.study.name

    @property
    def model(self) -> str:
        """The model as `--model` takes it."""
        return self.study.model

    @cached_property
    def loops(self) -> tuple[Loop, ...]:
        """Measured and fitted loop of each test."""
        out = list[Loop]()
        for name, best in zip(self.tests, self.fit.point.bests, strict=True):
            curves, test = best.simulated.curves, best.problem.measurement
            fitted = curves.get("stress_strain"), curves.get("stress_time")
            if (loop := loop_of(test, *fitted)) is not None:
                out.append(loop._replace(name=name))
        return tuple(out)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """The fitted problem of each test."""
        return self.fit.found.problems

    @property
    def drive(self) -> str | None:
        """The drive; None if the tests have different drives."""
        drives = {problem.objective.drive for problem in self.problems}
        return drives.pop() if len(drives) == 1 else None

    @property
    def bic(self) -> float:
        """Bayesian information criterion, with the effective number of samples of `alone`."""
        return self.fit.found.bic(self.alone.n_eff)

    @property
    def shares(self) -> tuple[float, ...]:
        """Share of each test in χ²."""
        costs = np.array(self.fit.found.costs)
        total = float(costs.sum())
        return tuple((costs / total if total else np.full(costs.size, 1.0 / costs.size)).tolist())

    @cached_property
    def noise(self) -> tuple[dict[str, dict[str, Any]], ...]:
        """Noise of the fitted curves of each test, which determines the weights; see fit.json."""
        return tuple(map(noise_of, self.fit.point.bests, self.fit.point.errors))

    def estimates(self, test: int) -> dict[str, ParameterEstimate]:
        """Return the parameters of one test, as in its fit.json."""
        problem, values = self.problems[test], self.fit.found.values[test]
        out = dict[str, ParameterEstimate]()
        for name, value in zip(problem.names, (values + problem.origins).tolist(), strict=True):
            if problem.is_exact(name):
                continue
            one, param = self.parameters[name], problem.params[name]
            if param.vary:
                at = one.estimate(self.tests[test])
                method = at.ci95 and "local covariance"
                out[name] = replace(at, value=value, ci95_method=method, range=None)
            else:
                why = "held fixed" if param.expr is None else f"tied by {param.expr}"
                out[name] = ParameterEstimate(value, None, None, one.unit, False, "fixed", why)
        return out

    def save(
        self: Joint,
        folder: str | Path,
        *,
        jobs: int | None = None,
        report: bool = True,
        figure_width: str = TWO,
    ) -> Path:
        """Write joint.json, its page, pictures and table.tex, and a result folder per test.

        An older result in the folder is replaced at the end, all at once. The folders of the tests
        are written by `jobs` processes (by default one per core). Without `report`, only tables are
        written. The width of figures is "one" or "two" columns or a length ("85 mm"). Returns the
        folder.
        """
        inches(figure_width)  # rejects an invalid width
        check_target(folder)
        with workers(jobs, len(self.tests), FEW_FOLDERS) as each:
            return save_joint(self, folder, each, report=report, width=figure_width)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of joint.json: SI units, plain types, null for missing values.

        "covariance" is that of shared values, common values of scattering parameters, and for rate
        laws of the values at `rate0` and the slopes (":b"). "specimens" is the correlation of own
        and scattering parameters between specimens.
        """
        found, model = self.fit.found, Model.parse(self.study.model)
        content = {
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "name": self.study.name,
            "model": model.words,
            **model.options,
            "relaxation": self.study.relaxation,
            "drive": self.drive,
            "seed": self.study.seed,
            **{name: getattr(self, name) for name in ("status", "warnings", "sentences", "rate0")},
            "tests": {
                name: {
                    "file": self.files[t],
                    "drive": self.problems[t].objective.drive,
                    "rate": self.rates[t],
                    "misfit": found.misfits[t],
                    "chi2_share": self.shares[t],
                    "noise": self.noise[t],
                    "n_data": self.problems[t].objective.n_data,
                    "data_sha256": self.problems[t].measurement.data_sha256,
                    "values": {name: one.value for name, one in self.estimates(t).items()},
                }
                for t, name in enumerate(self.tests)
            },
            "parameters": {name: one.to_json_dict() for name, one in self.parameters.items()},
            "covariance": {"names": self.covariance[0], "matrix": self.covariance[1]},
            "specimens": {"names": self.fit.correlation[0], "correlation": self.fit.correlation[1]},
            **{n: getattr(self, n) for n in ("evidence", "statistics", "refused", "runtime_s")},
        }
        return dict(plain(content))

    def test_fits(self) -> Iterator[Callable[[], Fit]]:
        """Yield functions that make the result of each test and can run in any process."""
        others = counted(len(self.tests) - 1, "other test")
        note = f"Fitted together with {others} ({self.study.name}): intervals use all of them."
        pairs = zip(self.problems, self.fit.found.values, strict=True)
        for t, (problem, values) in enumerate(pairs):
            yield partial(fit_of_test, problem, values, self.estimates(t), note, self.study.seed)

    @property
    def statistics(self) -> dict[str, float | int]:
        """Statistics of the joint fit and of the separate fits."""
        found = self.fit.found
        return {
            "n_tests": len(self.tests),
            "n_data": found.n_data,
            "n_vary": found.n_vary,
            "chisqr": found.cost,
            "redchi": found.cost / max(found.n_data - found.n_vary, 1),
            "n_effective": self.fit.point.uncertainty.covariance.effective,
            "n_eff": self.alone.n_eff,
            "bic": self.bic,
            "bic_alone": self.alone.bic(self.alone.n_eff),
            "n_vary_alone": self.alone.n_vary,
            "chisqr_alone": self.alone.cost,
        }


def common_covariance(fit: JointFit) -> tuple[tuple[str, ...], Array]:
    """Return the covariance of common values and slopes, SI; see `JointResult.to_json_dict`."""
    point, count = fit.point, len(fit.point.names)
    scales = np.ones(count)
    for i, name in enumerate(point.names):
        if fit.found.links.kind(name) == "scatter":
            spread, error = fit.spreads.get(name), point.of_common(name)[0]
            scales[i] = math.exp(min(spread.mean, LARGEST)) if spread else fit.found.common[name][0]
            scales[i] *= spread.stderr / error if spread and error > 0.0 else 1.0
    matrix = point.uncertainty.covariance.matrix[:count, :count]
    return point.names, matrix * np.outer(scales, scales)


def parameters_of(fit: JointFit, tests: tuple[str, ...]) -> dict[str, JointParameter]:
    """Return all parameters of the joint fit, those of the springs first."""
    problems = fit.found.problems
    found = {
        name: parameter_of(fit, tests, name)
        for name in (*problems[0].model.names, *NUISANCE)
        if any(name in one.index and not one.is_exact(name) for one in problems)
    }
    for test, best in zip(tests, fit.point.bests, strict=True):
        settled = settle(best, unsettled(best, contradictions(best.problem.measurement)))
        for name in best.problem.free() if settled else ():
            found[name] = _contested(found[name], test, partial(judged, settled, best, name))
    return found


def _contested(
    one: JointParameter, test: str, judge: Callable[[Ends, tuple[str, str]], tuple[str, str]]
) -> JointParameter:
    """Return a parameter with the states that contradictions in the record of a test leave it."""
    if one.ci95 is not None and one.state is not None and one.why is not None:
        state, why = judge(one.ci95, (one.state, one.why))
        one = replace(one, state=state, why=why)
    at = one.tests[test] if one.tests is not None else None
    if at is None or at.ci95 is None:
        return one
    state, why = judge(at.ci95, (at.state, at.why))
    return replace(one, tests={**(one.tests or {}), test: replace(at, state=state, why=why)})


def parameter_of(fit: JointFit, tests: tuple[str, ...], name: str) -> JointParameter:
    """Return one parameter of the joint fit."""
    found, unit, kind = fit.found, unit_of(name), fit.found.links.kind(name)
    free = [t for t, problem in enumerate(found.problems) if name in problem.free()]
    each = _values(fit, tests, name)
    if not free:
        value = float(np.median([one.value for one in each.values()]))
        return JointParameter("fixed", value, unit, state="fixed", why="held fixed")
    if kind == "own":
        value = float(np.median([each[tests[t]].value for t in free]))
        why = "one value for each test; this is their median"
        return JointParameter(kind, value, unit, why=why, tests=each)
    if kind == "scatter":
        return _scattering(fit, name, each)
    (value, *slope), span = found.common[name], fit.ranges.get(name)
    one = _judged(fit, free[0], name, value, fit.point.of_common(name), span)
    why = f"one value for {counted(len(free), 'test')}: {one.why}"
    why = f"at the rate of the median test; {why}" if slope else why
    joint = JointParameter(kind, value, unit, one.stderr, one.ci95, one.state, why, range=span)
    if not slope:
        return joint
    b, (error, freedom) = slope[0], fit.point.of_common(f"{name}:b")
    half = covariance.half_width(error, freedom)
    determined = math.isfinite(half)
    return replace(
        joint,
        tests=each,
        b=b,
        b_stderr=error if determined else None,
        b_ci95=(b - half, b + half) if determined else None,
        b_range=fit.ranges.get(f"{name}:b"),
    )


def _scattering(fit: JointFit, name: str, tests: dict[str, TestValue]) -> JointParameter:
    unit, spread, kind = unit_of(name), fit.spreads.get(name), "scatter"
    if spread is None:
        why = "too few tests determine it to estimate its common value"
        value = fit.found.common[name][0]
        return JointParameter(kind, value, unit, state="not determined", why=why, tests=tests)
    sign = -1.0 if next(iter(tests.values())).value < 0.0 else 1.0
    value, *ends = (sign * np.exp(np.minimum([spread.mean, *spread.ci95], LARGEST))).tolist()
    ci95, limits = (min(ends), max(ends)), (-math.inf, math.inf)
    state, why = covariance.state(name, value, covariance.wider(ci95, None), abs(value), limits)
    determined = state != "not determined"
    return JointParameter(
        kind,
        value,
        unit,
        abs(value) * spread.stderr if determined else None,
        ci95 if determined else None,
        state,
        f"common value of {counted(spread.count, 'test')}: {why}",
        tests,
        spread.tau,
        spread.tau_stderr,
        spread.tau_ci95,
    )


def _judged(
    fit: JointFit,
    test: int,
    name: str,
    value: float,
    error: tuple[float, float],
    span: tuple[float, float] | None = None,
) -> TestValue:
    """Judge a value by the wider of interval and range (`trust.covariance.RULE`).

    `error` contains standard error and degrees of freedom; limits and scale are those of `test`.
    """
    problem, (stderr, freedom) = fit.found.problems[test], error
    limits = fit.point.bests[test].limits(name)
    size = float(problem.sizes((name,), fit.found.values[test])[0])
    half = covariance.half_width(stderr, freedom)
    ends = (value - half, value + half)
    judged = covariance.state(name, value, covariance.wider(ends, span), size, limits)
    if not half <= covariance.NOTHING * size:
        return TestValue(value, None, None, *judged)
    return TestValue(value, stderr, (max(ends[0], limits[0]), min(ends[1], limits[1])), *judged)


def _values(fit: JointFit, tests: tuple[str, ...], name: str) -> dict[str, TestValue]:
    """Return a parameter in each test that has it, with the zeros of the test's file."""
    out, found = dict[str, TestValue](), fit.found
    for t, (test, problem) in enumerate(zip(tests, found.problems, strict=True)):
        if name not in problem.index or problem.is_exact(name):
            continue
        value = float(found.values[t][problem.index[name]])
        branch = fit.point.bests[t].unreached.get(name)
        if not problem.params[name].vary:
            one = TestValue(value, None, None, "fixed", "held fixed")
        elif branch is not None and found.links.kind(name) == "own":
            why = f"branch {branch} was never reached"
            one = TestValue(value, None, None, "not determined", why)
        else:
            one = _judged(fit, t, name, value, fit.point.of_test(t, name))
        zero = problem.measurement.origins.get(name, 0.0)
        ends = one.ci95 and (one.ci95[0] + zero, one.ci95[1] + zero)
        out[test] = replace(one, value=value + zero, ci95=ends)
    return out


def with_words(result: JointResult) -> JointResult:
    """Return a joint fit with its status, warnings and sentences."""
    lost, large = dict[str, None](), list[str]()
    for t, (test, problem) in enumerate(zip(result.tests, result.problems, strict=True)):
        for curve in problem.objective.counted:
            misfit = result.fit.found.misfits[t][curve]
            measured = problem.objective.measured[curve]
            if misfit is None or not misfit <= UNACCEPTABLE * np.std(measured) / np.ptp(measured):
                lost[test] = None
            elif misfit > POOR:
                large.append(f"{test} ({curve} {percent(misfit)})")
    share, top = max(zip(result.shares, result.tests, strict=True))
    evidence = list[tuple[str, str, str, float]]()  # parameter, best kind, its kind, gain in BIC
    for chosen in (tried for tried in result.evidence if tried.chosen):
        others = (tried for tried in result.evidence if tried.parameter == chosen.parameter)
        best = min(others, key=lambda tried: tried.bic)
        evidence.append((chosen.parameter, best.kind, chosen.kind, chosen.bic - best.bic))
    rates = [rate for rate in result.rates if rate is not None]
    shown = {
        "parameters": list(result.parameters.items()),
        "laws": RATES,
        "rates": f"{min(rates):.3g} to {max(rates):.3g} 1/s" if rates else "",
        "slopes": [
            (name, result.parameters[name].kind, half) for name, half in result.open_slopes.items()
        ],
    }
    warnings = render.sentences(
        "joint_warnings",
        refused=[(Path(file).name, why.rstrip(".")) for file, why in result.refused.items()],
        lost=list(lost),
        wrong=[
            (test, one, best.problem.objective.drive)
            for test, best in zip(result.tests, result.fit.point.bests, strict=True)
            for one in unsettled(best, contradictions(best.problem.measurement))
        ],
        large=large,
        top=(top, share) if len(result.tests) > 3 and share > DOMINANT else None,
        gap=result.bic - result.alone.bic(result.alone.n_eff),
        together=span_of(result.fit.found.misfits),
        alone=span_of(result.alone.misfits),
        evidence=evidence,
        **shown,
    )
    kinds = dict[str, list[str]]()
    for name, one in result.parameters.items():
        kinds.setdefault(one.kind, []).append(name)
    sentences = render.sentences(
        "joint_sentences",
        tests=len(result.tests),
        n_vary=result.fit.found.n_vary,
        kinds=[f"{listed(names)} {kind}" for kind, names in kinds.items() if kind != "fixed"],
        scatter=[
            f"{name} {percent(one.scatter)} ({' to '.join(map(percent, one.scatter_ci95))})"
            for name, one in result.parameters.items()
            if one.scatter is not None and one.scatter_ci95 is not None
        ],
        **shown,
    )
    status = "failed" if lost else "warnings" if warnings else "ok"
    return replace(result, status=status, warnings=warnings, sentences=sentences)


def span_of(found: Sequence[dict[str, float | None]]) -> tuple[float, float] | None:
    """Return smallest and largest misfit of some fits, of the loop or else of a time curve."""
    names = ("stress_strain", "stress_time", "displacement_time")
    each = (next((fit[n] for n in names if fit.get(n) is not None), None) for fit in found)
    misfits = [misfit for misfit in each if misfit is not None]
    return (min(misfits), max(misfits)) if misfits else None
