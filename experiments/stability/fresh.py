"""Is any result of the solver wrong? Random scenes and judges that share no code with it.

Method, families of scenes and answer: README.md. One command runs them and writes a row per scene
and rtol, those of the last four families to worn.csv:

    python experiments/stability/fresh.py                 # --out writes all to another file
    python experiments/stability/fresh.py --page          # README.md of fresh.csv and worn.csv

Another checkout's solver is judged with PYTHONPATH=that/checkout/src.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

sys.path.insert(0, str(Path(__file__).parents[1]))
import foamfit as ff
import studies
from independent import LOOSE, Truth, follow, judge, over_range
from scenes import Point, designed, scene_of

HERE = Path(__file__).parent
Array = NDArray[np.float64]
Scene = tuple[ff.Chain, ff.Impact | ff.StressDrive | ff.DisplacementDrive, Array]
Spec = dict[str, Any]

SEED = 2027
RTOLS = (1e-4, 1e-6, 1e-8)
MOST = {"base": 10_000_000, "long": 20_000_000}  # limit of the judge: steps times springs
USUAL_MOST = 4_000_000
BAD, POOR = 3.0, 1.0  # error over rtol
SLOPE_BAR = 1e-3  # allowed error of a derivative over its range, for rtol up to 1e-5


# ------------------------------------------------------------------------------------- the scenes


def log(rng: Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def bistable(rng: Generator, k0: float, eta: float = 0.0) -> Spec:
    """Draw a bistable spring with a given initial slope."""
    eps_a = log(rng, 0.02, 0.5)
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    return {
        "k0": k0,
        "kc": k0 * log(rng, 2.0, 100.0),
        "dsigma": -sigma_a * rng.uniform(0.0, 0.95),
        "eps_a": eps_a,
        "eps_c": eps_a + (0.9 - eps_a) * rng.uniform(0.1, 0.9),
        "kh_plus": k0 * log(rng, 0.1, 30.0),
        "kh_minus": k0 * log(rng, 0.05, 5.0),
        "eta": eta,
    }


def foam(rng: Generator, k0: float, eta: float = 0.0) -> Spec:
    """Draw a bistable spring near a published one, with another initial slope."""
    names = list(ff.published)
    item = ff.published[names[int(rng.integers(len(names)))]].bistable
    near = {
        key: value * rng.uniform(0.93, 1.07) * (1.0 if key.startswith("eps") else k0 / item.k0)
        for key, value in asdict(item).items()
        if key != "relaxation"
    }
    sigma_a = near["k0"] * near["eps_a"] / (1.0 - near["eps_a"])
    near["dsigma"] = item.dsigma / item.sigma_a * sigma_a * rng.uniform(0.93, 1.07)
    return near | {"eta": eta}


def linear(rng: Generator, k0: float, eta: float = 0.0, unilateral: bool | None = None) -> Spec:
    """Draw a linear spring in series with bistable ones of a given initial slope."""
    one_sided = bool(rng.random() < 0.5) if unilateral is None else unilateral
    return {"k0": k0 * log(rng, 1.0, 50.0), "eta": eta, "unilateral": one_sided}


def chain_of(
    rng: Generator, springs: list[Spec], height: float, masses: list[float], site: float = 0.0
) -> Spec:
    """Return a chain with different heights."""
    share = rng.uniform(0.5, 1.5, len(springs))
    return {
        "springs": springs,
        "heights": list(height * share / share.sum()),
        "area": log(rng, 5e-6, 5e-5),
        "masses": masses,
        "site": site,
    }


def bounce(spec: Spec, mass: float) -> float:
    """Return roughly half a period of a mass on a chain at rest."""
    soft = sum(h / s["k0"] for s, h in zip(spec["springs"], spec["heights"], strict=True))
    return math.pi * math.sqrt(mass * soft / spec["area"])


def struck(rng: Generator, spec: Spec, low: float, high: float) -> None:
    """Add a striker with a fraction (low to high) of the energy of the first branches."""
    mass = log(rng, 1e-3, 2e-2)
    k0 = min(s["k0"] for s in spec["springs"])
    energy = 0.05 * k0 * log(rng, low, high) * spec["area"] * sum(spec["heights"])
    spec["impact"] = [mass, math.sqrt(2.0 * energy / mass)]


def study(number: int) -> Spec:
    return {"point": asdict(_designed()[number])}


@cache
def _designed() -> list[Point]:
    # limits for brute force: no very long chains and histories
    return [
        replace(p, springs=min(p.springs, 12), samples=min(p.samples, 2001))
        for p in designed(1000, SEED)
    ]


def base(rng: Generator, number: int) -> Spec:
    """Draw an impact with a base dashpot: half published foam-2, half random springs."""
    if number % 2 == 0:
        item = ff.published["foam-2"]
        springs = [asdict(s) for s in item.chain.springs]
        springs[0]["eta"] = log(rng, 3e2, 1e6)
        spec: Spec = {
            "springs": springs,
            "heights": list(item.chain.heights),
            "area": item.chain.area,
            "masses": [log(rng, 1e-6, 2e-3), 0.0],
            "site": item.chain.site_damping if rng.random() < 0.3 else 0.0,
            "impact": [item.striker_mass, 4.44],
        }
        return spec | {"stop": log(rng, 1e-5, 1.5e-3), "samples": 301}
    k0 = log(rng, 1e5, 3e7)
    count = 2 if rng.random() < 0.7 else 3
    springs = [bistable(rng, k0 * log(rng, 0.5, 2.0)) for _ in range(count)]
    if rng.random() < 0.7:
        springs[0] = linear(rng, k0)
    masses = [log(rng, 1e-7, 5e-3) for _ in range(count - 1)] + [0.0]
    if count == 3 and rng.random() < 0.3:
        masses[int(rng.integers(2))] = 0.0
    spec = chain_of(rng, springs, log(rng, 2e-4, 5e-3), masses)
    if rng.random() < 0.2:
        spec["site"] = log(rng, 1.0, 1e5)
    spec["impact"] = [log(rng, 1e-3, 2e-2), log(rng, 0.1, 30.0)]
    whole = bounce(spec, spec["impact"][0])
    for i in range(count):  # from damping that stops the mass above within contact to hardly any
        if i == 0 or rng.random() < 0.3:
            springs[i]["eta"] = springs[i]["k0"] * whole * log(rng, 1e-4, 1e3)
    return spec | {"stop": log(rng, min(1e-7, 0.1 * whole), 2.0 * whole), "samples": 201}


def path(rng: Generator, top: float, turns: int) -> tuple[list[float], list[float]]:
    """Return a history from rest with random turning points and times."""
    levels = [0.0]
    for turn in range(turns):
        up = turn % 2 == 0
        last = levels[-1]
        levels.append(rng.uniform(last, top) if up else rng.uniform(-0.02 * top, last))
    return list(np.cumsum(rng.uniform(0.2, 1.0, turns + 1))), levels


def gap(rng: Generator, number: int) -> Spec:
    """Draw a unilateral spring at the base, inside or on top that is pulled or thrown open."""
    k0 = log(rng, 5e5, 3e7)
    count = int(rng.integers(2, 4))
    springs = [bistable(rng, k0) for _ in range(count)]
    at = int(rng.integers(count))
    springs[at] = linear(rng, k0, unilateral=True)
    inertia = rng.random() < 0.5 or number % 3 == 0
    masses = [log(rng, 1e-6, 5e-3) if inertia else 0.0 for _ in range(count - 1)] + [0.0]
    spec = chain_of(rng, springs, log(rng, 3e-4, 3e-3), masses)
    names = []
    for i, spring in enumerate(springs, start=1):
        own = ["k0", "height"] if "unilateral" in spring else ["k0", "kc", "eps_a", "kh_plus"]
        names.append(f"s{i}_{rng.choice(own)}")
    spec["sensitivities"] = names
    if number % 3 == 0:
        struck(rng, spec, 0.05, 3.0)
        whole = bounce(spec, spec["impact"][0])
        spec["stop"] = whole * log(rng, 0.3, 2.0)
    else:
        whole = bounce(spec, max(1e-4, *masses)) * log(rng, 3.0, 100.0)
        at_times, levels = path(rng, 0.75 * sum(spec["heights"]), int(rng.integers(2, 5)))
        levels.append(-0.01 * sum(spec["heights"]) * rng.random())  # pulled open at the end
        at_times.append(at_times[-1] + rng.uniform(0.2, 1.0))
        spec["displacement"] = [at_times, levels]
        spec["stop"] = whole
    if rng.random() < 0.4:
        for spring in springs:
            spring["eta"] = spring["k0"] * whole * log(rng, 1e-4, 1e-1)
    return spec | {"samples": 151}


def turns(rng: Generator, number: int) -> Spec:
    """Draw histories of displacement or stress with arbitrary turning points."""
    k0 = log(rng, 3e5, 3e7)
    count = int(rng.integers(1, 4))
    springs = [
        linear(rng, k0) if rng.random() < 0.25 and count > 1 else bistable(rng, k0)
        for _ in range(count)
    ]
    inertia, damped = rng.random() < 0.5, rng.random() < 0.6
    masses = [log(rng, 1e-7, 1e-2) if inertia else 0.0 for _ in range(count)]
    stressed = number % 2 == 1
    if not stressed or rng.random() < 0.5:
        masses[-1] = 0.0
    spec = chain_of(rng, springs, log(rng, 2e-4, 5e-3), masses)
    stop = log(rng, 1e-5, 1e-1)
    if inertia:
        stop = bounce(spec, max(masses) + 1e-9) * log(rng, 1.0, 100.0)
    if damped:
        for spring in springs:
            if rng.random() < 0.7:
                spring["eta"] = spring["k0"] * stop * log(rng, 1e-4, 10.0)
    if rng.random() < 0.3:
        spec["site"] = k0 * stop * log(rng, 1e-4, 1.0)
    number_of_turns = int(rng.integers(1, 9))
    if stressed:
        spec["stress"] = list(path(rng, k0 * log(rng, 0.1, 3.0), number_of_turns))
        spec["stress"][1] = [max(level, 0.0) for level in spec["stress"][1]]
    else:
        spec["displacement"] = list(path(rng, 0.8 * sum(spec["heights"]), number_of_turns))
    return spec | {"stop": stop, "samples": int(rng.choice([21, 101, 501]))}


def long(rng: Generator, number: int) -> Spec:
    """Draw three to ten springs with a light or heavy mass on each; most without dashpot."""
    k0 = log(rng, 5e5, 3e7)
    count = int(rng.integers(3, 11))
    draw = foam if rng.random() < 0.5 else bistable
    springs = [
        linear(rng, k0) if rng.random() < 0.2 else draw(rng, k0 * log(rng, 0.7, 1.5))
        for _ in range(count)
    ]
    spec = chain_of(rng, springs, log(rng, 5e-4, 1e-2), [0.0] * count)
    kind = number % 4
    if kind < 2:
        struck(rng, spec, 0.1, 6.0)
        whole = bounce(spec, spec["impact"][0])
        spec["stop"] = whole * log(rng, 0.2, 1.5)
    else:
        whole = spec["stop"] = log(rng, 1e-4, 1e-1)
        way = path(rng, 0.7 * sum(spec["heights"]), int(rng.integers(1, 5)))
        if kind == 2:
            spec["displacement"] = list(way)
        else:
            spec["stress"] = [way[0], [k0 * log(rng, 0.1, 1.0) * max(x, 0.0)
                                       / (0.7 * sum(spec["heights"])) for x in way[1]]]  # fmt: skip
    # masses whose vibration covers this many radians
    radians = log(rng, 30.0, 3e5)
    stiff = 4.0 * k0 * spec["area"] * count / sum(spec["heights"])
    heavy = min(stiff * (spec["stop"] / radians) ** 2, 3e-3)
    masses = [heavy * log(rng, 0.5, 2.0) for _ in range(count)]
    spec["masses"] = masses if kind == 3 else [*masses[:-1], 0.0]
    few = rng.random()
    for i, spring in enumerate(springs):
        if few < 0.25 or (few < 0.5 and i == int(few * 1000) % count):
            spring["eta"] = spring["k0"] * whole * log(rng, 1e-6, 1e-2)
    return spec | {"samples": 151}


# ------------------------------------------------------------------------- springs with memory

MICROSCALE = ("k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus")

WORN = ("stiffening", "softening", "weakening")


def microscale(rng: Generator, k0: float) -> Spec:
    """Draw a microscale spring: narrow and wide spreads, with and without a loop."""
    kc = k0 * log(rng, 0.05, 100.0)
    least = max(0.0, (math.sqrt(kc) - math.sqrt(k0)) / (math.sqrt(kc) + math.sqrt(k0)))
    wide = [log(rng, 1e-3, 2.0) if rng.random() < 0.3 else log(rng, 0.05, 1.0) for _ in range(2)]
    if rng.random() < 0.15:
        wide[1] = wide[0]
    sigma_plus = k0 * log(rng, 0.02, 2.0)
    return {
        "k0": k0,
        "kc": kc,
        "eps_star": least * (1.0 + 1e-12) + (0.0 if rng.random() < 0.1 else rng.uniform(0.0, 0.6)),
        "sigma_plus": sigma_plus,
        "spread_plus": wide[0],
        "sigma_minus": sigma_plus * log(rng, 0.02, 1.5),
        "spread_minus": wide[1],
    }


def worn(rng: Generator, k0: float) -> Spec:
    """Draw a microscale spring that remembers what has snapped; one in five is extreme."""
    spec, (n, d, s) = microscale(rng, k0), ((0.02, 50.0), 6.0, 6.0)
    if rng.random() < 0.8:
        (n, d, s) = (0.3, 4.0), 2.0, 1.0
    spec["stiffening"] = 1.0 if rng.random() < 0.1 else log(rng, *n)
    spec["softening"] = 0.0 if rng.random() < 0.15 else rng.uniform(0.0, d)
    spec["weakening"] = 0.0 if rng.random() < 0.15 else rng.uniform(0.0, s)
    k, kc, n = k0 * math.exp(-spec["softening"]), spec["kc"], spec["stiffening"]

    def excess(log_s: float) -> float:  # strain of branch a minus that of branch c
        return -math.expm1(-math.log1p(n * math.exp(log_s)) / n) - 1.0 / (
            1.0 + kc / k / math.exp(log_s)
        )

    grid = np.linspace(-20.0, 60.0, 801)
    top = grid[np.argmax([excess(x) for x in grid])]
    best = minimize_scalar(lambda x: -excess(x), bounds=(top - 0.1, top + 0.1), method="bounded")
    least = max(0.0, -best.fun) * (1.0 + 1e-9) + 1e-12
    spec["eps_star"] = least + (0.0 if rng.random() < 0.1 else rng.uniform(0.0, 0.6))
    return spec


def terms(rng: Generator, stop: float) -> list[list[float]]:
    """Draw one to three relaxation terms; one in ten has zero strength."""
    return [
        [0.0 if rng.random() < 0.1 else log(rng, 1e-3, 5.0), stop * log(rng, 1e-4, 1e3)]
        for _ in range(int(rng.integers(1, 4)))
    ]


def room(spring: Spec) -> float:
    """Return the largest possible compressive strain of a spring, or 1."""
    return 1.0 + spring.get("eps_star", 0.0)


def remembering(
    rng: Generator, number: int, springs: list[Spec], relaxing: list[bool], heavy: float = 0.3
) -> Spec:
    """Put springs with memory into a chain, and load it by impact, stress or displacement."""
    k0, count = min(s["k0"] for s in springs), len(springs)
    inertia = count > 1 and rng.random() < heavy
    masses = [log(rng, 1e-6, 5e-3) if inertia else 0.0 for _ in range(count - 1)] + [0.0]
    spec = chain_of(rng, springs, log(rng, 3e-4, 2e-2), masses)
    drive = ("impact", "stress", "displacement")[number % 3]
    stop = log(rng, 1e-4, 10.0)
    if drive == "stress" and rng.random() < 0.3:
        masses[-1] = log(rng, 1e-6, 5e-2)
    if drive == "impact":
        struck(rng, spec, 0.02, 10.0)
        stop = bounce(spec, spec["impact"][0]) * log(rng, 0.3, 4.0)
    elif max(masses) > 0.0:
        stop = bounce(spec, max(masses)) * log(rng, 1.0, 100.0)
    if drive != "impact":
        kind = rng.random()
        most = sum(h * room(s) for s, h in zip(springs, spec["heights"], strict=True))
        if kind < 0.15:
            top = log(rng, 1e-3, 0.1)  # hardly anything snaps
        elif kind < 0.25 and drive == "displacement":
            top = 1.0 - log(rng, 1e-3, 0.1)  # near the pole
        else:
            top = rng.uniform(0.2, 0.75)
        at, levels = path(rng, top, int(rng.integers(1, 10)))
        scale = most if drive == "displacement" else k0 * log(rng, 0.3, 10.0)
        floor = -math.inf if drive == "displacement" and rng.random() < 0.5 else 0.0
        spec[drive] = [at, [scale * max(level, floor) for level in levels]]
    if rng.random() < 0.4:
        for spring in springs:
            if rng.random() < 0.7:
                spring["eta"] = spring["k0"] * stop * log(rng, 1e-5, 10.0)
    if rng.random() < 0.2:
        spec["site"] = k0 * stop * log(rng, 1e-4, 1.0)
    for spring, relaxes in zip(springs, relaxing, strict=True):
        if relaxes:
            spring["relaxation"] = terms(rng, stop)
    if number % 10 < 3 and number // 10 % 3 == number % 10:  # a tenth, of every drive
        names = []
        for i, spring in enumerate(springs, start=1):
            own = ["k0", "height"]
            if "sigma_plus" in spring:
                own += [*MICROSCALE, *(name for name in WORN if spring.get(name))]
            elif "kc" in spring:
                own += ["kc", "eps_a", "eps_c", "kh_plus", "kh_minus"]
            names.append(f"s{i}_{rng.choice(own)}")
            for k, (g, _) in enumerate(spring.get("relaxation", []), start=1):
                if g > 0.0:
                    names += [f"s{i}_g{k}", f"s{i}_tau{k}"]
        spec["sensitivities"] = list(dict.fromkeys(names))
    return spec | {"stop": stop, "samples": int(rng.choice([21, 101, 501]))}


def alike(draw: Callable[[Generator, float], Spec], relaxes: bool) -> Callable[..., Spec]:
    """Draw one to three springs of a kind; bistable ones have initial slopes near k0."""

    def family(rng: Generator, number: int) -> Spec:
        k0 = log(rng, 1e5, 3e7)
        count = int(rng.choice([1, 1, 2, 3]))
        kind = draw if draw is not bistable or rng.random() >= 0.5 else foam
        springs = [kind(rng, k0 * log(rng, 0.5, 2.0)) for _ in range(count)]
        return remembering(rng, number, springs, [relaxes] * count)

    return family


def mixed(
    rng: Generator, number: int, draw: Callable[[Generator, float], Spec] = microscale,
    heavy: float = 0.3,
) -> Spec:  # fmt: skip
    """Draw springs of all kinds; at least one has memory."""
    k0 = log(rng, 1e5, 3e7)
    count = int(rng.integers(2, 6))
    at = int(rng.integers(count))
    springs, relaxing = [], []
    for i in range(count):
        kind, relaxes = rng.random(), bool(rng.random() < 0.5)
        if i == at or kind < 0.4:
            springs.append(draw(rng, k0 * log(rng, 0.5, 2.0)))
        elif kind < 0.7:
            springs.append(bistable(rng, k0 * log(rng, 0.5, 2.0)))
        else:
            springs.append(linear(rng, k0, unilateral=bool(rng.random() < 0.2)))
            relaxes = False
        relaxing.append(relaxes)
    return remembering(rng, number, springs, relaxing, heavy)


def known_motion(
    rng: Generator, number: int, draw: Callable[[Generator, float], Spec] = microscale
) -> Spec:
    """Draw springs in series, some identical, under a motion with arbitrary sample times.

    A third starts at 0, a third at another time, a third at 1.7e9 s with smallest steps of 1 µs.
    """
    k0, count = log(rng, 1e5, 3e7), int(rng.integers(2, 5))
    springs = []
    for i in range(count):
        stiff, kind = k0 * log(rng, 0.5, 2.0), rng.random()
        if i == 0 or kind < 0.5:
            springs.append(draw(rng, stiff))
            for spread in ("spread_plus", "spread_minus"):
                springs[-1][spread] = log(rng, 1e-6, 5.0)
        elif kind < 0.75:
            springs.append(bistable(rng, stiff))
        else:
            springs.append(linear(rng, stiff, unilateral=False))
    if rng.random() < 0.15:
        springs[-1] = dict(springs[0])
    spec = chain_of(rng, springs, log(rng, 3e-4, 2e-2), [0.0] * count)
    most = sum(h * room(s) for s, h in zip(springs, spec["heights"], strict=True))
    samples = int(rng.choice([11, 31, 61]))
    ratio = 10.0 ** float(rng.choice([0.0, 2.0, 5.0, 8.0]))
    steps = ratio ** rng.random(samples - 1)
    at, levels = path(rng, rng.uniform(0.1, 0.75), int(rng.integers(1, 8)))
    floor = -math.inf if rng.random() < 0.3 else 0.0
    if number % 5 == 2:  # with a hold
        at.append(at[-1] + 0.5)
        levels.insert(len(levels) // 2, levels[len(levels) // 2])
    spec["displacement"] = [at, [most * max(level, floor) for level in levels]]
    spec["origin"] = (0.0, -log(rng, 1.0, 1e4), 1.7e9)[number % 3]
    least = 1e-6 if number % 3 == 2 else log(rng, 1e-7, 1e-2)
    spec["steps"] = [float(step) for step in steps * least / steps.min()]
    if number % 10 == 0:
        spec["sensitivities"] = [
            f"s{i}_{rng.choice(MICROSCALE if 'sigma_plus' in s else ('k0', 'height'))}"
            for i, s in enumerate(springs, start=1)
        ]
    return spec | {"stop": sum(spec["steps"]), "samples": samples, "judge": "roots"}


def relaxing_motion(
    rng: Generator, number: int, draw: Callable[[Generator, float], Spec] = microscale
) -> Spec:
    """Add relaxation, and to some a dashpot, to the springs of `known_motion`."""
    spec = known_motion(rng, number, draw)
    for key in ("sensitivities", "judge"):
        spec.pop(key, None)
    relaxes = rng.random() < 0.7
    for i, spring in enumerate(spec["springs"]):
        if relaxes and "kc" in spring and (i == 0 or rng.random() < 0.5):
            spring["relaxation"] = [[log(rng, 1e-3, 5.0), spec["stop"] * log(rng, 1e-3, 1e3)]]
        if not relaxes or rng.random() < 0.2:
            spring["eta"] = spring["k0"] * spec["stop"] * log(rng, 1e-3, 10.0)
    return spec


def worn_motion(rng: Generator, number: int) -> Spec:
    return (relaxing_motion if number % 2 else known_motion)(rng, number, worn)


DRAWN: dict[str, Callable[[Generator, int], Spec]] = {
    "base": base, "gap": gap, "turns": turns, "long": long,
    "microscale": alike(microscale, False), "relaxation": alike(bistable, True),
    "microscale+relaxation": alike(microscale, True), "mixed": mixed,
    "motion": known_motion, "motion+relaxation": relaxing_motion,
    "worn": alike(worn, False), "worn+relaxation": alike(worn, True),
    "worn chain": partial(mixed, draw=worn, heavy=0.7), "worn motion": worn_motion,
}  # fmt: skip
FAMILIES = ("study", *DRAWN)
MEMORY, REMEMBERING = FAMILIES[5:11], FAMILIES[11:]


def spec_of(family: str, number: int) -> Spec:
    """Draw the specification of a scene."""
    if family == "study":
        return study(number)
    rng = np.random.default_rng([SEED, FAMILIES.index(family), number])
    return DRAWN[family](rng, number)


def scene_from(spec: Spec) -> Scene:
    """Return chain, drive and samples."""
    if "point" in spec:
        return scene_of(Point(**spec["point"]))
    springs = [
        (ff.MicroscaleSpring if "sigma_plus" in s else
         ff.BistableSpring if "kc" in s else ff.LinearSpring)(**s)
        for s in spec["springs"]
    ]  # fmt: skip
    chain = ff.Chain(springs, spec["heights"], spec["area"], spec["masses"], spec["site"])
    grid = np.linspace(0.0, spec["stop"], spec["samples"])
    if "impact" in spec:
        return chain, ff.Impact(*spec["impact"]), grid
    drive = "stress" if "stress" in spec else "displacement"
    at, levels = np.array(spec[drive][0]), np.array(spec[drive][1])
    if "steps" in spec:
        grid = spec["origin"] + np.append(0.0, np.cumsum(spec["steps"]))
        way = np.linspace(at[0], at[-1], grid.size)
        return chain, ff.DisplacementDrive(np.interp(way, at, levels)), grid
    values = np.interp(grid, spec["stop"] * (at - at[0]) / (at[-1] - at[0]), levels)
    return chain, (ff.StressDrive if drive == "stress" else ff.DisplacementDrive)(values), grid


def follower(scene: Scene, spec: Spec) -> Callable[[Any, Any, Array, float, int], Truth]:
    """Return the judge of a scene."""
    if spec.get("judge") == "roots":
        import roots  # only this judge needs mpmath

        return roots.follow
    if isinstance(scene[1], ff.Impact):
        return follow
    return lambda chain, drive, time, *bounds: follow(chain, drive, time - time[0], *bounds)


# ------------------------------------------------------------------------------- the derivatives


def moved(spec: Spec, name: str, factor: float) -> tuple[Spec, float]:
    """Multiply a parameter; return the scene and the original value."""
    other: Spec = json.loads(json.dumps(spec))
    prefix, _, short = name.partition("_")
    i = int(prefix[1:]) - 1
    place = other["heights"] if short == "height" else other["springs"][i]
    key: Any = i if short == "height" else short
    if short[:-1] in ("g", "tau"):
        place, key = place["relaxation"][int(short[-1]) - 1], int(short.startswith("tau"))
    value = float(place[key])
    place[key] = value * factor
    return other, value


STEPS = (1e-4, 1e-5)  # of the finite differences, relative to the parameter
LEAST_SLOPE = 1e-3  # smallest range of a judged derivative, over curve range per parameter


def slopes_of(spec: Spec, name: str, most: int) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Return derivatives of base stress and displacements by differences of judge runs.

    The shape is (curves, n_t). Also return the range of each and the valid samples: not those
    between two ends of contact, or where two step lengths disagree. Return None if there is no
    judgement.
    """
    found, ends = [], []
    span = np.zeros(0)
    for step in STEPS:
        sides = []
        for sign in (1.0, -1.0):
            other, value = moved(spec, name, 1.0 + sign * step)
            try:
                scene = scene_from(other)
            except ValueError:  # the scene is at the limit of admissible parameters
                return None
            truth = follower(scene, spec)(*scene, LOOSE, most)
            if truth.why:
                return None
            sides.append(np.vstack((truth.base_stress, truth.displacement)))
            ends.append(math.nan if truth.contact_end is None else truth.contact_end)
        found.append((sides[0] - sides[1]) / (2.0 * step * value))
        reach = np.abs(sides[0]).max(axis=1) * LEAST_SLOPE / value
        span = np.maximum(np.abs(found[-1]).max(axis=1), reach)
        span[1:] = span[1:].max()  # displacements share one range
    grid = scene_from(spec)[2]
    counts = np.ones(grid.size, bool)
    if not np.isnan(ends).all():
        counts = (grid < np.nanmin(ends)) | (grid > np.nanmax(ends))
    span = np.where(span > 0.0, span, 1.0)
    counts &= (np.abs(found[0] - found[1]) <= 0.1 * SLOPE_BAR * span[:, None]).all(axis=0)
    return found[1], span, counts


