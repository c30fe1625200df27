"""Do the 95 % intervals hold? Coverage of the true parameters on synthetic impacts.

Random bistable springs (with and without dashpot) are struck fast enough to close their loop, as in
experiments/noise_floor; 1 % noise on stress and displacement, white or autoregressive of first
order (autocorrelation time 8 samples), 300, 1000 or 5000 samples per curve. Contact starts at the
first sample. Each test goes the way of a user: it is written as a CSV with its TOML, which does not
state the noise, read by `foamfit.read_test` and fitted with the defaults of `foamfit.fit` (full
search, no knowledge of the truth). Every 95 % interval of a parameter that is not called "not
determined" either holds the truth or does not. Samples that the reader cuts before contact, and
offsets that it takes off, are counted: there are none to cut or to take off.

Beside it stands what the same draws of noise would make of a problem that is linear about the truth
and whose noise is known: there each interval holds in exactly 95 % of cases, so what its count is
off is the luck of the draw, and the rest is the doing of the fit.

    python experiments/recovery/recovery.py                  # 200 tests for each of six classes
    python experiments/recovery/recovery.py --tests 40
    python experiments/recovery/recovery.py --intervals local
"""

from __future__ import annotations

import argparse
import platform
import re
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.signal import lfilter
from scipy.stats import binomtest, norm

import foamfit as ff
from foamfit.data.measurement import Measurement
from foamfit.fitting.problem import make_problem
from foamfit.trust.best_point import BestPoint
from foamfit.trust.residuals.noise_process import NoiseProcess, parts

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "noise_floor"))
from noise_floor import random_case  # noqa: E402

TAU = 8.0
BEYOND = 1.05  # a record's length over that of contact, see random_case
PARAMETERS = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
SYMBOLS = {
    "k0": r"$k_0$", "kc": r"$k_c$", "dsigma": r"$\Delta\sigma$", "eps_a": r"$\varepsilon_a$",
    "eps_c": r"$\varepsilon_c$", "kh_plus": r"$k_{h+}$", "kh_minus": r"$k_{h-}$", "eta": r"$\eta$",
    "all": "all",
}  # fmt: skip
COLOURS = {300: "#56B4E9", 1000: "#0072B2", 5000: "#D55E00"}


@dataclass(frozen=True)
class Class:
    """A class of tests: autocorrelation time of its noise and samples per curve."""

    tau: float
    samples: int

    @property
    def noise(self) -> str:
        """What the noise is called."""
        return "white" if self.tau == 1.0 else "correlated"

    @property
    def rho(self) -> float:
        """Autocorrelation from one sample to the next."""
        return (self.tau - 1.0) / (self.tau + 1.0)

    def rng(self, seed: int) -> np.random.Generator:
        """Source of a test's spring and noise."""
        return np.random.default_rng([seed, self.samples, int(self.tau)])

    def draw(self, rng: np.random.Generator, samples: int) -> np.ndarray:
        """Noise of unit variance."""
        white = rng.standard_normal(samples + 500)
        return lfilter([np.sqrt(1.0 - self.rho**2)], [1.0, -self.rho], white)[500:]


CLASSES = tuple(Class(tau, samples) for tau in (1.0, TAU) for samples in (300, 1000, 5000))


def written(measurement: Measurement, folder: Path) -> Path:
    """Write a test as a user would have it: a CSV and its TOML."""
    path, specimen, striker = folder / "test.csv", measurement.specimen, measurement.striker
    table = {
        "time (s)": measurement.time,
        "stress (Pa)": measurement.stress,
        "displacement (m)": measurement.displacement,
    }
    pd.DataFrame(table).to_csv(path, index=False)
    path.with_suffix(".toml").write_text(
        f'[specimen]\nheight = "{specimen.height} m"\narea = "{specimen.area} m^2"\n'
        f'[striker]\nmass = "{striker.mass} kg"\nvelocity = "{striker.velocity} m/s"\n'
    )
    return path


def cut_before(test: Measurement) -> int:
    """Samples that the reader has cut before contact, by its own words."""
    found = re.search(r"(\d+) samples before and", " ".join(test.notes))
    return int(found[1]) if found else 0


def possible(group: Class, seed: int) -> bool:
    """Whether the specimen is pressed to less than its height: no other test can be made."""
    measurement = random_case(group.rng(seed), group.samples, group.draw)[1]
    return float(measurement.displacement.max()) < measurement.specimen.height


