"""The result of a joint fit: joint.json, sentences, page and figure, and a folder per test."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.api import FitResult
from foamfit.arrays import Array
from foamfit.codec import plain
from foamfit.fitting.search import SearchRecord
from foamfit.fitting.together import Together
from foamfit.options import RATES
from foamfit.parts import OfLaw, ParameterEstimate
from foamfit.report import figures, render
from foamfit.report.folder import Result, brief, write_json, write_result, write_text
from foamfit.report.listing import Row, table_of
from foamfit.report.plots import Values, draw_loops, plot_parameters
from foamfit.report.render import MISFITS, Readable, formula, parameters_tex, readable, symbols
from foamfit.results import Loop, stamp
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.study.joint_fit import LARGEST, JointFit, parameters_of
from foamfit.study.study_file import Study
from foamfit.text import ASKED, counted, number, readable_unit
from foamfit.trust.best_point import BestPoint
from foamfit.trust.checklist import misfits_of, status_of, warnings_of
from foamfit.trust.conclude import conclude
from foamfit.trust.covariance import RULE, Ends

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INPUT = ("velocity", "impulse", "input")  # those about the record, contradictions first
_OF_A_SEARCH = ("ended", "agree")  # items of the checklist that apply only to a search
# More than this share of χ², and this multiple of its share of samples, make a test dominant.
DOMINANT, MORE = 0.5, 2.0
# Least share of χ² that the scale of one test's force takes away if it is named; the next one takes
# away less by the factor `MORE`. A step to first order says nothing of a scale further from 1.
SCALED, FURTHEST = 0.3, 2.0
MOST_ROWS = 60  # of the table of tests on the terminal
SEVERAL_RATES = 1.5  # ratio of rates; those of nominally equal tests differ by a few percent


@dataclass(frozen=True)
class JointTest:
    """One test of a joint fit, as in joint.json; older versions wrote fewer fields."""

    __test__ = False  # for pytest: this is not a test class

    file: str = ""
    drive: str = ""
    rate: float | None = None  #: Mean strain rate on loading, 1/s
    misfit: dict[str, float | None] = field(default_factory=dict)
    chi2_share: float = math.nan  #: Share in χ² of all tests
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)  #: Determines the weights
    n_data: int = 0
    data_sha256: str = ""
    values: dict[str, float] = field(default_factory=dict)  #: Of the parameters, SI


@dataclass(frozen=True)
class Alternative:
    """A joint fit with one kind of a parameter, as evidence for this kind."""

    parameter: str
    kind: str
    chosen: bool
    bic: float
    n_vary: int
    chi2: float


@dataclass(frozen=True, eq=False, repr=False)
class JointResult(Result, OfLaw):
    """The result of a joint fit; the fields are those of joint.json, except the last ones."""

    _kind = "joint.json"
    name: str  #: Name of the study
    model: str  #: See `Model.name`
    tests: dict[str, JointTest]
    parameters: dict[str, ParameterEstimate]
    relaxation: int = 0
    drive: str | None = None  #: None if the tests have different drives
    seed: int = 0
    rate0: float | None = None  #: Rate of the median test, 1/s
    #: Of shared and common values, and for rate laws of values at `rate0` and slopes (":b")
    covariance: dict[str, Any] | None = None
    #: Correlation of own and scattering parameters between specimens
    specimens: dict[str, Any] | None = None
    evidence: tuple[Alternative, ...] = ()
    statistics: dict[str, float | int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  #: Files, and why they were not used
    status: str = "ok"
    warnings: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()
    runtime_s: float = math.nan
    results: dict[str, FitResult] = field(default_factory=dict)  #: Of each test
    fit: JointFit | None = None  #: The fit itself; None if the result was read from its folder

    @property
    def loops(self) -> dict[str, Loop]:
        """Measured and fitted loop of the tests that have one."""
        loops = {name: one.loop for name, one in self.results.items()}
        return {name: loop._replace(name=name) for name, loop in loops.items() if loop is not None}

    @property
    def rates(self) -> tuple[float | None, ...]:
        """Mean strain rate on loading of each test, 1/s."""
        return tuple(one.rate for one in self.tests.values())

    @property
    def varied(self) -> dict[str, ParameterEstimate]:
        """Parameters of the springs except those that are fixed."""
        return {n: p for n, p in self.of_springs.items() if p.kind != "fixed"}

    @property
    def of_springs(self) -> dict[str, ParameterEstimate]:
        """Parameters of the springs except those fixed at zero."""
        every = self.parameters.items()
        return {n: p for n, p in every if n not in NUISANCE and (p.kind != "fixed" or p.value)}

    def of_test(self, test: str) -> dict[str, ParameterEstimate]:
        """Return the parameters that may differ between tests, in one of them."""
        every = self.parameters.items()
        return {name: one.in_test(test) for name, one in every if test in (one.tests or {})}

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the loops of all tests, measured and fitted, into axes or a new figure."""
        return draw_loops(self.loops.values(), ax)

    def table(self) -> pd.DataFrame:
        """Return a row for each test and parameter, in SI; common values have the test "".

        `kind`, `scatter` and `b` are as in joint.json. The output of `to_latex` compiles.
        """
        common = {n: p for n, p in self.parameters.items() if p.kind != "own"}
        more = ("kind", "scatter", "b")
        columns = {key: {n: getattr(p, key) for n, p in common.items()} for key in more}
        frames = {"": render.frame(common, **columns)}
        for test in self.tests:
            own = self.of_test(test)
            kinds = {name: self.parameters[name].kind for name in own}
            frames[test] = render.frame(own, kind=kinds, scatter={}, b={})
        return render.stacked(frames, "test")

    def __repr__(self) -> str:
        """Return name, model, number of tests, status and the common values."""
        line = f"{self.law} · {counted(len(self.tests), 'test')} together · status {self.status}"
        rows = [readable(name, p) for name, p in self.varied.items()]
        return brief(self.name, line, rows)

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints."""
        every = {n: p for n, p in self.parameters.items() if p.kind != "fixed" or p.value}
        known = [one.misfit for one in self.tests.values()]
        curves = [n for n in MISFITS if any(misfit.get(n) is not None for misfit in known)]
        more: Any = {"parameters": every, "nuisance": NUISANCE, "shown": _shown}
        return render.words("joint", found=self, most=MOST_ROWS, curves=curves, **more)

    def write(self, folder: Path, *, pages: bool = True, width: str = figures.TWO) -> None:
        """Write joint.json, its page, its figure, table.tex, and a result folder per test."""
        write_json(folder / "joint.json", self.to_json_dict())
        shown = self.of_springs
        kinds = {name: one.kind for name, one in shown.items()}
        between = {name: render.words("between", one=one) for name, one in shown.items()}
        write_text(folder / "table.tex", parameters_tex(shown, kinds=kinds, between=between))
        for name, one in self.results.items():
            (folder / name).mkdir()
            write_result(one, folder / name, pages=pages, width=width)
        if pages:
            svg = figures.write_both(plot_joint(self, width=width), folder / "joint")
            write_text(folder / "joint.html", joint_page(self, folder, svg))

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of joint.json: SI units, plain types, null for missing values."""
        model, names = Model.parse(self.model), [one.name for one in fields(self)]
        shown = {name: getattr(self, name) for name in names if name not in ("results", "fit")}
        content: dict[str, Any] = plain(stamp() | shown | {"model": model.words, **model.options})
        for one in content["parameters"].values():
            one["state"] = one["state"] or None  # of an own parameter
        return content