def slope_bar(rtol: float) -> float:
    """Return the error of a derivative over its range beyond which it is wrong."""
    return max(SLOPE_BAR, 100.0 * rtol)


def slope_error(spec: Spec, scene: Scene, rtol: float, most: int, known: dict[str, Any]) -> float:
    """Return the largest error of the solver's derivatives over their range; NaN if unjudged."""
    names = spec.get("sensitivities", [])
    if not names:
        return math.nan
    answer = ff.simulate(*scene, rtol=rtol, sensitivities=names)
    worst = math.nan
    for name in names:
        if name not in known:
            known[name] = slopes_of(spec, name, most)
        if known[name] is None or known[name][2].sum() < 0.5 * scene[2].size:
            continue
        want, span, counts = known[name]
        got = answer.sensitivities[name]
        mine = np.vstack((got.base_stress, got.displacement))
        miss = np.abs(mine - want)[:, counts].max(axis=1) / span
        worst = np.nanmax([worst, miss.max() if np.isfinite(miss).all() else math.inf])
    return float(worst)


# ----------------------------------------------------------------------------------- the judgement


SIDES = "plus", "minus"
OF_STRESSES = 1e-14  # rounding error of the logarithm of a stress after a few switches
REASONS = {
    "step underflow": "shrank to nothing",
    "vibration": "masses vibrate too fast",
    "errors grow": "amplify the smallest error",
    "end of a branch": "of the end of its branch",
    "not finite": "no longer finite",
    "flat branch under stress": "flat branch",
    "bound on steps": "the bound of",
}


