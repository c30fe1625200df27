"""A joint fit: what the command prints, its page and picture, its folder with one per test."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from os.path import commonprefix
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.fitting.links import RATES, law_values
from foamfit.report import figures
from foamfit.report.figures import BLUE, TWO, VERMILION, image
from foamfit.report.folder import save_whole, write_json, write_result
from foamfit.report.readable import Readable, in_unit, own_name, readable, readable_unit, symbol
from foamfit.report.render import page, words
from foamfit.results import ParameterEstimate, law_in_words
from foamfit.springs.parameters import NUISANCE
from foamfit.text import percent
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.arrays import Array
    from foamfit.study.joint_result import JointData, JointParameter, TestFit

CURVES = {"stress_strain": "loop", "stress_time": "σ(t)", "displacement_time": "u(t)"}
DPI = 180  # of the picture
MOST_ROWS = 60  # of the table of tests on the terminal
# Columns of the picture, and inches of a loop and of a parameter.
LOOPS, LOOP, COLUMNS, PANEL = 6, (1.25, 1.15), 3, (2.5, 1.6)
LEAST_LOOP, LEAST_PANEL, LEAST_TABLE = 1.05, 1.55, 2.1  # in
MEASURED = "0.65"  # wide and light below what is fitted, which is darker in grey too
MOST_LOOPS = 48
MOST_NAMES = 12  # of tests that stand at an axis
# Tests are ordered by rate from this ratio of the largest to the smallest rate on, even if no
# parameter follows a law of rate; rates of nominally equal tests differ by some percent.
SEVERAL_RATES = 1.5
# Points of a drawn curve.
POINTS = 400


def save_joint(
    found: JointData,
    folder: str | Path,
    each: Callable[..., Iterable[Any]] = map,
    *,
    reports: bool = True,
    width: str = TWO,
) -> Path:
    """Write the folder whole, replacing an older result at the end; returns it.

    `each` maps a function over the tests, as `map` does; `width` is that of the figures. Where the
    reports fail, joint.json is written all the same, and RuntimeError says so.
    """
    failed = list[Exception]()

    def write(fresh: Path) -> None:
        write_json(fresh / "joint.json", found.to_json_dict())
        try:
            show(fresh)
        except OSError:
            raise
        except Exception as error:
            failed.append(error)

    def show(fresh: Path) -> None:
        folders = [fresh / name for name in found.tests]
        # Where other processes make the folders, the picture of all is drawn beside them.
        n = len(folders)
        made = each(_write_test, found.test_fits(), folders, [reports] * n, [width] * n)
        png = figures.write_both(plot_joint(found, width=width), fresh / "joint", DPI)
        if width != TWO:  # the page is as wide as two columns
            png = image(plot_joint(found), "png", DPI)
        text = joint_page(found, png, linked=reports)
        (fresh / "joint.html").write_text(text, encoding="utf-8", errors="replace")
        for _ in made:
            pass

    save_whole(folder, write)
    if failed:
        raise RuntimeError(
            f"{failed[0]!r}; {Path(folder) / 'joint.json'} is written, but not all reports"
        ) from failed[0]
    return Path(folder)


def _write_test(one: TestFit, folder: Path, reports: bool, width: str) -> None:
    folder.mkdir()
    write_result(one.fit(), folder, pages=reports, width=width)


def joint_text(found: JointData) -> str:
    """Return what the command prints of a joint fit."""
    evidence = {
        name: [["*" if o.chosen else "", o.kind, str(o.n_vary), f"{o.bic:.1f}"] for o in tried]
        for name, tried in _evidence(found).items()
    }
    return words(
        "joint",
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        parameters=_parameter_rows(found),
        tests=_test_rows(found)[: MOST_ROWS + 1],
        evidence=evidence,
    )


def joint_page(found: JointData, picture: bytes, *, linked: bool = True) -> str:
    """Return the page; `picture` is a PNG, `linked` says whether each test has a report."""
    each = []
    for name, one in found.parameters.items():
        if one.tests and one.kind != "fixed":
            size = max(abs(at.value) for at in one.tests.values())
            each.append((one, "".join(symbol(name)), *readable_unit(size, one.unit)))
    noise = {}
    for name in CURVES:
        if levels := [one[name]["sigma"] for one in found.noise if name in one]:
            noise[name] = readable_unit(max(levels), "m" if name.startswith("displ") else "Pa")
    return page(
        "joint",
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        version=version("foamfit"),
        picture=base64.b64encode(picture).decode("ascii"),
        parameters=[
            (one, _readable(name, one), between(one))
            for name, one in found.parameters.items()
            if name not in NUISANCE and (one.kind != "fixed" or one.value)
        ],
        rule=RULE,
        ranged=any(one.range for one in found.parameters.values()),
        evidence=_evidence(found),
        curves={name: CURVES[name] for name in _compared(found, CURVES)},
        of_curve=CURVES,
        noise=noise,
        each=each,
        linked=linked,
    )


def _readable(name: str, one: JointParameter) -> Readable:
    shared = ("value", "stderr", "ci95", "unit", "range")
    given: dict[str, Any] = {key: getattr(one, key) for key in shared}
    state, why = one.state or "", one.why or ""
    return readable(name, ParameterEstimate(**given, vary=True, state=state, why=why))


def _evidence(found: JointData) -> dict[str, list[Any]]:
    """The kinds that were tried, by parameter."""
    names = dict.fromkeys(one.parameter for one in found.evidence)
    return {name: [one for one in found.evidence if one.parameter == name] for name in names}


def _compared(found: JointData, curves: Iterable[str]) -> list[str]:
    """The curves that some test has."""
    every = found.fit.found.misfits
    return [name for name in curves if any(one.get(name) is not None for one in every)]


def _parameter_rows(found: JointData) -> list[list[str]]:
    """Table of the parameters, the header first."""
    ranged = any(one.range for one in found.parameters.values())
    span = ["range"] if ranged else []
    rows = [["parameter", "", "value", "95 % interval", *span, "", "between tests"]]
    for name, one in found.parameters.items():
        if one.kind == "fixed" and one.value == 0.0:
            continue
        # The median of a parameter of single records means nothing.
        value = "" if name in NUISANCE else in_unit((one.value,), one.unit)
        ends = [in_unit(end or (), one.unit) for end in (one.ci95, one.range)[: 1 + ranged]]
        rows.append([name, one.kind, value, *ends, one.state or "", between(one)])
    return rows


def between(one: JointParameter) -> str:
    """How a parameter varies from test to test."""
    if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None:
        low, high = one.scatter_ci95
        return f"scatters by {percent(one.scatter)} ({percent(low)} to {percent(high)})"
    if one.b is not None:
        ends = "" if one.b_ci95 is None else f" ({one.b_ci95[0]:.3g} to {one.b_ci95[1]:.3g})"
        return f"b = {one.b:.3g}{ends}"
    values = [at.value for at in (one.tests or {}).values()] if one.kind == "own" else []
    return in_unit((min(values), max(values)), one.unit) if values else ""


def _test_rows(found: JointData) -> list[list[str]]:
    """Table of the tests, the header first."""
    curves = _compared(found, ("stress_time", "displacement_time", "stress_strain"))
    rows = [["test", "rate (1/s)", *(c.replace("_", "-") for c in curves), "share of χ²"]]
    tests = zip(found.tests, found.rates, found.fit.found.misfits, found.shares, strict=True)
    for name, rate, off, share in tests:
        shown = ["–" if (m := off.get(curve)) is None else percent(m) for curve in curves]
        rows.append([name, "–" if rate is None else f"{rate:.3g}", *shown, percent(share)])
    return rows


# ------------------------------------------------------------------------------- the picture


def plot_joint(found: JointData, *, width: str = TWO) -> Figure:
    """Draw the loop of each test and every parameter by test, or by rate where there are several.

    Bars are 95 % intervals; a hollow mark is a test that does not determine the parameter well. The
    line is what the tests have in common: a value, a law of rate, a common value with its spread
    between specimens. `width` is "one" or "two" columns, or a length such as "85 mm".
    """
    shown = _shown(found)
    own = {n: one for n, one in found.parameters.items() if one.kind not in ("fixed", "shared")}
    names = [name for name in own if name not in NUISANCE]
    shared = [n for n, one in found.parameters.items() if one.kind == "shared"]
    panels, wide = len(names) + bool(shared), figures.inches(width)
    across = figures.abreast(wide, min(LOOPS, max(len(shown), COLUMNS)), LEAST_LOOP)
    columns = figures.abreast(wide, COLUMNS, LEAST_PANEL)
    rows, low = -(-len(shown) // across), -(-panels // columns)
    heights = [rows * LOOP[1], low * PANEL[1]]
    more = f"; {len(shown)} of {len(found.tests)} drawn" if len(shown) < len(found.tests) else ""
    told = f"{found.study.name} · {found.study.model} · {len(found.tests)} tests together{more}"
    lines = figures.title_lines(width, wide, told)
    with figures.drawing(wide, sum(heights) + 0.6 + 0.13 * len(lines), lines) as figure:
        top, bottom = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)[:, 0]
        most = int(72.0 * wide / across / 4.2)  # letters of a name
        loops = top.subplots(rows, across, squeeze=False).ravel().tolist()
        _draw_loops(loops, found, shown, most)
        axes = bottom.subplots(low, columns, squeeze=False).ravel().tolist()
        narrow = wide / columns < LEAST_TABLE
        for ax, name in zip(axes, names, strict=False):
            _parameter(ax, found, name, parted=narrow)
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        if shared:
            _list(axes[len(names)], found, shared, stacked=narrow)
        figures.legend_below(figure, figures.key_of([*loops, *axes]))
    return figure


def _shown(found: JointData) -> list[int]:
    """Tests whose loops are drawn, by rate where they have several: all, or some at equal steps."""
    rates = found.rates if by_rate(found) else [0.0] * len(found.tests)
    order = sorted(range(len(found.tests)), key=lambda t: (rates[t] or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(MOST_LOOPS, len(order))).astype(int))
    return [order[place] for place in places]


def _draw_loops(axes: list[Axes], found: JointData, shown: list[int], most: int) -> None:
    """Draw the loop of each test that is shown; names have so many letters at most."""
    tests = found.measurements
    top = max(float(np.max(t.stress)) for t in tests if t.stress is not None)
    factor, unit = readable_unit(top, "Pa")
    for ax, t in zip(axes, shown, strict=False):
        problem, test = found.problems[t], tests[t]
        curves = problem.objective.simulate(found.fit.found.values[t], everything=True).curves
        along, fitted, label = test.time, curves.get("stress_time"), "time (s)"
        if test.displacement is not None and "stress_strain" in curves:
            along, label = test.displacement / test.specimen.height, "strain"
            fitted = curves["stress_strain"]
        if along is None or test.stress is None:
            continue
        some = slice(None, None, max(along.size // POINTS, 1))
        ax.plot(along[some], test.stress[some] / factor, color=MEASURED, lw=1.5, label="_measured")
        if fitted is not None:
            ax.plot(along[some], fitted[some] / factor, color=BLUE, lw=0.7, label="_fitted")
        ax.set_label(found.tests[t])
        rate = found.rates[t] if by_rate(found) else None
        told = found.tests[t] if rate is None else f"{found.tests[t]}, {rate:.2g}/s"
        ax.set_title(told if len(told) <= most else f"…{told[-most + 1 :]}", fontsize=6)
        ax.tick_params(labelsize=5.5, length=2, pad=1.5)
        ax.locator_params(nbins=3)
        ax.set_xlabel(label, fontsize=6, labelpad=1, visible=t == shown[0])
        ax.set_ylabel(f"stress ({unit})", fontsize=6, labelpad=1, visible=t == shown[0])
    for ax in axes[len(shown) :]:
        ax.set_axis_off()


def by_rate(found: JointData) -> bool:
    """Whether tests are ordered by rate: a parameter follows a law of rate, or rates differ."""
    rates = [rate for rate in found.rates if rate]
    if found.rate0 is None or min(rates) == max(rates):
        return False
    if any(one.kind in RATES for one in found.parameters.values()):
        return True
    return len(rates) == len(found.rates) and max(rates) > SEVERAL_RATES * min(rates)


def _marks(tests: Sequence[str]) -> list[str]:
    """Short labels of the tests: the part in which their names differ, else numbers."""
    ways = (list(tests), [name[::-1] for name in tests])
    before, after = (len(commonprefix(way).rstrip("0123456789")) for way in ways)  # noqa: RUF071
    marks = [name[before : len(name) - after] for name in tests]
    short = all(0 < len(mark) <= 4 for mark in marks)
    return marks if short else [str(t) for t in range(1, len(tests) + 1)]


def _parameter(ax: Axes, found: JointData, name: str, *, parted: bool) -> None:
    """One parameter by test, or by rate; its title in two lines if `parted`."""
    one = found.parameters[name]
    rated = by_rate(found)
    factor, unit = readable_unit(abs(one.value), one.unit)
    x = np.array(found.rates, dtype=float) if rated else np.arange(1.0, len(found.tests) + 1)
    told = f"{own_name(name, found.study.model)}{f' ({unit})' if unit else ''}:"
    ax.set_title(f"{told}\n{one.kind}" if parted else f"{told} {one.kind}")
    ax.set_label(f"{told} {one.kind}")
    tests = one.tests or {}
    points = [(at, tests[test]) for at, test in zip(x, found.tests, strict=True) if test in tests]
    points = [(at, value) for at, value in points if value.state != "fixed"]
    size = 0.0 if one.kind in RATES else 3.5 if len(found.tests) < 60 else 1.5
    values, ends = figures.draw_estimates(ax, points, factor, size)
    if rated:
        ax.set_xscale("log")
        ax.set_xlabel("strain rate (1/s)", labelpad=1)
        if np.nanmax(x) < 10.0 * np.nanmin(x):  # no two powers of ten, and minor labels overlap
            ticks = np.geomspace(np.nanmin(x), np.nanmax(x), 3)
            ax.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
            ax.minorticks_off()
    else:
        ax.set_xlabel("test", labelpad=1)
        if len(x) <= MOST_NAMES:
            ax.set_xticks(x, _marks(found.tests))
    _common(ax, found, name, x, factor)
    if values and one.kind not in RATES:
        figures.limit(ax, values, ends)


def _common(ax: Axes, found: JointData, name: str, x: Array, factor: float) -> None:
    """What the tests have in common: line and 95 % band, spread between specimens dashed."""
    one = found.parameters[name]
    if one.kind == "own":
        return
    span, told, y = np.array([np.nanmin(x), np.nanmax(x)]), "", 0.97
    line: dict[str, Any] = {"color": VERMILION, "linewidth": 1.0}
    if one.kind in RATES and one.b is not None and found.rate0 is not None:
        span = np.geomspace(span[0], span[1], 50)
        values = law_values(one.kind, one.value, one.b, np.log(span / found.rate0))
        ax.plot(span, values / factor, label="_law of rate", **line)
        told, y = between(one), 0.05 if one.b > 0.0 else 0.97
    else:
        ax.plot(span, [one.value / factor] * 2, label="_in common", zorder=0, **line)
        if one.ci95 is not None:
            low, high = (end / factor for end in one.ci95)
            band: dict[str, Any] = {"color": VERMILION, "alpha": 0.18, "linewidth": 0, "zorder": 0}
            ax.fill_between(span, low, high, label="_95 % interval in common", **band)
        line |= {"linewidth": 0.7, "zorder": 0, "label": "_spread between specimens"}
        for sign in (-1.0, 1.0) if one.scatter else ():
            edge = one.value * np.exp(sign * (one.scatter or 0.0)) / factor
            ax.plot(span, [edge] * 2, "--", **line)
        told = f"spread {percent(one.scatter)}" if one.scatter else ""
    side: Any = {"ha": "right", "va": "top" if y > 0.5 else "bottom", "fontsize": 6.5}
    ax.text(0.98, y, told, transform=ax.transAxes, **side)


def _list(ax: Axes, found: JointData, names: list[str], *, stacked: bool) -> None:
    """Write the values that all tests share, side by side or `stacked` below their names."""
    lines = [["shared by all tests", "", ""]]
    for name in names:
        one = found.parameters[name]
        widths = [ends[1] - ends[0] for ends in (one.ci95, one.range) if ends is not None]
        half = 0.5 * max(widths, default=0.0)  # which decides its state
        error = f"±{percent(half / abs(one.value))}" if half and one.value else ""
        error += f" {one.state or ''}" if one.state != "determined" else ""
        value = in_unit((one.value,), one.unit)
        if stacked:
            lines += [[own_name(name, found.study.model), "", ""], [f"   {value} {error}", "", ""]]
        else:
            lines.append([own_name(name, found.study.model), value, error])
    size = min(7.0, 90.0 / len(lines))
    for column, x in ((0, 0.0), (1, 0.42), (2, 0.78)):
        told = "\n".join(line[column] for line in lines)
        ax.text(x, 1.0, told, transform=ax.transAxes, va="top", fontsize=size, linespacing=1.5)
