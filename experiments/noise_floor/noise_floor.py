"""How often does a fit reach the noise floor from the curve alone?

Synthetic impacts: random bistable springs (with and without dashpot) struck fast enough to close
the loop, 501 samples, 1 % white noise on stress and on displacement, time zero known. Each is
fitted with the defaults of `foamfit.fit`. A fit has reached the noise floor when its chi-square is
at most 1.02 times that of the true parameters.

    python experiments/noise_floor/noise_floor.py            # 100 cases, table and figure
    python experiments/noise_floor/noise_floor.py --cases 10
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import foamfit as ff
from foamfit.data.measurement import Measurement, Specimen, Striker
from foamfit.fitting.objective import Objective
from foamfit.springs.model import Model

HERE = Path(__file__).parent
NOISE = 0.01
HEIGHT, AREA, MASS = 1.2e-3, 1.9635e-5, 7e-3


def white(rng: np.random.Generator, samples: int) -> np.ndarray:
    """White noise of unit variance."""
    return rng.standard_normal(samples)


def random_case(
    rng: np.random.Generator,
    samples: int = 501,
    noise: Callable[[np.random.Generator, int], np.ndarray] = white,
) -> tuple[ff.BistableSpring, Measurement]:
    """A random spring and its synthetic impact, struck hard enough to use branch c."""
    k0 = 10 ** rng.uniform(6, 7.5)
    eps_a = rng.uniform(0.05, 0.35)
    sigma_a = k0 * eps_a / (1 - eps_a)
    eps_c = eps_a + rng.uniform(0.1, 0.45)
    drop = rng.uniform(0.05, 0.8)
    kh_plus = k0 * rng.uniform(0.1, 3)
    sigma_c = sigma_a * (1 - drop)
    spring = ff.BistableSpring(
        k0=k0,
        kc=k0 * 10 ** rng.uniform(0.7, 1.7),
        dsigma=-drop * sigma_a,
        eps_a=eps_a,
        eps_c=eps_c,
        kh_plus=kh_plus,
        kh_minus=sigma_c / eps_c * rng.uniform(0.5, 1.1),
    )
    # work to C1, and a third to a factor of two more than that
    strain = np.linspace(0, spring.eps_hat_c, 2000)
    work = np.trapezoid(spring.stress(strain), strain) * AREA * HEIGHT
    velocity = float(np.sqrt(2 * work * rng.uniform(1.3, 2.0) / MASS))
    if rng.random() < 0.5:
        eta = 10 ** rng.uniform(-2.5, -1) * spring.sigma_hat_c * HEIGHT / velocity
        spring = ff.BistableSpring(*spring.seven, eta=eta)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    drive = ff.Impact(MASS, velocity)
    long = ff.simulate(chain, drive, np.linspace(0, 20 * HEIGHT / velocity, 4001))
    end = long.contact_end or long.time[-1]
    time_ = np.linspace(0, 1.05 * end, samples)
    response = ff.simulate(chain, drive, time_)
    stress, motion = response.base_stress, response.displacement[-1]
    noisy = [x + NOISE * np.ptp(x) * noise(rng, x.size) for x in (stress, motion)]
    measurement = Measurement(
        name="synthetic impact",
        path=None,
        data_sha256="",
        time=time_,
        stress=noisy[0],
        displacement=noisy[1],
        specimen=Specimen(HEIGHT, AREA),
        striker=Striker(MASS, velocity),
        motion="measured",
    )
    return spring, measurement


def run(cases: int, seed: int) -> pd.DataFrame:
    """Fit every case; one row each."""
    rows = []
    for case in range(cases + 1):  # the first only compiles
        rng = np.random.default_rng([seed, case])
        spring, measurement = random_case(rng)
        began = time.perf_counter()
        result = ff.fit(measurement, seed=0)
        seconds = time.perf_counter() - began
        objective = Objective(measurement, Model.parse("bistable"), "impact", result.weights)
        truth = objective.residual(np.array([*spring.seven, spring.eta, 0.0]))
        ratio = result.statistics["chisqr"] / float(truth @ truth)
        if case:
            rows.append(
                {
                    "case": case,
                    "eta (Pa s)": spring.eta,
                    "chi-square over true": ratio,
                    "noise floor reached": ratio <= 1.02,
                    "seconds": seconds,
                    "evaluations": result.statistics["nfev"],
                    "visited": "".join(result.visited["s1"]),
                }
            )
    return pd.DataFrame(rows)


def picture(table: pd.DataFrame, path: Path) -> None:
    """Chi-square reached against seconds."""
    figure = Figure(figsize=(5.0, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    reached = table["noise floor reached"]
    for mask, colour, label in ((reached, "#0072B2", "reached"), (~reached, "#D55E00", "missed")):
        axes.plot(
            table["seconds"][mask],
            table["chi-square over true"][mask],
            "o",
            color=colour,
            markerfacecolor="none",
            label=f"noise floor {label} ({mask.sum()})",
        )
    axes.axhline(1.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="run time of the fit (s)", ylabel="χ² over χ² of the true parameters (–)")
    axes.set_title(f"{len(table)} synthetic impacts, 1 % noise", fontsize=10)
    figure.legend(frameon=False, fontsize=8, loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=200)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seed", type=int, default=2014)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    table = run(options.cases, options.seed)
    reached = int(table["noise floor reached"].sum())
    written = options.out / "noise_floor.csv"
    with keep_unchanged(written):
        table.to_csv(written, index=False, float_format="%.4g")
    picture(pd.read_csv(written), options.out / "noise_floor.png")  # times as they were kept
    print(
        f"noise floor reached in {reached} of {len(table)} synthetic impacts, "
        f"median {table['seconds'].median():.2f} s, slowest {table['seconds'].max():.2f} s "
        f"(foamfit {ff.__version__}, Python {platform.python_version()}, {platform.machine()})"
    )


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