def lines_of(
    task: tuple[str, int, tuple[float, ...]], most: int | None = None
) -> list[dict[str, Any]]:
    """Solve and judge a scene at each rtol; `most` limits the judge's steps times springs."""
    family, number, rtols = task
    spec, most = spec_of(family, number), most or MOST.get(family, USUAL_MOST)
    scene = scene_from(spec)
    began = time.perf_counter()
    truth = judge(*scene, most, follower(scene, spec))
    took = time.perf_counter() - began
    known: dict[str, Any] = {}
    lines = [
        {
            "scene": f"{family}:{number}", "family": family, "rtol": rtol,
            **judged(spec, scene, truth, rtol, most, known), "judge_seconds": round(took, 3),
        }
        for rtol in rtols
    ]  # fmt: skip
    for line in lines:  # the others can be redrawn from name and seed
        kept = line["outcome"] != "answer" or line["error"] > POOR
        line["parameters"] = json.dumps(spec) if kept else ""
    return lines


def finest_of(spec: Spec) -> float:
    """Return the smallest strain error that brute force with rounded stresses can resolve."""
    springs = spec.get("springs", [])
    spreads = [spring.get(f"spread_{side}", 1.0) for spring in springs for side in SIDES]
    return OF_STRESSES / min(spreads, default=1.0)


