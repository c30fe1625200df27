"""Plan of the next test: folder, text, table, figure and page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.codec import plain
from foamfit.data.measurement import Measurement
from foamfit.data.rig import Candidate, Rig
from foamfit.parts import OfLaw
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.report.folder import Result, write_json, write_text
from foamfit.report.render import own_name, page, sentences, words
from foamfit.results import stamp
from foamfit.springs.model import Model
from foamfit.springs.parameters import unit_of
from foamfit.text import engineering

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RISKY = 0.05  # largest probability of exceeding a limit of an advised test
SHOWN = 3.2  # largest half interval over the scale of a parameter that the figure shows
BEST = 12  # rows of the table of tests on the page
# What plan.json says of a candidate, and the name of it in `Outcome`.
IN_FILE = {"breaks": "breaks", "number_determined": "number", "expected": "expected"}
IN_FILE |= {"peak_force": "force", "quantity_error": "error", "told_apart": "apart"}
SETTINGS = ("drive", "mass", "velocity", "strain", "rate", "cycles", "hold", "interior", "repeat")


@dataclass(frozen=True)
class Expected:
    """What is expected of a parameter: 95 % interval and state."""

    ci95_width: float  #: median width of the interval over the draws, SI; NaN where it is unknown
    state: str
    ci95_width_10_90: tuple[float, float]  #: 10 and 90 % quantiles of the widths
    probability: float  #: with which the parameter is determined
    share: float  #: half the median width, not cut at limits, over the scale of the parameter


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a test would determine, together with the tests at hand."""

    candidate: Candidate
    breaks: float  #: probability that it exceeds a limit of the rig
    expected: dict[str, Expected]
    force: float  #: median of the largest force, N
    error: float | None  #: expected standard error of the quantity asked for, over its value
    apart: dict[str, float]  #: χ² by which it would exclude each rival law

    @property
    def number(self) -> float:
        """Expected number of determined parameters."""
        return sum(one.probability for one in self.expected.values())

    @property
    def determined(self) -> list[str]:
        """Parameters that are probably determined."""
        return [name for name, one in self.expected.items() if one.state == "determined"]

    @property
    def narrowness(self) -> float:
        """Mean logarithm of the expected intervals over the parameters."""
        known = [one.share for one in self.expected.values() if one.share > 0.0]
        return float(np.mean(np.log(known))) if known else np.inf

    @property
    def risky(self) -> bool:
        """Whether it exceeds a limit too probably to be advised."""
        return self.breaks > RISKY

    def chance(self, names: Sequence[str]) -> float:
        """Return the least probability with which one of these parameters is determined."""
        return min((self.expected[name].probability for name in names), default=1.0)

    @property
    def open(self) -> list[str]:
        """Parameters that probably stay open."""
        return [name for name in self.expected if name not in self.determined]


