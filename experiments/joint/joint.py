"""Do the intervals of joint fits hold, and what do they cost? Synthetic studies, from files.

Method. Each study goes the way of a user: its tests are written as CSV with one TOML, a STUDY.toml
says what the parameters are, and `foamfit.joint` fits them (search included, no knowledge of the
truth). The foam is a microscale spring under a slow triangle to 50 % strain, 101 samples, with
white noise of 0.25 % of the largest stress, which the TOML states.

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

Answer. Four tests have half the standard errors of one; intervals hold in 92 to 98 %: README.md.

    python experiments/joint/joint.py                 # all; writes joint.csv and joint.md
    python experiments/joint/joint.py --only log --draws 20
"""

from __future__ import annotations

import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

HEIGHT, TOP, NOISE = 10e-3, 0.5, 400.0
SPRING = {
    "k0": 5.5e5, "kc": 4e5, "eps_star": 0.3, "sigma_plus": 1.1e5, "spread_plus": 0.4,
    "sigma_minus": 7e4, "spread_minus": 0.6,
}  # fmt: skip
SHARED = dict.fromkeys(SPRING, "shared")
SPECIMEN = f'[specimen]\nheight = "10 mm"\narea = "1 cm^2"\n[noise]\nstress = "{NOISE} Pa"\n'
RATES = np.geomspace(0.01, 1.0, 5)
Row = dict[str, Any]


