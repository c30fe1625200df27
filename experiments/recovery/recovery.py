"""Do the 95 % intervals hold? Coverage of the true parameters on synthetic impacts.

Method. Random bistable springs (with and without dashpot) are struck fast enough to close their
loop; 1 % noise on stress and displacement, white or autoregressive of first order (autocorrelation
time 8 samples), 300, 1000 or 5000 samples per curve. Contact starts at the first sample. Each test
is written as a CSV with its TOML, which does not state the noise, read by `foamfit.read_test` and
fitted with the defaults of `foamfit.fit` (full search, no knowledge of the truth). Every 95 %
interval of a parameter that is not called "not determined" either holds the truth or does not.
Samples that the reader cuts before contact, and offsets that it takes off, are counted: there are
none to cut or to take off. Beside it stands a linear problem with the same noise (synthetic.py).

Answer. They hold in 93.9 % of cases, those of the linear problem in 94.7 %: see README.md.

    python experiments/recovery/recovery.py                  # 200 tests for each of six classes
    python experiments/recovery/recovery.py --tests 40
    python experiments/recovery/recovery.py --intervals local
"""

from __future__ import annotations

import re
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm

import foamfit as ff
from foamfit.data.measurement import Measurement
from foamfit.fitting.problem import make_problem
from foamfit.trust.best_point import BestPoint
from foamfit.trust.residuals.noise_process import parts

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402
from synthetic import BEYOND, autoregressive, linear, random_case, toml_of, white  # noqa: E402

TAU = 8.0
PARAMETERS = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
SYMBOLS = (
    r"$k_0$", r"$k_c$", r"$\Delta\sigma$", r"$\varepsilon_a$", r"$\varepsilon_c$", r"$k_{h+}$",
    r"$k_{h-}$", r"$\eta$", "all",
)  # fmt: skip
COLOURS = {300: studies.SKY, 1000: studies.BLUE, 5000: studies.VERMILION}
CLASS = ["noise", "samples"]


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
        return autoregressive(self.rho, white(rng, samples + 500))


CLASSES = tuple(Class(tau, samples) for tau in (1.0, TAU) for samples in (300, 1000, 5000))


def written(test: Measurement, folder: Path) -> Path:
    """Write a test as a user would have it: a CSV and its TOML."""
    return studies.write_test(
        folder / "test.csv", toml_of(test.specimen, test.striker), time=test.time,
        stress=test.stress, displacement=test.displacement,
    )  # fmt: skip


def cut_before(test: Measurement) -> int:
    """Samples that the reader has cut before contact, by its own words."""
    found = re.search(r"(\d+) samples before and", " ".join(test.notes))
    return int(found[1]) if found else 0


def possible(group: Class, seed: int) -> bool:
    """Whether the specimen is pressed to less than its height: no other test can be made."""
    measurement = random_case(group.rng(seed), group.samples, group.draw)[1]
    return float(measurement.displacement.max()) < measurement.specimen.height


def run_test(group: Class, seed: int, intervals: str = "auto") -> list[dict[str, Any]]:
    """Write, read and fit one synthetic test; a row for each parameter."""
    spring, measurement = random_case(group.rng(seed), group.samples, group.draw)
    with tempfile.TemporaryDirectory() as folder:
        test = ff.read_test(written(measurement, Path(folder)))
    kept = float(test.time[-1]) / float(measurement.time[-1] / BEYOND)
    began = time.perf_counter()
    result = ff.fit(test, seed=0, intervals=intervals)
    whole = {
        "cut": cut_before(test), "offset": any(" is taken off" in note for note in test.notes),
        "kept": min(kept, 1.0), "seconds": time.perf_counter() - began,
    }  # fmt: skip
    rows = []
    for name in PARAMETERS:
        estimate, truth = result.parameters[f"s1_{name}"], getattr(spring, name)
        low, high = estimate.ci95 or (np.nan, np.nan)
        rows.append(
            {
                "noise": group.noise, "samples": group.samples, "test": seed, "parameter": name,
                "truth": truth, "value": estimate.value, "low": low, "high": high,
                "state": estimate.state, "method": estimate.ci95_method,
                "holds": bool(low <= truth <= high), **whole,
            }
        )  # fmt: skip
    return rows


