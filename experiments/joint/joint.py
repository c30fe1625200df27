"""Do the intervals of joint fits hold, and what do they cost? Synthetic studies, from files.

Each study goes the way of a user: its tests are written as CSV with one TOML, a STUDY.toml says
what the parameters are, and `foamfit.joint` fits them (search included, no knowledge of the truth).
The foam is a microscale spring under a slow triangle to 50 % strain, 101 samples, with white noise
of 0.25 % of the largest stress, which the TOML states.

- four: four tests of one specimen against the first of them alone: standard errors over each other.
- scatter: groups of 8 specimens whose k0 is log-normal (spread 10 % or 3 %): do the intervals of
  the common value and of the spread hold the truth?
- log, power: 5 tests over two decades of rate, sigma_plus following a law: bias of value and slope
  over the standard error, coverage of their intervals, and what the evidence chooses.
- shaken: the same with noise of the displacement, which makes errors of the rates: are they in the
  interval of the slope?
- impacts: foam-1 (model-1 of the paper, with a dashpot) struck at five velocities, its k_h+ free of
  rate or following a power law: what does the evidence choose, and does it find the law?
- predict: a new specimen predicted from 4 to 6 whose own values go together (correlation 0.96 to
  0.99): how many of its samples lie inside the 95 % band, above and below it?
- time: seconds of a fit of 10, 20 and 50 tests with nine parameters, three of them shared, 1000
  samples each, with relaxation.

    python experiments/joint/joint.py                 # all; writes joint.csv and joint.md
    python experiments/joint/joint.py --only log --draws 20
"""

from __future__ import annotations

import argparse
import csv
import platform
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

import foamfit as ff

HERE = Path(__file__).parent
HEIGHT, TOP, NOISE = 10e-3, 0.5, 400.0
SPRING = {
    "k0": 5.5e5, "kc": 4e5, "eps_star": 0.3, "sigma_plus": 1.1e5, "spread_plus": 0.4,
    "sigma_minus": 7e4, "spread_minus": 0.6,
}  # fmt: skip
SPECIMEN = f'[specimen]\nheight = "10 mm"\narea = "1 cm^2"\n[noise]\nstress = "{NOISE} Pa"\n'
RATES = np.geomspace(0.01, 1.0, 5)
STUDIES = ("four", "scatter", "log", "power", "shaken", "impacts", "predict", "time")
Row = dict[str, str | float | int]