def judged(
    spec: Spec, scene: Scene, truth: Truth, rtol: float, most: int, known: dict[str, Any]
) -> dict[str, Any]:
    """Compare the solver's result for a scene with the true solution: errors over rtol."""
    finest = 0.0 if spec.get("judge") == "roots" else finest_of(spec)
    sure = not truth.why and max(truth.unsure, finest) <= 0.1 * rtol
    found: dict[str, Any] = {
        "judge": truth.why or ("judged" if sure else "chaotic"), "unsure": truth.unsure,
        "dip": truth.dip, "judge_steps": truth.steps, "switches": truth.switches,
        "true_end": truth.contact_end, "outcome": "answer", "reason": "", "method": "",
        "displacement": math.nan, "base_stress": math.nan, "error": math.nan, "end": math.nan,
        "slope": math.nan, "seconds": math.nan, "steps": 0,
    }  # fmt: skip
    began = time.perf_counter()
    try:
        answer = ff.simulate(*scene, rtol=rtol)
    except ff.SimulationError as refusal:
        found["seconds"] = time.perf_counter() - began
        found["reason"] = reason_of(refusal)
        found["outcome"] = "refused"
        return found
    except Exception as wrong:  # reported; a run of hundreds of scenes continues
        return found | {"outcome": "failure", "reason": f"{type(wrong).__name__}: {wrong}"[:200]}
    found["seconds"] = time.perf_counter() - began
    found |= {"method": answer.method, "steps": answer.steps}
    if not sure:
        return found
    found["displacement"] = over_range(answer.displacement, truth.displacement) / rtol
    found["base_stress"] = over_range(answer.base_stress, truth.base_stress) / rtol
    found["error"] = max(found["displacement"], found["base_stress"])
    ends = (answer.contact_end, truth.contact_end)
    if None in ends:
        found["end"] = 0.0 if ends[0] is ends[1] else math.inf
    else:
        found["end"] = abs(ends[0] / ends[1] - 1.0)  # type: ignore[operator]
    try:
        found["slope"] = slope_error(spec, scene, rtol, most, known)
    except ff.SimulationError:
        found["reason"] = "derivatives refused"
    if not found["error"] <= BAD:
        found["outcome"] = "failure"
    elif found["slope"] > slope_bar(rtol):
        found["outcome"] = "wrong derivative"
    return found


