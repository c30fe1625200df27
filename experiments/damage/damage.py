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
    """Return mean and standard deviation by cycle, of new and worn heels; kPa, kJ/m³ and %."""
    pressures = ("k", "sigma", "dissipated")
    factors = [
        100.0 if name in SHARES else 1e-3 if name.removeprefix("s1_").startswith(pressures) else 1.0
        for name in SHOWN
    ]
    by = [table["specimen"].str.partition("-")[0], table["cycle"]]
    groups = (table[list(SHOWN)] * factors).groupby(by)
    cells = groups.mean().map("{:.3g}".format) + " ± " + groups.std().map("{:.3g}".format)
    head = ["", "cycle", "start strain (%)", "dissipated", "misfit (%)", *(n[3:] for n in NAMES)]
    return studies.markdown(head, cells.reset_index().to_numpy())


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
    texts = ["{:+.0f} % ({:+.0f} to {:+.0f} %)".format(*row) for row in 100.0 * change[order]]
    return studies.shown(pd.DataFrame({
        f"cycle {cycle}": [f"`{WORN[i].removeprefix('s1_')}`" for i in order],
        "worn over new, less one": [text.replace("-", "−") for text in texts],
        "p": found.pvalue[order], "p, corrected": corrected,
    }), 2)  # fmt: skip


def lattice_table(table: pd.DataFrame) -> str:
    return studies.shown(pd.DataFrame({
        "lattice": table["specimen"], "cycle": table["cycle"],
        "start strain (%)": 100.0 * table["start_strain"],
        "peak stress (kPa)": 1e-3 * table["peak_stress"],
        "dissipated (kJ/m³)": 1e-3 * table["dissipated_energy"],
        "misfit (%)": 100.0 * table["misfit_stress_strain"],
    }))  # fmt: skip


def lattice_changes(table: pd.DataFrame) -> str:
    text = (
        "- From cycle {} to {} the peak stress changes by a factor of {:.2f}, the dissipated "
        "energy by {:.2f} (mean of three lattices)."
    )
    columns = ("peak_stress", "dissipated_energy")
    pairs = ((1, 2), (2, 1000))
    return "\n".join(
        text.format(*two, *(changed(table, column, *two)[0] for column in columns)) for two in pairs
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