def write_test(
    path: Path, rate: float, rng: np.random.Generator, samples: int = 101, shake: float = 0.0,
    relaxation: Any = (), **own: float,
) -> None:  # fmt: skip
    """Write a test of the foam with some parameters of its own; `shake` is noise of the motion."""
    spring = ff.MicroscaleSpring(**SPRING | own, relaxation=relaxation)
    up = np.linspace(0.0, TOP, samples // 2 + 1)
    strain = np.concatenate([up, up[::-1][1:]])
    clock = np.arange(strain.size) * (up[1] / rate)
    drive = ff.DisplacementDrive(HEIGHT * strain)
    stress = ff.simulate(ff.Chain([spring], [HEIGHT], 1e-4), drive, clock).base_stress
    stress = stress + NOISE * rng.standard_normal(stress.size)
    if shake:
        strain = strain + shake * TOP * rng.standard_normal(strain.size)
    studies.write_test(path, time=clock, stress=stress, displacement=HEIGHT * strain)


def write_study(folder: Path, kinds: dict[str, str], relaxation: int = 0) -> Path:
    (folder / "foam.toml").write_text(SPECIMEN)
    return studies.write_study(
        folder / "study.toml", ["t*.csv"], "microscale", kinds, specimen="foam.toml",
        drive="displacement", relaxation=relaxation,
    )  # fmt: skip


def off_and_held(one: Any, slope: float) -> tuple[float, bool]:
    """How far a slope is off in standard errors, and whether its interval holds the truth."""
    return (one.b - slope) / one.b_stderr, bool(one.b_ci95[0] <= slope <= one.b_ci95[1])


def in_errors(study: str, what: str, off: list[float], hits: list[bool]) -> Row:
    """Mean and spread of what is off, in standard errors, and coverage of the intervals."""
    row = {"study": study, "what": what, "draws": len(hits), "mean": float(np.mean(off))}
    return row | {"spread": float(np.std(off))} | studies.share(hits)


def four(draws: int, folder: Path) -> Iterator[Row]:
    """Standard errors of four tests of one specimen over those of one."""
    ratios = []
    for draw in range(draws):
        rng = np.random.default_rng([1, draw])
        for i in range(4):
            write_test(folder / f"t{i}.csv", 0.1, rng)
        joint = ff.joint(write_study(folder, SHARED), jobs=1)
        test = ff.read_test(folder / "t0.csv", folder / "foam.toml")
        alone = ff.fit(test, model="microscale", drive="displacement", intervals="local")
        pairs = [(joint.parameters[f"s1_{n}"], alone.parameters[f"s1_{n}"]) for n in SPRING]
        ratios.append([a.stderr / b.stderr for a, b in pairs if a.stderr and b.stderr])
    mean = float(np.mean([np.mean(one) for one in ratios]))
    yield {"study": "four", "what": "stderr of four tests over one's", "draws": draws, "mean": mean}


def scatter(draws: int, folder: Path, spread: float) -> Iterator[Row]:
    """Coverage of common value and spread over groups of 8 specimens."""
    common, hits, spreads = [], [], []
    kinds = SHARED | {"k0": "scatter", "sigma_plus": "own"}
    for draw in range(draws):
        rng = np.random.default_rng([2, round(1e3 * spread), draw])
        for i in range(8):
            own = SPRING["k0"] * np.exp(spread * rng.standard_normal())
            write_test(folder / f"t{i}.csv", 0.1, rng, k0=own)
        one = ff.joint(write_study(folder, kinds), jobs=1).parameters["s1_k0"]
        common.append(bool(one.ci95[0] <= SPRING["k0"] <= one.ci95[1]))
        hits.append(bool(one.scatter_ci95[0] <= spread <= one.scatter_ci95[1]))
        spreads.append(one.scatter)
    row: Row = {"study": f"scatter {spread:g}", "draws": draws}
    yield row | {"what": "common value"} | studies.share(common)
    yield row | {"what": "spread", "mean": float(np.mean(spreads))} | studies.share(hits)


def rates(draws: int, folder: Path, kind: str, slope: float) -> Iterator[Row]:
    """Bias and coverage of value and slope of a law of rate, and what the evidence is for."""
    off, hits, value_off, value_hits, chosen = [], [], [], [], []
    truth = SPRING["sigma_plus"]
    for draw in range(draws):
        rng = np.random.default_rng([3, len(kind), draw])
        for i, rate in enumerate(RATES):
            x = np.log(rate / RATES[2])
            factor = 1.0 + slope * x if kind == "log rate" else np.exp(slope * x)
            write_test(folder / f"t{i}.csv", rate, rng, sigma_plus=factor * truth)
        result = ff.joint(write_study(folder, SHARED | {"sigma_plus": kind}), jobs=1)
        one = result.parameters["s1_sigma_plus"]
        value_off.append((one.value - truth) / one.stderr)
        value_hits.append(bool(one.ci95[0] <= truth <= one.ci95[1]))
        for kept, found in zip((off, hits), off_and_held(one, slope), strict=True):
            kept.append(found)
        chosen.append(min(result.evidence, key=lambda alternative: alternative.bic).kind)
    yield in_errors(kind, "value", value_off, value_hits)
    yield in_errors(kind, "slope b", off, hits)
    for name in ("log rate", "power rate", "shared", "own"):
        yield {"study": kind, "what": f"evidence for {name}", "draws": draws,
               "share": chosen.count(name) / draws}  # fmt: skip


def shaken(draws: int, folder: Path, level: float) -> Iterator[Row]:
    """Slope of a power law where noise of the displacement makes errors of the rates."""
    slope, found, errors = 0.2, [], []
    for draw in range(draws):
        rng = np.random.default_rng([7, round(1e5 * level), draw])
        for i, rate in enumerate(RATES):
            own = SPRING["sigma_plus"] * (rate / RATES[2]) ** slope
            write_test(folder / f"t{i}.csv", rate, rng, shake=level, sigma_plus=own)
        result = ff.joint(write_study(folder, SHARED | {"sigma_plus": "power rate"}), jobs=1)
        found.append(off_and_held(result.parameters["s1_sigma_plus"], slope))
        apart = np.log(np.array(result.rates) / RATES)
        errors.append(apart - apart.mean())
    study = f"displacement noise {100 * level:g} %"
    scale = (len(RATES) / (len(RATES) - 1)) ** 0.5
    yield {"study": study, "what": "error of a rate", "draws": draws,
           "mean": scale * float(np.std(errors))}  # fmt: skip
    off, hits = zip(*found, strict=True)
    yield in_errors(study, "slope b", list(off), list(hits))


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
    stress, motion = (
        curve[: clock.size] + 5e-3 * np.ptp(curve) * rng.standard_normal(clock.size)
        for curve in (run.base_stress, run.displacement[-1])
    )
    toml = f'[specimen]\nheight = "{height} m"\narea = "{area} m^2"\n'
    toml += f'[striker]\nmass = "7 g"\nvelocity = "{velocity} m/s"\n'
    studies.write_test(path, toml, time=clock, stress=stress, displacement=motion)
    peak = int(np.argmax(run.displacement[-1]))
    return float(run.displacement[-1][peak] / height / run.time[peak])


def impacts(draws: int, folder: Path, slope: float) -> Iterator[Row]:
    """What the evidence says of k_h+ in impacts at five velocities."""
    chosen, found, kh_plus = [], [], 14.3e6
    kinds = dict.fromkeys(BISTABLE, "shared") | {"kh_plus": "auto"}
    study = studies.write_study(folder / "study.toml", ["t*.csv"], "bistable", kinds)
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
            found.append(off_and_held(one, slope))
    name = f"impacts, b = {slope:g}"
    for kind in ("shared", "power rate", "log rate", "own"):
        yield {"study": name, "what": f"{kind} chosen", "draws": draws,
               "share": chosen.count(kind) / draws}  # fmt: skip
    if found:
        off, hits = zip(*found, strict=True)
        yield in_errors(name, "slope b", list(off), list(hits))


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
    found, kinds = [], SHARED | dict.fromkeys(TOGETHER[kind], "own")
    for draw in range(draws):
        rng = np.random.default_rng([6, len(kind), draw])
        for old in folder.glob("t*.csv"):
            old.unlink()
        count = 4 + draw % 3
        for i in range(count + 1):
            own = specimen(rng, TOGETHER[kind], 0.03)
            name = f"t{i}" if i < count else "new"
            write_test(folder / f"{name}.csv", 0.1, rng, **own)
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
        write_test(folder / f"t{i:02d}.csv", 0.1, rng, 1001, relaxation=[(0.4, 0.5)], **own)
    kinds = dict.fromkeys(("kc", "spread_plus", "spread_minus"), "shared")
    text = write_study(folder, kinds, relaxation=1).read_text()
    for count in (10, 20, 50):
        tests = ", ".join(f'"t{i:02d}.csv"' for i in range(count))
        (folder / "study.toml").write_text(text.replace('"t*.csv"', tests))
        began = time.perf_counter()
        result = ff.joint(folder / "study.toml", jobs=jobs)
        seconds = time.perf_counter() - began
        yield {"study": "time", "what": f"{count} tests, {result.fit.found.n_vary} numbers",
               "draws": 1, "mean": seconds}  # fmt: skip


def table(frame: pd.DataFrame) -> str:
    """The rows as markdown."""
    rows = []
    for row in frame.to_dict("records"):
        given = {key for key, value in row.items() if not pd.isna(value)}
        mean = f"{row['mean']:.3g}" if "mean" in given else ""
        if "spread" in given:
            mean += f" ± {row['spread']:.2f} standard errors"
        elif row["study"] == "time":
            mean += " s"
        share = f"{100 * row['share']:.0f} %" if "share" in given else ""
        ends = f"{100 * row['low']:.0f} to {100 * row['high']:.0f} %" if "low" in given else ""
        rows.append([row["study"], row["what"], row["draws"], mean, share, ends])
    return studies.markdown("study | what | draws | mean | share | 95 % of the share", rows)


def save(rows: list[Row], folder: Path) -> None:
    """Write joint.csv and joint.md; of studies that were not run now the older rows stay."""
    path, columns = folder / "joint.csv", "study what draws mean spread share low high"
    frame = pd.DataFrame(rows).reindex(columns=columns.split())
    if path.is_file():
        older = pd.read_csv(path)
        frame = pd.concat([older[~older["study"].isin(frame["study"])], frame])
    frame.to_csv(path, index=False, lineterminator="\n")
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    (folder / "joint.md").write_text(f"{table(frame)}\n\n{machine}\n")
    print(table(frame))


STUDIES: dict[str, tuple[Any, int, tuple[Any, ...]]] = {  # maker, draws, each with one of these
    "four": (four, 20, ((),)),
    "scatter": (scatter, 100, ((0.1,), (0.03,))),
    "log": (rates, 200, (("log rate", 0.05),)),
    "power": (rates, 200, (("power rate", 0.05),)),
    "shaken": (shaken, 30, ((1e-3,), (3e-3,))),
    "impacts": (impacts, 20, ((0.0,), (0.2,))),
    "predict": (predictions, 60, tuple((kind,) for kind in TOGETHER)),
    "time": (timing, 0, ((),)),
}


def main() -> None:
    parser = studies.arguments(__doc__, HERE, jobs=(2, "processes of the timing"))
    parser.add_argument("--only", choices=list(STUDIES))
    parser.add_argument("--draws", type=int, help="default: 100 of groups, 200 of laws, 20 else")
    given = parser.parse_args()
    rows = list[Row]()
    for name, (maker, draws, cases) in STUDIES.items():
        for case in cases if given.only in (None, name) else ():
            with tempfile.TemporaryDirectory() as folder:
                place, count = Path(folder), given.draws or draws
                found = timing(place, given.jobs) if name == "time" else maker(count, place, *case)
                for row in found:
                    rows.append(row)
                    print(row, flush=True)
    save(rows, given.out)


if __name__ == "__main__":
    main()
