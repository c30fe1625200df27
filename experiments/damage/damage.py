"""What changes from cycle to cycle, and by wear? Shoe foam, and printed lattices to cycle 1000.

Method and answer: README.md. Also written: twins.csv, lattice.csv and lattice.png.

    FOAMFIT_DATA=… python experiments/damage/damage.py    # --page: from the tables alone
"""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.text import significant

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies

HERE = Path(__file__).parent
MODEL = {"model": "microscale", "relaxation": 1}
NAMES = tuple(f"s1_{name}" for name in (*studies.MICROSCALE, "g1", "tau1"))
SHOWN = ("start_strain", "dissipated_energy", "misfit_stress_strain", *NAMES)
# Compared by wear; a single test cannot separate kc and eps_star.
WORN = ("dissipated_energy", "peak_stress", *(n for n in NAMES if n[3:] not in ("kc", "eps_star")))
SHARES = ("start_strain", "misfit_stress_strain")
LATTICE_CYCLES = (1, 2, 10, 100, 1000)


def fitted(
    names: Sequence[str], folder: Path, **options: Any
) -> tuple[pd.DataFrame, dict[str, ff.CycleFits]]:
    """Fit the cycles of some specimens; return one row per specimen and cycle, and the fits."""
    found = {}
    for name in names:
        path = records.place(name, folder)
        found[name] = ff.fit_cycles(path, intervals="local", **MODEL, **options)
        print(name, len(found[name].results), "cycles", file=sys.stderr)
    tables = {name: one.by_cycle.reset_index() for name, one in found.items()}
    return pd.concat(tables, names=["specimen", None]).reset_index("specimen"), found


def twin_table(table: pd.DataFrame) -> str:
    """Return mean and standard deviation by cycle, new and worn; how often it is determined."""
    rows = []
    for (name, cycle), group in table.groupby([table["specimen"].str.split("-").str[0], "cycle"]):
        if len(group) < 5:
            continue
        shown = [name, str(cycle)]
        for column in SHOWN:
            m, s = group[column].mean(), group[column].std()
            pressure = column.removeprefix("s1_").startswith(("k", "sigma", "dissipated"))
            unit = 1e3 if pressure else 1.0  # kPa or kJ/m³
            text = f"{significant(m / unit, 3)} ± {significant(s / unit, 2)}"
            if column in NAMES:
                text += f" ({(group[f'{column}_state'] == 'determined').sum()})"
            shown.append(f"{100 * m:.2f} ± {100 * s:.2f} %" if column in SHARES else text)
        rows.append(shown)
    head = ["", "cycle", "start strain", "dissipated (kJ/m³)", "misfit", *(n[3:] for n in NAMES)]
    return studies.markdown(head, rows) + "\n\nStiffnesses and stresses in kPa, tau1 in s."


def changed(group: pd.DataFrame, column: str, first: int, last: int) -> tuple[float, float, int]:
    """Return mean and standard deviation of a column's ratio of two cycles; count the rises."""
    by = group.pivot_table(index="specimen", columns="cycle", values=column)
    ratio = by[last] / by[first]
    if not np.isfinite(ratio).all():  # a value at its bound of zero has no ratio
        return 1.0, math.inf, 0
    return float(ratio.mean()), float(ratio.std()), int((ratio > 1).sum())


def twin_changes(table: pd.DataFrame) -> str:
    """List the changes from cycle 1 to 2 and from cycle 2 to 6."""
    lines = []
    for first, last in ((1, 2), (2, 6)):
        parts = []
        for column in ("dissipated_energy", *NAMES):
            mean, spread, rises = changed(table, column, first, last)
            if abs(mean - 1.0) > 2.0 * spread / 10**0.5 and rises in (0, 1, 9, 10):
                name = "dissipated energy" if "energy" in column else f"`{column[3:]}`"
                parts.append(f"{name} × {mean:.2f} (± {spread:.2f})")
        lines.append(
            f"- From cycle {first} to {last} these change in the same direction in at least nine "
            "of the ten specimens (mean ratio ± standard deviation): "
            f"{'; '.join(parts) or 'nothing'}."
        )
    return "\n".join(lines)


