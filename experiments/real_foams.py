"""How well do the laws fit measured foams, and do specimens of one foam get the same states?

Method. Every uniaxial specimen of running-shoe foam (arXiv:2602.12694, LivingMatterLab/CANN) is
fitted with four laws. Misfit, values and states of the specimens of one foam are compared. The
measurements are not part of this repository; FOAMFIT_DATA contains shoe-foam/ and shoe-foam-twins/.

Answer. Microscale springs with relaxation have a misfit of 0.43 to 0.93 % of the range: see
real_foams.md. Also written: real_foams.csv (every parameter of every fit), real_foams.png (one
loop, two laws).

    FOAMFIT_DATA=path/to/data python experiments/real_foams.py     # two minutes of processor time
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

import foamfit as ff
import studies
from foamfit.data.measurement import Measurement
from foamfit.report.figures import BLUE, DPI, GREY, VERMILION
from foamfit.report.readable import readable
from foamfit.results import Fit, ParameterEstimate
from foamfit.springs.parameters import NUISANCE
from foamfit.text import number, percent

HERE = Path(__file__).parent
TABLE = HERE / "real_foams.csv"
SHOE_FOAM = {  # height and diameter of specimens whose first cycle is a file of its own
    "turbo-comp-1": ("10.53 mm", "7.63 mm"),
    "turbo-comp-2": ("9.66 mm", "7.68 mm"),
    "leap-comp-2": ("10.65 mm", "7.62 mm"),
    "leap-comp-3": ("10.68 mm", "7.80 mm"),
}
# Name of the law: model, relaxation terms, descents (None: the default of a fit).
LAWS: dict[str, tuple[str, int, int | None]] = {
    "bistable": ("bistable", 0, None),
    "two bistable": ("bistable+bistable", 0, 12),
    "microscale": ("microscale", 0, None),
    "microscale, relaxation": ("microscale", 1, None),
}
BEST, PLAIN = "microscale, relaxation", "bistable"
SHOWN = "new-heel-comp-1"  # in the picture
SOURCE = "arXiv:2602.12694 (LivingMatterLab/CANN)"


def first_cycles(data: Path, folder: Path, foams: tuple[str, ...] = ()) -> Iterator[Measurement]:
    """Yield the first cycle of every specimen, or of the specimens of some foams."""
    own = [(name, *size, f"shoe-foam/{name}_cycle1.csv", "") for name, size in SHOE_FOAM.items()]
    twins = [
        (*one, f"shoe-foam-twins/{one[0]}_raw.txt", studies.GAP)
        for one in studies.twins(data / "shoe-foam-twins")
    ]
    for name, height, diameter, file, columns in (*own, *twins):
        if not foams or name.rpartition("-")[0] in foams:
            toml = studies.write_specimen(folder / f"{name}.toml", height, diameter, columns)
            toml.write_text(f'name = "{name}"\n{toml.read_text()}')
            yield ff.read_test(data / file, toml)


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
            "agreeing": result.statistics["n_agreeing"],
            "seconds": seconds,
            "parameter": name, "value": p.value, "stderr": p.stderr, "ci95_low": low,
            "ci95_high": high, "unit": p.unit, "state": p.state,
        }  # fmt: skip


def misfit_table(table: pd.DataFrame) -> str:
    wide = table.pivot_table(index="test", columns="law", values="misfit", sort=False)[list(LAWS)]
    rows = ([test, *(f"{100.0 * x:.2f}" for x in own)] for test, own in wide.iterrows())
    return studies.markdown(["specimen", *LAWS], rows)


def law_table(table: pd.DataFrame) -> str:
    rows = []
    for law in LAWS:
        own = table[table["law"] == law]
        fits = own.drop_duplicates("test")
        states = own["state"].value_counts()
        agree = own.groupby(["foam", "parameter"])["state"].nunique() == 1
        rows.append([
            law, len(own) // len(fits), f"{100.0 * fits['misfit'].median():.2f} %",
            f"{(fits['agreeing'] > 1).sum()} of {len(fits)}", f"{fits['seconds'].median():.1f} s",
            " / ".join(str(states.get(s, 0)) for s in ("determined", "weak", "not determined")),
            f"{agree.sum()} of {len(agree)}",
        ])  # fmt: skip
    head = "law | parameters | misfit | best found again | run time | determined / weak / not"
    return studies.markdown(f"{head} | twins agree", rows)


def draw(results: dict[str, Fit], path: Path) -> None:
    """Draw the measured loop with both laws, their residuals, and the parameters of the better."""
    best = results[BEST]
    strain, stress = best.strain, best.curves.measured_stress
    assert strain is not None
    assert stress is not None
    styles = {
        PLAIN: {"color": BLUE, "lw": 0.9, "alpha": 0.6},
        BEST: {"color": VERMILION, "lw": 1.3},
    }
    with studies.sheet(path, 7.0, 3.5, DPI) as figure:
        grid = figure.add_gridspec(2, 2, width_ratios=[4.0, 2.9], height_ratios=[4.0, 1.0])
        loop, off = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
        side = figure.add_subplot(grid[:, 1])
        way = np.cumsum(np.hypot(np.diff(strain, prepend=0.0) / np.ptp(strain),
                                 np.diff(stress, prepend=0.0) / np.ptp(stress)))  # fmt: skip
        some = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], 90)).clip(0, way.size - 1))
        loop.plot(
            strain[some], stress[some] / 1e3, "o", ms=3.6, mfc="white", mec="0.55", mew=0.6,
            label="measured", zorder=2,
        )  # fmt: skip
        clock = best.curves.time
        assert clock is not None
        for law, result in results.items():
            fitted = result.curves.stress
            assert fitted is not None
            count = len(varied(result))
            misfit = percent(result.misfit["stress_strain"] or 0.0)
            name = {PLAIN: "bistable", BEST: "microscale with relaxation"}[law]
            style = styles[law] | {"zorder": 3 if law == BEST else 2.5}
            loop.plot(
                strain, fitted / 1e3, label=f"{name}:\n{count} parameters, misfit {misfit}", **style
            )
            off.plot(clock, 100.0 * (fitted - stress) / np.ptp(stress), **style | {"lw": 0.7})
        loop.set(xlabel="strain (–)", ylabel="stress (kPa)")
        loop.legend(loc="upper left", handlelength=1.4)
        off.axhline(0.0, color=GREY, lw=0.6)
        off.set(xlabel="time (s)", ylabel="residual\n(% of range)")
        _write_values(side, best)
        figure.suptitle(
            f"Running-shoe foam, {best.measurement.name}, first cycle", x=0.012, ha="left",
            fontsize=8.5, weight="bold",
        )  # fmt: skip


def _write_values(side: Axes, result: Fit) -> None:
    """Write the parameters of a fit as a table."""
    side.set_axis_off()
    side.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    meaning = {
        "k0": "elastic stiffness", "kc": "densified stiffness", "eps_star": "densification strain",
        "sigma_plus": "snap-through stress", "spread_plus": "and its spread",
        "sigma_minus": "snap-back stress", "spread_minus": "and its spread",
        "g1": "relaxing strength", "tau1": "relaxation time",
    }  # fmt: skip
    for i, (name, p) in enumerate(varied(result).items()):
        one, y = readable(name, p), 0.93 - 0.088 * i
        stem, index = one.symbol
        index = index.partition(",")[0].replace("−", "-")
        index = {"1": name[-1]}.get(index, index) if name[-1].isdigit() else index
        greek = {"ε": r"\varepsilon", "σ": r"\sigma", "τ": r"\tau"}.get(stem, stem)
        side.text(0.0, y, f"${greek}_{{{index}}}$", fontsize=9, va="center")
        side.text(0.13, y, meaning[name.removeprefix("s1_")], va="center", color=GREY)
        unit = "" if one.unit == "–" else f" {one.unit}"
        side.text(1.0, y, f"{one.with_error}{unit}", va="center", ha="right")
    side.text(
        0.0, 0.05, f"Values ± standard error. Measurement:\n{SOURCE}", va="center", color=GREY,
        fontsize=6.5,
    )  # fmt: skip


def main() -> dict[str, Fit]:
    """Write page and table; return the fits for the figure."""
    data = studies.measurements("shoe-foam", "shoe-foam-twins")
    ff.fit(ff.read_test(HERE / "foam-1" / "model-1-2.0mps-reconstruction.csv"))  # compiles
    rows, shown = list[dict[str, Any]](), dict[str, Fit]()
    with tempfile.TemporaryDirectory() as folder:
        tests = list(first_cycles(data, Path(folder)))
        for test in tests:
            for law, (model, relaxation, starts) in LAWS.items():
                began = time.process_time()
                result = ff.fit(test, model=model, relaxation=relaxation, starts=starts)
                seconds = time.process_time() - began  # the machine may be shared
                rows += rows_of(test.name, law, result, seconds)
                misfit = number(100.0 * (result.misfit["stress_strain"] or 0.0))
                print(f"{test.name:18}{law:24}{misfit} %  {seconds:.1f} s", flush=True)
                if test.name == SHOWN and law in (PLAIN, BEST):
                    shown[law] = result
    table = pd.DataFrame(rows)
    studies.write_csv(table, TABLE, 6)
    page = (HERE / "real_foams.template.md").read_text(encoding="utf-8").format(
        source=SOURCE, count=len(tests), misfits=misfit_table(table), laws=law_table(table),
    )  # fmt: skip
    (HERE / "real_foams.md").write_text(page)
    return shown


if __name__ == "__main__":
    studies.arguments(__doc__).parse_args()
    before = TABLE.read_bytes() if TABLE.exists() else b""
    with studies.keep_unchanged(HERE):
        both = main()
    if TABLE.read_bytes() != before:  # small changes of the numbers hardly change pixels
        draw(both, HERE / "real_foams.png")
