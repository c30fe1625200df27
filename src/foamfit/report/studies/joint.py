"""A joint fit: what the command prints, its page and picture, its folder with one per test."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.fitting.links import RATES, law_values
from foamfit.report import figures
from foamfit.report.figures import BLUE, TWO, VERMILION, image
from foamfit.report.folder import save_whole, write_json, write_result, write_text
from foamfit.report.readable import in_unit, own_name, readable, readable_unit, symbol
from foamfit.report.render import page, words
from foamfit.report.shown import Joint
from foamfit.report.studies.parameters import Compared, plot_parameters
from foamfit.report.tables import parameters_tex
from foamfit.results import Fit, law_in_words
from foamfit.springs.parameters import NUISANCE
from foamfit.text import percent
from foamfit.trust.covariance import RULE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.study.joint_result import JointData, JointParameter

CURVES = {"stress_strain": "loop", "stress_time": "σ(t)", "displacement_time": "u(t)"}
DPI = 180  # of the picture
MOST_ROWS = 60  # of the table of tests on the terminal
# Columns of the picture, and inches of a loop and of a parameter.
LOOPS, LOOP, COLUMNS, PANEL = 6, (1.25, 1.15), 3, (2.5, 1.6)
LEAST_LOOP, LEAST_PANEL, ROOMY = 1.05, 1.55, 2.1  # in
MEASURED = "0.65"  # wide and light below what is fitted, which is darker in grey too
MOST_LOOPS = 48
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
        write_text(fresh / "table.tex", joint_tex(found))
        folders = [fresh / name for name in found.tests]
        # Where other processes make the folders, the picture of all is drawn beside them.
        n = len(folders)
        made = each(_write_test, found.test_fits(), folders, [reports] * n, [width] * n)
        pictures = [
            figures.write_both(draw(found, width=width), fresh / name, DPI)
            for name, draw in (("joint", plot_joint), ("parameters", plot_compared))
        ]
        if width != TWO:  # the page is as wide as two columns
            pictures = [image(draw(found), "png", DPI) for draw in (plot_joint, plot_compared)]
        text = joint_page(found, *pictures, linked=reports)
        write_text(fresh / "joint.html", text)
        for _ in made:
            pass

    save_whole(folder, write)
    if failed:
        raise RuntimeError(
            f"{failed[0]!r}; {Path(folder) / 'joint.json'} is written, but not all reports"
        ) from failed[0]
    return Path(folder)


def joint_tex(found: Joint) -> str:
    """Return table.tex: a row for each parameter of the springs."""
    shown = _of_springs(found)
    return parameters_tex(
        {name: one.estimate() for name, one in shown.items()},
        kinds={name: one.kind for name, one in shown.items()},
        between={name: between(one) for name, one in shown.items()},
    )


def _of_springs(found: Joint) -> dict[str, JointParameter]:
    """Parameters of the springs but for those that are held at zero."""
    every = found.parameters.items()
    return {n: p for n, p in every if n not in NUISANCE and (p.kind != "fixed" or p.value)}


def _write_test(one: Callable[[], Fit], folder: Path, reports: bool, width: str) -> None:
    folder.mkdir()
    write_result(one(), folder, pages=reports, width=width)


def joint_text(found: JointData) -> str:
    """Return what the command prints of a joint fit."""
    evidence = {
        name: [["*" if o.chosen else "", o.kind, str(o.n_vary), f"{o.bic:.1f}"] for o in tried]
        for name, tried in found.tried.items()
    }
    return words(
        "joint",
        found=found,
        law=law_in_words(found.study.model, found.study.relaxation),
        parameters=_parameter_rows(found),
        tests=_test_rows(found)[: MOST_ROWS + 1],
        evidence=evidence,
    )


def joint_page(found: JointData, loops: bytes, compared: bytes, *, linked: bool = True) -> str:
    """Return the page with two pictures (PNG); `linked` says whether each test has a report."""
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
        loops=base64.b64encode(loops).decode("ascii"),
        compared=base64.b64encode(compared).decode("ascii"),
        parameters=[
            (one, readable(name, one.estimate()), between(one))
            for name, one in _of_springs(found).items()
        ],
        rule=RULE,
        ranged=any(one.range for one in found.parameters.values()),
        evidence=found.tried,
        curves={name: CURVES[name] for name in _compared(found, CURVES)},
        of_curve=CURVES,
        noise=noise,
        each=each,
        linked=linked,
    )


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
    """Draw the loop of each test, and each parameter that follows a law of rate against the rate.

    Bars are 95 % intervals of the tests. `width` is "one" or "two" columns, or a length such as
    "85 mm".
    """
    shown, wide = _shown(found), figures.inches(width)
    names = [n for n, one in found.parameters.items() if one.kind in RATES and n not in NUISANCE]
    across = figures.abreast(wide, min(LOOPS, max(len(shown), COLUMNS)), LEAST_LOOP)
    columns = figures.abreast(wide, COLUMNS, LEAST_PANEL)
    rows, low = -(-len(shown) // across), -(-len(names) // columns)
    heights = [rows * LOOP[1], low * PANEL[1]]
    more = f"; {len(shown)} of {len(found.tests)} drawn" if len(shown) < len(found.tests) else ""
    told = f"{found.name} · {found.model} · {len(found.tests)} tests together{more}"
    lines = figures.title_lines(wide, told, titled=figures.is_titled(width))
    with figures.drawing(wide, sum(heights) + 0.6 + 0.13 * len(lines), lines) as figure:
        parts = [height for height in heights if height]
        top, *bottom = figure.subfigures(len(parts), 1, height_ratios=parts, squeeze=False)[:, 0]
        most = int(72.0 * wide / across / 4.2)  # letters of a name
        loops = top.subplots(rows, across, squeeze=False).ravel().tolist()
        _draw_loops(loops, found, shown, most)
        for part in bottom:
            axes = part.subplots(low, columns, squeeze=False).ravel().tolist()
            for ax, name in zip(axes, names, strict=False):
                _law_of_rate(ax, found, name, parted=wide / columns < ROOMY)
            for ax in axes[len(names) :]:
                ax.set_axis_off()
            loops += axes
        figures.legend_below(figure, figures.key_of(loops))
    return figure


def plot_compared(found: JointData, *, width: str = TWO) -> Figure:
    """Draw the parameters of all tests side by side, the tests by rate where they have several."""
    rates = dict(zip(found.tests, found.rates, strict=True)) if by_rate(found) else {}
    tests = sorted(found.tests, key=lambda test: rates.get(test) or 0.0)
    names = {t: f"{t}, {rates[t]:.2g}/s" if rates.get(t) else t for t in tests}
    springs = len(found.model.split("+"))
    compared = [
        Compared(
            name,
            {names[t]: one.estimate(t) for t in tests if one.tests and t in one.tests},
            springs,
            one.kind,
            one.estimate() if one.kind in ("shared", "scatter") else None,
            one.scatter,
        )
        for name, one in _of_springs(found).items()
        if one.kind != "fixed"
    ]
    title = f"{found.name} · {found.model} · {len(tests)} tests together"
    return plot_parameters(title, list(names.values()), compared, width=width)


def _shown(found: JointData) -> list[int]:
    """Tests whose loops are drawn, by rate where they have several: all, or some at equal steps."""
    rates = found.rates if by_rate(found) else [0.0] * len(found.tests)
    order = sorted(range(len(found.tests)), key=lambda t: (rates[t] or 0.0, t))
    places = np.unique(np.linspace(0, len(order) - 1, min(MOST_LOOPS, len(order))).astype(int))
    return [order[place] for place in places]


def _draw_loops(axes: list[Axes], found: JointData, shown: list[int], most: int) -> None:
    """Draw the loop of each test that is shown; names have so many letters at most."""
    loops = {one.name: one for one in found.loops}
    tops = (float(np.max(one.measured)) for one in loops.values())
    factor, unit = readable_unit(max(tops, default=0.0), "Pa")
    for ax, t in zip(axes, shown, strict=False):
        if (one := loops.get(found.tests[t])) is None:
            continue
        some = slice(None, None, max(one.along.size // POINTS, 1))
        x = one.along[some]
        ax.plot(x, one.measured[some] / factor, color=MEASURED, lw=1.5, label="_measured")
        if one.fitted is not None:
            ax.plot(x, one.fitted[some] / factor, color=BLUE, lw=0.7, label="_fitted")
        ax.set_label(one.name)
        rate = found.rates[t] if by_rate(found) else None
        told = one.name if rate is None else f"{one.name}, {rate:.2g}/s"
        ax.set_title(told if len(told) <= most else f"…{told[-most + 1 :]}", fontsize=6)
        ax.tick_params(labelsize=5.5, length=2, pad=1.5)
        ax.locator_params(nbins=3)
        ax.set_xlabel(one.label, fontsize=6, labelpad=1, visible=t == shown[0])
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


def _law_of_rate(ax: Axes, found: JointData, name: str, *, parted: bool) -> None:
    """One parameter by rate, with its law; its title in two lines if `parted`."""
    one, x = found.parameters[name], np.array(found.rates, dtype=float)
    factor, unit = readable_unit(abs(one.value), one.unit)
    told = f"{own_name(name, found.model)}{f' ({unit})' if unit else ''}:"
    ax.set_title(f"{told}\n{one.kind}" if parted else f"{told} {one.kind}")
    ax.set_label(f"{told} {one.kind}")
    tests = one.tests or {}
    points = [(at, tests[test]) for at, test in zip(x, found.tests, strict=True) if test in tests]
    figures.draw_estimates(ax, points, factor, 0.0)
    ax.set_xscale("log")
    ax.set_xlabel("strain rate (1/s)", labelpad=1)
    low, high = np.nanmin(x), np.nanmax(x)
    if high < 10.0 * low:  # no two powers of ten, and minor labels overlap
        ticks = np.geomspace(low, high, 3)
        ax.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
        ax.minorticks_off()
    if one.b is not None and found.rate0 is not None:
        rates = np.geomspace(low, high, 50)
        values = law_values(one.kind, one.value, one.b, np.log(rates / found.rate0))
        ax.plot(rates, values / factor, label="_law of rate", color=VERMILION, linewidth=1.0)
        y = 0.05 if one.b > 0.0 else 0.97
        side: Any = {"ha": "right", "va": "top" if y > 0.5 else "bottom", "fontsize": 6.5}
        told = between(one).partition(" (")[0] if parted else between(one)
        ax.text(0.98, y, told, transform=ax.transAxes, **side)
