"""How well do the laws fit measured foams, and do specimens of one foam get the same states?

Method and answer: README.md. Also written: real_foams.csv (every parameter of every fit) and
real_foams.png (one loop, two laws).

    FOAMFIT_DATA=… python experiments/real_foams/real_foams.py     # two minutes of processor time
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

import foamfit as ff
from foamfit.parts import ParameterEstimate
from foamfit.report.render import readable
from foamfit.results import Fit
from foamfit.springs.parameters import NUISANCE

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from records import SOURCE
from studies import BLUE, GREY, VERMILION

HERE = Path(__file__).parent
# Name of the law: model, relaxation terms, descents (None: the default of a fit).
LAWS: dict[str, tuple[str, int, int | None]] = {
    "bistable": ("bistable", 0, None),
    "two bistable": ("bistable+bistable", 0, 12),
    "microscale": ("microscale", 0, None),
    "microscale, relaxation": ("microscale", 1, None),
}
STATES = ("determined", "weak", "not determined")
BEST, PLAIN = "microscale, relaxation", "bistable"
SHOWN = "new-heel-comp-1"  # in the picture


def varied(result: Fit) -> dict[str, ParameterEstimate]:
    """Return the free parameters of the springs, without the zeros of the record."""
    found = result.parameters.items()
    return {name: p for name, p in found if p.vary and name not in NUISANCE}


def rows_of(test: str, law: str, result: Fit, seconds: float) -> Iterator[dict[str, object]]:
    """Return one row for each free parameter of the springs."""
    for name, p in varied(result).items():
        low, high = p.ci95 or (None, None)
        yield {
            "test": test, "foam": test.rpartition("-comp")[0], "law": law,
            "misfit": result.misfit["stress_strain"],
            "agreeing": result.statistics["n_agreeing"], "seconds": seconds, "parameter": name,
            "value": p.value, "stderr": p.stderr, "ci95_low": low, "ci95_high": high,
            "unit": p.unit, "state": p.state,
        }  # fmt: skip


def law_table(table: pd.DataFrame) -> str:
    rows = []
    for law in LAWS:
        own = table[table["law"] == law]
        fits = own.drop_duplicates("test")
        agree = own.groupby(["foam", "parameter"])["state"].nunique() == 1
        rows.append([
            law, len(own) // len(fits), f"{100.0 * fits['misfit'].median():.2f} %",
            f"{(fits['agreeing'] > 1).sum()} of {len(fits)}", f"{fits['seconds'].median():.1f} s",
            " / ".join(str((own["state"] == one).sum()) for one in STATES),
            f"{agree.sum()} of {len(agree)}",
        ])  # fmt: skip
    head = "law | parameters | misfit | best found again | run time | determined / weak / not"
    return studies.markdown(f"{head} | twins agree", rows)


def draw(results: dict[str, Fit], path: Path) -> None:
    """Draw the measured loop with both laws, their residuals, and the parameters of the better."""
    best = results[BEST]
    strain, stress, clock = best.strain, best.curves.measured_stress, best.curves.time
    way = np.hypot(np.diff(strain, prepend=0.0) / np.ptp(strain),
                   np.diff(stress, prepend=0.0) / np.ptp(stress)).cumsum()  # fmt: skip
    some = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], 90)).clip(0, way.size - 1))
    styles = {
        PLAIN: ("bistable", {"color": BLUE, "alpha": 0.6, "zorder": 2.5}, 0.9),
        BEST: ("microscale with relaxation", {"color": VERMILION, "zorder": 3}, 1.3),
    }
    with studies.sheet(path, 7.0, 3.5, 250) as figure:
        grid = figure.add_gridspec(2, 2, width_ratios=[4.0, 2.9], height_ratios=[4.0, 1.0])
        loop, off = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
        style = {"ms": 3.6, "mfc": "white", "mec": "0.55", "mew": 0.6, "zorder": 2}
        loop.plot(strain[some], stress[some] / 1e3, "o", label="measured", **style)
        for law, result in results.items():
            (name, style, width), fitted = styles[law], result.curves.stress
            misfit = 100.0 * (result.misfit["stress_strain"] or 0.0)
            label = f"{name}:\n{len(varied(result))} parameters, misfit {misfit:.2g} %"
            loop.plot(strain, fitted / 1e3, label=label, lw=width, **style)
            off.plot(clock, 100.0 * (fitted - stress) / np.ptp(stress), lw=0.7, **style)
        loop.set(xlabel="strain (–)", ylabel="stress (kPa)")
        loop.legend(loc="upper left", handlelength=1.4)
        off.axhline(0.0, color=GREY, lw=0.6)
        off.set(xlabel="time (s)", ylabel="residual\n(% of range)")
        _write_values(figure.add_subplot(grid[:, 1]), best)
        title = f"Running-shoe foam, {best.measurement.name}, first cycle"
        figure.suptitle(title, x=0.012, ha="left", fontsize=8.5, weight="bold")


def _write_values(side: Axes, result: Fit) -> None:
    """Write the parameters of a fit as a table."""
    side.set_axis_off()
    side.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    meaning = {
        "k0": ("k_{0}", "elastic stiffness"), "kc": ("k_{c}", "densified stiffness"),
        "eps_star": (r"\varepsilon_{*}", "densification strain"),
        "sigma_plus": (r"\sigma_{+}", "snap-through stress"),
        "spread_plus": ("s_{+}", "and its spread"),
        "sigma_minus": (r"\sigma_{-}", "snap-back stress"),
        "spread_minus": ("s_{-}", "and its spread"),
        "g1": ("g_{1}", "relaxing strength"), "tau1": (r"\tau_{1}", "relaxation time"),
    }  # fmt: skip
    for i, (name, p) in enumerate(varied(result).items()):
        one, y = readable(name, p), 0.93 - 0.088 * i
        symbol, text = meaning[name.removeprefix("s1_")]
        side.text(0.0, y, f"${symbol}$", fontsize=9, va="center")
        side.text(0.13, y, text, va="center", color=GREY)
        unit = "" if one.unit == "–" else f" {one.unit}"
        side.text(1.0, y, f"{one.with_error}{unit}", va="center", ha="right")
    note = f"Values ± standard error. Measurement:\n{SOURCE}"
    side.text(0.0, 0.05, note, va="center", color=GREY, fontsize=6.5)


def main() -> None:
    """Fit every specimen by every law; write page, table and figure."""
    studies.arguments(__doc__).parse_args()
    studies.measurements("shoe-foam", "shoe-foam-twins")
    ff.fit(ff.read_test(HERE.parent / "foam-1" / "model-1-2.0mps-reconstruction.csv"))  # compiles
    rows, shown = list[dict[str, Any]](), dict[str, Fit]()
    with studies.workplace() as folder:
        tests = list(records.first_cycles(folder))
        for test in tests:
            for law, (model, relaxation, starts) in LAWS.items():
                options = {"model": model, "relaxation": relaxation, "starts": starts}
                result, seconds = studies.timed(ff.fit, test, **options)
                rows += rows_of(test.name, law, result, seconds)
                misfit = 100.0 * (result.misfit["stress_strain"] or 0.0)
                print(f"{test.name:18}{law:24}{misfit:.2f} %  {seconds:.1f} s", flush=True)
                if test.name == SHOWN and law in (PLAIN, BEST):
                    shown[law] = result
    table = pd.DataFrame(rows)
    studies.write_csv(table, HERE / "real_foams.csv", 6)
    draw(shown, HERE / "real_foams.png")
    wide = table.pivot_table(index="test", columns="law", values="misfit", sort=False)[list(LAWS)]
    cells = (100.0 * wide).map("{:.2f}".format).reset_index().to_numpy()
    misfits = studies.markdown(["specimen", *LAWS], cells)
    studies.write_page(
        HERE, source=SOURCE, count=len(tests), misfits=misfits, laws=law_table(table)
    )


if __name__ == "__main__":
    main()
