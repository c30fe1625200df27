"""How do the laws of foamfit compare with laws of the literature?

Method and answer: README.md. Also written: other_laws.csv (a row per fit) and other_laws.png.

    FOAMFIT_DATA=… python experiments/other_laws/other_laws.py    # --jobs 2 is faster
"""

import importlib
import re
import sys
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.springs import laws
from foamfit.springs.parameters import NUISANCE

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies

HERE = Path(__file__).parent
sys.path.append(str(HERE.parents[1] / "notebooks"))  # of bouc_wen.py
ROWS = 320  # of a thinned record
MEASURES = ("misfit", "predicted", "scaled")  # over the range of the measured stress


class Compared(NamedTuple):
    """One law of the table: model, relaxation terms, and the file that defines it."""

    name: str
    model: str
    relaxation: int = 0
    file: str = ""
    more: dict[str, Any] = {}  # further options of the fit  # noqa: RUF012


WORN = "microscale, stiffening, softening, weakening, relaxation"
LAWS = (
    Compared("microscale", "microscale"),
    Compared("microscale, relaxation", "microscale", 1),
    Compared(WORN, "microscale", 1, more={"stiffening": True, "mullins": True}),
    Compared("bistable", "bistable"),
    Compared("bistable, relaxation", "bistable", 1),
    Compared("bistable, power-law damper", "bistable-power-damper", 0, "power_law_damper"),
    Compared("quasi-linear viscoelastic: Ogden, two Prony terms", "ogden", 2, "ogden"),
    Compared("Ogden-Roxburgh, relaxation", "ogden-roxburgh", 1, "ogden_roxburgh"),
    Compared("Bouc-Wen, linear, relaxation", "bouc-wen", 1, "bouc_wen"),
    Compared("Bouc-Wen beside Ogden, relaxation", "bouc-wen-foam", 1, "bouc_wen_foam"),
    Compared("Maxwell-slip beside Ogden, relaxation", "maxwell-slip", 1, "maxwell_slip"),
    Compared("fractional element on Ogden, relaxation", "fractional", 1, "fractional"),
)
DRAWN = (1, 2, 6, 7, 9, 10, 11)  # laws in the figure
# Group, test and unseen test; for a lattice, the cycles.
FOAM, MYCELIUM, LATTICE, IMPACT = "shoe foams", "mycelium", "lattices", "impact"
TESTS = (
    (FOAM, "turbo-comp-1", "turbo-comp-2"),
    (FOAM, "leap-comp-2", "leap-comp-3"),
    (FOAM, "new-heel-comp-1", "new-heel-comp-2"),
    (FOAM, "worn-heel-comp-1", "worn-heel-comp-2"),
    (MYCELIUM, "outplane-4s-1", "outplane-4s-2"),
    (LATTICE, "tpu87-20 cycle 10", "tpu87-20 cycle 100"),
    (LATTICE, "tpu87-50 cycle 10", "tpu87-50 cycle 100"),
    (IMPACT, "cartilage 1", "cartilage 3"),
)
SHOWN = ("turbo-comp-1", "outplane-4s-1", "tpu87-20 cycle 10", "cartilage 1")


