"""How often does a fit reach the noise floor from the curve alone? And do its intervals hold?

Method. A fit has reached the noise floor when its chi-square is at most 1.02 times that of the true
parameters. Bistable: random springs (with and without dashpot) are struck fast enough to close the
loop, 501 samples, 1 % white noise on stress and on displacement, time zero known, and fitted with
the defaults of `foamfit.fit`. Microscale: random springs with one relaxation term are compressed at
a constant rate until most of their micro-springs have snapped, and back; 600 samples, 1 % white
noise on the stress; each goes by way of a CSV and its TOML. Beside their intervals stands what the
same noise makes of a linear problem (see synthetic.py).

Answer. In 100 of 100 impacts and in 200 of 200 slow tests; see experiments/README.md.

    python experiments/noise_floor/noise_floor.py                   # 100 impacts, table and figure
    python experiments/noise_floor/noise_floor.py --law microscale --cases 200
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

import foamfit as ff
from foamfit.fitting.problem import make_problem
from foamfit.springs.law import most_beyond
from foamfit.springs.model import Model
from foamfit.trust.best_point import BestPoint

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402
from synthetic import NOISE, linear, random_case  # noqa: E402

REACHED = 1.02
SAMPLES, HEIGHT, DIAMETER, DURATION = 600, 10e-3, 7.6e-3, 4.0  # of a slow test; m, s
MODEL = Model(("microscale",), 1)


def impact(case: int, seed: int) -> dict[str, Any]:
    """Fit one impact: a row of noise_floor.csv."""
    spring, measurement = random_case(np.random.default_rng([seed, case]))
    began = time.perf_counter()
    result = ff.fit(measurement, seed=0)
    seconds = time.perf_counter() - began
    problem = make_problem(measurement, "bistable", "impact", None, None, False)
    values = problem.vector()
    values[:9] = *spring.seven, spring.eta, 0.0
    truth = problem.objective.residual(values)
    ratio = result.statistics["chisqr"] / float(truth @ truth)
    return {
        "case": case, "eta (Pa s)": spring.eta, "chi-square over true": ratio,
        "noise floor reached": ratio <= REACHED, "seconds": seconds,
        "evaluations": result.statistics["nfev"], "visited": "".join(result.visited["s1"]),
    }  # fmt: skip


def random_spring(rng: np.random.Generator) -> tuple[ff.MicroscaleSpring, float]:
    """A random spring, and the strain at which the stress first holds 0.7 to 0.98 of it snapped."""
    while True:
        k0 = 10 ** rng.uniform(5, 7)
        kc = k0 * 10 ** rng.uniform(-0.5, 1)
        sigma_plus, spread_plus = k0 * rng.uniform(0.1, 0.5), rng.uniform(0.15, 0.6)
        spring = ff.MicroscaleSpring(
            k0=k0, kc=kc, eps_star=most_beyond(k0, kc, 1.0)[0] + rng.uniform(0.02, 0.3),
            sigma_plus=sigma_plus, spread_plus=spread_plus,
            sigma_minus=sigma_plus * rng.uniform(0.3, 0.8), spread_minus=rng.uniform(0.3, 0.9),
            relaxation=[(rng.uniform(0.1, 1.0), DURATION * 10 ** rng.uniform(-2, -0.5))],
        )  # fmt: skip
        most = sigma_plus * np.exp(spread_plus * ndtri(rng.uniform(0.7, 0.98)))
        strain = float(spring.strain(most))
        if strain < 0.85:
            return spring, strain


def slow_test(case: int, seed: int) -> dict[str, Any]:
    """Fit one slow test by way of its files: a row of microscale.csv."""
    rng = np.random.default_rng([seed, case])
    spring, strain = random_spring(rng)
    clock = np.linspace(0.0, DURATION, SAMPLES)
    motion = HEIGHT * strain * (1.0 - np.abs(2.0 * clock / DURATION - 1.0))
    chain = ff.Chain([spring], [HEIGHT], 0.25 * np.pi * DIAMETER**2)
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), clock).base_stress
    stress = stress + NOISE * np.ptp(stress) * rng.standard_normal(SAMPLES)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"synthetic-{case}.csv"
        studies.write_test(path, time=clock, displacement=motion, stress=stress)
        studies.write_specimen(path.with_suffix(".toml"), "10 mm", "7.6 mm", "")
        test = ff.read_test(path)
    result = ff.fit(test, model="microscale", relaxation=1)
    problem = make_problem(test, "microscale", "displacement", None, None, False, relaxation=1)
    names = tuple(name for name in problem.free() if not name.endswith("_eta"))
    own = [getattr(spring, name.removeprefix("s1_")) for name in MODEL.names[:8]]
    truth = np.zeros(problem.vector().size)  # the zeros of the record are right
    truth[: len(MODEL.names)] = *own, *spring.relaxation[0], 0.0
    around, objective = BestPoint(problem, truth, names), problem.objective
    (curve,) = objective.counted
    level = NOISE * np.ptp(around.simulated.curves[curve]) * objective.factor(curve)
    pull, sd = linear(around, {curve: level})
    sure = dict(zip(names, (np.abs(pull @ around.residual) < 1.96 * sd).tolist(), strict=True))
    chisqr: Any = result.statistics["chisqr"]
    ratio = float(chisqr) / float(around.residual @ around.residual)
    row: dict[str, Any] = {
        "case": case, "samples": objective.n_data, "chi-square over true": ratio,
        "noise floor reached": ratio <= REACHED,
    }  # fmt: skip
    for name, value in zip(MODEL.names, truth, strict=False):
        found = result.parameters[name]
        if found.vary:
            inside = None if found.ci95 is None else found.ci95[0] <= value <= found.ci95[1]
            row |= {f"{name} state": found.state, f"{name} held": inside}
            row |= {f"{name} linear": sure.get(name)}
    return row


def coverage(table: pd.DataFrame) -> Iterator[str]:
    """Say how often intervals hold, and what a linear problem has."""
    names = [name for name in MODEL.names[:-1] if f"{name} held" in table]
    pairs = {name: table[[f"{name} held", f"{name} linear"]].dropna() for name in names}
    pairs = {name: own.astype(bool).to_numpy() for name, own in pairs.items()}
    yield "of the intervals so many hold the true value; of a linear problem with the same noise:"
    for name, own in {"all": np.concatenate(list(pairs.values())), **pairs}.items():
        held, sure = own.mean(axis=0)
        yield f"  {name}: {held:.1%} of {len(own)}; {sure:.1%}"


def picture(table: pd.DataFrame, path: Path) -> None:
    """Chi-square reached against seconds."""
    with studies.sheet(path, 5.0, 3.2) as figure:
        axes = figure.add_subplot()
        for reached, colour, label in (
            (True, studies.BLUE, "reached"), (False, studies.VERMILION, "missed"),
        ):  # fmt: skip
            own = table[table["noise floor reached"] == reached]
            label = f"noise floor {label} ({len(own)})"
            axes.plot(
                own["seconds"], own["chi-square over true"], "o", color=colour, mfc="none",
                label=label,
            )  # fmt: skip
        axes.axhline(1.0, color="0.6", linewidth=0.8)
        axes.set(xlabel="run time of the fit (s)", ylabel="χ² over χ² of the true parameters (–)")
        axes.set_title(f"{len(table)} synthetic impacts, 1 % noise")
        figure.legend(loc="outside lower center", ncols=2)


def main() -> None:
    parser = studies.arguments(__doc__, HERE, cases=100, seed=2014)
    parser.add_argument("--law", choices=("bistable", "microscale"), default="bistable")
    options = parser.parse_args()
    fit = impact if options.law == "bistable" else slow_test
    fit(0, options.seed)  # compiles
    table = pd.DataFrame([fit(case, options.seed) for case in range(1, options.cases + 1)])
    reached = int(table["noise floor reached"].sum())
    print(f"noise floor reached in {reached} of {len(table)} synthetic tests")
    if options.law == "microscale":
        studies.write_csv(table, options.out / "microscale.csv")
        print("\n".join(coverage(table)))
        return
    written = options.out / "noise_floor.csv"
    with studies.keep_unchanged(written):
        studies.write_csv(table, written)
    picture(pd.read_csv(written), options.out / "noise_floor.png")  # times as they were kept
    seconds = table["seconds"]
    print(
        f"median {seconds.median():.2f} s, slowest {seconds.max():.2f} s", studies.circumstances()
    )


if __name__ == "__main__":
    studies.run(main, HERE)