@dataclass(frozen=True)
class Quantity:
    """A quantity that the foam is needed for: its value and standard error over it, as known."""

    text: str
    unit: str
    value: float
    error: float


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Result, OfLaw):
    """The tests that a rig can make, ranked by what they would determine; SI."""

    name: str  #: that of the joint fit, or of the first test at hand
    tests: tuple[Measurement, ...]  #: the tests at hand
    model: str
    relaxation: int
    rig: Rig
    now: dict[str, Expected]  #: what is known now
    outcomes: tuple[Outcome, ...]
    advice: Outcome | None  #: that of the advised test; None if none is safe
    #: the pair of tests that determines most, with what both determine
    pair: tuple[Outcome, Candidate] | None
    never: dict[str, str]  #: parameters that no single test determines, and what would
    #: by striker mass: velocities that reach every branch in half, and in 95 % of the draws
    closing: dict[float, tuple[float, float]]
    quantity: Quantity | None
    rivals: tuple[str, ...]  #: laws of further results, which the test should tell apart
    missed: bool  #: whether the law misses the record by more than the noise
    contradicted: bool  #: whether force, mass and motion of the record disagree as well
    drives: frozenset[str]  #: of the tests at hand
    held: dict[str, float]  #: spring parameters that the user has fixed, SI
    seed: int

    @property
    def not_joined(self) -> str:
        """Why no study can fit the next test together with the tests at hand; "" if one can."""
        for one in self.tests:
            if one.path is None:
                return f"{one.name} has no record"
            if not one.path.is_file():
                return f"the record of {one.name} is not found at {one.path}"
            if one.cycle != min(one.cycles) or one.last_cycle is not None:
                return f"{one.name} was fitted with other cycles; a study reads the first of each"
        return ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The advice: next test, what it will determine, what stays open, and remarks."""
        return sentences("plan", plan=self, advice=self.advice, own=self.own)

    def own(self, names: Sequence[str]) -> list[str]:
        """Return names of parameters, without the spring if there is only one."""
        return [own_name(name, self.model) for name in names]

    _kind = "plan.json"

    def __repr__(self) -> str:
        """Return the advice."""
        return "\n  ".join((f"{self.name}: which test next?", *self.sentences))

    def table(self) -> pd.DataFrame:
        """Return a row for each test: settings, risk, expected number and widths (SI)."""
        import pandas as pd

        rows = []
        for one in self.outcomes:
            row: dict[str, Any] = {key: getattr(one.candidate, key) for key in SETTINGS}
            row |= {"breaks": one.breaks, "determined": one.number, "peak_force": one.force}
            row |= {"error": one.error} if self.quantity else {}
            row |= {f"told apart from {name}": x for name, x in one.apart.items()}
            row |= {f"{name}_ci95_width": x.ci95_width for name, x in one.expected.items()}
            rows.append(row | {f"{name}_state": x.state for name, x in one.expected.items()})
        return pd.DataFrame(rows)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the intervals now and after the advised test; returns the axes."""
        with figures.axes_or_new(ax) as axes:
            draw_intervals(axes, self)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=2)
        return axes

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``plan.json``: SI, plain types, None for missing values."""
        best, content = self.advice, {**stamp(), "tests": [one.name for one in self.tests]}
        content |= {key: getattr(self, key) for key in ("model", "relaxation", "seed")}
        keys = ("determined", "open", "breaks", "expected")
        content["advice"] = best and _asked(best.candidate) | {
            key: getattr(best, key) for key in keys
        }
        content["now"] = self.now
        content["candidates"] = [
            _asked(one.candidate) | {key: getattr(one, name) for key, name in IN_FILE.items()}
            for one in self.outcomes
        ]
        pair = self.pair and [_asked(self.pair[0].candidate), _asked(self.pair[1])]
        content["pair"] = self.pair and {"tests": pair, "determined": self.pair[0].determined}
        closing = self.closing.items()
        ends = [{"mass": mass, "half": half, "sure": sure} for mass, (half, sure) in closing]
        content |= {"never_determined": self.never, "closing_velocity": ends}
        content |= {key: getattr(self, key) for key in ("quantity", "rig", "sentences")}
        return dict(plain(content))

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints."""
        return words("plan_terminal", plan=self)

    def write(self, folder: Path, *, pages: bool = True, width: str = TWO) -> None:
        """Write plan.json, plan.html, plan.png, plan.pdf, next.toml and joint.toml."""
        write_json(folder / "plan.json", self.to_json_dict())
        if self.advice is not None:
            write_text(folder / "next.toml", self.advice.candidate.toml(self.tests[0]))
        if self.advice is not None and not self.not_joined:
            # The folder will have a sibling's place, so relative paths remain valid.
            paths = [os.path.relpath(one.path, folder) for one in self.tests if one.path]
            values = {"files": [*paths, "next.csv"], "read": Model.parse(self.model)}
            write_text(folder / "joint.toml", words("next_study", plan=self, **values) + "\n")
        if pages:
            ranked = sorted(self.outcomes, key=lambda one: (one.risky, -one.number))
            shown: dict[str, Any] = {"plan": self, "best": ranked[:BEST], "risky": RISKY}
            shown["svg"] = figures.write_both(plot_plan(self, width=width), folder / "plan")
            write_text(folder / "plan.html", page("plan", unit_of=unit_of, **shown))


def _asked(one: Candidate) -> dict[str, Any]:
    """Return the settings of a test that apply to it."""
    given = {key: getattr(one, key) for key in SETTINGS}
    given = {key: value for key, value in given.items() if value not in (None, False, 0.0)}
    return given if one.drive == "displacement" else given | {"cycles": 1}


