"""Plan of the next test: folder, text, table, figure and page."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.data.measurement import Measurement
from foamfit.data.rig import Candidate, Rig
from foamfit.report import figures
from foamfit.report import folder as results
from foamfit.report.figures import TWO
from foamfit.report.readable import own_name
from foamfit.report.render import page, sentences, words
from foamfit.report.studies.plan_figure import draw_intervals, plot_plan
from foamfit.results import law_in_words, plain
from foamfit.springs.model import Model
from foamfit.springs.parameters import unit_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

SCHEMA = 1
RISKY = 0.05  # largest probability of exceeding a limit of an advised test
BEST = 12  # rows of the table of tests on the page


@dataclass(frozen=True)
class Expected:
    """What is expected of a parameter: 95 % interval and state.

    `width` is the median width of the interval over the draws (SI; NaN where it is unknown), and
    `ends` their 10 and 90 % quantiles. `share` is half of it over the scale of the parameter, and
    `chance` the probability that the parameter is determined.
    """

    width: float
    ends: tuple[float, float]
    share: float
    state: str
    chance: float

    def capped(self) -> Expected:
        """Return the same, but not determined."""
        state = "weak" if self.state == "determined" else self.state
        return replace(self, state=state, chance=0.0)


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
        return sum(one.chance for one in self.expected.values())

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
        return min((self.expected[name].chance for name in names), default=1.0)

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


@dataclass(frozen=True, eq=False)
class Plan:
    """The tests that a rig can make, ranked by what they would determine; SI."""

    tests: tuple[Measurement, ...]  #: the tests at hand
    model: str
    relaxation: int
    rig: Rig
    now: dict[str, Expected]  #: what is known now
    outcomes: tuple[Outcome, ...]
    advised: int | None  #: place of the advised test in `outcomes`; None if none is safe
    #: the pair of tests that determines most, with what both determine
    pair: tuple[Outcome, Candidate] | None
    never: dict[str, str]  #: parameters that no test of this rig determines, and what would
    #: by striker mass: velocities that reach every branch in half, and in 95 % of the draws
    closing: dict[float, tuple[float, float]]
    quantity: Quantity | None
    rivals: tuple[str, ...]  #: laws of further results, which the test should tell apart
    missed: bool  #: whether the law misses the record by more than the noise
    #: whether force, mass and motion of the record contradict each other as well; an impact of the
    #: same rig then determines nothing
    contradicted: bool
    seed: int

    @property
    def advice(self) -> Outcome | None:
        """The advised test."""
        return None if self.advised is None else self.outcomes[self.advised]

    @property
    def name(self) -> str:
        """Name of the first test at hand."""
        return self.tests[0].name

    @property
    def law(self) -> str:
        """The model and its relaxation in words."""
        return law_in_words(self.model, self.relaxation)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The advice: next test, what it will determine, what stays open, and remarks."""
        return sentences("plan", plan=self, advice=self.advice, own=self.own)

    def own(self, names: Sequence[str]) -> list[str]:
        """Return names of parameters, without the spring if there is only one."""
        return [own_name(name, self.model) for name in names]

    def __repr__(self) -> str:
        """Return the advice."""
        return "\n  ".join((f"{self.name}: which test next?", *self.sentences))

    def _repr_html_(self) -> str:
        lines = "".join(f"<li>{line}</li>" for line in self.sentences)
        return f"<p><b>{self.name}: which test next?</b></p><ul>{lines}</ul>"

    def table(self) -> pd.DataFrame:
        """Return a row for each test: settings, risk, expected number and widths (SI)."""
        import pandas as pd

        rows = []
        for one in self.outcomes:
            asked = one.candidate
            row: dict[str, Any] = {key: getattr(asked, key) for key in SETTINGS}
            row |= {"breaks": one.breaks, "determined": one.number, "peak_force": one.force}
            row |= {"error": one.error} if self.quantity else {}
            row |= {f"told apart from {name}": x for name, x in one.apart.items()}
            row |= {f"{name}_ci95_width": x.width for name, x in one.expected.items()}
            rows.append(row | {f"{name}_state": x.state for name, x in one.expected.items()})
        return pd.DataFrame(rows)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the intervals now and after the advised test; returns the axes."""
        with figures.axes_or_new(ax) as axes:
            draw_intervals(axes, self)
        return axes

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of ``plan.json``: SI, plain types, None for missing values."""
        best = self.advice
        pair = self.pair and [_asked(self.pair[0].candidate), _asked(self.pair[1])]
        content: dict[str, Any] = plain({
            "schema": SCHEMA,
            "foamfit": version("foamfit"),
            "tests": [one.name for one in self.tests],
            "model": self.model,
            "relaxation": self.relaxation,
            "seed": self.seed,
            "advice": best and _asked(best.candidate) | {
                "determined": best.determined, "open": best.open, "breaks": best.breaks,
                "expected": _shown(best.expected),
            },
            "now": _shown(self.now),
            "candidates": [
                _asked(one.candidate) | {
                    "breaks": one.breaks, "number_determined": one.number,
                    "expected": _shown(one.expected), "peak_force": one.force,
                    "quantity_error": one.error, "told_apart": one.apart,
                }
                for one in self.outcomes
            ],
            "pair": pair and {"tests": pair, "determined": self.pair and self.pair[0].determined},
            "never_determined": self.never,
            "closing_velocity": [
                {"mass": mass, "half": ends[0], "sure": ends[1]}
                for mass, ends in self.closing.items()
            ],
            "quantity": self.quantity,
            "rig": self.rig,
            "sentences": self.sentences,
        })  # fmt: skip
        return content

    def save(self, folder: str | Path, *, report: bool = True, figure_width: str = TWO) -> Path:
        """Write plan.json, plan.html, plan.png, plan.pdf, next.toml and joint.toml; return it.

        A complete new plan replaces an older one. Without `report` there are no figure and no page.
        """
        figures.inches(figure_width)  # rejects an invalid width

        def write(fresh: Path) -> None:
            results.write_json(fresh / "plan.json", self.to_json_dict())
            if self.advice is not None:
                results.write_text(fresh / "next.toml", self.advice.candidate.toml(self.tests[0]))
                results.write_text(fresh / "joint.toml", self._study(Path(folder)))
            if report:
                svg = figures.write_both(plot_plan(self, width=figure_width), fresh / "plan")
                results.write_text(fresh / "plan.html", self._page(svg))

        results.check_target(folder, of="plan.json")
        return results.save_whole(folder, write)

    def _study(self, folder: Path) -> str:
        """Return joint.toml, the study of the tests at hand and the next one."""
        files = [os.path.relpath(one.path, folder) for one in self.tests if one.path is not None]
        values = {"files": [*files, "next.csv"], "read": Model.parse(self.model)}
        return words("next_study", plan=self, folder=folder, **values) + "\n"

    def _page(self, svg: bytes) -> str:
        """Return plan.html."""
        ranked = sorted(self.outcomes, key=lambda one: (one.risky, -one.number))
        return page("plan", plan=self, svg=svg, best=ranked[:BEST], risky=RISKY, unit_of=unit_of)


SETTINGS = ("drive", "mass", "velocity", "strain", "rate", "cycles", "hold", "interior", "repeat")


def _asked(one: Candidate) -> dict[str, Any]:
    """Return the settings of a test that apply to it."""
    given = {key: getattr(one, key) for key in SETTINGS}
    given = {key: value for key, value in given.items() if value not in (None, False, 0.0)}
    return given if one.drive == "displacement" else given | {"cycles": 1}


def _shown(expected: dict[str, Expected]) -> dict[str, dict[str, Any]]:
    """Return expected intervals for plan.json."""
    return {
        name: {
            "ci95_width": one.width,
            "state": one.state,
            "ci95_width_10_90": one.ends,
            "probability": one.chance,
        }
        for name, one in expected.items()
    }


def plan_text(plan: Plan) -> str:
    """Return the text that the command prints."""
    return words("plan_terminal", plan=plan)