def read(name: str, folder: Path) -> ff.Measurement:
    """Read a test like a user; keep every n-th row, at most `ROWS`, and no striker."""
    record, _, cycle = name.partition(" cycle ")
    test = ff.read_test(records.place(record, folder), cycle=int(cycle) if cycle else None)
    step, own = -(-test.time.size // ROWS), test.specimen
    toml = f'name = "{test.name}"\n[specimen]\nheight = "{own.height} m"\narea = "{own.area} m^2"\n'
    columns = {name: getattr(test, name)[::step] for name in ("time", "stress", "displacement")}
    return ff.read_test(studies.write_test(folder / f"{name}.csv", toml, **columns))


def fit_all(case: tuple[str, str, str], starts: int) -> list[dict[str, Any]]:
    """Fit one test by every law and predict the unseen test; return rows with curves."""
    rows, (group, name, other) = [], case
    with studies.workplace() as folder:
        test, held_out = (read(one, folder) for one in (name, other))
        for law in LAWS:
            if law.file and not laws.is_registered(law.model):
                ff.register(importlib.import_module(law.file).LAW)
            options: dict[str, Any] = law.more | {"relaxation": law.relaxation}
            ff.fit(test, model=law.model, starts=1, max_time=0.2, intervals="local", **options)
            options |= {"model": law.model, "drive": "displacement", "starts": starts}
            result, seconds = studies.timed(ff.fit, test, **options)  # after compilation
            states = [p.state for n, p in result.parameters.items() if p.vary and n not in NUISANCE]
            strain, curves = result.strain, result.curves
            rows.append({
                "group": group, "test": name, "held_out": other, "law": law.name,
                "parameters": len(states), "misfit": result.misfit["stress_strain"],
                **predicted(result, held_out),
                **{s: states.count(s) for s in ("determined", "weak", "not determined")},
                "seconds": seconds, "rows": test.stress.size,
                "curves": (strain, curves.measured_stress, curves.stress),
            })  # fmt: skip
            off, cross = (100.0 * rows[-1][one] for one in ("misfit", "scaled"))
            print(f"{name:20}{law.name:50}{off:6.2f} %{cross:8.2f} %{seconds:7.1f} s", flush=True)
    return rows


def predicted(result: Any, test: ff.Measurement) -> dict[str, float]:
    """Return the misfit of an unseen test: as predicted, and after scaling the stress."""
    one = ff.predict(result, test, extrapolate=True).curves["stress_strain"]
    factors = {"predicted": 1.0}
    factors["scaled"] = one.predicted @ one.measured / (one.predicted @ one.predicted)
    return {
        name: float(np.sqrt(np.mean((k * one.predicted - one.measured) ** 2)) / one.range)
        for name, k in factors.items()
    }


def law_table(table: pd.DataFrame) -> str:
    """Return the table of the README: for each law, misfit and predicted misfit by group."""
    groups, rows = table["group"].unique(), []
    means = table.pivot_table(index="law", columns="group", values=list(MEASURES), sort=False)
    text = (100.0 * means).map("{:.2f}".format)
    text = text.where(means != means.min(), "**" + text + "**")
    for law, own in table.groupby("law", sort=False):
        cells = (" / ".join(text.loc[law, (one, group)] for one in MEASURES) for group in groups)
        rows.append([
            law, own["parameters"].iloc[0], *cells,
            f"{own['determined'].mean():.1f}", f"{own['seconds'].median():.1f} s",
        ])  # fmt: skip
    return studies.markdown(["law", "parameters", *groups, "determined", "run time"], rows)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw measured and fitted loops: a row for each kind of test, a column for each law."""
    found = {(row["test"], row["law"]): row for row in rows}
    names = [LAWS[i].name for i in DRAWN]
    tests = [name for name in SHOWN if any(test == name for test, _ in found)]
    with studies.sheet(path, 1.55 * len(names), 1.5 * len(tests) + 0.5) as figure:
        axes = figure.subplots(len(tests), len(names), sharey="row", sharex="row", squeeze=False)
        for (i, name), (column, law) in product(enumerate(tests), enumerate(names)):
            row, ax = found[name, law], axes[i, column]
            if name == tests[0]:
                title = re.sub(r"(?<=[:,]) | (?=on |beside )", "\n", law)
                ax.set_title(title, fontsize=6.5)
            if name == tests[-1]:
                ax.set_xlabel("strain (–)")
            strain, measured, fitted = row["curves"]
            factor, unit = (1e6, "MPa") if measured.max() > 1e6 else (1e3, "kPa")
            ax.plot(strain, measured / factor, color="0.6", lw=1.6)
            ax.plot(strain, fitted / factor, color=studies.VERMILION, lw=0.9)
            misfit = f"{100.0 * row['misfit']:.2f} %"
            ax.text(0.05, 0.95, misfit, transform=ax.transAxes, va="top", fontsize=7)
            if column == 0:
                ax.set_ylabel(f"{name}\nstress ({unit})", fontsize=7)
        title = (
            "Measured (grey; shoe foam arXiv:2602.12694, mycelium LivingMatterLab/CANN, lattice "
            "mev43/FYP-Cyclic-Compression, cartilage JoVE 64450), fitted (red), misfit"
        )
        figure.suptitle(title, x=0.01, ha="left", fontsize=7.5)


def main() -> None:
    """Fit all tests; write page, table and figure."""
    numbers = {"starts": (6, "descents of each fit"), "jobs": (1, "processes")}
    parser = studies.arguments(__doc__, HERE, page=True, **numbers)
    parser.add_argument("--only", default="", help="tests whose name contains this")
    given = parser.parse_args()
    if not given.page:
        folders = ("shoe-foam", "shoe-foam-twins", "mycelium-rates", "lattice-cycles")
        studies.measurements(*folders, "cartilage-impact")
    cases, rows = [case for case in TESTS if given.only in case[1]], list[dict[str, Any]]()
    jobs = [] if given.page else [(case, given.starts) for case in cases]
    for more in studies.in_order(fit_all, jobs, given.jobs):
        rows += more  # an interrupted study keeps its rows
        table = pd.DataFrame(rows).drop(columns="curves")
        studies.write_csv(table, given.out / "other_laws.csv")
        draw(rows, given.out / "other_laws.png")
    table = pd.read_csv(given.out / "other_laws.csv")
    studies.write_page(
        HERE, out=given.out, table=law_table(table), rows=ROWS,
        starts=given.starts, minutes=f"{table['seconds'].sum() / 60.0:.0f}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