def _shown(name: str, one: ParameterEstimate) -> Readable:
    """Return a parameter in readable form; the range of an own one is that of its values."""
    if one.kind == "own" and one.tests:
        values = [own.value for own in one.tests.values()]
        one = replace(one, range=(min(values), max(values)))
    return readable(name, one)


def joint_page(found: JointResult, folder: Path, figure: bytes) -> str:
    """Return the page in a folder, with its figure (SVG)."""
    rows = [
        Row(test, misfit=own.misfit, parameters=found.of_test(test), more=_more(found, own))
        for test, own in found.tests.items()
    ]
    every = found.of_springs.items()
    shown = [(one, readable(name, one), render.words("between", one=one)) for name, one in every]
    told: dict[str, Any] = {"found": found, "figure": figure, "parameters": shown, "rule": RULE}
    return render.page("joint", table=table_of(rows, folder), **told)


def _more(found: JointResult, own: JointTest) -> dict[str, Any]:
    """Return the cells of a test that only joint fits have: rate, share of χ² and noise."""
    rate = "" if own.rate is None else f"{own.rate:.3g}"
    out = {"rate (1/s)": (rate, ""), "share of χ² (%)": (f"{100 * own.chi2_share:.1f}", "")}
    for curve in MISFITS:
        levels = [one.noise[curve]["sigma"] for one in found.tests.values() if curve in one.noise]
        if (level := own.noise.get(curve)) is not None:
            unit = "m" if curve.startswith("displ") else "Pa"
            factor, unit = readable_unit(max(levels), unit)
            note = render.words("noise", level=level, factor=factor)
            out[f"noise {MISFITS[curve]} ({unit})"] = (number(level["sigma"] / factor), note)
    return out


