"""What a joint fit found: data only, and the content of joint.json."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from foamfit.arrays import Array
from foamfit.fitting.links import RATES
from foamfit.fitting.problem import Problem
from foamfit.fitting.search import SearchRecord
from foamfit.fitting.together import Together
from foamfit.results import SCHEMA, Fit, Loop, ParameterEstimate, loop_of, plain
from foamfit.springs.model import Model
from foamfit.study.joint_fit import Alternative, JointFit
from foamfit.study.study_file import Study
from foamfit.text import counted
from foamfit.trust.best_point import BestPoint
from foamfit.trust.checklist import status_of, warnings_of
from foamfit.trust.conclude import conclude, noise_of

# Keys of a parameter that only some kinds have.
_OF_SCATTER = ("scatter", "scatter_stderr", "scatter_ci95")
_OF_RATE = ("b", "b_stderr", "b_ci95", "b_range")
# Questions to a search of one test.
_OF_A_SEARCH = ("ended", "agree")


@dataclass(frozen=True)
class TestValue:
    """A parameter in one test, SI; None where the test says nothing of it."""

    __test__ = False  # what pytest must not take for a test

    value: float
    stderr: float | None
    ci95: tuple[float, float] | None
    state: str
    why: str


@dataclass(frozen=True)
class JointParameter:
    """One parameter of a joint fit, SI.

    `kind` is one of `links.KINDS` or "fixed". `value` is the common one: of a scattering parameter
    the median specimen's, by a law of rate that at the rate of the median test, of an own one the
    median over the tests (which has no error). `scatter` is the standard deviation of its logarithm
    between specimens, `b` the slope of the law of rate. `tests` has its value in each test, unless
    it is the same in all.
    """

    kind: str
    value: float
    unit: str
    stderr: float | None = None
    ci95: tuple[float, float] | None = None
    state: str | None = None
    why: str | None = None
    tests: Mapping[str, TestValue] | None = None
    scatter: float | None = None
    scatter_stderr: float | None = None
    scatter_ci95: tuple[float, float] | None = None
    b: float | None = None
    b_stderr: float | None = None
    b_ci95: tuple[float, float] | None = None
    # What the error of the law leaves open of it (`joint_fit.ranges_of`); None where all is noise.
    range: tuple[float, float] | None = None
    b_range: tuple[float, float] | None = None

    def estimate(self, test: str | None = None) -> ParameterEstimate:
        """The common value, or that of a test, as the parameter of a fit."""
        if test is None or self.tests is None:
            told, span = (self.state or "", self.why or ""), self.range
            return ParameterEstimate(
                self.value, self.stderr, self.ci95, self.unit, True, *told, range=span
            )
        at = self.tests[test]
        return ParameterEstimate(at.value, at.stderr, at.ci95, self.unit, True, at.state, at.why)

    def to_json_dict(self) -> dict[str, Any]:
        """Return its part of joint.json."""
        gone = ["tests"] if self.tests is None else []
        gone += [key for key in _OF_SCATTER if self.kind != "scatter"]
        gone += [key for key in _OF_RATE if self.kind not in RATES]
        return {key: value for key, value in asdict(self).items() if key not in gone}


def fit_of_test(
    problem: Problem, values: Array, parameters: dict[str, ParameterEstimate], note: str, seed: int
) -> Fit:
    """The result of a test in a joint fit; `systematic` is that of a fit of this test alone."""
    problem.put(values)
    made = conclude(BestPoint(problem, values), SearchRecord(seed, 0, time.perf_counter()))
    checklist = tuple(check for check in made.checklist if check.key not in _OF_A_SEARCH)
    own = {
        name: replace(one, systematic=made.parameters.get(name, one).systematic)
        for name, one in parameters.items()
    }
    return replace(
        made,
        parameters=own,
        notes=(note, *made.notes),
        checklist=checklist,
        status=status_of(checklist),
        warnings=warnings_of(checklist),
        budget=None,
    )


@dataclass(frozen=True, eq=False)
class JointData:
    """Everything that a joint fit found; arrays are in the order of `tests`."""

    study: Study
    tests: tuple[str, ...]
    files: tuple[Path, ...]
    rates: tuple[float | None, ...]  # Mean strain rate on loading, 1/s
    rate0: float | None  # That of the median test
    fit: JointFit
    parameters: Mapping[str, JointParameter]
    covariance: tuple[tuple[str, ...], Array]  # Names and matrix, SI; see `to_json_dict`
    evidence: tuple[Alternative, ...]
    alone: Together  # The fits of the tests one by one
    refused: Mapping[str, str]  # File and sentence
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
        """The loop of each test, measured and fitted."""
        out = list[Loop]()
        for name, best in zip(self.tests, self.fit.point.bests, strict=True):
            curves, test = best.simulated.curves, best.problem.measurement
            fitted = curves.get("stress_strain"), curves.get("stress_time")
            if (loop := loop_of(test, *fitted)) is not None:
                out.append(loop._replace(name=name))
        return tuple(out)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What was fitted, for each test."""
        return self.fit.found.problems

    @property
    def drive(self) -> str | None:
        """The drive; None where the tests have different ones."""
        drives = {problem.objective.drive for problem in self.problems}
        return drives.pop() if len(drives) == 1 else None

    @property
    def bic(self) -> float:
        """Bayesian information criterion, counted as that of the tests one by one in `alone`."""
        return self.fit.found.bic(self.alone.n_eff)

    @property
    def shares(self) -> tuple[float, ...]:
        """Share of each test in χ²."""
        costs = np.array(self.fit.found.costs)
        total = float(costs.sum())
        return tuple((costs / total if total else np.full(costs.size, 1.0 / costs.size)).tolist())

    @cached_property
    def noise(self) -> tuple[dict[str, dict[str, Any]], ...]:
        """Noise of each counted curve of each test, by which it is weighted; as in fit.json."""
        return tuple(map(noise_of, self.fit.point.bests, self.fit.point.errors))

    @property
    def tried(self) -> dict[str, list[Alternative]]:
        """The kinds that were tried, by parameter."""
        names = dict.fromkeys(one.parameter for one in self.evidence)
        return {name: [one for one in self.evidence if one.parameter == name] for name in names}

    def estimates(self, test: int) -> dict[str, ParameterEstimate]:
        """Parameters of one test, as its fit.json has them."""
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

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of joint.json: SI, plain types, null for what is not there.

        The covariance is that of shared values, common values of what scatters, and by a law of
        rate of the value at `rate0` and, with ":b", the slope. "specimens" has the correlation of
        what changes from specimen to specimen.
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
        """What makes the result of each test, in any process."""
        others = counted(len(self.tests) - 1, "other test")
        note = f"Fitted together with {others} ({self.study.name}): intervals are those of all."
        pairs = zip(self.problems, self.fit.found.values, strict=True)
        for t, (problem, values) in enumerate(pairs):
            yield partial(fit_of_test, problem, values, self.estimates(t), note, self.study.seed)

    @property
    def statistics(self) -> dict[str, float | int]:
        """Counts and χ² of the whole fit."""
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
