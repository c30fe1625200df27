"""Joint fit: text, page and figures, and its folder with a folder per test."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.fitting.links import RATES, law_values
from foamfit.parts import ParameterEstimate, law_in_words
from foamfit.report import figures
from foamfit.report.figures import FITTED, GREY, SEEN, TWO, VERMILION, image
from foamfit.report.folder import save_whole, write_json, write_result, write_text
from foamfit.report.listing import Listed, table_of
from foamfit.report.readable import in_unit, own_name, readable, readable_unit
from foamfit.report.render import page, words
from foamfit.report.shown import Joint
from foamfit.report.studies.parameters import Panel, plot_parameters
from foamfit.report.tables import MISFITS, formula, parameters_tex, symbols
from foamfit.results import Fit
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.text import number, percent
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_ROWS = 60  # of the table of tests on the terminal
LOOPS, LOOP = 6, (1.25, 1.15)  # loops per row, and size of a loop in inches
COLUMNS, PANEL = 3, (2.5, 1.6)  # parameters per row, and size of a panel in inches
LEAST_LOOP, LEAST_PANEL = 1.05, 1.55  # least widths, inches
ROOMY = 2.1  # width of a panel with room for a title in one line, inches
MOST_LOOPS = 48
SEVERAL_RATES = 1.5  # ratio of rates; those of nominally equal tests differ by a few percent


def save_joint(
    found: Joint,
    folder: str | Path,
    each: Callable[..., Iterable[Any]] = map,
    *,
    report: bool = True,
    width: str = TWO,
) -> Path:
    """Write a result folder, which replaces an older one when complete; return its path.

    `each` maps a function over the tests, as `map` does; `width` is that of the figures. Without
    `report` only tables are written.
    """

    def write(fresh: Path) -> None:
        write_json(fresh / "joint.json", found.to_json_dict())
        shown = _of_springs(found)
        text = parameters_tex(
            shown,
            kinds={name: one.kind for name, one in shown.items()},
            between={name: between(one) for name, one in shown.items()},
        )
        write_text(fresh / "table.tex", text)
        folders, n = [fresh / name for name in found.tests], len(found.tests)
        # If other processes write these folders, the common figures are drawn at the same time.
        written = each(_write_test, found.fits, folders, [report] * n, [width] * n)
        pictures = list[bytes]()
        if report:
            for name, draw in (("joint", plot_joint), ("parameters", plot_compared)):
                svg = figures.write_both(draw(found, width=width), fresh / name)
                # The page has room for two columns.
                pictures.append(svg if width == TWO else image(draw(found), "svg"))
        for _ in written:
            pass
        if report:
            write_text(fresh / "joint.html", joint_page(found, fresh, *pictures))

    return save_whole(folder, write)


def _of_springs(found: Joint) -> dict[str, ParameterEstimate]:
    """Return the parameters of the springs except those fixed at zero."""
    every = found.parameters.items()
    return {n: p for n, p in every if n not in NUISANCE and (p.kind != "fixed" or p.value)}


def _write_test(one: Callable[[], Fit] | Fit, folder: Path, report: bool, width: str) -> None:
    folder.mkdir()
    write_result(one if isinstance(one, Fit) else one(), folder, pages=report, width=width)


def _common(found: Joint) -> dict[str, Any]:
    """Return the values that text and page have in common."""
    content = found.to_json_dict()
    tests, evidence = content["tests"].values(), dict[str, list[Mapping[str, Any]]]()
    for one in content["evidence"]:
        evidence.setdefault(one["parameter"], []).append(one)
    known = {name for one in tests for name, x in one["misfit"].items() if x is not None}
    return {
        "found": content,
        "law": law_in_words(Model.of_result(content).name, content["relaxation"]),
        "evidence": evidence,
        "curves": {name: label for name, label in MISFITS.items() if name in known},
        "ranged": any(one.range for one in found.parameters.values()),
    }


def joint_text(found: Joint) -> str:
    """Return the text that the command prints for a joint fit."""
    every = {n: p for n, p in found.parameters.items() if p.kind != "fixed" or p.value}
    more: Any = {"parameters": every, "nuisance": NUISANCE, "between": between, "most": MOST_ROWS}
    return words("joint", **more, **_common(found))


def joint_page(found: Joint, folder: Path, loops: bytes, compared: bytes) -> str:
    """Return the page in a folder, with its two figures (SVG)."""
    common = _common(found)
    shown = {n: one for n, one in found.parameters.items() if one.kind != "fixed"}
    levels: dict[str, tuple[float, str]] = {}  # factor and unit of the noise of each curve
    known = [one["noise"] for one in common["found"]["tests"].values()]
    for name in MISFITS:
        if sizes := [one[name]["sigma"] for one in known if name in one]:
            levels[name] = readable_unit(max(sizes), "m" if name.startswith("displ") else "Pa")
    listed = [
        Listed(
            folder / test,
            test,
            "",
            own["misfit"],
            parameters={
                n: one.in_test(test) for n, one in shown.items() if one.tests and test in one.tests
            },
            more=_more(own, levels),
        )
        for test, own in common["found"]["tests"].items()
    ]
    return page(
        "joint",
        loops=loops,
        compared=compared,
        parameters=[
            (one, readable(name, one), between(one)) for name, one in _of_springs(found).items()
        ],
        rule=RULE,
        table=table_of(listed, folder, loops=False),
        **common,
    )


def _more(own: Mapping[str, Any], levels: Mapping[str, tuple[float, str]]) -> dict[str, Any]:
    """Return the cells of a test that only joint fits have: rate, share of χ² and noise."""
    rate = "" if own["rate"] is None else f"{own['rate']:.3g}"
    out = {"rate (1/s)": (rate, ""), "share of χ² (%)": (f"{100 * own['chi2_share']:.1f}", "")}
    for curve, (factor, unit) in levels.items():
        if level := own["noise"].get(curve):
            note = "stated" if level["given"] else "estimated"
            if level["time"] > 1.05:
                note += f", correlated over {level['time']:.2g} samples"
            if level["scale"] > level["sigma"]:
                note += f", counted as {number(level['scale'] / factor)}"
            out[f"noise {MISFITS[curve]} ({unit})"] = (number(level["sigma"] / factor), note)
    return out


def between(one: ParameterEstimate) -> str:
    """Return a description of the variation of a parameter between the tests."""
    if one.kind == "scatter" and one.scatter is not None and one.scatter_ci95 is not None:
        low, high = one.scatter_ci95
        return f"scatters by {percent(one.scatter)} ({percent(low)} to {percent(high)})"
    if one.b is not None:
        ends = "" if one.b_ci95 is None else f" ({one.b_ci95[0]:.3g} to {one.b_ci95[1]:.3g})"
        return f"b = {one.b:.3g}{ends}"
    values = [at.value for at in (one.tests or {}).values()] if one.kind == "own" else []
    return in_unit((min(values), max(values)), one.unit) if values else ""


# ------------------------------------------------------------------------------- the figures


def plot_joint(found: Joint, *, width: str = TWO) -> Figure:
    """Draw the loop of each test, and the parameters with a rate law over the rate.

    Bars are 95 % intervals of the tests. At most `MOST_LOOPS` loops are drawn. `width` is "one" or
    "two" columns, or a length such as "85 mm".
    """
    wide, names = figures.inches(width), _in_order(found)
    places = np.unique(np.linspace(0, len(names) - 1, min(MOST_LOOPS, len(names))).astype(int))
    shown = [list(names)[place] for place in places]
    laws = [n for n, one in found.parameters.items() if one.kind in RATES and n not in NUISANCE]
    across = figures.abreast(wide, min(LOOPS, max(len(shown), COLUMNS)), LEAST_LOOP)
    columns = figures.abreast(wide, COLUMNS, LEAST_PANEL)
    rows, low = -(-len(shown) // across), -(-len(laws) // columns)
    heights = [rows * LOOP[1], low * PANEL[1]]
    more = f"; {len(shown)} of {len(names)} drawn" if len(shown) < len(names) else ""
    title = f"{found.name} · {found.model} · {len(names)} tests together{more}"
    with figures.drawing(wide, sum(heights) + 0.6, *figures.title(width, title)) as figure:
        parts = [height for height in heights if height]
        top, *bottom = figure.subfigures(len(parts), 1, height_ratios=parts, squeeze=False)[:, 0]
        axes = figures.grid_of(top, rows, across, len(shown))
        most = int(72.0 * wide / across / 4.2)  # letters of a name
        _draw_loops(axes, found, {test: figures.tail(names[test], most) for test in shown})
        for part in bottom:
            below = figures.grid_of(part, low, columns, len(laws))
            for ax, name in zip(below, laws, strict=True):
                _law_of_rate(ax, found, name, parted=wide / columns < ROOMY)
            axes += below
        figures.legend_below(figure, figures.named_in(axes))
    return figure


def plot_compared(found: Joint, *, width: str = TWO) -> Figure:
    """Draw the parameters of all tests side by side; tests are sorted by rate if rates differ."""
    names = _in_order(found)
    shown = {name: one for name, one in _of_springs(found).items() if one.kind != "fixed"}
    panels = [
        Panel(
            name,
            formula(own),
            {names[t]: one.in_test(t) for t in names if one.tests and t in one.tests},
            kind=one.kind or "",
            common=one if one.kind in ("shared", "scatter") else None,
            scatter=one.scatter,
        )
        for own, (name, one) in zip(symbols(shown), shown.items(), strict=True)
    ]
    title = f"{found.name} · {found.model} · {len(names)} tests together"
    return plot_parameters(title, list(names.values()), panels, width=width)


def _in_order(found: Joint) -> dict[str, str]:
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


def _draw_loops(axes: list[Axes], found: Joint, titles: Mapping[str, str]) -> None:
    """Draw the loop of each test that has a title."""
    loops = {one.name: one for one in found.loops}
    tops = (float(np.max(one.measured)) for one in loops.values())
    factor, unit = readable_unit(max(tops, default=0.0), "Pa")
    for ax, (test, title) in zip(axes, titles.items(), strict=True):
        if (one := loops.get(test)) is None:
            continue
        ax.plot(one.along, one.measured / factor, **SEEN)
        if one.fitted is not None:
            ax.plot(one.along, one.fitted / factor, **FITTED)
        ax.set_label(one.name)
        ax.set_title(title, fontsize=6)
        ax.tick_params(labelsize=5.5, length=2, pad=1.5)
        ax.locator_params(nbins=3)
        ax.set_xlabel(one.label, fontsize=6, labelpad=1, visible=ax is axes[0])
        ax.set_ylabel(f"stress ({unit})", fontsize=6, labelpad=1, visible=ax is axes[0])


def _law_of_rate(ax: Axes, found: Joint, name: str, *, parted: bool) -> None:
    """Draw a parameter over the rate, with its law; the title has two lines if `parted`."""
    one, x = found.parameters[name], np.array(found.rates, dtype=float)
    factor, unit = readable_unit(abs(one.value), one.unit)
    title = f"{own_name(name, found.model)}{f' ({unit})' if unit else ''}: {one.kind}"
    ax.set(label=title, title=title.replace(": ", ":\n") if parted else title)
    tests = one.tests or {}
    ends = [tests[t].ci95 or (np.nan,) * 2 if t in tests else (np.nan,) * 2 for t in found.tests]
    ax.vlines(x, *np.transpose(ends) / factor, color=GREY, lw=0.8, label="95 % interval")
    ax.set_xlabel("strain rate (1/s)", labelpad=1)
    ax.set_xscale("log")
    low, high = np.nanmin(x), np.nanmax(x)
    if high < 10.0 * low:  # too few powers of ten, and minor labels would overlap
        ticks = np.geomspace(low, high, 3)
        ax.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
        ax.minorticks_off()
    if one.b is not None and found.rate0 is not None:
        rates = np.geomspace(low, high, 50)
        values = law_values(str(one.kind), one.value, one.b, np.log(rates / found.rate0))
        ax.plot(rates, values / factor, label="rate law", color=VERMILION, linewidth=1.0)
        y, va = (0.05, "bottom") if one.b > 0.0 else (0.97, "top")
        slope = between(one).partition(" (")[0] if parted else between(one)
        ax.text(0.98, y, slope, ha="right", va=va, fontsize=6.5, transform=ax.transAxes)
