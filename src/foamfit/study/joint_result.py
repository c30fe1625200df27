"""The result of a joint fit: joint.json, text, page and figure, and a folder per test."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.api import FitResult
from foamfit.codec import plain
from foamfit.fitting.links import RATES
from foamfit.parts import OfLaw, ParameterEstimate
from foamfit.report import figures
from foamfit.report.figures import TWO
from foamfit.report.folder import Result, brief, write_json, write_result, write_text
from foamfit.report.listing import Row, table_of
from foamfit.report.plots import draw_loops
from foamfit.report.readable import readable, readable_unit
from foamfit.report.render import page, words
from foamfit.report.studies.parameters import Panel, plot_parameters
from foamfit.report.tables import MISFITS, formula, frame, parameters_tex, stacked, symbols
from foamfit.results import Fit, Loop, stamp
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.study.joint_fit import Alternative, JointFit
from foamfit.text import counted, number
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NOT_IN_FILE = ("loops", "fits", "fit")  # fields that joint.json does not contain
MOST_ROWS = 60  # of the table of tests on the terminal
MOST_LOOPS = 48
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


@dataclass(frozen=True, eq=False, repr=False)
class JointResult(Result, OfLaw):
    """The result of a joint fit; the fields are those of joint.json, except the last ones.

    "covariance" is that of shared values, common values of scattering parameters, and for rate laws
    of the values at `rate0` and the slopes (":b"). "specimens" is the correlation of own and
    scattering parameters between specimens.
    """

    _kind = "joint.json"
    name: str  #: Name of the study
    model: str  #: See `Model.name`
    tests: dict[str, JointTest]
    parameters: dict[str, ParameterEstimate]
    relaxation: int = 0
    drive: str | None = None  #: None if the tests have different drives
    seed: int = 0
    rate0: float | None = None  #: Rate of the median test, 1/s
    covariance: dict[str, Any] | None = None
    specimens: dict[str, Any] | None = None
    evidence: tuple[Alternative, ...] = ()
    statistics: dict[str, float | int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)  #: Files, and why they were not used
    status: str = "ok"
    warnings: tuple[str, ...] = ()
    sentences: tuple[str, ...] = ()
    runtime_s: float = math.nan
    loops: tuple[Loop, ...] = ()  #: Measured and fitted loop of each test
    #: Result of each test, or a function that makes it
    fits: tuple[Fit | Callable[[], Fit], ...] = ()
    fit: JointFit | None = None  #: The fit itself; None if the result was read from its folder

    @cached_property
    def results(self) -> dict[str, FitResult]:
        """Result of each test at the joint fit."""
        made = (one if isinstance(one, Fit) else one() for one in self.fits)
        return {name: FitResult(**vars(one)) for name, one in zip(self.tests, made, strict=True)}

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

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the loops of all tests, measured and fitted, into axes or a new figure."""
        return draw_loops(self.loops, ax)

    def table(self) -> pd.DataFrame:
        """Return a row for each test and parameter, in SI; common values have the test "".

        `kind`, `scatter` and `b` are as in joint.json. The output of `to_latex` compiles.
        """
        common = {n: p for n, p in self.parameters.items() if p.kind != "own"}
        more = ("kind", "scatter", "b")
        columns = {key: {n: getattr(p, key) for n, p in common.items()} for key in more}
        frames = {"": frame(common, **columns)}
        for test in self.tests:
            own = {n: p for n, p in self.parameters.items() if p.tests and test in p.tests}
            kinds = {name: p.kind for name, p in own.items()}
            each = {name: p.in_test(test) for name, p in own.items()}
            frames[test] = frame(each, kind=kinds, scatter={}, b={})
        return stacked(frames, "test")

    def __repr__(self) -> str:
        """Return name, model, number of tests, status and the common values."""
        line = f"{self.model} · {counted(len(self.tests), 'test')} together · status {self.status}"
        rows = [readable(name, p) for name, p in self.varied.items()]
        return brief(self.name, line, rows)

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints."""
        every = {n: p for n, p in self.parameters.items() if p.kind != "fixed" or p.value}
        known = [one.misfit for one in self.tests.values()]
        curves = [n for n in MISFITS if any(misfit.get(n) is not None for misfit in known)]
        more: Any = {"parameters": every, "nuisance": NUISANCE, "between": _between}
        return words("joint", found=self, most=MOST_ROWS, curves=curves, readable=readable, **more)

    def write(self, folder: Path, *, pages: bool = True, width: str = TWO) -> None:
        """Write joint.json, its page, its figure, table.tex, and a result folder per test."""
        write_json(folder / "joint.json", self.to_json_dict())
        shown = self.of_springs
        kinds = {name: one.kind for name, one in shown.items()}
        between = {name: _between(one) for name, one in shown.items()}
        write_text(folder / "table.tex", parameters_tex(shown, kinds=kinds, between=between))
        for name, one in self.results.items():
            (folder / name).mkdir()
            write_result(one, folder / name, pages=pages, width=width)
        if pages:
            svg = figures.write_both(plot_joint(self, width=width), folder / "joint")
            write_text(folder / "joint.html", joint_page(self, folder, svg))

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of joint.json: SI units, plain types, null for missing values."""
        model, names = Model.parse(self.model), (one.name for one in fields(self))
        shown = {name: getattr(self, name) for name in names if name not in _NOT_IN_FILE}
        content: dict[str, Any] = plain(stamp() | shown | {"model": model.words, **model.options})
        for one in content["parameters"].values():
            one["state"] = one["state"] or None  # of an own parameter
        return content