def run_test(group: Class, seed: int, intervals: str = "auto") -> list[dict[str, object]]:
    """Write, read and fit one synthetic test; a row for each parameter."""
    spring, measurement = random_case(group.rng(seed), group.samples, group.draw)
    with tempfile.TemporaryDirectory() as folder:
        test = ff.read_test(written(measurement, Path(folder)))
    cut, taken = cut_before(test), any(" is taken off" in note for note in test.notes)
    kept = float(test.time[-1]) / float(measurement.time[-1] / BEYOND)
    began = time.perf_counter()
    result = ff.fit(test, seed=0, intervals=intervals)
    seconds = time.perf_counter() - began
    rows = []
    for name in PARAMETERS:
        estimate, truth = result.parameters[f"s1_{name}"], getattr(spring, name)
        low, high = estimate.ci95 or (np.nan, np.nan)
        rows.append(
            {
                "noise": group.noise,
                "samples": group.samples,
                "test": seed,
                "parameter": name,
                "truth": truth,
                "value": estimate.value,
                "low": low,
                "high": high,
                "state": estimate.state,
                "method": estimate.ci95_method,
                "holds": bool(low <= truth <= high),
                "cut": cut,
                "offset": taken,
                "kept": min(kept, 1.0),
                "seconds": seconds,
            }
        )
    return rows


def linear_test(group: Class, seed: int) -> list[dict[str, object]]:
    """Intervals of known noise about the truth, to first order in it; a row for each parameter."""
    drawn: list[np.ndarray] = []

    def draw(rng: np.random.Generator, samples: int) -> np.ndarray:
        drawn.append(group.draw(rng, samples))
        return drawn[-1]

    spring, measurement = random_case(group.rng(seed), group.samples, draw)
    problem = make_problem(measurement, "bistable", "impact", None, None, False)
    truth = problem.vector()
    truth[:9] = *spring.seven, spring.eta, 0.0
    around = BestPoint(problem, truth)
    names = around.names
    scaled = around.jacobian * around.sizes
    pull = np.linalg.pinv(scaled.T @ scaled, rcond=1e-14, hermitian=True) @ scaled.T
    variance = np.zeros(len(names))
    for part, noise in zip(parts(problem.objective.sizes), drawn, strict=True):
        level = np.std(around.residual[part]) / np.std(noise)
        process = NoiseProcess(np.array([group.rho] if group.rho else []), level**2)
        variance += process.forms(pull[:, part].T)
    z = pull @ around.residual / np.sqrt(variance)
    return [
        {
            "noise": group.noise,
            "samples": group.samples,
            "test": seed,
            "parameter": name.removeprefix("s1_"),
            "linear": bool(abs(off) < norm.ppf(0.975)),
        }
        for name, off in zip(names, z, strict=True)
    ]