def plot_joint(found: JointResult, *, width: str = figures.TWO) -> Figure:
    """Draw the loops, and below them the parameters of all tests; see `plot_parameters`."""
    names, every = _in_order(found), found.loops
    loops = [every[test]._replace(name=name) for test, name in names.items() if test in every]
    panels = list[Values]()
    for name, own in symbols(found.varied).items():
        one = found.parameters[name]
        each = {names[t]: one.in_test(t) for t in names if t in (one.tests or {})}
        panels.append(Values(name, formula(own), each, joint=one))
    title = f"{found.name} · {found.law} · {len(names)} tests together"
    return plot_parameters(title, list(names.values()), panels, width=width, loops=loops)


def _in_order(found: JointResult) -> dict[str, str]:
    """Return the displayed names of the tests; if rates differ, sorted by rate and with it."""
    rates = {test: one.rate or 0.0 for test, one in found.tests.items()}
    law = any(one.kind in RATES for one in found.parameters.values())
    if not law and not 0.0 < SEVERAL_RATES * min(rates.values()) < max(rates.values()):
        return {test: test for test in found.tests}
    tests = sorted(rates, key=rates.__getitem__)
    return {t: f"{t}, {rates[t]:.2g}/s" if rates[t] else t for t in tests}


def fit_of_test(
    best: BestPoint, joint: Mapping[str, ParameterEstimate], test: str, note: str, seed: int
) -> FitResult:
    """Return the result of a test in a joint fit; `systematic` is from this test alone."""
    best.problem.put(best.values)
    alone = conclude(best, SearchRecord(seed, 0, time.perf_counter()))
    checks = tuple(check for check in alone.checklist if check.key not in _OF_A_SEARCH)
    verdict: Any = {"status": status_of(checks), "warnings": warnings_of(checks), "budget": None}
    own = dict(alone.parameters)
    for name in best.problem.free():
        one, kept = joint[name].in_test(test), own[name]
        method, systematic = one.ci95 and "local covariance", kept.systematic
        own[name] = replace(one, value=kept.value, ci95_method=method, systematic=systematic)
    notes = (note, *alone.notes)
    made = replace(alone, parameters=own, notes=notes, checklist=checks, **verdict)
    return FitResult(**vars(made))


def result_of(
    study: Study,
    tests: Mapping[str, Path],
    rates: Sequence[float | None],
    fit: JointFit,
    alone: Together,  # the separate fits
    slopes: Mapping[str, float],  # those of `joint.evidence`
    **about: Any,  # further fields of the result
) -> JointResult:
    """Return the result of a joint fit of `tests` (names and files) at these rates (1/s)."""
    found, parameters = fit.found, parameters_of(fit, tuple(tests))
    total = float(np.sum(found.costs))
    shares = np.divide(found.costs, total) if total else np.full(len(tests), 1.0 / len(tests))
    others = counted(len(tests) - 1, "other test")
    note = f"Fitted together with {others} ({study.name}): intervals use all of them."
    of_tests, results = dict[str, JointTest](), dict[str, FitResult]()
    every = zip(tests.items(), rates, fit.point.bests, shares.tolist(), strict=True)
    for (name, file), rate, best, share in every:
        results[name] = one = fit_of_test(best, parameters, name, note, study.seed)
        of_tests[name] = JointTest(
            file=str(file),
            drive=one.drive,
            rate=rate,
            misfit=one.misfit,
            chi2_share=share,
            noise=one.noise,
            n_data=best.problem.objective.n_data,
            data_sha256=one.measurement.data_sha256,
            values={n: p.value for n, p in one.parameters.items()},
        )
    drives = {one.drive for one in of_tests.values()}
    result = JointResult(
        **{name: getattr(study, name) for name in ("name", "model", "relaxation", "seed")},
        drive=drives.pop() if len(drives) == 1 else None,
        tests=of_tests,
        parameters=parameters,
        covariance={"names": fit.point.names, "matrix": _common_covariance(fit)},
        specimens={"names": fit.correlation[0], "correlation": fit.correlation[1]},
        statistics={
            "n_data": found.n_data,
            "n_vary": found.n_vary,
            "chisqr": found.cost,
            "redchi": found.cost / max(found.n_data - found.n_vary, 1),
            "n_effective": fit.point.uncertainty.covariance.effective,
            "n_eff": alone.n_eff,
            "bic": found.bic(alone.n_eff),
            "bic_alone": alone.bic(alone.n_eff),
        },
        results=results,
        fit=fit,
        **about,
    )
    return _with_words(result, fit, alone, slopes)