def reason_of(refusal: ff.SimulationError) -> str:
    """Return a keyword for the reason of a refusal."""
    return next((key for key, part in REASONS.items() if part in str(refusal)), "other")


def summary(lines: pd.DataFrame) -> pd.DataFrame:
    """Return counts per family and rtol."""
    rows = []
    for (family, rtol), group in lines.groupby(["family", "rtol"], sort=False):
        known = group[group.judge == "judged"]
        steady = group[group.judge.isin(["judged", "chaotic"])]
        refused = known[known.outcome == "refused"]
        rows.append({
            "family": family, "rtol": rtol, "scenes": len(group), "judged": len(known),
            "chaotic": len(steady) - len(known), "beyond the judge": len(group) - len(steady),
            "answers": int((known.outcome != "refused").sum()),
            "refused": len(refused),
            "reasons": ", ".join(f"{k} {n}" for k, n in refused.reason.value_counts().items()),
            "over 1 rtol": int((known.error > POOR).sum()),
            "over 3 rtol": int((known.error > BAD).sum()),
            "largest / rtol": known.error.max(),
            "derivatives": int(known.slope.notna().sum()),
            "refused derivatives": int((known.reason == "derivatives refused").sum()),
            "wrong derivatives": int((known.slope > slope_bar(rtol)).sum()),
            "longest s": group.seconds.max(),
        })  # fmt: skip
    return pd.DataFrame(rows)


