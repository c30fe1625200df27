"""Does `--model auto` find the true structure of a test?

Method and answer: README.md. Also written: structures.csv (a row for each test).

    python experiments/ladder/ladder.py              # --page: from the table alone
    python experiments/ladder/ladder.py --tests 2 --out FOLDER
"""

import sys
from dataclasses import replace
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.data.measurement import Measurement, Specimen, Striker
from foamfit.fitting.problem import make_params

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies

HERE = Path(__file__).parent
HEIGHT, AREA, MASS, SAMPLES = 1.2e-3, 1.9635e-5, 7e-3, 401
CLEAR_MISFIT, CLEAR_DAMPING = 0.5, 0.05
# The models of linear and bistable springs, from the simplest up.
MODELS = ("bistable", "linear+bistable", "bistable+bistable", "linear+bistable+bistable")
STRUCTURES = [
    ("bistable", False), ("bistable", True), ("linear+bistable", False), ("linear+bistable", True),
    ("bistable+bistable", False),
]  # fmt: skip


def name_of(model: str, damped: bool) -> str:
    return f"{model} {'with' if damped else 'without'} damping"


def bistable(rng: np.random.Generator, sigma_a: float, late: bool) -> ff.BistableSpring:
    """Draw a spring; `late`: one that densifies late, like those of the paper's chains."""
    eps_a = rng.uniform(0.15, 0.4) if late else rng.uniform(0.05, 0.35)
    eps_c = eps_a + (rng.uniform(0.25, 0.4) if late else rng.uniform(0.1, 0.45))
    k0, drop = sigma_a * (1 - eps_a) / eps_a, rng.uniform(0.1, 0.7)
    return ff.BistableSpring(
        k0=k0, kc=k0 * 10 ** rng.uniform(0.8, 1.6), dsigma=-drop * sigma_a, eps_a=eps_a,
        eps_c=eps_c, kh_plus=k0 * rng.uniform(0.3, 3),
        kh_minus=sigma_a * (1 - drop) / eps_c * rng.uniform(0.5, 1.1),
    )  # fmt: skip


def random_chain(rng: np.random.Generator, model: str) -> tuple[list, list[float]]:
    """Draw springs and heights: a linear spring 2-8 times as stiff, or σ_a 2-4 times as high."""
    sigma_a, share = 10 ** rng.uniform(5.5, 6.5), rng.uniform(0.35, 0.65)
    heights = [HEIGHT * share, HEIGHT * (1 - share)]
    if model == "bistable":
        return [bistable(rng, sigma_a, late=False)], [HEIGHT]
    if model == "linear+bistable":
        spring = bistable(rng, sigma_a, late=True)
        return [ff.LinearSpring(spring.k0 * rng.uniform(2, 8)), spring], heights
    stiff = bistable(rng, sigma_a * rng.uniform(2, 4), late=True)
    return [bistable(rng, sigma_a, late=True), stiff], heights


def random_test(
    rng: np.random.Generator, model: str, damped: bool
) -> tuple[Measurement, Measurement, float, float, bool] | None:
    """Return a test without and with noise, the noise, the share of damping, loops closed."""
    try:
        springs, heights = random_chain(rng, model)
    except ValueError:  # inadmissible, so draw again
        return None
    loops = {i: one for i, one in enumerate(springs) if isinstance(one, ff.BistableSpring)}
    top = rng.uniform(1.2, 2.0) * max(spring.sigma_hat_c for spring in loops.values())
    history, pairs = np.linspace(0, top, 4000), zip(springs, heights, strict=True)
    works = (np.trapezoid(history, one.strain(history)) * h * AREA for one, h in pairs)
    velocity = float(np.sqrt(2 * float(sum(works)) / MASS))  # of the quasi-static work
    site = 0.0
    if damped:
        share = 10 ** rng.uniform(-1.5, -0.6)  # of the largest stress, at first contact
        eta = share * top * HEIGHT / velocity
        velocity *= np.sqrt(1 + 4 * share)  # compensates for the dashpot approximately
        if len(springs) == 1:
            springs = [replace(springs[0], eta=eta)]
        else:
            site = eta
    chain = ff.Chain(springs, heights, AREA, site_damping=site)
    drive = ff.Impact(MASS, velocity)
    long = ff.simulate(chain, drive, np.linspace(0, 20 * HEIGHT / velocity, 8001))
    end = long.contact_end or long.time[-1]
    times = np.linspace(0, 1.05 * end, SAMPLES)
    run = ff.simulate(chain, drive, times)
    if run.displacement[-1].max() >= HEIGHT:  # linear springs do not stop at a strain of 1
        return None
    entered = {(int(row[1]), int(row[3])) for row in run.switches}
    closed = all({(i, 1), (i, 2), (i, 3)} <= entered for i in loops)  # branches d, c, e
    # Dissipated power per area: η ẇ²/H, in the dashpot of one spring and in the onsite damper.
    speed = np.gradient(run.displacement[-1], times)
    rate = (site + (springs[0].eta if len(springs) == 1 else 0.0)) / HEIGHT * speed**2
    contact = times <= end
    spent = float(np.trapezoid(rate[contact], times[contact])) * AREA
    noise = rng.uniform(0.005, 0.01)
    curves = run.base_stress, run.displacement[-1]
    clean = Measurement(
        f"synthetic impact on {name_of(model, damped)}", None, "", time=times, stress=curves[0],
        displacement=curves[1], specimen=Specimen(HEIGHT, AREA), striker=Striker(MASS, velocity),
        motion="measured",
    )  # fmt: skip
    noisy = [x + noise * np.ptp(x) * rng.standard_normal(x.size) for x in curves]
    test = replace(clean, stress=noisy[0], displacement=noisy[1])
    return clean, test, noise, spent / (0.5 * MASS * velocity**2), closed