def with_linear(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of fits with what a linear problem would make of the same noise."""
    groups = {(group.noise, group.samples): group for group in CLASSES}
    tests = rows[["noise", "samples", "test"]].drop_duplicates().itertuples(index=False)
    linear = [row for noise, size, test in tests for row in linear_test(groups[noise, size], test)]
    return rows.merge(pd.DataFrame(linear), how="left")


def first_possible(group: Class, tests: int) -> list[int]:
    """Seeds of the first so many tests of a class that can be made."""
    seeds = (seed for seed in count(1) if possible(group, seed))
    return list(islice(seeds, tests))


def run(tests: int, intervals: str, raw: Path | None) -> pd.DataFrame:
    """Fit all tests of all classes, but for those that `raw` holds already; it is kept up."""
    rows = pd.read_csv(raw) if raw is not None and raw.exists() else pd.DataFrame()
    done = set(map(tuple, rows[["noise", "samples", "test"]].to_numpy())) if len(rows) else set()
    began = time.perf_counter()
    seeds = {group: first_possible(group, tests) for group in CLASSES}
    for number in range(tests):
        for group in CLASSES:
            seed = seeds[group][number]
            if (group.noise, group.samples, seed) not in done:
                rows = pd.concat([rows, pd.DataFrame(run_test(group, seed, intervals))])
        if raw is not None:
            rows.to_csv(raw, index=False)
        if number % 10 == 9:
            took = time.perf_counter() - began
            print(f"{number + 1} tests per class: {took:.0f} s", file=sys.stderr, flush=True)
    last = {(group.noise, group.samples): seeds[group][-1] for group in CLASSES}
    within = [last[noise, size] for noise, size in zip(rows["noise"], rows["samples"], strict=True)]
    return rows[rows["test"] <= within]


def coverage(rows: pd.DataFrame) -> pd.DataFrame:
    """Coverage of each parameter and class with its binomial 95 % interval, and typical widths."""
    given = rows[rows["low"].notna()].copy()
    scale = given["truth"].abs().where(given["truth"] != 0.0)
    given["width"] = (given["high"] - given["low"]) / 2.0 / scale
    out = []
    for (noise, samples), group in given.groupby(["noise", "samples"], sort=False):
        total = len(rows[(rows["noise"] == noise) & (rows["samples"] == samples)])
        for name in (*PARAMETERS, "all"):
            own = group if name == "all" else group[group["parameter"] == name]
            count, held = len(own), int(own["holds"].sum())
            error = binomtest(held, count).proportion_ci(method="wilson")
            out.append(
                {
                    "noise": noise,
                    "samples": samples,
                    "parameter": name,
                    "tests": total // (1 if name == "all" else len(PARAMETERS)),
                    "intervals": count,
                    "coverage": held / count,
                    "error low": error.low,
                    "error high": error.high,
                    "coverage, linear": own["linear"].dropna().astype(float).mean(),
                    "half width over truth, median": own["width"].median(),
                    "profiled": (own["method"] == "profile likelihood").mean(),
                }
            )
    return pd.DataFrame(out)


def picture(table: pd.DataFrame, path: Path, tests: int) -> None:
    """Coverage and interval width per parameter and class."""
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    figure.suptitle(
        f"{tests} synthetic impacts per class, 1 % noise, read from CSV and TOML", fontsize=10
    )
    names = (*PARAMETERS, "all")
    for column, (noise, title) in enumerate(
        (("white", "white noise"), ("correlated", f"correlated noise, τ = {TAU:g} samples"))
    ):
        above, below = axes[0, column], axes[1, column]
        above.axhspan(93, 97, color="0.92", linewidth=0)
        above.axhline(95, color="0.6", linewidth=0.8)
        above.set_title(title, fontsize=9)
        for shift, (samples, colour) in zip((-0.22, 0.0, 0.22), COLOURS.items(), strict=True):
            own = table[(table["noise"] == noise) & (table["samples"] == samples)]
            own = own.set_index("parameter").loc[list(names)]
            x = np.arange(len(names)) + shift
            percent = 100.0 * own["coverage"]
            error = [percent - 100.0 * own["error low"], 100.0 * own["error high"] - percent]
            above.errorbar(
                x, percent, error, fmt="o", color=colour, markersize=3, linewidth=0.9,
                label=f"{samples} samples per curve" if column == 0 else None,
            )  # fmt: skip
            above.plot(
                x, 100.0 * own["coverage, linear"], "x", color=colour, markersize=3.5,
                markeredgewidth=0.7, alpha=0.8,
            )  # fmt: skip
            below.plot(x[:-1], 100.0 * own["half width over truth, median"][:-1], "o",
                       color=colour, markersize=3)  # fmt: skip
        below.set_yscale("log")
        below.set_xticks(range(len(names)), [SYMBOLS[name] for name in names])
    axes[0, 0].plot([], [], "x", color="0.4", markersize=3.5, label="linear problem, same noise")
    axes[0, 0].set_ylabel("truth inside the 95 % interval (%)", fontsize=8)
    axes[1, 0].set_ylabel("median half width (% of truth)", fontsize=8)
    for panel in axes.flat:
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(
        frameon=False, fontsize=8, loc="outside lower center", ncols=4, columnspacing=1.2,
        handletextpad=0.4,
    )  # fmt: skip
    figure.savefig(path, dpi=200)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tests", type=int, default=200)
    parser.add_argument("--intervals", default="auto", choices=("auto", "local", "profile"))
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--raw", type=Path, help="one row per test and parameter; resumed")
    options = parser.parse_args()
    began = time.perf_counter()
    run_test(CLASSES[0], 0)  # compiles
    rows = with_linear(run(options.tests, options.intervals, options.raw))
    table = coverage(rows)
    suffix = "" if options.intervals == "auto" else f"_{options.intervals}"
    table.to_csv(options.out / f"recovery{suffix}.csv", index=False, float_format="%.4g")
    picture(table, options.out / f"recovery{suffix}.png", options.tests)
    each = rows.drop_duplicates(["noise", "samples", "test"]).groupby(["noise", "samples"])
    print("tests in which the reader cut samples at the start, took an offset off:")
    print(each.agg(cut=("cut", np.count_nonzero), offset=("offset", "sum")).to_string())
    print("share of the time of contact that it kept: median, least")
    print(each["kept"].agg(["median", "min"]).round(3).to_string())
    wide = table.pivot_table(
        index=["noise", "samples"], columns="parameter", values="coverage", sort=False
    )
    print((100.0 * wide).round(1).to_string())
    whole = table[table["parameter"] == "all"].set_index(["noise", "samples"])
    print("of a linear problem, same noise:", end=" ")
    print(", ".join(f"{100.0 * share:.1f}" for share in whole["coverage, linear"]))
    print(
        f"{options.tests} tests per class in {(time.perf_counter() - began) / 60:.1f} minutes, "
        f"median {rows['seconds'].median():.2f} s per fit "
        f"(foamfit {ff.__version__}, Python {platform.python_version()}, {platform.machine()})"
    )


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
