"""The fifteen families of random scenes of the stability study.

A scene is drawn as a specification, a dictionary that JSON can hold, from the seed, its family and
its number. README.md describes the families.
"""

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial

import numpy as np
from numpy.random import Generator
from scipy.optimize import minimize_scalar

import foamfit as ff
from scenes import Spec, designed
from studies import MICROSCALE

SEED = 2027

# ------------------------------------------------------------------ bistable and linear springs


def log(rng: Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def bistable(rng: Generator, k0: float, eta: float = 0.0) -> Spec:
    """Draw a bistable spring with a given initial slope."""
    eps_a = log(rng, 0.02, 0.5)
    sigma_a = k0 * eps_a / (1.0 - eps_a)
    return {
        "k0": k0, "kc": k0 * log(rng, 2.0, 100.0), "dsigma": -sigma_a * rng.uniform(0.0, 0.95),
        "eps_a": eps_a, "eps_c": eps_a + (0.9 - eps_a) * rng.uniform(0.1, 0.9),
        "kh_plus": k0 * log(rng, 0.1, 30.0), "kh_minus": k0 * log(rng, 0.05, 5.0), "eta": eta,
    }  # fmt: skip


def foam(rng: Generator, k0: float, eta: float = 0.0) -> Spec:
    """Draw a bistable spring near a published one, with another initial slope."""
    names = list(ff.published)
    item = ff.published[names[int(rng.integers(len(names)))]].bistable
    near = {
        key: value * rng.uniform(0.93, 1.07) * (1.0 if key.startswith("eps") else k0 / item.k0)
        for key, value in asdict(item).items() if key != "relaxation"
    }  # fmt: skip
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
        "springs": springs, "heights": list(height * share / share.sum()),
        "area": log(rng, 5e-6, 5e-5), "masses": masses, "site": site,
    }  # fmt: skip


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
    """Return a designed scene, within the limits of brute force."""
    point = _designed()[number]
    few = {"springs": min(point.springs, 12), "samples": min(point.samples, 2001)}
    return {"point": asdict(point) | few}


_designed = cache(partial(designed, 1000, SEED))


def base(rng: Generator, number: int) -> Spec:
    """Draw an impact with a base dashpot: half published foam-2, half random springs."""
    if number % 2 == 0:
        item = ff.published["foam-2"]
        springs = [asdict(s) for s in item.chain.springs]
        springs[0]["eta"] = log(rng, 3e2, 1e6)
        return {
            "springs": springs, "heights": list(item.chain.heights), "area": item.chain.area,
            "masses": [log(rng, 1e-6, 2e-3), 0.0],
            "site": item.chain.site_damping if rng.random() < 0.3 else 0.0,
            "impact": [item.striker_mass, 4.44], "stop": log(rng, 1e-5, 1.5e-3), "samples": 301,
        }  # fmt: skip
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
    kinds = (["k0", "height"] if "unilateral" in s else ["k0", "kc", "eps_a", "kh_plus"]
             for s in springs)  # fmt: skip
    spec["sensitivities"] = [f"s{i}_{rng.choice(own)}" for i, own in enumerate(kinds, start=1)]
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
    springs = [linear(rng, k0) if rng.random() < 0.25 and count > 1 else bistable(rng, k0)
               for _ in range(count)]  # fmt: skip
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
    most = k0 * log(rng, 0.1, 3.0) if stressed else 0.8 * sum(spec["heights"])
    at, levels = path(rng, most, number_of_turns)
    floor = 0.0 if stressed else -math.inf
    spec["stress" if stressed else "displacement"] = [at, [max(x, floor) for x in levels]]
    return spec | {"stop": stop, "samples": int(rng.choice([21, 101, 501]))}


def long(rng: Generator, number: int) -> Spec:
    """Draw three to ten springs with a light or heavy mass on each; most without dashpot."""
    k0 = log(rng, 5e5, 3e7)
    count = int(rng.integers(3, 11))
    draw = foam if rng.random() < 0.5 else bistable
    springs = [linear(rng, k0) if rng.random() < 0.2 else draw(rng, k0 * log(rng, 0.7, 1.5))
               for _ in range(count)]  # fmt: skip
    spec = chain_of(rng, springs, log(rng, 5e-4, 1e-2), [0.0] * count)
    kind = number % 4
    if kind < 2:
        struck(rng, spec, 0.1, 6.0)
        whole = bounce(spec, spec["impact"][0])
        spec["stop"] = whole * log(rng, 0.2, 1.5)
    else:
        whole = spec["stop"] = log(rng, 1e-4, 1e-1)
        most = 0.7 * sum(spec["heights"])
        at, levels = path(rng, most, int(rng.integers(1, 5)))
        if kind == 3:
            levels = [k0 * log(rng, 0.1, 1.0) * max(x, 0.0) / most for x in levels]
        spec["displacement" if kind == 2 else "stress"] = [at, levels]
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
        "k0": k0, "kc": kc,
        "eps_star": least * (1.0 + 1e-12) + (0.0 if rng.random() < 0.1 else rng.uniform(0.0, 0.6)),
        "sigma_plus": sigma_plus, "spread_plus": wide[0],
        "sigma_minus": sigma_plus * log(rng, 0.02, 1.5), "spread_minus": wide[1],
    }  # fmt: skip


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
        s = math.exp(log_s)
        return -math.expm1(-math.log1p(n * s) / n) - 1.0 / (1.0 + kc / k / s)

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


def room(spec: Spec) -> float:
    """Return the largest possible compression of a chain; each spring's strain is at least 1."""
    pairs = zip(spec["springs"], spec["heights"], strict=True)
    return sum(h * (1.0 + s.get("eps_star", 0.0)) for s, h in pairs)


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
        if kind < 0.15:
            top = log(rng, 1e-3, 0.1)  # hardly anything snaps
        elif kind < 0.25 and drive == "displacement":
            top = 1.0 - log(rng, 1e-3, 0.1)  # near the pole
        else:
            top = rng.uniform(0.2, 0.75)
        at, levels = path(rng, top, int(rng.integers(1, 10)))
        scale = room(spec) if drive == "displacement" else k0 * log(rng, 0.3, 10.0)
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
    most, samples = room(spec), int(rng.choice([11, 31, 61]))
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


DRAWN: dict[str, Callable[[Generator, int], Spec]] = {
    "base": base, "gap": gap, "turns": turns, "long": long,
    "microscale": alike(microscale, False), "relaxation": alike(bistable, True),
    "microscale+relaxation": alike(microscale, True), "mixed": mixed,
    "motion": known_motion, "motion+relaxation": relaxing_motion,
    "worn": alike(worn, False), "worn+relaxation": alike(worn, True),
    "worn chain": partial(mixed, draw=worn, heavy=0.7),
    "worn motion": lambda rng, n: (relaxing_motion if n % 2 else known_motion)(rng, n, worn),
}  # fmt: skip
FAMILIES = ("study", *DRAWN)
MEMORY, REMEMBERING = FAMILIES[5:11], FAMILIES[11:]


def spec_of(family: str, number: int) -> Spec:
    """Draw the specification of a scene."""
    if family == "study":
        return study(number)
    rng = np.random.default_rng([SEED, FAMILIES.index(family), number])
    return DRAWN[family](rng, number)