def best_simpler_misfit(clean: Measurement, model: str, damped: bool) -> float:
    """Return the least RMS misfit of the simpler models to both curves without noise."""
    ladder, least = list(product(MODELS, (False, True))), np.inf
    for name, with_ in ladder[: ladder.index((model, damped))]:
        params = make_params(clean, name)
        for key in params:
            if key.endswith("eta") and not with_:
                params[key].set(value=0.0, vary=False)
        result = ff.fit(clean, model=name, params=params)
        both = [result.misfit["stress_time"], result.misfit["displacement_time"]]
        least = min(least, float(np.sqrt(np.mean(np.square(both)))))
    return least


def climb(seed: int, kind: int, case: int) -> dict[str, Any]:
    """Draw a test of a structure and fit it; return a row of structures.csv."""
    (model, damped), rng = STRUCTURES[kind], np.random.default_rng([seed, kind, case])
    made = next(filter(None, (random_test(rng, model, damped) for _ in count())))
    clean, test, noise, dissipated, closed = made
    misfit = best_simpler_misfit(clean, model, damped)
    clear = closed and misfit >= CLEAR_MISFIT * noise
    result, seconds = studies.timed(ff.fit, test, model="auto")
    chosen, truth = result.ladder.chosen, name_of(model, damped)
    return {
        "structure": truth, "case": case,
        "clear": clear and (not damped or dissipated >= CLEAR_DAMPING), "chosen": chosen.name,
        "found": chosen.name == truth, "models tried": len(result.ladder.rungs),
        "seconds": seconds,
    }  # fmt: skip


def structure_table(table: pd.DataFrame) -> str:
    rows = []
    for name, own in table.groupby("structure", sort=False):
        parts = (own[own["clear"]], own[~own["clear"]])
        found = (f"{part['found'].sum()} of {len(part)}" for part in parts)
        seconds, tried = own["seconds"].median(), own["models tried"].median()
        rows.append([name, *found, f"{seconds:.1f}", f"{tried:.0f}"])
    head = "structure | clear: found | unclear: found | seconds (median) | models tried (median)"
    return studies.markdown(head, rows)


def main() -> None:
    numbers = {"tests": (20, "tests of each structure"), "seed": 2014}
    options = studies.arguments(__doc__, HERE, page=True, **numbers).parse_args()
    if not options.page:
        ff.fit(random_test(np.random.default_rng(0), "bistable", False)[1])  # compiles
        kinds, cases = range(len(STRUCTURES)), range(1, options.tests + 1)
        jobs = ((options.seed, kind, case) for case in cases for kind in kinds)
        table = studies.said(studies.in_order(climb, jobs, 2))
        studies.write_csv(table, options.out / "structures.csv")
    table = pd.read_csv(options.out / "structures.csv")
    clear = table[table["clear"]]
    studies.write_page(
        HERE, options.out, samples=SAMPLES, structures=structure_table(table),
        damping=100 * CLEAR_DAMPING, misfit=CLEAR_MISFIT,
        found=int(clear["found"].sum()), clear=len(clear), rate=100 * clear["found"].mean(),
    )  # fmt: skip


if __name__ == "__main__":
    main()