def plot_plan(plan: Plan, *, width: str = TWO) -> Figure:
    """Draw the expected number of determined parameters over all tests, and the intervals."""
    wide = figures.inches(width)
    title = [f"{plan.name}: {plan.law}. Expected by simulation, not measured."]
    title += [] if plan.advice is None else [f"Advised: {plan.advice.candidate}."]
    stacked = wide < 5.0
    tall = (5.8 if stacked else 3.1) + 0.16 * max(len(plan.now) - 8, 0)
    with figures.drawing(wide, tall, *figures.title(width, *title)) as figure:
        left, right = figure.subplots(2, 1) if stacked else figure.subplots(1, 2)
        _map(left, plan)
        draw_intervals(right, plan)
        figures.legend_below(figure, [left, right])
    return figure


def _map(ax: Axes, plan: Plan) -> None:
    """Draw the expected number of determined parameters against the settings of the tests."""
    impact, table = bool(plan.rig.masses), plan.table()
    axes = ("velocity", "mass") if impact else ("rate", "strain")
    single = table[~table["repeat"].astype(bool)]
    # Of several tests with the same settings the best counts; risky ones are hatched.
    best = single.sort_values("determined").groupby([*axes[::-1]]).last()
    count, risk = best["determined"].unstack(), best["breaks"].unstack()
    x, y = count.columns.astype(float).to_list(), count.index.astype(float).to_list()
    style: Any = {"facecolor": "none", "edgecolor": VERMILION, "hatch": "////", "linewidth": 0.0}
    for row, column in np.argwhere(risk.to_numpy() > RISKY):
        ax.fill_between((column - 0.5, column + 0.5), row - 0.5, row + 0.5, **style)
    style = {"cmap": "Blues", "vmin": 0, "vmax": len(plan.now), "origin": "lower"}
    shown = ax.imshow(count, aspect="auto", **style)
    at = plan.advice and [getattr(plan.advice.candidate, name) for name in axes]
    if at and at[0] in x and at[1] in y:
        star: Any = {"color": VERMILION, "ms": 11, "mec": "white", "ls": "none"}
        ax.plot(x.index(at[0]), y.index(at[1]), "*", label="advised test", **star)
    few = np.unique(np.linspace(0, len(x) - 1, 5).astype(int))
    ax.set_xticks(few, [f"{x[column]:.2g}" for column in few])
    ax.set_yticks(range(len(y)), [engineering(1e3 * b, "g") if impact else f"{b:.2g}" for b in y])
    ax.set_ylabel("striker mass" if impact else "largest strain")
    ax.set_xlabel("velocity (m/s)" if impact else "strain rate (1/s)")
    ax.set_title(f"expected number of the {len(plan.now)} parameters determined", fontsize=8)
    ax.figure.colorbar(shown, ax=ax, aspect=30, pad=0.02)


def draw_intervals(ax: Axes, plan: Plan) -> None:
    """Draw the 95 % interval of each parameter over its scale, now and after the advised test."""
    names, best = list(plan.now), plan.advice
    pairs: list[tuple[str, str, dict[str, Expected], float]] = [("now", GREY, plan.now, -0.17)]
    if best is not None:
        pairs.append(("after the advised test (expected)", BLUE, best.expected, 0.17))
    for label, colour, expected, shift in pairs:
        for i, name in enumerate(names):
            one = expected[name]
            unknown = one.state == "not determined" or not one.share < SHOWN
            half = SHOWN if unknown else max(one.share, 0.01)
            style: Any = {"color": colour, "linewidth": 2.6, "solid_capstyle": "butt"}
            style |= {"linestyle": (0, (1, 1)) if unknown else "-"}
            ax.plot([-half, half], [i + shift] * 2, label=f"{'_' * bool(i)}{label}", **style)
    for edge in (-0.5, 0.5):
        ax.axvline(edge, color="black", linewidth=0.5)
    ax.set(yticks=range(len(names)), yticklabels=plan.own(names), ylim=(len(names) - 0.5, -0.5))
    ax.set_xscale("symlog", linthresh=0.1)
    ax.set(xticks=(-3, -0.5, 0, 0.5, 3), xlim=(-SHOWN, SHOWN))
    ax.set_xticklabels(["−300 %", "−50 %", "0", "50 %", "300 %"])
    ax.minorticks_off()
    ax.set_title("95 % interval (dotted: not determined)", fontsize=8)
