"""What changes from cycle to cycle: twins of a shoe foam, and printed lattices up to cycle 1000.

The measurements are not part of this repository. Give their folder:

    FOAMFIT_DATA=path/to/data python experiments/damage/damage.py

It holds shoe-foam-twins/ (arXiv:2602.12694, LivingMatterLab/CANN: five specimens each of the heel
of a new and of a worn shoe, compressed 6 times) and lattice-cycles/ (printed TPU lattices,
mev43/FYP-Cyclic-Compression-Data-Analysis: 1000 cycles, of which 145 are recorded).

Writes damage.md, twins.csv, twins.png, lattice.csv and lattice.png beside this file.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.one_model import Options
from foamfit.report.figures import BLUE, VERMILION, drawing, save
from foamfit.study.shared import Group, Selection, select_own
from foamfit.text import significant

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from specimens import twins, write_specimen  # noqa: E402

MODEL = {"model": "microscale", "relaxation": 1}
LAW = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")
NAMES = tuple(f"s1_{name}" for name in (*LAW, "g1", "tau1"))
TOGETHER = (1, 2, 4)
LATTICES, LATTICE_CYCLES = ("tpu87-20", "tpu87-35", "tpu87-50"), (1, 2, 10, 100, 1000)
LATTICE = """\
time = { column = "Total Time (s)" }
displacement = { column = "Position(Linear:Position) (mm)", counts_down = true }
force = { column = "Force(Linear:Load) (kN)", scale = -1 }
cycle = { column = "Total Cycles" }"""
PAGE = """\
# What changes from cycle to cycle

Made by `python experiments/damage/damage.py`; the data are not part of this repository. A later
cycle starts at its own contact: its start strain, which the specimen has not recovered since the
first contact, is taken off.

## Ten specimens of running-shoe foam (measurements: arXiv:2602.12694)

Five specimens each of the heel of a new and of a worn shoe, 6 cycles, one microscale spring
with one relaxation term (9 parameters), each cycle of each specimen on its own (`twins.csv`). Mean
over five specimens ± standard deviation:

![Parameters by cycle, new and worn](twins.png)

{twins}

{told}

### Cycles {cycles} together

Each specimen is one fit of three cycles; which parameters each cycle has of its own is chosen by
BIC summed over the ten specimens (one parameter more in each
step, then exchanges; {n_eff} effective samples: stretches in which a cycle's own fit lies on one
side of its curve). Misfit: RMS of the stress over its range, least to largest of the ten specimens.

{steps}

{chosen}

## Printed TPU lattices (measurements: mev43/FYP-Cyclic-Compression-Data-Analysis)

6 mm at 1 Hz; the column of the machine numbers the cycles. The size of the specimens is not stated:
20 mm × 12 mm is assumed, so that stresses and strains compare within a specimen alone. Their loop
has neither a plateau nor densification, so that most of the nine parameters are not determined one
by one; what the loop itself says is below, and `lattice.csv` has the parameters.

![Loops and what they say by cycle](lattice.png)

{lattice}

