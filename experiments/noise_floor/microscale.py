"""Does a fit of a microscale spring with relaxation reach the noise floor? Do its intervals hold?

Synthetic slow tests: random microscale springs with one relaxation term, compressed at a constant
rate until most of their micro-springs have snapped, and back; 600 samples, 1 % white noise on the
stress. Each goes the way of a user: a CSV and its TOML, `foamfit.read_test`, the defaults of
`foamfit.fit` with model "microscale" and relaxation 1. A fit has reached the noise floor when its
chi-square is at most 1.02 times that of the true parameters. Beside the intervals stands what the
same noise makes of a problem that is linear about the truth and whose noise is known: there each
interval holds in exactly 95 % of cases, so what that is off is the luck of the draw.

    python experiments/noise_floor/microscale.py             # 200 cases and their table
    python experiments/noise_floor/microscale.py --cases 10
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import ndtri

import foamfit as ff
from foamfit.fitting.problem import make_problem
from foamfit.springs.law import least_eps_star
from foamfit.springs.model import Model
from foamfit.trust.best_point import BestPoint

HERE = Path(__file__).parent
NOISE, SAMPLES = 0.01, 600
HEIGHT, DIAMETER = 10e-3, 7.6e-3
TOML = '[specimen]\nheight = "10 mm"\ndiameter = "7.6 mm"\n'
MODEL = Model(("microscale",), 1)


def random_spring(rng: np.random.Generator, duration: float) -> tuple[ff.MicroscaleSpring, float]:
    """A random spring, and the strain at which the stress first holds 0.7 to 0.98 of it snapped."""
    while True:
        k0 = 10 ** rng.uniform(5, 7)
        kc = k0 * 10 ** rng.uniform(-0.5, 1)
        sigma_plus, spread_plus = k0 * rng.uniform(0.1, 0.5), rng.uniform(0.15, 0.6)
        spring = ff.MicroscaleSpring(
            k0=k0,
            kc=kc,
            eps_star=least_eps_star(k0, kc) + rng.uniform(0.02, 0.3),
            sigma_plus=sigma_plus,
            spread_plus=spread_plus,
            sigma_minus=sigma_plus * rng.uniform(0.3, 0.8),
            spread_minus=rng.uniform(0.3, 0.9),
            relaxation=[(rng.uniform(0.1, 1.0), duration * 10 ** rng.uniform(-2, -0.5))],
        )
        most = sigma_plus * np.exp(spread_plus * ndtri(rng.uniform(0.7, 0.98)))
        strain = float(spring.strain(most))
        if strain < 0.85:
            return spring, strain


def random_case(rng: np.random.Generator) -> tuple[np.ndarray, pd.DataFrame]:
    """The true parameters in the order of the model, and the table of a synthetic test."""
    duration = 4.0
    spring, strain = random_spring(rng, duration)
    time = np.linspace(0.0, duration, SAMPLES)
    motion = HEIGHT * strain * (1.0 - np.abs(2.0 * time / duration - 1.0))
    chain = ff.Chain([spring], [HEIGHT], 0.25 * np.pi * DIAMETER**2)
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), time).base_stress
    stress = stress + NOISE * np.ptp(stress) * rng.standard_normal(SAMPLES)
    truth = [getattr(spring, name.removeprefix("s1_")) for name in MODEL.names[:8]]
    table = {"time (s)": time, "displacement (m)": motion, "stress (Pa)": stress}
    return np.array([*truth, *spring.relaxation[0], 0.0]), pd.DataFrame(table)


def linear(around: BestPoint) -> dict[str, bool]:
    """Whether intervals of known noise about the truth hold it, to first order in the noise."""
    objective = around.problem.objective
    (curve,) = objective.counted
    level = NOISE * np.ptp(around.simulated.curves[curve]) * objective.factor(curve)
    pull = np.linalg.pinv(around.jacobian * around.sizes)
    z = pull @ around.residual / (level * np.linalg.norm(pull, axis=1))
    return dict(zip(around.names, (np.abs(z) < 1.96).tolist(), strict=True))


def fit_case(case: int, seed: int, folder: Path) -> dict[str, object]:
    """Fit one case by way of its files; one row of the table."""
    truth, table = random_case(np.random.default_rng([seed, case]))
    path = folder / f"synthetic-{case}.csv"
    table.to_csv(path, index=False)
    path.with_suffix(".toml").write_text(TOML)
    test = ff.read_test(path)
    result = ff.fit(test, model="microscale", relaxation=1)
    problem = make_problem(test, "microscale", "displacement", None, None, False, relaxation=1)
    names = tuple(name for name in problem.free() if not name.endswith("_eta"))
    around, objective = BestPoint(problem, truth, names), problem.objective
    residual, sure = around.residual, linear(around)
    ratio = float(result.statistics["chisqr"]) / float(residual @ residual)  # type: ignore[arg-type]
    row: dict[str, object] = {
        "case": case,
        "samples": objective.n_data,
        "chi-square over true": ratio,
        "noise floor reached": ratio <= 1.02,
    }
    for name, value in zip(MODEL.names, truth, strict=True):
        found = result.parameters[name]
        if found.vary:
            inside = None if found.ci95 is None else found.ci95[0] <= value <= found.ci95[1]
            row |= {f"{name} state": found.state, f"{name} held": inside}
            row |= {f"{name} linear": sure.get(name)}
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=2014)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = [fit_case(i, options.seed, Path(folder)) for i in range(1, options.cases + 1)]
    table = pd.DataFrame(rows)
    table.to_csv(options.out / "microscale.csv", index=False, float_format="%.4g")
    reached = int(table["noise floor reached"].sum())
    print(f"noise floor reached in {reached} of {len(table)} synthetic tests")
    names = [name for name in MODEL.names[:-1] if f"{name} held" in table]
    pairs = {name: table[[f"{name} held", f"{name} linear"]].dropna() for name in names}
    pairs = {name: own.astype(bool).to_numpy() for name, own in pairs.items()}
    pairs = {"all": np.concatenate(list(pairs.values())), **pairs}
    print("of the intervals so many hold the true value; of a linear problem with the same noise:")
    for name, own in pairs.items():
        share, sure = own.mean(axis=0)
        print(f"  {name}: {share:.1%} of {len(own)}; {sure:.1%}")


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))
    from unchanged import keep_unchanged

    with keep_unchanged(HERE):
        main()
