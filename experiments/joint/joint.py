"""Do the intervals of joint fits contain the true values? How small are standard errors?

Method and answer: README.md. The foam is a microscale spring under a slow triangle to 50 % strain,
101 samples, with white noise of 0.25 % of the largest stress, which the TOML states.

    python experiments/joint/joint.py                 # all; writes joint.csv and README.md
    python experiments/joint/joint.py --only log --draws 20 --out FOLDER
"""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from truth import Microscale, Motion, Rig

HERE = Path(__file__).parent
HEIGHT, TOP, NOISE, SAMPLES = 10e-3, 0.5, 400.0, 101
SPRING = {
    "k0": 5.5e5, "kc": 4e5, "eps_star": 0.3, "sigma_plus": 1.1e5, "spread_plus": 0.4,
    "sigma_minus": 7e4, "spread_minus": 0.6,
}  # fmt: skip
SHARED = dict.fromkeys(SPRING, "shared")
SPECIMEN = f'[specimen]\nheight = "10 mm"\narea = "1 cm^2"\n[noise]\nstress = "{NOISE} Pa"\n'
RATES = np.geomspace(0.01, 1.0, 5)
Row = dict[str, Any]


def write_test(path: Path, rate: float, rng: np.random.Generator, **own: float) -> None:
    """Write a test of the foam with some changed parameters."""
    clock = np.linspace(0.0, 2.0 * TOP / rate, SAMPLES)
    motion = Motion(tuple(clock[[0, SAMPLES // 2, -1]]), (0.0, HEIGHT * TOP, 0.0), ("line",) * 2)
    foam = Rig((Microscale(**SPRING | own),), (HEIGHT,), 1e-4, motion=motion)
    stress = foam.follow(clock).base_stress + NOISE * rng.standard_normal(SAMPLES)
    studies.write_test(path, time=clock, stress=stress, displacement=motion.at(clock))


def write_study(folder: Path, kinds: dict[str, str]) -> Path:
    (folder / "foam.toml").write_text(SPECIMEN)
    return studies.write_study(
        folder / "study.toml", ["t*.csv"], "microscale", kinds, specimen="foam.toml",
        drive="displacement",
    )  # fmt: skip


def four(draws: int, folder: Path) -> Iterator[Row]:
    """Yield the standard errors of four tests of one specimen over those of one."""
    ratios = []
    for draw in range(draws):
        rng = np.random.default_rng([1, draw])
        for i in range(4):
            write_test(folder / f"t{i}.csv", 0.1, rng)
        joint = ff.joint(write_study(folder, SHARED))
        test = ff.read_test(folder / "t0.csv", folder / "foam.toml")
        alone = ff.fit(test, model="microscale", drive="displacement", intervals="local")
        pairs = [(joint.parameters[f"s1_{n}"], alone.parameters[f"s1_{n}"]) for n in SPRING]
        ratios.append(np.mean([a.stderr / b.stderr for a, b in pairs if a.stderr and b.stderr]))
    mean = float(np.mean(ratios))
    yield {"study": "four", "what": "stderr of four tests over one's", "draws": draws, "mean": mean}


def held(intervals: Iterable[tuple[float, float]], truth: float) -> dict[str, float]:
    """Return the share of intervals that contain the true value, with its 95 % interval."""
    return studies.share([bool(low <= truth <= high) for low, high in intervals])


def scatter(draws: int, folder: Path, spread: float) -> Iterator[Row]:
    """Yield the coverage of common value and spread over groups of 8 specimens."""
    found, kinds = [], SHARED | {"k0": "scatter", "sigma_plus": "own"}
    for draw in range(draws):
        rng = np.random.default_rng([2, round(1e3 * spread), draw])
        for i in range(8):
            own = SPRING["k0"] * np.exp(spread * rng.standard_normal())
            write_test(folder / f"t{i}.csv", 0.1, rng, k0=own)
        found.append(ff.joint(write_study(folder, kinds)).parameters["s1_k0"])
    row: Row = {"study": f"scatter {spread:g}", "draws": draws}
    yield row | {"what": "common value"} | held((one.ci95 for one in found), SPRING["k0"])
    mean = float(np.mean([one.scatter for one in found]))
    yield row | {"what": "spread", "mean": mean} | held((one.scatter_ci95 for one in found), spread)


def rates(draws: int, folder: Path, kind: str, slope: float) -> Iterator[Row]:
    """Yield bias (in standard errors) and coverage of a rate law."""
    truth, found = SPRING["sigma_plus"], []
    for draw in range(draws):
        rng = np.random.default_rng([3, len(kind), draw])
        for i, rate in enumerate(RATES):
            x = np.log(rate / RATES[2])
            factor = 1.0 + slope * x if kind == "log rate" else np.exp(slope * x)
            write_test(folder / f"t{i}.csv", rate, rng, sigma_plus=factor * truth)
        study = write_study(folder, SHARED | {"sigma_plus": kind})
        found.append(ff.joint(study).parameters["s1_sigma_plus"])
    values = [(one.value, one.stderr, one.ci95) for one in found]
    slopes = [(one.b, one.b_stderr, one.b_ci95) for one in found]
    for what, true, each in (("value", truth, values), ("slope b", slope, slopes)):
        off = [(value - true) / error for value, error, _ in each]
        row = {"study": kind, "what": what, "draws": draws, "mean": float(np.mean(off))}
        yield row | {"spread": float(np.std(off))} | held((ends for *_, ends in each), true)


STUDIES: dict[str, tuple[Any, ...]] = {  # maker, draws and settings of each part
    "four": (four, 20),
    "scatter": (scatter, 100, 0.1),
    "small scatter": (scatter, 100, 0.03),
    "log": (rates, 200, "log rate", 0.05),
    "power": (rates, 200, "power rate", 0.05),
}


def main() -> None:
    parser = studies.arguments(__doc__, HERE)
    parser.add_argument("--only", choices=list(STUDIES))
    parser.add_argument("--draws", type=int, help="default: 100 of groups, 200 of laws, 20 else")
    given = parser.parse_args()
    rows = list[Row]()
    for name in [given.only] if given.only else STUDIES:
        maker, draws, *settings = STUDIES[name]
        with studies.workplace() as folder:
            rows += maker(given.draws or draws, folder, *settings)
    studies.write_csv(rows, given.out / "joint.csv")
    table = studies.shown(pd.DataFrame(rows))
    print(studies.write_page(HERE, given.out, table=table))


if __name__ == "__main__":
    main()