{lattice_told}
"""


def markdown(rows: Sequence[Sequence[str]]) -> str:
    head, *rest = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([head, "|" + " --- |" * len(rows[0]), *rest])


def percent(share: float) -> str:
    return f"{100 * share:.2g} %"


# ------------------------------------------------------------------------------- the twins


def fit_twins(data: Path, toml: Path) -> tuple[pd.DataFrame, list[Group]]:
    """One row per specimen and cycle, and for each specimen the cycles to be fitted together."""
    rows, groups = [], []
    for name, height, diameter in twins(data / "shoe-foam-twins"):
        write_specimen(toml, height, diameter)
        path = data / "shoe-foam-twins" / f"{name}_raw.txt"
        found = ff.fit_cycles(path, toml, together=False, intervals="local", **MODEL)
        table = found.table.reset_index()
        table.insert(0, "specimen", name)
        rows.append(table)
        options = Options(relaxation=1)
        fits = [found.results[n] for n in TOGETHER]
        problems = tuple(options.problem(r.measurement, r.model, r.params) for r in fits)
        groups.append(Group(problems, tuple(p.vector() for p in problems)))
        print(name, len(found.results), "cycles", file=sys.stderr)
    return pd.concat(rows, ignore_index=True), groups


def kind(table: pd.DataFrame, name: str) -> pd.DataFrame:
    return table[table["specimen"].str.startswith(name)]


def twin_columns() -> list[str]:
    return ["start_strain", "dissipated_energy", "misfit_stress_strain", *NAMES]


def twin_table(table: pd.DataFrame) -> str:
    """Mean and standard deviation by cycle, new and worn."""
    head = ["", "cycle", "start strain", "dissipated (kJ/m³)", "misfit", *(n[3:] for n in NAMES)]
    rows = [head]
    for name in ("new", "worn"):
        for cycle, group in kind(table, name).groupby("cycle"):
            if len(group) < 5:
                continue
            mean, spread = group[twin_columns()].mean(), group[twin_columns()].std()
            shown = [name, str(cycle)]
            for column in twin_columns():
                m, s = mean[column], spread[column]
                if column in ("start_strain", "misfit_stress_strain"):
                    shown.append(f"{100 * m:.2f} ± {100 * s:.2f} %")
                else:
                    pressure = column.removeprefix("s1_").startswith(("k", "sigma", "dissipated"))
                    unit = 1e3 if pressure else 1.0
                    shown.append(f"{significant(m / unit, 3)} ± {significant(s / unit, 2)}")
            rows.append(shown)
    return markdown(rows) + "\n\nStiffnesses and stresses in kPa, tau1 in s."


def changed(group: pd.DataFrame, column: str, first: int, last: int) -> tuple[float, float, int]:
    """Mean ratio of a column from one cycle to another, its standard deviation, and the rises."""
    by = group.pivot_table(index="specimen", columns="cycle", values=column)
    ratio = by[last] / by[first]
    if not np.isfinite(ratio).all():  # a value at its limit of zero has no ratio
        return 1.0, math.inf, 0
    return float(ratio.mean()), float(ratio.std()), int((ratio > 1).sum())


def named(column: str) -> str:
    return "dissipated energy" if "energy" in column else f"`{column.removeprefix('s1_')}`"


def twins_told(table: pd.DataFrame) -> str:
    """What changes from the first to the second and from the second to the sixth cycle."""
    lines = []
    for first, last in ((1, 2), (2, 6)):
        parts = []
        for column in ("dissipated_energy", *NAMES):
            mean, spread, rises = changed(table, column, first, last)
            if abs(mean - 1.0) > 2.0 * spread / 10**0.5 and rises in (0, 1, 9, 10):
                parts.append(f"{named(column)} × {mean:.2f} (± {spread:.2f})")
        told = "; ".join(parts) or "nothing"
        lines.append(
            f"- From cycle {first} to {last} these change alike in at least nine of the ten "
            f"specimens (mean ratio ± standard deviation): {told}."
        )
    lines.append("- Worn against new: see the study of [twins](../twins/README.md).")
    return "\n".join(lines)


def steps_table(selection: Selection) -> str:
    head = ["of each cycle", "parameters", "BIC", *(f"misfit of cycle {n}" for n in TOGETHER)]
    rows = [[*head, "of what sharing costs, won back"]]
    tests = len(selection.best.fits)
    for step in selection.steps:
        off = np.array([[m["stress_strain"] for m in fit.misfits] for fit in step.fits], float)
        ends = [f"{100 * a:.2f}–{100 * b:.2f} %" for a, b in np.transpose([off.min(0), off.max(0)])]
        own = ", ".join(name[3:] for name in step.own) or "nothing"
        mark = " (chosen)" if step is selection.best else ""
        counts = str(step.n_vary // tests)
        won = percent(selection.explained(step))
        rows.append([own + mark, counts, f"{step.bic:.0f}", *ends, won])
    return markdown(rows)


def chosen_told(selection: Selection) -> str:
    best = selection.best
    own = ", ".join(f"`{name[3:]}`" for name in best.own)
    shared = ", ".join(f"`{name[3:]}`" for name in best.fits[0].shared)
    parts = []
    for name in best.own:
        middle = np.median([fit.value(name) for fit in best.fits], axis=0)
        kilo = 1e-3 if name[3:].startswith(("k", "sigma")) else 1.0
        shown = ", ".join(significant(kilo * value, 3) for value in middle)
        parts.append(f"`{name[3:]}` {shown}{' kPa' if kilo < 1 else ''}")
    return (
        f"Each cycle has {own} of its own; {shared} are shared. Median over the specimens in "
        f"cycles {', '.join(map(str, TOGETHER))}: {'; '.join(parts)}."
    )


def draw_twins(table: pd.DataFrame) -> None:
    columns = twin_columns()
    with drawing(7.4, 5.2) as figure:
        axes = figure.subplots(3, 4)
        for ax, column in zip(axes.flat, columns, strict=True):
            for name, colour, off in (("new", BLUE, -0.06), ("worn", VERMILION, 0.06)):
                by = kind(table, name).groupby("cycle")[column].agg(["mean", "std", "count"])
                by = by[by["count"] == 5]
                scale = {"start_strain": 100, "misfit_stress_strain": 100}.get(column, 1.0)
                if column.startswith(("s1_k", "s1_sigma", "dissipated")):
                    scale = 1e-3
                ax.errorbar(
                    by.index + off, scale * by["mean"], scale * by["std"], color=colour,
                    marker="o", markersize=3, linewidth=0.8, label=name,
                )  # fmt: skip
            unit = {"start_strain": " (%)", "misfit_stress_strain": " (%)", "s1_tau1": " (s)"}
            unit["dissipated_energy"] = " (kJ/m³)"
            kilo = " (kPa)" if column.startswith(("s1_k", "s1_sigma")) else ""
            title = column.removeprefix("s1_").removesuffix("_stress_strain").replace("_energy", "")
            ax.set_title(title + unit.get(column, kilo))
            ax.set_ylim(bottom=0)
            ax.set_xlabel("cycle")
            ax.set_xticks(range(1, 7))
        axes.flat[0].legend(loc="lower right")
        save(figure, HERE / "twins.png")


# ------------------------------------------------------------------------------- the lattices


def fit_lattices(data: Path, toml: Path) -> tuple[pd.DataFrame, dict[str, ff.CycleFits]]:
    write_specimen(toml, "12 mm", "20 mm", LATTICE)
    rows, found = [], {}
    for name in LATTICES:
        path = data / "lattice-cycles" / f"{name}_raw.csv"
        found[name] = ff.fit_cycles(
            path, toml, cycles=LATTICE_CYCLES, together=False, intervals="local", **MODEL
        )
        table = found[name].table.reset_index()
        table.insert(0, "specimen", name)
        rows.append(table)
        print(name, len(found[name].results), "cycles", file=sys.stderr)
    return pd.concat(rows, ignore_index=True), found


def lattice_table(table: pd.DataFrame) -> str:
    rows = [
        ["lattice", "cycle", "start strain", "peak stress (kPa)", "dissipated (kJ/m³)", "misfit"]
    ]
    for row in table.itertuples():
        rows.append(
            [
                row.specimen,
                str(row.cycle),
                f"{100 * row.start_strain:.1f} %",
                f"{row.peak_stress / 1e3:.0f}",
                f"{row.dissipated_energy / 1e3:.1f}",
                f"{100 * row.misfit_stress_strain:.2f} %",
            ]
        )
    return markdown(rows)


def lattice_told(table: pd.DataFrame) -> str:
    lines = []
    for first, last in ((1, 2), (2, 1000)):
        peak, loss = (
            changed(table, column, first, last)[0]
            for column in ("peak_stress", "dissipated_energy")
        )
        lines.append(
            f"- From cycle {first} to {last} the peak stress changes by a factor of {peak:.2f}, "
            f"the dissipated energy by {loss:.2f} (mean of three lattices)."
        )
    last = table[table["cycle"] == 1000].set_index("specimen")["start_strain"]
    gone = ", ".join(f"{100 * value:.1f} % ({name})" for name, value in last.items())
    lines.append(f"- At cycle 1000 contact starts at a strain of {gone}, and it still rises.")
    lines.append(
        "- Cycle 1 starts under the preload of the machine (20 N), which no law that starts at "
        "zero stress follows: hence its larger misfit."
    )
    return "\n".join(lines)


def draw_lattices(table: pd.DataFrame, found: dict[str, ff.CycleFits]) -> None:
    import matplotlib

    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, len(LATTICE_CYCLES)))
    with drawing(7.4, 3.9) as figure:
        axes = figure.subplots(2, 3)
        for ax, (name, one) in zip(axes[0], found.items(), strict=True):
            for (cycle, result), colour in zip(sorted(one.results.items()), colours, strict=True):
                m = result.measurement
                strain = m.displacement / m.specimen.height + m.start_strain
                ax.plot(strain, m.stress / 1e3, color=colour, linewidth=0.8, label=f"cycle {cycle}")
            ax.set(title=name, xlabel="strain from the first contact", ylabel="stress (kPa)")
        axes[0, 0].legend(fontsize=6)
        shown = {
            "start_strain": ("start strain (%)", 100.0, False),
            "peak_stress": ("peak stress over cycle 1", 1.0, True),
            "dissipated_energy": ("dissipated energy over cycle 1", 1.0, True),
        }
        for ax, (column, (title, scale, relative)) in zip(axes[1], shown.items(), strict=True):
            for name, group in table.groupby("specimen"):
                values = scale * group[column].to_numpy()
                values = values / values[0] if relative else values
                ax.plot(group["cycle"], values, "o-", markersize=3, linewidth=0.8, label=name)
            ax.set(title=title, xlabel="cycle", xscale="log")
        axes[1, 0].legend(fontsize=6)
        save(figure, HERE / "lattice.png")


def main() -> None:
    data = Path(os.environ.get("FOAMFIT_DATA", ""))
    if not (data / "shoe-foam-twins").is_dir():
        raise SystemExit("set FOAMFIT_DATA to the folder that holds shoe-foam-twins/")
    with tempfile.TemporaryDirectory() as folder:
        toml = Path(folder) / "specimen.toml"
        lattices, found = fit_lattices(data, toml)
        twins, groups = fit_twins(data, toml)
    twins.to_csv(HERE / "twins.csv", index=False, float_format="%.6g")
    lattices.to_csv(HERE / "lattice.csv", index=False, float_format="%.6g")
    draw_twins(twins)
    draw_lattices(lattices, found)
    selection = select_own(groups, progress=lambda _, what: print(what, file=sys.stderr))
    page = PAGE.format(
        twins=twin_table(twins), told=twins_told(twins), cycles=", ".join(map(str, TOGETHER)),
        n_eff=selection.n_eff, steps=steps_table(selection),
        chosen=chosen_told(selection), lattice=lattice_table(lattices),
        lattice_told=lattice_told(lattices),
    )  # fmt: skip
    (HERE / "damage.md").write_text(page)


if __name__ == "__main__":
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
