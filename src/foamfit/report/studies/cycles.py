"""The folder of a record's cycles: a result folder for each, a table, a picture, a summary."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from foamfit.report.figures import BLUE, GREY, TWO, VERMILION, abreast, drawing, image, inches
from foamfit.report.folder import CYCLES_PLOTTED, save_whole, write_json, write_result, write_table
from foamfit.report.plotted import table
from foamfit.text import aligned, percent, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from foamfit.report.result_figures import Mapped
    from foamfit.study.cycle_fits import FittedCycles

COLUMNS, PANEL = 4, (1.85, 1.5)  # of the picture; inches
LEAST = 1.55  # in, of a panel
MOST_LOOPS = 12
DPI = 200
FAR = 20  # a last cycle that is so many times the first is drawn on a logarithmic axis


def save_cycles(
    found: FittedCycles, folder: str | Path, *, report: bool = True, width: str = TWO,
    mapped: Mapped = map,
) -> Path:  # fmt: skip
    """Write the folder whole, replacing an older result at the end; returns it.

    For `report`, `width` and `mapped` see `foamfit.report.folder.save_result`.
    """
    return save_whole(
        folder, lambda fresh: write_cycles(found, fresh, pages=report, width=width, mapped=mapped)
    )


def write_cycles(
    found: FittedCycles, folder: Path, *, pages: bool = True, width: str = TWO, mapped: Mapped = map
) -> None:
    """Write all files of the cycles into a folder that is there; reports and pictures if wanted."""
    for number, result in found.results.items():
        (folder / f"cycle-{number}").mkdir()
        inner = folder / f"cycle-{number}"
        write_result(result, inner, pages=pages, width=width, mapped=mapped)
    write_table(folder / "cycles.csv", found.rows())
    write_json(folder / "cycles.json", found.to_json_dict())
    if pages:
        figure = plot_cycles(found, width=width)
        (folder / "cycles.png").write_bytes(image(figure, "png", DPI))
        (folder / CYCLES_PLOTTED).write_bytes(table(figure))


# ------------------------------------------------------------------------------- in words


def cycles_text(found: FittedCycles) -> str:
    """Return what the command prints of the cycles of a record."""
    n = len(found.recorded)
    fitted = f"{len(found.results)} of {n} {'cycle' if n == 1 else 'cycles'} fitted"
    lines = [f"{found.test}: {found.model}: {fitted}", ""]
    lines += _table(found)
    for number, why in sorted(found.refused.items()):
        lines += ["", *wrapped(f"cycle {number}: {why}")]
    if found.selection is not None:
        lines += ["", "fitted together, what each cycle has of its own:"]
        lines += _steps(found)
    for sentence in found.sentences:
        lines += ["", *wrapped(sentence)]
    return "\n".join(lines)


def _table(found: FittedCycles) -> list[str]:
    names = found.varied
    rows = [["cycle", "start strain", "misfit", *(name.removeprefix("s1_") for name in names)]]
    for number, one in sorted(found.results.items()):
        off = one.misfit.get("stress_strain") or one.misfit.get("stress_time")
        cells = [f"{one.parameters[name].value:.3g}" for name in names]
        strain = percent(one.measurement.start_strain)
        rows.append([str(number), strain, "–" if off is None else percent(off), *cells])
    if len(names) > 12:  # a chain: the table is in cycles.csv
        rows = [row[:3] for row in rows]
    return aligned(rows)


def _steps(found: FittedCycles) -> list[str]:
    assert found.selection is not None
    content = found.to_json_dict()["together"]
    rows = [["", "of each cycle", "parameters", "BIC", *(f"misfit {n}" for n in found.together)]]
    last = content["alone"] | {"own": ["all (each alone)"], "chosen": False}
    for step in (*content["steps"], last):
        own = ", ".join(name.removeprefix("s1_") for name in step["own"]) or "nothing"
        off = [percent(m) if m is not None else "–" for m in step["misfit"].values()]
        mark = "*" if step["chosen"] else ""
        rows.append([mark, own, str(step["n_vary"]), f"{step['bic']:.1f}", *off])
    return aligned(rows)


# ------------------------------------------------------------------------------- the picture


def plot_cycles(found: FittedCycles, *, width: str = TWO) -> Figure:
    """Draw the loops laid over each other, and start strain, energy, misfit, parameters by cycle.

    Bars are 95 % intervals; a hollow mark is a parameter that its cycle does not determine well.
    Lines are the fit of several cycles together: level where the parameter is shared. `width` is
    "one" or "two" columns, or a length such as "85 mm".
    """
    results = dict(sorted(found.results.items()))
    varied = found.varied
    panels, wide = 3 + len(varied), inches(width)
    columns = max(abreast(wide, COLUMNS, LEAST), 2)
    rows = 2 + max(0, -(-(panels - 2 * (columns - 2)) // columns))
    told = "points: each cycle alone with 95 % interval, hollow if weak or not determined"
    told += "; lines: fitted together" if found.selection is not None else ""
    lines = [
        line for part in (f"{found.test} · {found.model}", told)
        for line in textwrap.wrap(part, int(16 * wide))
    ]  # fmt: skip
    with drawing(wide, rows * PANEL[1] + 0.13 * len(lines) + 0.1) as figure:
        grid = figure.add_gridspec(rows, columns)
        _loops(figure.add_subplot(grid[:2, :2]), found)
        places = [(i, j) for i in range(rows) for j in range(columns) if i > 1 or j > 1]
        axes = [figure.add_subplot(grid[place]) for place in places[:panels]]
        if results:
            _by_cycle(axes[0], {n: 100 * r.measurement.start_strain for n, r in results.items()})
            energy = {n: r.energy.get("dissipated_energy") for n, r in results.items()}
            _by_cycle(axes[1], {n: e / 1e3 for n, e in energy.items() if e is not None})
            off = {n: r.misfit.get("stress_strain") for n, r in results.items()}
            _by_cycle(axes[2], {n: 100 * m for n, m in off.items() if m is not None})
        titles = ("start strain (%)", "dissipated (kJ/m³)", "misfit of the loop (%)")
        for ax, title in zip(axes[:3], titles, strict=True):
            ax.set_title(title)
        for ax, name in zip(axes[3:], varied, strict=True):
            _parameter(ax, found, name)
        for ax in axes:
            _axis(ax, sorted(results))
        figure.suptitle("\n".join(lines), x=0.01, ha="left", fontsize=8, parse_math=False)
    return figure


def _loops(ax: Axes, found: FittedCycles) -> None:
    """Measured loops over each other, from light to dark; the first and the last one fitted."""
    import matplotlib

    there = [
        n for n, r in sorted(found.results.items()) if r.curves.measured_displacement is not None
    ]
    keep = np.unique(np.geomspace(1, max(len(there), 1), MOST_LOOPS).astype(int)) - 1
    shown = [there[i] for i in keep if i < len(there)]
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, max(len(shown), 1)))
    for number, colour in zip(shown, colours, strict=False):
        result = found.results[number]
        curves, height = result.curves, result.measurement.specimen.height
        assert curves.measured_displacement is not None
        strain = curves.measured_displacement / height + result.measurement.start_strain
        measured, fitted = curves.measured_stress, curves.stress_along
        if measured is not None:
            label = f"cycle {number}"
            ax.plot(strain, measured / 1e3, color=colour, linewidth=0.9, label=label)
        if fitted is not None and number in (shown[0], shown[-1]):
            label = f"_cycle {number}, fitted"
            ax.plot(strain, fitted / 1e3, ":", color="black", linewidth=0.8, label=label)
    ax.set_xlabel("strain from the first contact")
    ax.set_ylabel("stress (kPa)")
    ax.set_title("measured; first and last fitted (dotted)")
    if shown:
        ax.legend(loc="upper left", fontsize=6.5, handlelength=1.2, labelspacing=0.25)


def _by_cycle(ax: Axes, values: dict[int, float]) -> None:
    style: dict[str, Any] = {"color": BLUE, "markersize": 3, "linewidth": 0.8}
    ax.plot(list(values), list(values.values()), "o-", label="_each cycle alone", **style)


def _short(name: str, found: FittedCycles) -> str:
    """Name of a parameter, without the spring where there is one alone."""
    return name if "+" in found.model else name.removeprefix("s1_")


def _scale(values: Sequence[float], unit: str) -> tuple[float, str]:
    """Factor and unit in which values are drawn."""
    largest = max((abs(value) for value in values), default=0.0)
    if unit == "Pa":
        return (1e-6, "MPa") if largest >= 1e6 else (1e-3, "kPa")
    return 1.0, unit


def _parameter(ax: Axes, found: FittedCycles, name: str) -> None:
    """One parameter with its 95 % intervals against the cycle."""
    points = [
        (n, r.parameters[name]) for n, r in sorted(found.results.items()) if name in r.parameters
    ]
    unit = points[0][1].unit
    factor, shown = _scale([p.value for _, p in points], unit)
    ax.set_title(_short(name, found) + (f" ({shown})" if shown else ""))
    for number, p in points:
        sure = p.state == "determined"
        if p.ci95 is not None and np.all(np.isfinite(p.ci95)):
            ends = [factor * end for end in p.ci95]
            ax.plot([number] * 2, ends, color=GREY, linewidth=0.8, label="_95 % interval")
        face, label = BLUE if sure else "white", f"_each cycle alone, {p.state}"
        ax.plot(
            number, factor * p.value, "o", color=BLUE, markerfacecolor=face, markersize=3.5,
            label=label,
        )  # fmt: skip
    if found.selection is not None:
        best = found.selection.best.fits[0]
        if name in (*best.shared, *found.selection.best.own):
            values = factor * np.array(best.value(name))
            label = "_fitted together"
            ax.plot(found.together, values, color=VERMILION, linewidth=0.9, zorder=0, label=label)
    _limit(ax, factor, [p for _, p in points], found, name)


def _limit(ax: Axes, factor: float, points: Sequence[Any], found: FittedCycles, name: str) -> None:
    """Let wide intervals run out of the panel rather than flatten the values."""
    values = [factor * p.value for p in points]
    if found.selection is not None and name in found.selection.best.fits[0].shared:
        values += [factor * v for v in found.selection.best.fits[0].value(name)]
    ends = [factor * end for p in points for end in (p.ci95 or ()) if np.isfinite(end)]
    low, high = min(values), max(values)
    room = max(1.5 * (high - low), 0.25 * max(abs(low), abs(high)), 1e-12)
    ax.set_ylim(
        max(min([low, *ends]), low - room) - 0.06 * room,
        min(max([high, *ends]), high + room) + 0.06 * room,
    )


def _axis(ax: Axes, numbers: Sequence[int]) -> None:
    ax.set_xlabel("cycle")
    if numbers and numbers[-1] >= FAR * numbers[0]:
        ax.set_xscale("log")
    elif len(numbers) <= 8:
        ax.set_xticks(list(numbers))