def _between(one: ParameterEstimate) -> str:
    """Return a description of the variation of a parameter between the tests."""
    return words("between", one=one)


def joint_page(found: JointResult, folder: Path, figure: bytes) -> str:
    """Return the page in a folder, with its figure (SVG)."""
    varied = {n: p.tests for n, p in found.parameters.items() if p.kind != "fixed" and p.tests}
    rows = [
        Row(
            test,
            misfit=own.misfit,
            parameters={n: found.parameters[n].in_test(test) for n in varied if test in varied[n]},
            more=_more(found, own),
        )
        for test, own in found.tests.items()
    ]
    shown = [(one, readable(name, one), _between(one)) for name, one in found.of_springs.items()]
    told: dict[str, Any] = {"found": found, "figure": figure, "parameters": shown, "rule": RULE}
    return page("joint", table=table_of(rows, folder), **told)


def _more(found: JointResult, own: JointTest) -> dict[str, Any]:
    """Return the cells of a test that only joint fits have: rate, share of χ² and noise."""
    rate = "" if own.rate is None else f"{own.rate:.3g}"
    out = {"rate (1/s)": (rate, ""), "share of χ² (%)": (f"{100 * own.chi2_share:.1f}", "")}
    for curve in MISFITS:
        levels = [one.noise[curve]["sigma"] for one in found.tests.values() if curve in one.noise]
        if curve in own.noise:
            unit = "m" if curve.startswith("displ") else "Pa"
            factor, unit = readable_unit(max(levels), unit)
            level = own.noise[curve]
            note = words("noise", level=level, factor=factor)
            out[f"noise {MISFITS[curve]} ({unit})"] = (number(level["sigma"] / factor), note)
    return out


def plot_joint(found: JointResult, *, width: str = TWO) -> Figure:
    """Draw the loops, and below them the parameters of all tests side by side.

    Tests are sorted by rate if rates differ. At most `MOST_LOOPS` loops are drawn.
    """
    names = _in_order(found)
    loops = {one.name: one for one in found.loops}
    shown = [loops[test]._replace(name=name) for test, name in names.items() if test in loops]
    kept = np.unique(np.linspace(0, max(len(shown) - 1, 0), MOST_LOOPS).astype(int))
    panels = [
        Panel(
            name,
            formula(own),
            {names[t]: one.in_test(t) for t in names if one.tests and t in one.tests},
            joint=one,
        )
        for own, (name, one) in zip(symbols(found.varied), found.varied.items(), strict=True)
    ]
    title = f"{found.name} · {found.model} · {len(names)} tests together"
    above = partial(draw_loops, [shown[i] for i in kept[: len(shown)]]) if shown else None
    return plot_parameters(title, list(names.values()), panels, width=width, above=above)


def _in_order(found: JointResult) -> dict[str, str]:
    """Return the displayed names of the tests; if rates differ, sorted by rate and with the rate.

    Rates differ if a parameter follows a rate law, or by the factor `SEVERAL_RATES`.
    """
    known = [rate for rate in found.rates if rate]
    least = 1.0 if any(one.kind in RATES for one in found.parameters.values()) else SEVERAL_RATES
    all_known = least == 1.0 or len(known) == len(found.tests)
    if found.rate0 is None or not all_known or max(known) <= least * min(known):
        return {test: test for test in found.tests}
    rates = dict(zip(found.tests, found.rates, strict=True))
    tests = sorted(found.tests, key=lambda test: rates[test] or 0.0)
    return {t: t if rates[t] is None else f"{t}, {rates[t]:.2g}/s" for t in tests}
