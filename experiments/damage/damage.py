"""What changes in a shoe foam from cycle to cycle, and by wear?

Method and answer: README.md. Also written: twins.csv and twins.png.

    FOAMFIT_DATA=… python experiments/damage/damage.py    # --page: from the table alone
"""

import math
import sys
from pathlib import Path

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


def fitted(folder: Path) -> pd.DataFrame:
    """Fit the cycles of all specimens; return one row per specimen and cycle."""
    tables = {}
    for name in records.HEELS:
        found = ff.fit_cycles(records.place(name, folder), intervals="local", **MODEL)
        tables[name] = found.by_cycle.reset_index()
        print(name, len(found.results), "cycles", file=sys.stderr)
    return pd.concat(tables, names=["specimen", None]).reset_index("specimen")


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


def draw(table: pd.DataFrame) -> None:
    """Draw mean and standard deviation over five specimens of what changes, by cycle."""
    names = {"dissipated_energy": (1e3, "dissipated energy (kJ/m³)"), "s1_k0": (1e3, "k₀ (kPa)"),
             "s1_sigma_plus": (1e3, "σ₊ (kPa)"), "s1_g1": (1.0, "g₁ (–)")}  # fmt: skip
    groups = table.groupby([table["specimen"].str.partition("-")[0], "cycle"])[list(names)]
    mean, spread = groups.mean(), groups.std()
    with studies.sheet(HERE / "twins.png", 7.4, 2.1) as figure:
        for ax, (name, (unit, label)) in zip(figure.subplots(1, 4), names.items(), strict=True):
            for heel, colour in (("new", studies.BLUE), ("worn", studies.VERMILION)):
                own, off = mean.loc[heel, name] / unit, spread.loc[heel, name] / unit
                ax.errorbar(own.index, own, off, color=colour, marker=".", lw=0.9, label=heel)
            ax.set(title=label, xlabel="cycle", ylim=(0.0, None), xticks=own.index)
        ax.legend(loc="lower right")


def main() -> None:
    if not studies.arguments(__doc__, page=True).parse_args().page:
        studies.measurements("shoe-foam-twins")
        with studies.workplace() as folder:
            studies.write_csv(fitted(folder), HERE / "twins.csv", 6)
    twins = pd.read_csv(HERE / "twins.csv")
    draw(twins)
    worn = "\n\n".join(worn_table(twins, cycle) for cycle in (1, 5))
    studies.write_page(HERE, twins=twin_table(twins), told=twin_changes(twins), worn=worn)


if __name__ == "__main__":
    main()