def _common_covariance(fit: JointFit) -> Array:
    """Return the covariance of common values and slopes, SI; see `JointResult`."""
    point, count = fit.point, len(fit.point.names)
    scales = np.ones(count)
    for i, name in enumerate(point.names):
        if fit.found.links.kind(name) == "scatter":
            spread, error = fit.spreads.get(name), point.of_common(name)[0]
            scales[i] = math.exp(min(spread.mean, LARGEST)) if spread else fit.found.common[name][0]
            scales[i] *= spread.stderr / error if spread and error > 0.0 else 1.0
    matrix = point.uncertainty.covariance.matrix[:count, :count]
    return np.asarray(matrix * np.outer(scales, scales))


def _with_words(
    result: JointResult, fit: JointFit, alone: Together, open_slopes: Mapping[str, float]
) -> JointResult:
    """Return a joint fit with its status, warnings and sentences."""
    lost, large, missed = list[str](), list[Any](), list[float]()
    doubts = dict[str, list[str]]()  # tests by their warnings about probable errors in the input
    every = zip(result.tests.items(), fit.point.bests, fit.point.errors, strict=True)
    for (test, one), best, errors in every:
        objective = best.problem.objective
        pairs = zip(objective.counted, errors, strict=True)
        shares = [error.law / objective.span(curve) for curve, error in pairs if error.found]
        missed += [max(shares)] if shares else []
        followed = misfits_of(best, one.misfit)
        lost += [test] * any(curve["lost"] for curve in followed)
        large += [(test, curve["name"], curve["off"]) for curve in followed if curve["poor"]]
    fits = result.results.items()
    checks = [(check, test) for test, fit in fits for check in fit.checklist if check.key in _INPUT]
    for check, test in sorted(checks, key=lambda pair: _INPUT.index(pair[0].key)):
        for warning in check.warnings:
            doubts.setdefault(warning.removeprefix(ASKED).strip(), []).append(test)
    rates = [rate for rate in result.rates if rate is not None]
    first, top = max(result.tests.items(), key=lambda pair: pair[1].chi2_share)
    slopes = [(name, result.parameters[name].kind, half) for name, half in open_slopes.items()]
    told: dict[str, Any] = {"result": result, "laws": RATES, "slopes": slopes, "lost": lost}
    told |= {"large": large, "doubts": doubts, "missed": missed}
    told |= {"rates": f"{min(rates):.3g} to {max(rates):.3g} 1/s" if rates else ""}
    told |= {"top": (first, top), "dominant": max(DOMINANT, MORE * top.n_data / fit.found.n_data)}
    told |= {"together": _span_of(fit.found.misfits), "alone": _span_of(alone.misfits)}
    told |= {"n_vary": fit.found.n_vary, "scaled": _scaled(result, fit)}
    warnings = render.sentences("joint_warnings", **told)
    status = "failed" if lost else "warnings" if warnings else "ok"
    said = render.sentences("joint_sentences", **told)
    return replace(result, status=status, warnings=warnings, sentences=said)


def _scaled(result: JointResult, fit: JointFit) -> tuple[str, float, float] | None:
    """Return the test whose scale of the force departs clearly most, the factor and its gain."""
    scales = [(*fit.point.scale(t)[::-1], name) for t, name in enumerate(result.tests)]
    (gain, factor, test), (second, *_) = sorted(scales, reverse=True)[:2]
    clear = fit.point.uncertainty.errs and gain > SCALED and gain > MORE * second
    return (test, factor, gain) if clear and 1.0 / FURTHEST < factor < FURTHEST else None


def _span_of(found: Sequence[dict[str, float | None]]) -> Ends | None:
    """Return smallest and largest misfit of some fits, of the loop or else of a time curve."""
    names = ("stress_strain", "stress_time", "displacement_time")
    each = (next((fit[n] for n in names if fit.get(n) is not None), None) for fit in found)
    misfits = [misfit for misfit in each if misfit is not None]
    return (min(misfits), max(misfits)) if misfits else None