def worn_table(table: pd.DataFrame, cycle: int) -> str:
    """Compare worn with new specimens in one cycle: Welch's test of the logarithms, Holm (1979)."""
    own = table[table["cycle"] == cycle].set_index("specimen")[list(WORN)]
    logs = [np.log(own[own.index.str.startswith(heel)]) for heel in ("worn", "new")]
    found = stats.ttest_ind(*logs, equal_var=False)
    ends = found.confidence_interval()
    change = np.expm1([logs[0].mean() - logs[1].mean(), ends.low, ends.high]).T
    order = np.argsort(found.pvalue)
    left = len(WORN) - np.arange(len(WORN))
    corrected = np.maximum.accumulate(np.minimum(left * found.pvalue[order], 1.0))
    rows = []
    for i, holm in zip(order, corrected, strict=True):
        text = "{:+.0f} % ({:+.0f} to {:+.0f} %)".format(*(100.0 * change[i])).replace("-", "−")
        p_values = (significant(p, 2) for p in (found.pvalue[i], holm))
        rows.append([f"`{WORN[i].removeprefix('s1_')}`", text, *p_values])
    return studies.markdown(f"cycle {cycle} | worn over new, less one | p | p, corrected", rows)


def lattice_table(table: pd.DataFrame) -> str:
    head = "lattice | cycle | start strain | peak stress (kPa) | dissipated (kJ/m³) | misfit"
    rows = (
        (row.specimen, row.cycle, f"{100 * row.start_strain:.1f} %", f"{row.peak_stress / 1e3:.0f}",
         f"{row.dissipated_energy / 1e3:.1f}", f"{100 * row.misfit_stress_strain:.2f} %")
        for row in table.itertuples()
    )  # fmt: skip
    return studies.markdown(head, rows)


def lattice_changes(table: pd.DataFrame) -> str:
    return "\n".join(
        f"- From cycle {first} to {last} the peak stress changes by a factor of "
        f"{changed(table, 'peak_stress', first, last)[0]:.2f}, the dissipated energy by "
        f"{changed(table, 'dissipated_energy', first, last)[0]:.2f} (mean of three lattices)."
        for first, last in ((1, 2), (2, 1000))
    )


def draw_lattices(found: dict[str, ff.CycleFits]) -> None:
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, len(LATTICE_CYCLES)))
    with studies.sheet(HERE / "lattice.png", 7.4, 2.3, 250) as figure:
        axes = figure.subplots(1, 3)
        for ax, (name, one) in zip(axes, found.items(), strict=True):
            for (cycle, result), colour in zip(sorted(one.results.items()), colours, strict=True):
                m = result.measurement
                strain = m.displacement / m.specimen.height + m.start_strain
                ax.plot(strain, m.stress / 1e3, color=colour, linewidth=0.8, label=f"cycle {cycle}")
            ax.set(title=name, xlabel="strain from the first contact", ylabel="stress (kPa)")
        axes[0].legend(fontsize=6)


def measure() -> None:
    """Fit all cycles; write both tables and the figure."""
    studies.measurements("shoe-foam-twins", "lattice-cycles")
    with studies.workplace() as folder:
        lattices, found = fitted(records.LATTICES, folder, cycles=LATTICE_CYCLES)
        twins, _ = fitted(records.HEELS, folder)
    studies.write_csv(twins, HERE / "twins.csv", 6)
    studies.write_csv(lattices, HERE / "lattice.csv", 6)
    draw_lattices(found)


def main() -> None:
    if not studies.arguments(__doc__, page=True).parse_args().page:
        measure()
    twins, lattices = (pd.read_csv(HERE / f"{name}.csv") for name in ("twins", "lattice"))
    worn = "\n\n".join(worn_table(twins, cycle) for cycle in (1, 5))
    studies.write_page(
        HERE, twins=twin_table(twins), told=twin_changes(twins), worn=worn,
        lattice=lattice_table(lattices), lattice_told=lattice_changes(lattices),
    )  # fmt: skip


if __name__ == "__main__":
    main()
