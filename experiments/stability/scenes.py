"""Stiff and extreme scenes of bistable and linear springs: a Latin hypercube over all axes.

Everything is generated from a seed, in SI units. Springs, histories and durations are synthetic.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import foamfit as ff

Array = NDArray[np.float64]
Scene = tuple[ff.Chain, ff.Impact | ff.StressDrive | ff.DisplacementDrive, Array]
Spec = dict[str, Any]  # a scene that JSON can hold; see `families`

AREA, STRIKER = 1.9635e-5, 7e-3  # m², kg: the specimens and the striker of the paper
HISTORIES = ("on a", "on d", "on c", "on e", "loops", "all branches")
KINDS = ("bistable", "linear+bistable", "unilateral+bistable")
DRIVES = ("impact", "stress", "displacement")


@dataclass(frozen=True)
class Point:
    """Coordinates of a scene on the axes of the study; see `AXES` for the ranges."""

    drive: str = "impact"
    kinds: str = "bistable"  # repeated from the base up
    history: str = "all branches"  # where the stress or displacement reverses
    k0: float = 5e6  # Pa
    kc_ratio: float = 15.0  # k_c/k0
    dsigma_ratio: float = -0.3  # Δσ/σ_a
    kh_plus_ratio: float = 2.0  # k_h+/k0
    kh_minus_ratio: float = 0.4  # k_h-/k0
    eps_a: float = 0.2
    eps_c: float = 0.5
    mass: float = 0.0  # kg, above every spring but the last
    top_mass: float = 0.0  # kg, on top under a prescribed stress
    eta: float = 0.0  # Pa·s, of every spring, in parallel
    site_eta: float = 0.0  # Pa·s, the onsite damper
    velocity: float = 2.0  # m/s
    height: float = 1e-3  # m, overall
    springs: int = 1
    samples: int = 201
    duration: float = 1.0  # relative to the natural duration; see `duration_of`


def spring_of(point: Point) -> ff.BistableSpring:
    """Return the bistable spring of a scene."""
    sigma_a = point.k0 * point.eps_a / (1.0 - point.eps_a)
    return ff.BistableSpring(
        k0=point.k0, kc=point.kc_ratio * point.k0, dsigma=point.dsigma_ratio * sigma_a,
        eps_a=point.eps_a, eps_c=point.eps_c, kh_plus=point.kh_plus_ratio * point.k0,
        kh_minus=point.kh_minus_ratio * point.k0, eta=point.eta,
    )  # fmt: skip


def chain_of(point: Point) -> ff.Chain:
    """Return the chain of a scene; slightly different heights make all springs different."""
    bistable = spring_of(point)
    linear = ff.LinearSpring(10.0 * point.k0, point.eta, point.kinds.startswith("unilateral"))
    pattern = (bistable,) if point.kinds == "bistable" else (linear, bistable)
    springs = [pattern[(i + 1) % len(pattern) - 1] for i in range(point.springs)]
    if point.springs == 1:
        springs = [bistable]
    weights = 1.0 + 0.3 * np.sin(1.0 + 2.0 * np.arange(point.springs))
    heights = point.height * weights / weights.sum()
    masses = np.full(point.springs, point.mass)
    masses[-1] = point.top_mass if point.drive == "stress" else 0.0
    return ff.Chain(springs, list(heights), AREA, list(masses), site_damping=point.site_eta)


def duration_of(point: Point) -> float:
    """Return the natural duration of a scene: a bounce, or the time of masses and dashpots."""
    mass = STRIKER if point.drive == "impact" else point.mass * point.springs + point.top_mass
    swing = math.pi * math.sqrt(mass * point.height / (AREA * point.k0))
    relax = (point.eta + point.site_eta) / point.k0
    if point.drive != "impact":
        return point.duration * max(20.0 * swing, relax, 1e-6)
    crossing = 4.0 * point.height / point.velocity
    stop = mass * point.height / (AREA * (point.eta + point.site_eta + 1e-300))
    if relax > swing and stop < crossing:  # dashpots stop the striker, which then creeps back
        return point.duration * min(relax, 1e6 * swing)
    return point.duration * min(swing, crossing)


def turns_of(point: Point) -> Array:
    """Return the strains of the bistable spring at the turning points of the history."""
    spring = spring_of(point)
    low, high = spring.eps_a, spring.eps_hat_c
    back = 0.0 if spring.eps_hat_a is None else max(spring.eps_hat_a, 0.0)
    on_a, on_d = 0.6 * low, 0.5 * (low + high)
    on_c = high + 0.3 * (1.0 + spring.eps_star - high)
    near = high + 0.1 * (1.0 + spring.eps_star - high)
    on_e = spring.eps_c - 0.4 * (spring.eps_c - back)
    down = 0.5 * back  # back on a, where a meets e
    turns = {
        "on a": [on_a, 0.2 * on_a, on_a, 0.0],
        "on d": [on_d, on_a, 0.9 * on_d, low, on_d],
        "on c": [on_c, near, on_c, 0.5 * (near + spring.eps_c)],
        "on e": [on_c, on_e, 0.5 * (on_e + spring.eps_c), on_e, on_c, 0.9 * on_e],
        "loops": [on_c, down, on_c, down, near],
        "all branches": [on_a, 0.5 * on_a, on_d, on_a, on_c, near, on_c, on_e, on_c, down, on_d],
    }
    return np.array([0.0, *turns[point.history]])


def scene_of(point: Point) -> Scene:
    """Return chain, drive and samples of a scene."""
    chain = chain_of(point)
    time = np.linspace(0.0, duration_of(point), point.samples)
    if point.drive == "impact":
        return chain, ff.Impact(STRIKER, point.velocity), time
    strains = turns_of(point)
    last = len(strains) - 1
    fine = np.interp(np.linspace(0, last, 64 * last + 1), np.arange(last + 1), strains)
    along = np.linspace(0.0, duration_of(point), len(fine))
    if point.drive == "stress":
        levels = spring_of(point).stress(fine)
        if point.kh_plus_ratio == 0.0 or point.kh_minus_ratio == 0.0:
            levels = levels * (1.0 - 1e-3)
        return chain, ff.StressDrive(np.interp(time, along, levels)), time
    share = 1.0
    if point.springs > 1 and point.kinds != "bistable":  # share of the linear springs excluded
        bistable = [isinstance(s, ff.BistableSpring) for s in chain.springs]
        share = math.fsum(np.array(chain.heights)[bistable]) / chain.height
    motion = np.interp(time, along, fine) * chain.height * share
    return chain, ff.DisplacementDrive(motion), time


def scene_from(spec: Spec) -> Scene:
    """Return chain, drive and samples."""
    if "point" in spec:
        return scene_of(Point(**spec["point"]))
    kinds = {"sigma_plus": ff.MicroscaleSpring, "kc": ff.BistableSpring, "k0": ff.LinearSpring}
    springs = [next(kind for key, kind in kinds.items() if key in s)(**s) for s in spec["springs"]]
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


def _log(u: float, low: float, high: float) -> float:
    return low * (high / low) ** u


def _or_zero(u: float, low: float, high: float, share: float) -> float:
    """Return zero for a share of the design, else a log-scaled value between low and high."""
    return 0.0 if u < share else _log((u - share) / (1.0 - share), low, high)


def designed(count: int, seed: int) -> list[Point]:
    """Return scenes of a Latin hypercube over all axes; most chains are short, some long."""
    points = []
    for u in qmc.LatinHypercube(19, rng=seed).random(count):
        springs = round(1000.0 ** (u[0] ** 7))
        samples = round(_log(u[1] ** 2, 5.0, 2e4))
        eps_a = _log(u[3], 0.01, 0.6)
        points.append(Point(
            drive=DRIVES[min(int(u[2] * 4.0), 3) % 3],  # impacts twice as often
            kinds=KINDS[int(u[4] * 3)], history=HISTORIES[int(u[5] * len(HISTORIES))],
            k0=_log(u[6], 1e5, 1e8), kc_ratio=_log(u[7], 1.0, 1e5),
            dsigma_ratio=-min(max(1.1 * u[8] - 0.1, 0.0), 1.0) * 0.99,
            kh_plus_ratio=_or_zero(u[9], 1e-3, 100.0, 0.1),
            kh_minus_ratio=_or_zero(u[10], 1e-3, 100.0, 0.1),
            eps_a=eps_a, eps_c=eps_a + (0.95 - eps_a) * (0.05 + 0.9 * u[11]),
            mass=_or_zero(u[12], 1e-12, STRIKER, 0.5),
            top_mass=_or_zero(u[13], 1e-12, STRIKER, 0.7),
            eta=_or_zero(u[14], 1e-6, 1e8, 0.4), site_eta=_or_zero(u[15], 1e-6, 1e8, 0.6),
            velocity=_log(u[16], 1e-3, 100.0), height=_log(u[17], 1e-6, 1.0), springs=springs,
            samples=max(min(samples, 200_000 // springs), 5), duration=_log(u[18], 0.1, 10.0),
        ))  # fmt: skip
    return points
