"""Fitted parameters beside the published ones, or beside those of another fit.

Everything is shown as the paper's tables show it: stiffness of branch a in MPa, the other slopes as
ratios to it, the stress drop as a ratio to σ_a.
"""

from __future__ import annotations

import itertools
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from foamfit.codec import build, reading
from foamfit.errors import InputError
from foamfit.files import csv_bytes, write_file
from foamfit.report import figures
from foamfit.report.figures import BLUE, GREY, TWO, VERMILION
from foamfit.report.folder import load_result
from foamfit.report.readable import readable
from foamfit.report.render import sentences, words
from foamfit.results import Fit, ParameterEstimate, law_in_words
from foamfit.springs.laws import law
from foamfit.springs.laws.record import ETA, RELAXATION_TIME, STRENGTH, Compared, Param
from foamfit.springs.model import Model
from foamfit.springs.published import PublishedSet
from foamfit.springs.published import published as published_sets
from foamfit.text import signed, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Result = Fit | Mapping[str, Any] | str | Path

MARKS = ((BLUE, "o"), (VERMILION, "s"), ("black", "^"), (GREY, "D"))  # of the results
NOTHING = 3.0  # standard error over value beyond which a difference is meaningless
WORST_FIRST = ("not determined", "weak", "determined", "fixed")
VAGUE = "its standard error is many times its value, so the test does not determine it"


@dataclass(frozen=True)
class Row:
    """One parameter in the paper's unit ("k_h+/k0", "" or "k0", "MPa"), and its reference.

    `spring` is 1 at the base, 0 for what belongs to the chain; the state of a ratio is the worst of
    its parts. A published `reference` has no standard error. `remark` says why the two are not
    compared; it is "" where they are.
    """

    spring: int
    name: str
    unit: str
    value: float | None
    stderr: float | None
    state: str
    reference: float | None
    reference_stderr: float | None
    remark: str

    @property
    def label(self) -> str:
        """Name with its spring, for example "s2 k0"."""
        return f"s{self.spring} {self.name}" if self.spring else self.name

    @property
    def lost(self) -> bool:
        """Whether there is a reference, but the test does not determine the parameter."""
        nothing = self.state == "not determined" or self.remark == VAGUE
        return nothing and self.reference is not None

    def difference_over(self, unit: float) -> float | None:
        """Fitted minus reference over a unit; None where it means nothing."""
        if self.remark or self.value is None or self.reference is None or not unit:
            return None
        return (self.value - self.reference) / unit

    @property
    def percent(self) -> float | None:
        """The difference in percent of the reference."""
        return self.difference_over(abs(self.reference or 0.0) / 100.0)

    @property
    def spread(self) -> float:
        """Standard error of the difference, those of both sides taken as independent."""
        return math.hypot(self.stderr or 0.0, self.reference_stderr or 0.0)

    @property
    def standard_errors(self) -> float | None:
        """The difference in standard errors."""
        return self.difference_over(self.spread)

    @property
    def is_shown(self) -> bool:
        """Whether a figure has something to show of it."""
        return self.standard_errors is not None or self.lost