def linear_test(group: Class, seed: int) -> list[dict[str, Any]]:
    """Intervals of known noise about the truth, to first order in it; a row for each parameter."""
    drawn: list[np.ndarray] = []

    def draw(rng: np.random.Generator, samples: int) -> np.ndarray:
        drawn.append(group.draw(rng, samples))
        return drawn[-1]

    spring, measurement = random_case(group.rng(seed), group.samples, draw)
    problem = make_problem(measurement, "bistable", "impact", None, None, False)
    truth = problem.vector()
    truth[:9] = *spring.seven, spring.eta, 0.0
    around, objective = BestPoint(problem, truth), problem.objective
    pieces = zip(objective.counted, parts(objective.sizes), drawn, strict=True)
    levels = {c: float(np.std(around.residual[p]) / np.std(noise)) for c, p, noise in pieces}
    pull, sd = linear(around, levels, group.rho)
    held = np.abs(pull @ around.residual) < norm.ppf(0.975) * sd
    return [
        {"noise": group.noise, "samples": group.samples, "test": seed,
         "parameter": name.removeprefix("s1_"), "linear": bool(inside)}
        for name, inside in zip(around.names, held, strict=True)
    ]  # fmt: skip


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
    tests = rows[[*CLASS, "test"]].drop_duplicates().groupby(CLASS).size()
    out = []
    for at, group in given.groupby(CLASS, sort=False):
        for name in (*PARAMETERS, "all"):
            own = group if name == "all" else group[group["parameter"] == name]
            held = studies.share(own["holds"].tolist())
            out.append(
                {
                    "noise": at[0], "samples": at[1], "parameter": name,
                    "tests": tests[at] * (len(PARAMETERS) if name == "all" else 1),
                    "intervals": len(own), "coverage": held["share"], "error low": held["low"],
                    "error high": held["high"],
                    "coverage, linear": own["linear"].dropna().astype(float).mean(),
                    "half width over truth, median": own["width"].median(),
                    "profiled": (own["method"] == "profile likelihood").mean(),
                }
            )  # fmt: skip
    return pd.DataFrame(out)


def picture(table: pd.DataFrame, path: Path, tests: int) -> None:
    """Coverage and interval width per parameter and class."""
    names = (*PARAMETERS, "all")
    titles = {"white": "white noise", "correlated": f"correlated noise, τ = {TAU:g} samples"}
    with studies.sheet(path, 7.2, 4.8) as figure:
        axes = figure.subplots(2, 2, sharex="col", sharey="row")
        figure.suptitle(
            f"{tests} synthetic impacts per class, 1 % noise, read from CSV and TOML", fontsize=10
        )
        for (above, below), (noise, title) in zip(axes.T, titles.items(), strict=True):
            above.axhspan(93, 97, color="0.92", linewidth=0)
            above.axhline(95, color="0.6", linewidth=0.8)
            above.set_title(title)
            for shift, (samples, colour) in zip((-0.22, 0.0, 0.22), COLOURS.items(), strict=True):
                own = table[(table["noise"] == noise) & (table["samples"] == samples)]
                own = 100.0 * own.set_index("parameter").loc[list(names), "coverage":]
                x, share = np.arange(len(names)) + shift, own["coverage"]
                error = [share - own["error low"], own["error high"] - share]
                look = {"color": colour, "markersize": 3}
                label = f"{samples} samples per curve" if noise == "white" else None
                above.errorbar(x, share, error, fmt="o", linewidth=0.9, label=label, **look)
                above.plot(x, own["coverage, linear"], "x", mew=0.7, alpha=0.8, **look)
                below.plot(x[:-1], own["half width over truth, median"][:-1], "o", **look)
            below.set_yscale("log")
            below.set_xticks(range(len(names)), SYMBOLS)
        axes[0, 0].plot([], [], "x", color="0.4", markersize=3, label="linear problem, same noise")
        axes[0, 0].set_ylabel("truth inside the 95 % interval (%)")
        axes[1, 0].set_ylabel("median half width (% of truth)")
        figure.legend(loc="outside lower center", ncols=4, columnspacing=1.2, handletextpad=0.4)


def main() -> None:
    parser = studies.arguments(__doc__, HERE, tests=200)
    parser.add_argument("--intervals", default="auto", choices=("auto", "local", "profile"))
    parser.add_argument("--raw", type=Path, help="one row per test and parameter; resumed")
    options = parser.parse_args()
    run_test(CLASSES[0], 0)  # compiles
    rows = with_linear(run(options.tests, options.intervals, options.raw))
    table = coverage(rows)
    suffix = "" if options.intervals == "auto" else f"_{options.intervals}"
    studies.write_csv(table, options.out / f"recovery{suffix}.csv")
    picture(table, options.out / f"recovery{suffix}.png", options.tests)
    each = rows.drop_duplicates([*CLASS, "test"]).groupby(CLASS)
    print(
        "tests in which the reader cut samples at the start, took an offset off; the share of the"
    )
    print("time of contact that it kept, median and least; median seconds of a fit:")
    told = each.agg(
        cut=("cut", np.count_nonzero), offset=("offset", "sum"), kept=("kept", "median"),
        least=("kept", "min"), seconds=("seconds", "median"),
    )  # fmt: skip
    print(told.round(3).to_string())
    wide = table.pivot_table(index=CLASS, columns="parameter", values="coverage", sort=False)
    wide["linear"] = table[table["parameter"] == "all"].set_index(CLASS)["coverage, linear"]
    print((100.0 * wide).round(1).to_string(), studies.circumstances(), sep="\n")


if __name__ == "__main__":
    studies.run(main, HERE)
