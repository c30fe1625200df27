"""What changes from cycle to cycle? Twins of a shoe foam, and printed lattices up to cycle 1000.

Method. shoe-foam-twins/ (arXiv:2602.12694, LivingMatterLab/CANN) are five specimens each of the
heel of a new and of a worn shoe, compressed 6 times; lattice-cycles/ (printed TPU lattices,
mev43/FYP-Cyclic-Compression-Data-Analysis) are 1000 cycles, of which 145 are recorded. Every cycle
is fitted on its own by a microscale spring with relaxation; then three cycles of each twin
together, and the parameters that each cycle has of its own are chosen by BIC. The measurements are
not part of this repository.

Answer. Snap-through and relaxation change from cycle to cycle: see damage.md. Beside it: twins.csv,
twins.png, lattice.csv and lattice.png.

    FOAMFIT_DATA=path/to/data python experiments/damage/damage.py
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from selection import Selection, select_own

import foamfit as ff
from foamfit.fitting.together import Together
from foamfit.one_model import Options
from foamfit.report.figures import BLUE, DPI, VERMILION
from foamfit.text import significant

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

MODEL = {"model": "microscale", "relaxation": 1}
LAW = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")
NAMES = tuple(f"s1_{name}" for name in (*LAW, "g1", "tau1"))
SHOWN = ("start_strain", "dissipated_energy", "misfit_stress_strain", *NAMES)
SHARES = ("start_strain", "misfit_stress_strain")
TOGETHER = (1, 2, 4)
LATTICES, LATTICE_CYCLES = ("tpu87-20", "tpu87-35", "tpu87-50"), (1, 2, 10, 100, 1000)
LATTICE = """\
time = { column = "Total Time (s)" }
displacement = { column = "Position(Linear:Position) (mm)", counts_down = true }
force = { column = "Force(Linear:Load) (kN)", scale = -1 }
cycle = { column = "Total Cycles" }"""


def is_pressure(column: str) -> bool:
    """Whether a column is told in kPa, or in kJ/m³."""
    return column.removeprefix("s1_").startswith(("k", "sigma", "dissipated"))


# ------------------------------------------------------------------------------- the twins


def fit_twins(data: Path, toml: Path) -> tuple[pd.DataFrame, list[Together]]:
    """One row per specimen and cycle, and for each specimen the cycles to be fitted together."""
    rows, groups = [], []
    for name, height, diameter in studies.twins(data / "shoe-foam-twins"):
        studies.write_specimen(toml, height, diameter)
        path = data / "shoe-foam-twins" / f"{name}_raw.txt"
        found = ff.fit_cycles(path, toml, intervals="local", **MODEL)
        rows.append(found.by_cycle.reset_index().assign(specimen=name))
        fits = [found.results[n] for n in TOGETHER]
        options = Options(relaxation=1)
        problems = tuple(options.problem(r.measurement, r.model, r.params) for r in fits)
        groups.append(Together.of_own_fits(problems, [p.vector() for p in problems]))
        print(name, len(found.results), "cycles", file=sys.stderr)
    return specimen_first(rows), groups


def specimen_first(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """Put tables of specimens below each other, the name of the specimen first."""
    table = pd.concat(tables, ignore_index=True)
    return table[["specimen", *table.columns.drop("specimen")]]


def kind(table: pd.DataFrame, name: str) -> pd.DataFrame:
    return table[table["specimen"].str.startswith(name)]


def twin_table(table: pd.DataFrame) -> str:
    """Mean and standard deviation by cycle, new and worn."""
    rows = []
    for name in ("new", "worn"):
        for cycle, group in kind(table, name).groupby("cycle"):
            if len(group) < 5:
                continue
            shown = [name, str(cycle)]
            for column in SHOWN:
                m, s = group[column].mean(), group[column].std()
                unit = 1e3 if is_pressure(column) else 1.0
                told = f"{significant(m / unit, 3)} ± {significant(s / unit, 2)}"
                shown.append(f"{100 * m:.2f} ± {100 * s:.2f} %" if column in SHARES else told)
            rows.append(shown)
    head = ["", "cycle", "start strain", "dissipated (kJ/m³)", "misfit", *(n[3:] for n in NAMES)]
    return studies.markdown(head, rows) + "\n\nStiffnesses and stresses in kPa, tau1 in s."


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
                name = "dissipated energy" if "energy" in column else f"`{column[3:]}`"
                parts.append(f"{name} × {mean:.2f} (± {spread:.2f})")
        lines.append(
            f"- From cycle {first} to {last} these change alike in at least nine of the ten "
            f"specimens (mean ratio ± standard deviation): {'; '.join(parts) or 'nothing'}."
        )
    lines.append("- Worn against new: see the study of [twins](../twins/README.md).")
    return "\n".join(lines)


def steps_table(selection: Selection) -> str:
    rows, tests = [], len(selection.best.fits)
    for step in selection.steps:
        off = np.array([[m["stress_strain"] for m in fit.misfits] for fit in step.fits], float)
        ends = [f"{100 * a:.2f}–{100 * b:.2f} %" for a, b in np.transpose([off.min(0), off.max(0)])]
        own = ", ".join(name[3:] for name in step.own) or "nothing"
        mark = " (chosen)" if step is selection.best else ""
        won = f"{100 * selection.explained(step):.2g} %"
        rows.append([own + mark, step.n_vary // tests, f"{step.bic:.0f}", *ends, won])
    misfits = (f"misfit of cycle {n}" for n in TOGETHER)
    head = ["of each cycle", "parameters", "BIC", *misfits, "of what sharing costs, won back"]
    return studies.markdown(head, rows)


def chosen_told(selection: Selection) -> str:
    best, parts = selection.best, []
    for name in best.own:
        middle = np.median([fit.value(name) for fit in best.fits], axis=0)
        kilo, unit = (1e-3, " kPa") if is_pressure(name) else (1.0, "")
        shown = ", ".join(significant(kilo * value, 3) for value in middle)
        parts.append(f"`{name[3:]}` {shown}{unit}")
    own, shared = (", ".join(f"`{n[3:]}`" for n in ns) for ns in (best.own, best.fits[0].shared))
    return (
        f"Each cycle has {own} of its own; {shared} are shared. Median over the specimens in "
        f"cycles {', '.join(map(str, TOGETHER))}: {'; '.join(parts)}."
    )


def draw_twins(table: pd.DataFrame) -> None:
    units = {**dict.fromkeys(SHARES, (100, " (%)")), "s1_tau1": (1, " (s)")}
    units["dissipated_energy"] = 1e-3, " (kJ/m³)"
    with studies.sheet(HERE / "twins.png", 7.4, 5.2, DPI) as figure:
        axes = figure.subplots(3, 4)
        for ax, column in zip(axes.flat, SHOWN, strict=True):
            scale, unit = units.get(column, (1e-3, " (kPa)") if is_pressure(column) else (1, ""))
            for name, colour, off in (("new", BLUE, -0.06), ("worn", VERMILION, 0.06)):
                by = kind(table, name).groupby("cycle")[column].agg(["mean", "std", "count"])
                by = by[by["count"] == 5]
                ax.errorbar(
                    by.index + off, scale * by["mean"], scale * by["std"], color=colour,
                    marker="o", markersize=3, linewidth=0.8, label=name,
                )  # fmt: skip
            title = column.removeprefix("s1_").removesuffix("_stress_strain").replace("_energy", "")
            ax.set(title=title + unit, xlabel="cycle", xticks=range(1, 7))
            ax.set_ylim(bottom=0)
        axes.flat[0].legend(loc="lower right")


# ------------------------------------------------------------------------------- the lattices


def fit_lattices(data: Path, toml: Path) -> tuple[pd.DataFrame, dict[str, ff.CycleFits]]:
    studies.write_specimen(toml, "12 mm", "20 mm", LATTICE)
    found = {
        name: ff.fit_cycles(
            data / "lattice-cycles" / f"{name}_raw.csv", toml, cycles=LATTICE_CYCLES,
            intervals="local", **MODEL,
        )
        for name in LATTICES
    }  # fmt: skip
    tables = [one.by_cycle.reset_index().assign(specimen=name) for name, one in found.items()]
    return specimen_first(tables), found


def lattice_table(table: pd.DataFrame) -> str:
    head = "lattice | cycle | start strain | peak stress (kPa) | dissipated (kJ/m³) | misfit"
    rows = (
        (row.specimen, row.cycle, f"{100 * row.start_strain:.1f} %", f"{row.peak_stress / 1e3:.0f}",
         f"{row.dissipated_energy / 1e3:.1f}", f"{100 * row.misfit_stress_strain:.2f} %")
        for row in table.itertuples()
    )  # fmt: skip
    return studies.markdown(head, rows)


def lattice_told(table: pd.DataFrame) -> str:
    lines = []
    for first, last in ((1, 2), (2, 1000)):
        columns = ("peak_stress", "dissipated_energy")
        peak, loss = (changed(table, column, first, last)[0] for column in columns)
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
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.95, len(LATTICE_CYCLES)))
    with studies.sheet(HERE / "lattice.png", 7.4, 3.9, DPI) as figure:
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


def main() -> None:
    studies.arguments(__doc__).parse_args()
    data = studies.measurements("shoe-foam-twins", "lattice-cycles")
    with tempfile.TemporaryDirectory() as folder:
        toml = Path(folder) / "specimen.toml"
        lattices, found = fit_lattices(data, toml)
        twins, groups = fit_twins(data, toml)
    studies.write_csv(twins, HERE / "twins.csv", 6)
    studies.write_csv(lattices, HERE / "lattice.csv", 6)
    draw_twins(twins)
    draw_lattices(lattices, found)
    selection = select_own(groups, progress=lambda _, what: print(what, file=sys.stderr))
    studies.write_page(
        HERE, "damage.md", twins=twin_table(twins), told=twins_told(twins),
        cycles=", ".join(map(str, TOGETHER)), n_eff=selection.n_eff, steps=steps_table(selection),
        chosen=chosen_told(selection), lattice=lattice_table(lattices),
        lattice_told=lattice_told(lattices),
    )  # fmt: skip


if __name__ == "__main__":
    studies.run(main, HERE)