def write_test(
    path: Path, spring: ff.MicroscaleSpring, rate: float, rng: np.random.Generator, samples: int,
    shake: float = 0.0,
) -> None:  # fmt: skip
    """Write a test; `shake` is the noise of the displacement over its range."""
    up = np.linspace(0.0, TOP, samples // 2 + 1)
    strain = np.concatenate([up, up[::-1][1:]])
    clock = np.arange(strain.size) * (up[1] / rate)
    drive = ff.DisplacementDrive(HEIGHT * strain)
    stress = ff.simulate(ff.Chain([spring], [HEIGHT], 1e-4), drive, clock).base_stress
    stress = stress + NOISE * rng.standard_normal(stress.size)
    if shake:
        strain = strain + shake * TOP * rng.standard_normal(strain.size)
    columns = np.column_stack([clock, stress, 1e3 * HEIGHT * strain])
    header = "time (s),stress (Pa),displacement (mm)"
    np.savetxt(path, columns, fmt="%.10g", delimiter=",", header=header, comments="")


def write_study(folder: Path, kinds: dict[str, str], relaxation: int = 0) -> Path:
    (folder / "foam.toml").write_text(SPECIMEN)
    lines = [f's1_{name} = "{kind}"' for name, kind in kinds.items()]
    (folder / "study.toml").write_text(
        'tests = ["t*.csv"]\nmodel = "microscale"\nspecimen = "foam.toml"\n'
        f'drive = "displacement"\nrelaxation = {relaxation}\n[parameters]\n' + "\n".join(lines)
    )
    return folder / "study.toml"


def four(draws: int, folder: Path) -> Iterator[Row]:
    """Standard errors of four tests of one specimen over those of one."""
    ratios = []
    for draw in range(draws):
        rng = np.random.default_rng([1, draw])
        for i in range(4):
            write_test(folder / f"t{i}.csv", ff.MicroscaleSpring(**SPRING), 0.1, rng, 101)
        joint = ff.joint(write_study(folder, dict.fromkeys(SPRING, "shared")), jobs=1)
        alone = ff.fit(
            ff.read_test(folder / "t0.csv", folder / "foam.toml"), model="microscale",
            drive="displacement", intervals="local",
        )  # fmt: skip
        pairs = [(joint.parameters[f"s1_{n}"], alone.parameters[f"s1_{n}"]) for n in SPRING]
        ratios.append([a.stderr / b.stderr for a, b in pairs if a.stderr and b.stderr])
    mean = float(np.mean([np.mean(one) for one in ratios]))
    yield {"study": "four", "what": "stderr of four tests over one's", "draws": draws, "mean": mean}


def scatter(draws: int, folder: Path, spread: float) -> Iterator[Row]:
    """Coverage of common value and spread over groups of 8 specimens."""
    hits, spreads = [], []
    kinds = dict.fromkeys(SPRING, "shared") | {"k0": "scatter", "sigma_plus": "own"}
    for draw in range(draws):
        rng = np.random.default_rng([2, round(1e3 * spread), draw])
        for i in range(8):
            own = SPRING["k0"] * np.exp(spread * rng.standard_normal())
            spring = ff.MicroscaleSpring(**SPRING | {"k0": own})
            write_test(folder / f"t{i}.csv", spring, 0.1, rng, 101)
        one = ff.joint(write_study(folder, kinds), jobs=1).parameters["s1_k0"]
        assert one.ci95 is not None
        assert one.scatter_ci95 is not None
        ends = (one.ci95, one.scatter_ci95)
        truth = (SPRING["k0"], spread)
        hits.append([low <= value <= high for (low, high), value in zip(ends, truth, strict=True)])
        spreads.append(one.scatter)
    for j, what in enumerate(("common value", "spread")):
        row: Row = {"study": f"scatter {spread:g}", "what": what, "draws": draws}
        if j == 1:
            row["mean"] = float(np.mean(spreads))
        yield row | coverage([hit[j] for hit in hits])


def rates(draws: int, folder: Path, kind: str, slope: float) -> Iterator[Row]:
    """Bias and coverage of value and slope of a law of rate, and what the evidence is for."""
    off, hits, chosen = [], [], []
    kinds = dict.fromkeys(SPRING, "shared") | {"sigma_plus": kind}
    for draw in range(draws):
        rng = np.random.default_rng([3, len(kind), draw])
        for i, rate in enumerate(RATES):
            x = np.log(rate / RATES[2])
            factor = 1.0 + slope * x if kind == "log rate" else np.exp(slope * x)
            spring = ff.MicroscaleSpring(**SPRING | {"sigma_plus": factor * SPRING["sigma_plus"]})
            write_test(folder / f"t{i}.csv", spring, rate, rng, 101)
        result = ff.joint(write_study(folder, kinds), jobs=1)
        one, truth = result.parameters["s1_sigma_plus"], (SPRING["sigma_plus"], slope)
        found = ((one.value, one.stderr, one.ci95), (one.b, one.b_stderr, one.b_ci95))
        off.append([(f[0] - t) / f[1] for f, t in zip(found, truth, strict=True)])
        hits.append([f[2][0] <= t <= f[2][1] for f, t in zip(found, truth, strict=True)])
        chosen.append(min(result.evidence, key=lambda alternative: alternative.bic).kind)
    for j, what in enumerate(("value", "slope b")):
        bias = [one[j] for one in off]
        yield {
            "study": kind, "what": what, "draws": draws, "mean": float(np.mean(bias)),
            "spread": float(np.std(bias)),
        } | coverage([hit[j] for hit in hits])  # fmt: skip
    for name in ("log rate", "power rate", "shared", "own"):
        yield {"study": kind, "what": f"evidence for {name}", "draws": draws,
               "share": chosen.count(name) / draws}  # fmt: skip


def shaken(draws: int, folder: Path, level: float) -> Iterator[Row]:
    """Slope of a power law where noise of the displacement makes errors of the rates."""
    slope, off, hits, errors = 0.2, [], [], []
    kinds = dict.fromkeys(SPRING, "shared") | {"sigma_plus": "power rate"}
    for draw in range(draws):
        rng = np.random.default_rng([7, round(1e5 * level), draw])
        for i, rate in enumerate(RATES):
            own = SPRING["sigma_plus"] * (rate / RATES[2]) ** slope
            spring = ff.MicroscaleSpring(**SPRING | {"sigma_plus": own})
            write_test(folder / f"t{i}.csv", spring, rate, rng, 101, level)
        result = ff.joint(write_study(folder, kinds), jobs=1)
        one = result.parameters["s1_sigma_plus"]
        off.append((one.b - slope) / one.b_stderr)
        hits.append(one.b_ci95[0] <= slope <= one.b_ci95[1])
        apart = np.log(np.array(result.rates) / RATES)
        errors.append(apart - apart.mean())
    study = f"displacement noise {100 * level:g} %"
    scale = (len(RATES) / (len(RATES) - 1)) ** 0.5
    yield {"study": study, "what": "error of a rate", "draws": draws,
           "mean": scale * float(np.std(errors))}  # fmt: skip
    yield {"study": study, "what": "slope b", "draws": draws, "mean": float(np.mean(off)),
           "spread": float(np.std(off))} | coverage(hits)  # fmt: skip


VELOCITIES = (2.0, 2.3, 2.7, 3.2, 4.0)  # m/s
BISTABLE = ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")


def strike(path: Path, kh_plus: float, velocity: float, rng: np.random.Generator) -> float:
    """Write an impact with 0.5 % noise, its TOML beside it; returns its mean strain rate."""
    published, height, area = ff.published["foam-1/model-1"].bistable, 1.19e-3, 1.9635e-5
    seven = dict(zip(BISTABLE, published.seven, strict=False))
    spring = ff.BistableSpring(**seven | {"kh_plus": kh_plus}, eta=200.0)
    clock = np.linspace(0.0, 1.5e-3 / velocity, 301)
    run = ff.simulate(ff.Chain([spring], [height], area), ff.Impact(7e-3, velocity), clock)
    clock = clock[clock <= run.contact_end]
    noisy = [
        curve[: clock.size] + 5e-3 * np.ptp(curve) * rng.standard_normal(clock.size)
        for curve in (run.base_stress, run.displacement[-1])
    ]
    peak = int(np.argmax(run.displacement[-1]))
    columns = np.column_stack([1e3 * clock, 1e-6 * noisy[0], 1e3 * noisy[1]])
    header = "time (ms),stress (MPa),displacement (mm)"
    np.savetxt(path, columns, fmt="%.10g", delimiter=",", header=header, comments="")
    path.with_suffix(".toml").write_text(
        f'[specimen]\nheight = "{height} m"\narea = "{area} m^2"\n'
        f'[striker]\nmass = "7 g"\nvelocity = "{velocity} m/s"\n'
    )
    return float(run.displacement[-1][peak] / height / run.time[peak])


def impacts(draws: int, folder: Path, slope: float) -> Iterator[Row]:
    """What the evidence says of k_h+ in impacts at five velocities."""
    chosen, off, hits, kh_plus = [], [], [], 14.3e6
    kinds = dict.fromkeys(BISTABLE, "shared") | {"kh_plus": "auto"}
    study = folder / "study.toml"
    lines = [f's1_{name} = "{kind}"' for name, kind in kinds.items()]
    study.write_text('tests = ["t*.csv"]\nmodel = "bistable"\n[parameters]\n' + "\n".join(lines))
    for draw in range(draws):
        rng = np.random.default_rng([5, draw])
        middle = strike(folder / "t2.csv", kh_plus, VELOCITIES[2], rng)
        for i, velocity in enumerate(VELOCITIES):
            rate = middle * velocity / VELOCITIES[2]
            for _ in range(5 if slope else 1):  # a stiffer branch changes the rate, too
                factor = (rate / middle) ** slope if i != 2 else 1.0
                rate = strike(folder / f"t{i}.csv", kh_plus * factor, velocity, rng)
        one = ff.joint(study, jobs=1).parameters["s1_kh_plus"]
        chosen.append(one.kind)
        if one.kind == "power rate":
            off.append((one.b - slope) / one.b_stderr)
            hits.append(one.b_ci95[0] <= slope <= one.b_ci95[1])
    name = f"impacts, b = {slope:g}"
    for kind in ("shared", "power rate", "log rate", "own"):
        yield {"study": name, "what": f"{kind} chosen", "draws": draws,
               "share": chosen.count(kind) / draws}  # fmt: skip
    if hits:
        yield {"study": name, "what": "slope b", "draws": len(hits), "mean": float(np.mean(off)),
               "spread": float(np.std(off))} | coverage(hits)  # fmt: skip


def specimen(rng: np.random.Generator, along: dict[str, float], apart: float) -> dict[str, float]:
    """One specimen: its parameters go with one density, and a little each their own way."""
    z = rng.standard_normal()
    return SPRING | {
        name: SPRING[name] * float(np.exp(share * z + apart * rng.standard_normal()))
        for name, share in along.items()
    }


# By how much parameters change with one standard deviation of the density: their logarithms.
TOGETHER = {
    "stiffness": {"k0": 0.25, "kc": 0.25, "sigma_plus": 0.25, "sigma_minus": 0.25},
    "density": {"k0": 0.15, "kc": 0.3, "eps_star": -0.15, "sigma_plus": 0.15, "sigma_minus": 0.15},
}


def predictions(draws: int, folder: Path, kind: str) -> Iterator[Row]:
    """A new specimen predicted from four to six whose own values are strongly correlated."""
    found, kinds = [], dict.fromkeys(SPRING, "shared") | dict.fromkeys(TOGETHER[kind], "own")
    for draw in range(draws):
        rng = np.random.default_rng([6, len(kind), draw])
        for old in folder.glob("t*.csv"):
            old.unlink()
        count = 4 + draw % 3
        for i in range(count + 1):
            spring = ff.MicroscaleSpring(**specimen(rng, TOGETHER[kind], 0.03))
            name = f"t{i}" if i < count else "new"
            write_test(folder / f"{name}.csv", spring, 0.1, rng, 101)
        result = ff.joint(write_study(folder, kinds), jobs=1)
        test = ff.read_test(folder / "new.csv", folder / "foam.toml")
        one = ff.predict(result, test, draws=200).curves["stress_strain"]
        above, below = np.mean(one.measured > one.hi), np.mean(one.measured < one.lo)
        found.append([one.inside, above, below, one.half_width / one.range])
    shares, study = np.array(found), f"predict, {kind}"
    for j, what in enumerate(("inside the band", "above it", "below it")):
        half = 1.96 * float(shares[:, j].std(ddof=1)) / draws**0.5
        mean = float(shares[:, j].mean())
        yield {"study": study, "what": what, "draws": draws, "share": mean,
               "low": max(mean - half, 0.0), "high": min(mean + half, 1.0)}  # fmt: skip
    yield {"study": study, "what": "half of the band over the range", "draws": draws,
           "mean": float(shares[:, 3].mean())}  # fmt: skip


def timing(folder: Path, jobs: int) -> Iterator[Row]:
    """Seconds of fits with nine parameters, three of them shared."""
    rng = np.random.default_rng(4)
    for i in range(50):
        own = {n: SPRING[n] * np.exp(0.08 * rng.standard_normal())
               for n in ("k0", "sigma_plus", "sigma_minus")}  # fmt: skip
        spring = ff.MicroscaleSpring(**SPRING | own, relaxation=[(0.4, 0.5)])
        write_test(folder / f"t{i:02d}.csv", spring, 0.1, rng, 1001)
    kinds = dict.fromkeys(("kc", "spread_plus", "spread_minus"), "shared")
    text = write_study(folder, kinds, relaxation=1).read_text()
    for count in (10, 20, 50):
        tests = ", ".join(f'"t{i:02d}.csv"' for i in range(count))
        (folder / "study.toml").write_text(text.replace('"t*.csv"', tests))
        began = time.perf_counter()
        result = ff.joint(folder / "study.toml", jobs=jobs)
        seconds = time.perf_counter() - began
        row: Row = {"study": "time", "what": f"{count} tests, {result.fit.found.n_vary} numbers",
                    "draws": 1, "mean": seconds}  # fmt: skip
        yield row


def coverage(hits: list[bool]) -> Row:
    interval = binomtest(sum(hits), len(hits)).proportion_ci(0.95, "wilson")
    return {
        "share": float(np.mean(hits)), "low": float(interval.low), "high": float(interval.high),
    }  # fmt: skip


def table(rows: list[Row]) -> str:
    """The rows as markdown."""
    lines = [
        "| study | what | draws | mean | share | 95 % of the share |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        mean = "" if "mean" not in row else f"{float(row['mean']):.3g}"
        if "spread" in row:
            mean += f" ± {float(row['spread']):.2f} standard errors"
        elif row["study"] == "time":
            mean += " s"
        share = "" if "share" not in row else f"{100 * float(row['share']):.0f} %"
        ends = (
            ""
            if "low" not in row
            else f"{100 * float(row['low']):.0f} to {100 * float(row['high']):.0f} %"
        )
        lines.append(
            f"| {row['study']} | {row['what']} | {row['draws']} | {mean} | {share} | {ends} |"
        )
    return "\n".join(lines)


def save(rows: list[Row], folder: Path) -> None:
    """Write joint.csv and joint.md; of studies that were not run now the older rows stay."""
    path, now = folder / "joint.csv", {row["study"] for row in rows}
    if path.is_file():
        with path.open(newline="") as file:
            older = [{k: v for k, v in row.items() if v} for row in csv.DictReader(file)]
        rows = [*(row for row in older if row["study"] not in now), *rows]
    keys = ("study", "what", "draws", "mean", "spread", "share", "low", "high")
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, keys, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    (folder / "joint.md").write_text(f"{table(rows)}\n\n{machine}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--only",
        choices=("four", "scatter", "log", "power", "shaken", "impacts", "predict", "time"),
    )
    parser.add_argument("--draws", type=int, help="default: 100 of groups, 200 of laws, 20 else")
    parser.add_argument("--jobs", type=int, default=2, help="processes of the timing")
    parser.add_argument("--out", type=Path, default=HERE)
    given = parser.parse_args()
    rows = list[Row]()
    studies = {
        "four": [lambda at: four(given.draws or 20, at)],
        "scatter": [lambda at, s=s: scatter(given.draws or 100, at, s) for s in (0.1, 0.03)],
        "log": [lambda at: rates(given.draws or 200, at, "log rate", 0.05)],
        "power": [lambda at: rates(given.draws or 200, at, "power rate", 0.05)],
        "shaken": [lambda at, s=s: shaken(given.draws or 30, at, s) for s in (1e-3, 3e-3)],
        "impacts": [lambda at, b=b: impacts(given.draws or 20, at, b) for b in (0.0, 0.2)],
        "predict": [lambda at, k=k: predictions(given.draws or 60, at, k) for k in TOGETHER],
        "time": [lambda at: timing(at, given.jobs)],
    }
    for name, makers in studies.items():
        for make in makers if given.only in (None, name) else ():
            with tempfile.TemporaryDirectory() as folder:
                for row in make(Path(folder)):
                    rows.append(row)
                    print(row, flush=True)
    save(rows, given.out)
    print(table(rows))


if __name__ == "__main__":
    main()
