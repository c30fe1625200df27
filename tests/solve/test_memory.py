"""Chains in which springs remember, by the explicit integrator, against an independent one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from foamfit.springs.chain import Drive
from foamfit.springs.spring import Spring
from memory_reference import Array, follow

AREA = 1.9635e-5
TIME = np.linspace(0.0, 3e-3, 61)
MICRO = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 0.4, 5.5e5, 0.6)
FOAM = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.08, 1.3e6, 0.41, 5.5e5, 0.77)
SHARP = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.0e6, 1e-3, 5.5e5, 2e-3)
WIDE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 2.0, 2.5e5, 1.7)
CROSSED = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 9.0e5, 0.3, 7.0e5, 0.8)  # hysteretic below
ABOVE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 9.0e5, 0.8, 7.0e5, 0.4)  # hysteretic above
REVERSIBLE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 6.0e5, 0.5, 7.0e5, 0.5)
BISTABLE = ff.BistableSpring(5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6)
LINEAR = ff.LinearSpring(60e6)
ONE, TWO = [(0.5, 2e-4)], [(0.4, 5e-5), (0.6, 1e-3)]
IMPACT = ff.Impact(7e-3, 1.5)


def chain(springs: list[Spring], masses: list[float] | None = None, site: float = 0.0) -> ff.Chain:
    heights = [1.19e-3] if len(springs) == 1 else [0.7e-3, 0.49e-3, 0.3e-3][: len(springs)]
    return ff.Chain(springs, heights, AREA, masses, site)


def damped(spring: Spring, eta: float) -> Spring:
    return replace(spring, eta=eta)


def relaxing(spring: Spring, terms: list[tuple[float, float]] = ONE) -> Spring:
    return replace(spring, relaxation=terms)


def cycles(t: Array, size: float) -> Array:
    """Loading and unloading with inner loops, linear between few corners."""
    corners = np.array([0.0, 0.6, 0.35, 0.8, 0.2, 0.7, 1.0, 0.05, 0.5, 0.0, -0.03])
    return size * np.interp(t, np.linspace(t[0], t[-1], corners.size), corners)


def motion(size: float) -> Drive:
    return ff.DisplacementDrive(cycles(TIME, size))


def stress(size: float) -> Drive:
    return ff.StressDrive(cycles(TIME, size))


MOVED = motion(0.5e-3)
SCENES: dict[str, tuple[ff.Chain, Drive]] = {
    "impact": (chain([MICRO]), IMPACT),
    "impact, relaxation": (chain([relaxing(MICRO)]), IMPACT),
    "impact, two terms, dashpot, onsite damper": (
        chain([damped(relaxing(FOAM, TWO), 30.0)], site=20.0), IMPACT),
    "impact, sharp": (chain([SHARP]), IMPACT),
    "impact, wide": (chain([relaxing(WIDE)]), IMPACT),
    "impact, hysteretic below": (chain([CROSSED]), ff.Impact(7e-3, 2.0)),
    "impact, hysteretic above": (chain([relaxing(ABOVE)]), ff.Impact(7e-3, 2.5)),
    "impact, reversible": (chain([REVERSIBLE]), IMPACT),
    "impact, wholly snapped": (chain([MICRO]), ff.Impact(7e-3, 6.0)),
    "impact, sharp and wholly snapped": (chain([relaxing(SHARP)]), ff.Impact(7e-3, 4.0)),
    "impact, bistable relaxing": (chain([relaxing(BISTABLE)]), ff.Impact(7e-3, 2.3)),
    "impact, bistable relaxing, dashpot": (
        chain([damped(relaxing(BISTABLE, TWO), 50.0)]), ff.Impact(7e-3, 2.3)),
    "impact on two": (chain([LINEAR, relaxing(MICRO)]), IMPACT),
    "impact on two microscale": (chain([FOAM, relaxing(MICRO)]), IMPACT),
    "impact, one of two damped": (chain([relaxing(FOAM), damped(MICRO, 100.0)]), IMPACT),
    "impact, both damped": (chain([damped(relaxing(FOAM), 50.0), damped(MICRO, 80.0)]), IMPACT),
    "impact, interior mass": (chain([LINEAR, relaxing(MICRO)], [1e-3, 0.0]), IMPACT),
    "impact, interior mass, two microscale": (
        chain([relaxing(FOAM), relaxing(MICRO, TWO)], [2e-3, 0.0], 20.0), IMPACT),
    "impact, interior mass, dashpots": (
        chain([damped(relaxing(FOAM), 30.0), damped(MICRO, 30.0)], [1e-3, 0.0]), IMPACT),
    "impact on three": (chain([FOAM, LINEAR, relaxing(MICRO)], [0.0, 1e-3, 0.0]), IMPACT),
    "motion of two": (chain([LINEAR, MICRO]), MOVED),
    "motion of two, relaxing": (chain([relaxing(FOAM), relaxing(MICRO, TWO)]), MOVED),
    "motion of two, bistable": (chain([relaxing(BISTABLE), relaxing(MICRO)]), MOVED),
    "motion of two, one damped": (chain([relaxing(FOAM), damped(MICRO, 200.0)]), MOVED),
    "motion of two, both damped": (chain([damped(relaxing(FOAM), 200.0), damped(MICRO, 200.0)]), MOVED),
    "motion of two, interior mass": (chain([LINEAR, relaxing(MICRO)], [1e-3, 0.0]), MOVED),
    "stress, relaxing": (chain([relaxing(MICRO)]), stress(2e6)),
    "stress, dashpot": (chain([damped(MICRO, 200.0)]), stress(2e6)),
    "stress on two, relaxing": (chain([relaxing(FOAM), relaxing(MICRO, TWO)]), stress(2e6)),
    "stress on two, one damped": (chain([relaxing(FOAM), damped(MICRO, 200.0)]), stress(2e6)),
    "stress, viscous top": (chain([relaxing(FOAM), MICRO], site=1e3), stress(2e6)),
    "stress on a mass": (chain([relaxing(FOAM), MICRO], [0.0, 1e-4]), stress(1.5e6)),
    "stress, bistable relaxing": (chain([relaxing(BISTABLE)]), stress(5e6)),
}  # fmt: skip


def difference(one: Array, other: Array) -> float:
    """Largest difference over the range of the first, rest included."""
    return float(np.abs(one - other).max()) / (max(one.max(), 0.0) - min(one.min(), 0.0))


def names_of(given: ff.Chain) -> list[str]:
    """All parameters of a chain that has these springs."""
    names = []
    for i, spring in enumerate(given.springs, start=1):
        own = [n for n in spring.__dataclass_fields__ if n not in ("relaxation", "unilateral")]
        for k in range(1, len(spring.relaxation) + 1):
            own += [f"g{k}", f"tau{k}"]
        names += [f"s{i}_{n}" for n in [*own, "height"]]
    return [*names, "site_eta"]


def value_of(given: ff.Chain, name: str) -> float:
    if name == "site_eta":
        return given.site_damping
    i, short = int(name[1]) - 1, name.split("_", 1)[1]
    if short == "height":
        return given.heights[i]
    if short.startswith(("g", "tau")):
        return given.springs[i].relaxation[int(short[-1]) - 1][short.startswith("tau")]
    return float(getattr(given.springs[i], short))


def with_value(given: ff.Chain, name: str, value: float) -> ff.Chain:
    springs, heights, site = list(given.springs), list(given.heights), given.site_damping
    i, short = (int(name[1]) - 1, name.split("_", 1)[1]) if name != "site_eta" else (0, "site_eta")
    if short == "site_eta":
        site = value
    elif short == "height":
        heights[i] = value
    elif short.startswith(("g", "tau")):
        terms = [list(pair) for pair in springs[i].relaxation]
        terms[int(short[-1]) - 1][short.startswith("tau")] = value
        springs[i] = replace(springs[i], relaxation=terms)
    else:
        springs[i] = replace(springs[i], **{short: value})
    return ff.Chain(springs, heights, AREA, given.masses, site)