def wrong(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the scenes with wrong results."""
    return lines[(lines.error > POOR) | (lines.slope > np.maximum(SLOPE_BAR, 100.0 * lines.rtol))]


# ---------------------------------------------------------------------------------------- the page


def store(lines: pd.DataFrame, out: Path | None) -> None:
    """Write the rows to a file, or to fresh.csv and worn.csv."""
    worn = lines.family.isin(REMEMBERING)
    parts = {HERE / "fresh.csv": lines[~worn], HERE / "worn.csv": lines[worn]}
    for path, part in ({out: lines} if out else parts).items():
        if len(part):
            part.to_csv(path, index=False, float_format="%.6g")


def write_page() -> None:
    """Write README.md from the stored scenes."""
    lines = pd.concat([pd.read_csv(HERE / name) for name in ("fresh.csv", "worn.csv")])
    lines["reason"] = lines.reason.fillna("")
    table, plain = summary(lines), set(FAMILIES) - {*MEMORY, *REMEMBERING}
    tables = {
        name: studies.shown(table[table.family.isin(families)], 2)
        for name, families in (("fresh", plain), ("memory", MEMORY), ("worn", REMEMBERING))
    }
    worn = lines[lines.family.isin(REMEMBERING)]
    studies.write_page(
        HERE, **tables, fresh_scenes=lines.scene.nunique(), fresh_seed=SEED,
        fresh_judged=lines[lines.judge == "judged"].scene.nunique(),
        worn_scenes=worn.scene.nunique(),
        fresh_each=int(lines.groupby("family").scene.nunique().max()),
    )  # fmt: skip


# ------------------------------------------------------------------------------------ the command


def compile_all(families: tuple[str, ...]) -> None:
    """Run a few scenes of each family, so that no timed scene compiles."""
    for family in families:
        for number in range(6):
            scene = scene_from(spec_of(family, number))
            with contextlib.suppress(ff.SimulationError):
                ff.simulate(*scene)


def main() -> None:
    """Run the command line."""
    warnings.simplefilter("ignore")
    ask = studies.arguments(
        __doc__, scenes=(134, "per family"), first=(0, "number of the first scene")
    )
    ask.add_argument("--family", action="append", choices=FAMILIES)
    ask.add_argument("--rtol", type=float, action="append")
    ask.add_argument("--out", type=Path, help="instead of fresh.csv and worn.csv")
    ask.add_argument("--processes", type=int, default=2, choices=(1, 2))
    ask.add_argument(
        "--page", action="store_true", help="write README.md of fresh.csv and worn.csv"
    )
    given = ask.parse_args()
    rtols = tuple(given.rtol or RTOLS)
    if given.page:
        write_page()
        return
    numbers = range(given.first, given.first + given.scenes)
    tasks = [(f, n, rtols) for f in given.family or FAMILIES for n in numbers]
    lines: list[dict[str, Any]] = []
    compile_all(tuple(dict.fromkeys(family for family, *_ in tasks)))
    for found in studies.in_order(lines_of, [(task,) for task in tasks], given.processes):
        lines += found
        if len(lines) % (50 * len(rtols)) == 0:
            print(f"{len(lines) // len(rtols)} scenes", file=sys.stderr, flush=True)
            store(pd.DataFrame(lines), given.out)
    table = pd.DataFrame(lines)
    store(table, given.out)
    with pd.option_context("display.width", 250, "display.max_columns", 30):
        print(summary(table).to_string(index=False))
        columns = ["scene", "rtol", "error", "slope", "end", "method", "steps", "dip", "switches"]
        print(wrong(table)[columns].to_string(index=False))


if __name__ == "__main__":
    main()
