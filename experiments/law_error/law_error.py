"""Does `ci95` contain the best noise-free fit of a law if the foam follows another law?

Method and answer: README.md. Also written: law_error.csv.

    python experiments/law_error/law_error.py                # 200 draws each
    python experiments/law_error/law_error.py --draws 20 --out FOLDER
"""

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import foamfit as ff

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from truth import Microscale, Motion, Rig

HERE = Path(__file__).parent
NOISE = 0.005  # of the range


class Curves(NamedTuple):
    """A test without noise: SI."""

    time: np.ndarray
    stress: np.ndarray
    displacement: np.ndarray
    height: float
    area: float
    striker: tuple[float, float] | None = None  # mass and velocity


SPRING = ff.BistableSpring(
    k0=5.5e6, kc=82.5e6, dsigma=-0.179e6, eps_a=0.14, eps_c=0.31, kh_plus=4e6, kh_minus=2.1e6
)


def branches(width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return strain, loading stress and unloading stress, with kinks rounded over a width."""
    top = 1.12 * SPRING.eps_hat_c
    strain = np.linspace(0.0, top + 0.08, 6001)
    up = SPRING.stress(strain)
    down = SPRING.stress(np.concatenate([strain, strain[::-1]]))[strain.size :][::-1]
    half = max(int(0.5 * width / strain[1]), 1)
    window = np.hanning(2 * half + 3)[1:-1]

    def rounded(stress: np.ndarray) -> np.ndarray:
        longer = np.pad(stress, half, mode="reflect", reflect_type="odd")
        smooth = np.convolve(longer, window / window.sum(), "valid")
        return smooth - smooth[0]  # exactly zero, where contact ends

    return strain, rounded(up), rounded(down)


def impact(width: float, rate: float, samples: int = 501) -> Curves:
    """Simulate an impact on a foam with rounded kinks or a stress rise of `rate` per e-fold."""
    height, area, mass = 1.2e-3, 1.9635e-5, 7e-3
    strain, up, down = branches(width)
    inside = strain <= 1.12 * SPRING.eps_hat_c
    velocity = np.sqrt(2.0 * np.trapezoid(up[inside], strain[inside]) * area * height / mass)

    def stress(x: float, v: float, path: np.ndarray) -> float:
        speed = np.maximum(np.abs(v), 0.01 * velocity) / velocity
        return np.interp(x / height, strain, path) * (1.0 + rate * np.log(speed))

    def run(start: float, state: list[float], path: np.ndarray, end: Any) -> Any:
        end.terminal, end.direction = True, -1
        return solve_ivp(
            lambda _, y: [y[1], -area * stress(y[0], y[1], path) / mass],
            (start, start + 20.0 * height / velocity), state, events=end, dense_output=True,
            rtol=1e-9, atol=1e-12, max_step=height / velocity / 500.0,
        )  # fmt: skip

    there = run(0.0, [0.0, velocity], up, lambda t, y: y[1])
    turn = there.t[-1]
    back = run(turn, there.y[:, -1], down, lambda t, y: stress(y[0], y[1], down))
    clock = np.linspace(0.0, back.t[-1], samples)
    loading = clock <= turn
    y = np.where(loading, there.sol(np.minimum(clock, turn)), back.sol(np.maximum(clock, turn)))
    force = np.where(loading, stress(y[0], y[1], up), stress(y[0], y[1], down))
    return Curves(clock, force, y[0], height, area, (mass, float(velocity)))


@cache
def curves(kind: str) -> Curves:
    """Return the test of one kind, without noise."""
    if kind == "microscale and relaxation":
        height, area, clock = 10e-3, 4.6e-5, np.linspace(0.0, 5.0, 1000)
        turn, most = clock[499:501], 2e-3 * clock[499]  # the samples next to the turning point
        motion = Motion((0.0, *turn, 5.0), (0.0, most, most, 0.0), ("line",) * 3)
        foam = Microscale(5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, relaxation=((0.5, 0.2),))
        course = Rig((foam,), (height,), area, motion=motion).run(0.0, 5.0)
        clock = clock[:930]
        return Curves(clock, course.stress(clock), course.top(clock, False), height, area)
    return impact(0.03 if kind == "rounded kinks" else 1e-4, 0.02 if kind == "rate effect" else 0.0)


KINDS = {  # and the autocorrelation of the noise from sample to sample
    "microscale and relaxation": 0.0,
    "rounded kinks": 0.0,
    "rate effect": 0.0,
    "own law": 0.0,
    "own law, correlated noise": 0.9,
}


def read(kind: str, draw: int | None) -> ff.Measurement:
    """Write a test with new noise, or without noise, as files of a user, and read it."""
    test, rho = curves(kind.split(",")[0]), KINDS[kind]
    stress, motion = test.stress, test.displacement
    if draw is not None:
        rng = np.random.default_rng([draw, list(KINDS).index(kind)])
        white = rng.standard_normal((2, test.time.size + 500))
        one, other = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], white)[:, 500:]
        stress = stress + NOISE * np.ptp(stress) * one
        if test.striker is not None:
            motion = motion + NOISE * np.ptp(motion) * other
    toml = f'[specimen]\nheight = "{test.height} m"\narea = "{test.area} m^2"\n'
    if test.striker is not None:
        toml += '[striker]\nmass = "{} kg"\nvelocity = "{} m/s"\n'.format(*test.striker)
    columns = {"time": test.time, "stress": stress, "displacement": motion}
    with studies.workplace() as folder:
        return ff.read_test(studies.write_test(folder / "test.csv", toml, **columns))


def draws_of(kind: str, draws: int) -> pd.DataFrame:
    """Return a row for each parameter and draw."""
    rows, without = list[dict[str, Any]](), ff.fit(read(kind, None))
    for draw in range(draws):
        result, seconds = studies.timed(ff.fit, read(kind, draw))
        found = any(item["law_error"] is not None for item in result.noise.values())
        for name, item in result.parameters.items():
            if item.vary and name.startswith("s1_"):  # not of the record
                low, high = item.ci95 or (np.nan, np.nan)
                rows.append({
                    "kind": kind, "draw": draw, "parameter": name, "value": item.value,
                    "best without noise": without.parameters[name].value, "low": low,
                    "high": high, "ranged": item.range is not None, "state": item.state,
                    "found": found, "seconds": seconds,
                })  # fmt: skip
    return pd.DataFrame(rows)


def coverage(rows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Count how often `ci95` contains the best noise-free fit; compare its width with refits."""
    for (kind, name), own in rows.groupby(["kind", "parameter"], sort=False):
        given = own[own["low"].notna()]
        truth = given["best without noise"]
        scatter = own["value"].quantile(0.975) - own["value"].quantile(0.025)
        width = (given["high"] - given["low"]).median()
        yield {
            "kind": kind, "parameter": name, "draws": own["draw"].nunique(),
            "intervals": len(given), "holds": truth.between(given["low"], given["high"]).mean(),
            "width over scatter": width / scatter if scatter > 0.0 else np.nan,
            "error of the law found": own["found"].mean(), "with a range": own["ranged"].mean(),
            "determined": (own["state"] == "determined").mean(), "seconds": own["seconds"].median(),
        }  # fmt: skip


def summary_of(table: pd.DataFrame) -> str:
    """Return a Markdown row for each kind."""
    groups = table.groupby("kind", sort=False)
    holds = 100 * groups["holds"].agg(["mean", "min", "max"])
    width = groups["width over scatter"].agg(["min", "max"])
    summary = pd.DataFrame({
        "test": list(groups.groups), "draws": groups["draws"].max(),
        "ci95 contains the best fit without noise (%)":
            [f"{mean:.1f} ({low:.1f} to {high:.1f})" for mean, low, high in holds.to_numpy()],
        "width of ci95 over the scatter of refits":
            [f"{low:.2f} to {high:.2f}" for low, high in width.to_numpy()],
        "law error detected (%)": (100 * groups["error of the law found"].mean()).round(1),
        "median fit (s)": groups["seconds"].median().round(2),
    })  # fmt: skip
    return studies.markdown(summary.columns, summary.to_numpy())


def main() -> None:
    options = studies.arguments(__doc__, HERE, draws=200).parse_args()
    table = studies.said(row for kind in KINDS for row in coverage(draws_of(kind, options.draws)))
    studies.write_csv(table, options.out / "law_error.csv")
    noise, summary = f"{100 * NOISE:g} %", summary_of(table)
    studies.write_page(HERE, options.out, noise=noise, summary=summary)


if __name__ == "__main__":
    main()