@dataclass(frozen=True)
class Pair:
    """One result beside its reference."""

    test: str
    model: str
    drive: str
    status: str
    reference: str
    rows: tuple[Row, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """Results beside the published sets that they belong to, or beside the first of them."""

    pairs: tuple[Pair, ...]
    with_published: bool


def compare(results: Sequence[Result], published: str | None = None) -> Comparison:
    """Put fits, result folders or what `load_result` gives beside what was published.

    Without `published`, each goes beside the set that its test names, for example "foam-1/model-3";
    where a test names none, all are put beside the first of them. InputError if a result cannot be
    read, the set is unknown, or there is nothing to compare with.
    """
    if published is not None:
        published_side(published)  # refuses one that is not there
    sides = [side_of(result) for result in results]
    if not sides:
        raise InputError("nothing to compare; give at least one result folder")
    belongs = [published or (None if _unpublished(s) else recognised(s.test)) for s in sides]
    found = [published_side(name) for name in belongs if name is not None]
    if len(found) == len(sides):
        pairs = zip(sides, found, strict=True)
        return Comparison(tuple(_pair(one, other) for one, other in pairs), with_published=True)
    if len(sides) == 1:
        kind = _unpublished(sides[0])
        raise InputError(
            f"no published set has {kind} springs; give a second result to compare with"
            if kind
            else f"the test '{sides[0].test}' names no published set; choose one by --published "
            f"({', '.join(published_sets)}), or give a second result"
        )
    return Comparison(tuple(_pair(side, sides[0]) for side in sides[1:]), with_published=False)


def recognised(test: str) -> str | None:
    """Return the published set that the name of a test contains, if there is one."""

    def plain(text: str) -> str:
        return re.sub(r"[\s/_-]+", "-", text.casefold())

    for name in sorted(published_sets, key=len, reverse=True):
        if re.search(rf"(?<![a-z0-9]){plain(name)}(?![0-9a-z])", plain(test)):
            return name
    return None


# ---------------------------------------------------------------- the sides


@dataclass(frozen=True)
class Side:
    """The parameters of one side of a comparison: of a fit, or published."""

    label: str
    kinds: tuple[str, ...]
    estimates: Mapping[str, ParameterEstimate]
    correlation: Mapping[tuple[str, str], float]
    drive: str = ""
    status: str = ""
    stopped: str | None = None
    test: str = ""
    sha: str = ""
    source: PublishedSet | None = None
    relaxation: int = 0  # terms of each hysteretic spring


def side_of(result: Result) -> Side:
    """Return the parameters of a fit; InputError if the result is not whole."""
    given: Mapping[str, Any]
    if isinstance(result, Fit):
        given = result.to_json_dict()
    else:
        given = result if isinstance(result, Mapping) else load_result(result)
    with reading(str(result) if isinstance(result, str | Path) else "the result"):
        model, drive = Model.of_result(given), str(given["drive"])
        found = given.get("correlation") or {"names": (), "matrix": ()}
        pairs = itertools.product(found["names"], repeat=2)
        flat = zip(pairs, itertools.chain(*found["matrix"]), strict=True)
        law_name = law_in_words(model.name, model.relaxation)
        return Side(
            label=f"{given['test']}: {law_name}, {drive} drive",
            kinds=model.kinds,
            relaxation=model.relaxation,
            estimates={n: build(ParameterEstimate, p, {}) for n, p in given["parameters"].items()},
            correlation={pair: float(value) for pair, value in flat if value is not None},
            drive=drive,
            status=given["status"],
            stopped=given.get("stopped"),
            test=given["test"],
            sha=str(given.get("data_sha256", "")),
        )


def published_side(name: str) -> Side:
    """Return the parameters of a published set; InputError if the name is unknown."""
    if name not in published_sets:
        known = ", ".join(published_sets)
        raise InputError(f"there is no published set '{name}'; there are {known}")
    item = published_sets[name]
    values = {} if item.eta is None else {"site_eta": item.eta}
    for i, spring in enumerate(item.chain.springs, start=1):
        values |= {f"s{i}_{name}": getattr(spring, name) for name in spring.law.own}
        values[f"s{i}_height"] = item.chain.heights[i - 1]
    estimates = {
        name: ParameterEstimate(value, None, None, "", False, "published", "")
        for name, value in values.items()
    }
    kinds = tuple(spring.law.kind for spring in item.chain.springs)
    return Side(f"published {name}", kinds, estimates, {}, source=item)


def _unpublished(side: Side) -> str:
    """Return the first kind of spring that has no published parameters, or ""."""
    laws = map(law, side.kinds)
    return next((one.kind for one in laws if one.hysteretic and not one.published), "")


# ---------------------------------------------------------------- the quantities of the tables


def _total(*parts: Any) -> Any:
    return sum(parts)


def _quantities(kind: str, relaxation: int) -> Iterator[Compared]:
    """Give the rows of a kind of spring."""
    yield from law(kind).compared or map(_as_it_is, law(kind).params)
    for k in range(1, relaxation + 1) if law(kind).hysteretic else ():
        for param in (STRENGTH, RELAXATION_TIME):
            yield Compared(f"{param.symbol[0]}_{k}", param.unit, (f"{param.name}{k}",), _total)


def _as_it_is(param: Param) -> Compared:
    factor, unit = (1e6, "MPa") if param.unit == "Pa" else (1.0, param.unit)
    label = "_".join(filter(None, param.symbol)) or param.name
    return Compared(label, unit, (param.name,), lambda value: value / factor)


class _Value(NamedTuple):
    value: float | None = None
    stderr: float | None = None
    state: str = ""
    why: str = ""


def _evaluate(side: Side, names: Sequence[str], formula: Callable[..., Any]) -> _Value | None:
    """Return a function of parameters with its error; None where a side lacks a parameter."""
    if not names or any(name not in side.estimates for name in names):
        return None
    parts = [side.estimates[name] for name in names]
    at = np.array([part.value for part in parts])
    try:
        value = float(formula(*at.tolist()))
    except (ZeroDivisionError, ValueError):
        return None
    rank = {state: i for i, state in enumerate(WORST_FIRST)}
    worst = min(parts, key=lambda part: rank.get(part.state, len(rank)))
    if not any(part.stderr for part in parts) or worst.state == "not determined":
        return _Value(value, None, worst.state, worst.why)
    # Derivatives by a complex step: exact, and the formula is written once.
    slopes = [formula(*(at + 1e-30j * row)).imag / 1e-30 for row in np.eye(len(parts))]
    errors = np.array(slopes) * [part.stderr or 0.0 for part in parts]
    known = [[side.correlation.get((a, b), float(a == b)) for b in names] for a in names]
    np.fill_diagonal(correlation := np.array(known), 1.0)
    variance = float(errors @ correlation @ errors)
    return _Value(value, math.sqrt(max(variance, 0.0)) or None, worst.state, worst.why)


# ---------------------------------------------------------------- one result, row by row


def _pair(side: Side, other: Side) -> Pair:
    nothing = _incomparable(side, other)
    rows = (*_spring_rows(side, other, nothing), *_damping_rows(side, other, nothing))
    ratios = any("/" in row.name for row in rows)
    remarks = sentences("remarks", side=side, other=other, nothing=nothing, ratios=ratios)
    status = f"{side.status}, stopped by {side.stopped}" if side.stopped else side.status
    model = law_in_words("+".join(side.kinds), side.relaxation)
    return Pair(side.test, model, side.drive, status, other.label, rows, remarks)


def _incomparable(side: Side, other: Side) -> str:
    """Return why no parameter can be compared, "" if some can."""
    unpublished = _unpublished(side) if other.source is not None else ""
    differ = [*map(_family, side.kinds)] != [*map(_family, other.kinds)]
    return words("incomparable", side=side, other=other, unpublished=unpublished, differ=differ)


def _family(kind: str) -> str:
    return kind if law(kind).hysteretic else "linear"


def _spring_rows(side: Side, other: Side, nothing: str) -> Iterator[Row]:
    several = len(side.kinds) > 1
    for i, kind in enumerate(side.kinds, start=1):
        alike = i <= len(other.kinds) and _family(other.kinds[i - 1]) == _family(kind)
        for quantity in _quantities(kind, side.relaxation):
            eta = quantity.of == (ETA.name,)
            if eta and not several:
                continue  # of one spring, it stands with the onsite damper
            names = [f"s{i}_{part}" for part in quantity.of]
            value = _evaluate(side, names, quantity.formula)
            reference = _evaluate(other, names, quantity.formula) if alike else None
            idle = eta and reference is None
            if value is None or (idle and (value.state, value.value) == ("fixed", 0.0)):
                continue
            remark = nothing or _remark(value, reference, eta, side, other)
            told = (i if several else 0, quantity.label, quantity.unit)
            yield Row(*told, *value[:3], *(reference or _Value())[:2], remark)


def _damping_rows(side: Side, other: Side, nothing: str) -> Iterator[Row]:
    """Give the damping of the striker's motion, and its ratio as the paper defines it."""
    one_spring, item = len(side.kinds) == 1, other.source
    names = [n for n in ("site_eta", "s1_eta")[: 1 + one_spring] if n in side.estimates]
    theirs = [n for n in names if n in other.estimates] if item is None else ["site_eta"]
    value, reference = _evaluate(side, names, _total), _evaluate(other, theirs, _total)
    if value is None:
        return
    if item is None and value.value == 0.0 and not (reference and reference.value):
        return
    remark = nothing or _remark(value, reference, True, side, other)
    told = (0, "η" if one_spring else "site η", "Pa·s")
    yield Row(*told, *value[:3], *(reference or _Value())[:2], remark)
    soft = [i for i, kind in enumerate(side.kinds, 1) if law(kind).hysteretic]
    if item is None or len(soft) != 1 or nothing:
        return
    # ρ H = m/A, so that 2 H √(ρ k_c) = 2 √(m H k_c/A).
    inertia = item.striker_mass * item.chain.height / item.chain.area
    ratio = _evaluate(
        side,
        [*names, f"s{soft[0]}_kc"],
        lambda *at: _total(*at[:-1]) / (2.0 * (inertia * at[-1]) ** 0.5),
    )
    if ratio is not None:
        # ζ is η over a root, so it is known as well as η unless k_c is undetermined.
        if ratio.state != "not determined" or value.state == "fixed":
            ratio = ratio._replace(state=value.state, why=value.why)
        lost = ratio.state == "not determined" != value.state
        remark = f"not determined: {ratio.why}" if lost and not remark else remark
        yield Row(0, "ζ", "", *ratio[:3], item.damping_ratio, None, remark)


def _remark(value: _Value, reference: _Value | None, eta: bool, side: Side, other: Side) -> str:
    """Return why two numbers are not compared, "" if they are."""
    size = max(abs(one.value or 0.0) for one in (value, reference or _Value()))
    vague = reference is not None and (value.stderr or 0.0) > NOTHING * size
    given = {"value": value, "reference": reference, "side": side, "other": other}
    return words("remark", eta=eta, vague=VAGUE if vague else "", **given)


# ---------------------------------------------------------------- as a text and as a CSV


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as aligned text, at most 100 columns wide, no newline at the end."""
    reference = "published" if comparison.with_published else "reference"
    titles = ("parameter", "unit", "fitted", reference, "deviation", "", "state")
    pairs = []
    for pair in comparison.pairs:
        whole = {remark[:-1].casefold() for remark in pair.remarks}
        apart = dict[str, list[str]]()
        for row in pair.rows:
            if row.remark and row.remark.casefold() not in whole:
                apart.setdefault(row.remark, []).append(row.label)
        ratio = any(row.name == "ζ" for row in pair.rows)  # then a published set is beside it
        item = published_sets[pair.reference.removeprefix("published ")] if ratio else None
        pairs.append((pair, [titles, *map(_cells, pair.rows)], apart, item))
    return words("comparison", pairs=pairs, with_published=comparison.with_published)


def _cells(row: Row) -> tuple[str, ...]:
    off = "not compared" if row.remark and row.reference is not None else None
    values = _with_error(row.value, row.stderr), _with_error(row.reference, row.reference_stderr)
    deviation = off or _signed(row.percent, " %"), _signed(row.standard_errors, " s.e.")
    return (row.label, row.unit or "–", *values, *deviation, row.state)


def _signed(value: float | None, unit: str) -> str:
    return "" if value is None else signed(value, 0 if abs(value) >= 99.5 else 1) + unit


def _with_error(value: float | None, stderr: float | None) -> str:
    """Return a number with its error, rounded to two digits of the error; "–" for none."""
    if value is None:
        return "–"
    if stderr is None:
        return f"{value:.4g}".replace("-", "−")
    if max(abs(value), stderr) >= 1e5:
        return f"{significant(value, 3)} ± {significant(stderr)}".replace("-", "−")
    return readable("", ParameterEstimate(value, stderr, None, "", True, "", "")).with_error


def write_csv(comparison: Comparison, path: str | Path) -> None:
    """Write a comparison as a table, one parameter of one result per line."""
    of_pair = ("test", "model", "drive", "reference")
    of_row = {"parameter": "name", "unit": "unit", "value": "value", "stderr": "stderr"}
    of_row |= {"state": "state", "reference_value": "reference"}
    of_row |= {name: name for name in ("reference_stderr", "percent", "standard_errors", "remark")}
    rows: list[list[Any]] = [[*of_pair, "spring", *of_row]]
    for pair in comparison.pairs:
        for row in pair.rows:
            told = [getattr(pair, name) for name in of_pair]
            rows.append([*told, row.spring or "", *(getattr(row, n) for n in of_row.values())])
    write_file(path, csv_bytes(rows))


# ---------------------------------------------------------------- as a figure


def plot_comparison(
    comparison: Comparison, path: str | Path | None = None, *, width: str = TWO
) -> Figure:
    """Draw how far each parameter is from its reference, in standard errors, and in percent.

    One panel for each reference; shaded are one and three standard errors. What is not compared is
    left out, what is not determined is named. For `path` and `width` see `plots.plot_fit`.
    """
    groups: dict[str, list[Pair]] = {}
    for pair in comparison.pairs:
        groups.setdefault(pair.reference, []).append(pair)
    wide = figures.inches(width)
    columns = figures.abreast(wide, min(len(groups), 2), 2.9)
    lines = [max(len(_shown(pairs)), 1) * (len(_lanes(pairs)) + 1) for pairs in groups.values()]
    rows = [max(lines[i : i + columns]) for i in range(0, len(lines), columns)]
    with figures.drawing(wide, 0.5 + sum(0.6 + 0.12 * n for n in rows)) as figure:
        ratios = [n + 2 for n in rows]
        axes = figures.grid_of(figure, len(rows), columns, len(groups), height_ratios=ratios)
        for ax, (reference, pairs) in zip(axes, groups.items(), strict=True):
            _draw_comparison(ax, pairs)
            title = textwrap.fill(f"beside {reference}", int(16 * wide / columns))
            ax.set_title(title, loc="left", fontsize=7.5, pad=4, weight="bold", parse_math=False)
        for ax in axes[-columns:]:  # the lowest ones
            ax.set_xlabel("deviation (standard errors)")
        _name_results(figure, list(groups.values()))
    return figures.save(figure, path)


def _shown(pairs: list[Pair]) -> list[str]:
    """Return the parameters that at least one result can show, in order."""
    rows = [row for pair in pairs for row in pair.rows]
    there = {row.label for row in rows if row.is_shown}
    return [label for label in dict.fromkeys(row.label for row in rows) if label in there]


def _lanes(pairs: list[Pair]) -> list[int]:
    """Return the indices of the results that have something to show; each gets a lane."""
    return [k for k, pair in enumerate(pairs) if any(row.is_shown for row in pair.rows)]


def _draw_comparison(ax: Axes, pairs: list[Pair]) -> None:
    """Draw one line per parameter and result, grouped by parameter."""
    labels = _shown(pairs)
    if not labels:
        figures.say_nothing_there(ax)
        return
    found = [row.standard_errors for pair in pairs for row in pair.rows]
    reach = max(4.0, 1.1 * max((abs(z) for z in found if z is not None), default=0.0))
    for half, shade in ((3.0, "0.95"), (1.0, "0.88")):
        ax.axvspan(-half, half, color=shade, lw=0, zorder=0)
    ax.axvline(0.0, color=GREY, lw=0.6, zorder=1)
    lanes = _lanes(pairs)
    step = len(lanes) + 1
    for lane, k in enumerate(lanes):
        color, mark = MARKS[k % len(MARKS)]
        side = f"{pairs[k].test}, {pairs[k].model}, {pairs[k].drive} drive"
        for row in pairs[k].rows:
            if row.label not in labels:
                continue
            y, z, name = labels.index(row.label) * step + lane, row.standard_errors, row.label
            beside: dict[str, Any] = {"va": "center", "fontsize": 6.5, "color": color}
            if row.lost:
                beside |= {"ha": "center", "style": "italic", "label": f"_{side}: {name}:"}
                ax.annotate("not determined", (0.0, y), **beside)
            elif z is not None:
                ax.plot([0.0, z], [y, y], color=color, lw=0.9, zorder=2)
                face = "white" if row.state == "weak" else color
                style: dict[str, Any] = {"ms": 3.4, "color": color, "mfc": face, "zorder": 3}
                ax.plot(z, y, mark, label=f"_{side}: {name}", **style)
                beside |= {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
                ax.annotate(_percent(row), (1.0, y), (2, 0), ha="left", **beside)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(step * len(labels) - 0.5, -1.0)
    ax.set_yticks(
        [i * step + 0.5 * (step - 2) for i in range(len(labels))],
        [_math(label) for label in labels],
    )
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)


def _name_results(figure: Figure, groups: list[list[Pair]]) -> None:
    """Explain the colours once: by drive if the drives are the same in every panel."""
    drives = [[f"{pair.drive} drive" for pair in pairs] for pairs in groups]
    names = max(drives, key=len)
    if len(groups) == 1 and len(set(names)) < len(names):
        names = [f"{s.test}: {s.model}, {s.drive} drive" for s in groups[0]]
    elif len(set(names)) < len(names) or any(d != names[: len(d)] for d in drives):
        names = [f"result {k + 1}" for k in range(len(names))]
    drawn = {k for pairs in groups for k in _lanes(pairs)}
    entries = dict[str, Any]()
    for k, name in enumerate(names):
        color, mark = MARKS[k % len(MARKS)]
        label = name if k in drawn else f"{name}: nothing to compare"
        (entries[label],) = figure.axes[0].plot([], [], mark, ms=3.4, color=color, label=label)
    if any(row.state == "weak" for group in groups for pair in group for row in pair.rows):
        style: dict[str, Any] = {"ms": 3.4, "color": GREY, "mfc": "white"}
        label = "hollow: weakly determined"
        (entries[label],) = figure.axes[0].plot([], [], "o", label=label, **style)
    figures.legend_below(figure, entries)


def _math(label: str) -> str:
    """Write the symbols of a label as formulas: "s2 k_h+/k0" gives "s2 $k_{h+}$/$k_{0}$"."""
    *spring, name = label.split(" ")
    parts = re.findall(r"(Δ?\w)_?([^/]*)/?", name.translate(str.maketrans("₊₋−", "+--")))
    told = "/".join(f"${stem}_{{{index}}}$" if index else f"${stem}$" for stem, index in parts)
    return " ".join([*spring, told])


def _percent(row: Row) -> str:
    """Return the difference with its standard error, in percent of the reference."""
    if row.percent is None or not row.reference:
        return ""
    spread = 100.0 * row.spread / abs(row.reference)
    places = 0 if spread >= 10.0 else 1 if spread >= 1.0 else 2
    return f"{signed(row.percent, places)} ± {spread:.{places}f} %"
