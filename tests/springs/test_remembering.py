"""Microscale springs with memory (docs/theory.md) against an independent implementation."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import ndtr

import foamfit as ff
from reference import Microscale, differences

Array = NDArray[np.float64]
PLAIN = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 0.4, 5.5e5, 0.6)
WORN = replace(PLAIN, stiffening=1.6, softening=0.7, weakening=0.45)
SPRINGS = {
    "none": PLAIN,
    "all three": WORN,
    "no weakening": replace(WORN, weakening=0.0),
    "no softening": replace(WORN, softening=0.0),
    "hysteretic above": replace(WORN, spread_plus=0.8, spread_minus=0.4),
    "equal spreads": replace(WORN, spread_minus=0.4),
    "reversible once snapped": replace(WORN, weakening=2.0, spread_minus=0.4),
    "always reversible": replace(WORN, sigma_minus=3e6, spread_minus=0.4, weakening=0.0),
    "unstiffened": replace(WORN, stiffening=1.0),
    "soft at first": replace(WORN, stiffening=0.3, eps_star=0.6),
}


def between(rng: Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def drawn(rng: Generator, extreme: bool) -> ff.MicroscaleSpring:
    """Draw an admissible spring; the lower bound on ε_* is a maximum over a grid of stresses."""
    k0 = between(rng, 1e4, 1e8)
    kc = k0 * between(rng, 0.02, 100.0)
    n = between(rng, 0.02, 50.0) if extreme else between(rng, 0.3, 4.0)
    d, s = rng.uniform(0.0, 6.0 if extreme else 2.0), rng.uniform(0.0, 6.0 if extreme else 1.0)
    d, s = (d, 0.0) if (kind := rng.random()) < 0.15 else (0.0, s) if kind < 0.3 else (d, s)
    n = 1.0 if 0.3 < kind < 0.4 else n
    wide = [between(rng, 1e-3, 5.0) if extreme else between(rng, 0.05, 1.0) for _ in range(2)]
    if rng.random() < 0.15:
        wide[1] = wide[0]
    x = np.logspace(-8.0, 14.0, 4001)
    k = k0 * math.exp(-d)
    least = max(0.0, float((-np.expm1(-np.log1p(n * x) / n) - k * x / (kc + k * x)).max()))
    star = least + (1e-5 if rng.random() < 0.2 else rng.uniform(1e-3, 0.6))
    plus = k0 * between(rng, 0.02, 2.0)
    minus = plus * between(rng, 0.005, 1.5)
    return ff.MicroscaleSpring(
        k0, kc, star, plus, wide[0], minus, wide[1], stiffening=n, softening=d, weakening=s
    )


def history(rng: Generator, spring: ff.MicroscaleSpring) -> Array:
    """Draw a stress history with partial loops, new peaks, zeros, revisited levels and tension."""
    top = spring.sigma_plus * between(rng, 0.1, 30.0)
    pull = -0.4 * min(spring.k0 * math.exp(-spring.softening) / spring.stiffening, spring.kc)
    levels = [0.0]
    for turn in range(int(rng.integers(2, 14))):
        last = levels[-1]
        kind = rng.random()
        if turn > 2 and kind < 0.25:
            levels.append(levels[int(rng.integers(len(levels)))])
        elif turn % 2 == 0:
            levels.append(rng.uniform(last, max(last, top)) if kind < 0.8 else 1.2 * top)
        else:
            levels.append(
                0.0 if kind < 0.4 else pull if kind < 0.5 else max(last, 0.0) * rng.random()
            )
    parts = int(rng.choice([1, 2, 6]))
    return np.concatenate([
        np.linspace(a, b, parts + 1)[1:] for a, b in pairwise(levels)
    ])  # fmt: skip


@pytest.mark.parametrize("extreme", [False, True])
def test_stress_and_strain_are_those_of_the_formula(extreme: bool) -> None:
    """To 1e-8 of the range, or to the effect of rounding the strain where that is larger."""
    for number in range(150):
        rng = np.random.default_rng([8, extreme, number])
        spring = drawn(rng, extreme)
        given = history(rng, spring)
        along, strain, fractions = Microscale(spring), [], []
        for s in given:
            along.keep(s)
            strain.append(along.strain(s))
            fractions.append((ndtr(along.w), ndtr(along.most)))
        wanted = np.array(strain)
        assert np.abs(spring.strain(given) - wanted).max() <= 1e-12 * np.abs(wanted).max(), number
        found = spring.fractions_along(given)
        assert np.abs(np.transpose(found) - fractions).max() <= 1e-12, number
        assert spring.fraction_along(given).tolist() == found[0].tolist()
        along, back, loose = Microscale(spring), [], []
        for eps in wanted:
            digit = 8e-16 * abs(eps)
            back.append(along.stress(eps))
            loose.append(abs(along.stress(eps + digit) - along.stress(eps - digit)))
            along.keep(back[-1])
        got, allowed = spring.stress(wanted), 1e-9 * np.abs(given).max() + 2.0 * np.array(loose)
        assert (np.abs(got - back) <= allowed).all(), number
        assert (np.abs(got - given) <= allowed).all(), number  # stress inverts strain


def test_without_memory_it_is_section_6_bit_for_bit() -> None:
    same = replace(PLAIN, stiffening=1.0, softening=0.0, weakening=0.0)
    assert same.law is PLAIN.law
    assert same.row.tolist() == PLAIN.row.tolist()
    # softening and weakening do not affect first loading
    up = np.linspace(0.0, 4e6, 30)
    once = SPRINGS["unstiffened"]
    assert once.strain(up) == pytest.approx(PLAIN.strain(up), rel=1e-14)
    assert once.stress(PLAIN.strain(up)) == pytest.approx(up, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("stiffening", 0.0), ("stiffening", -1.0), ("stiffening", math.nan),
        ("stiffening", math.inf), ("softening", -0.1), ("softening", math.nan),
        ("weakening", -1e-9), ("weakening", math.inf),
    ],
)  # fmt: skip
def test_an_inadmissible_value_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ff.InputError, match=name) as refused:
        replace(WORN, **{name: value})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("n", [0.02, 0.3, 1.0, 1.6, 50.0])
@pytest.mark.parametrize("kc", [2e5, 2.5e6, 5.5e6, 8e7])
def test_the_least_eps_star_is_that_of_the_softened_branch(n: float, kc: float) -> None:
    for d in (0.0, 0.7, 4.0):
        k = 5.5e6 * math.exp(-d)
        s = np.geomspace(1e-6 * k, 1e15 * k, 400_001)
        least = max(0.0, float((-np.expm1(-np.log1p(n * s / k) / n) - s / (kc + s)).max()))
        own = replace(PLAIN, kc=kc, eps_star=5.0, stiffening=n, softening=d)
        replace(own, eps_star=least + 1e-8)
        if least > 1e-6:
            with pytest.raises(ff.InputError, match="eps_star"):
                replace(own, eps_star=least - 1e-6)


def test_a_tension_that_the_softened_branch_cannot_carry_is_refused() -> None:
    pole = -WORN.k0 * math.exp(-WORN.softening) / WORN.stiffening
    with pytest.raises(ff.SimulationError, match="tension"):
        WORN.strain(np.array([0.0, 3e6, 0.0, 1.01 * pole]))
    WORN.strain(np.array([0.0, 3e6, 0.0, 0.99 * pole]))
    with pytest.raises(ff.SimulationError, match="branch"):
        WORN.stress(np.array([0.0, 1.0 + WORN.eps_star]))


@pytest.mark.parametrize("name", SPRINGS)
@pytest.mark.parametrize("by_strain", [False, True])
def test_inner_loops_return_to_where_they_began(name: str, by_strain: bool) -> None:
    """Each loop closes and a larger loop erases it, but not the largest fraction ever snapped."""
    spring = SPRINGS[name]
    stress = 1e6 * np.array([0, 2.5, 0.6, 1.4, 0.9, 1.2, 0.9, 1.4, 0.6, 1.4, 0.6, 2.5, 3.0])
    follow = spring.strain
    if by_strain:  # the inverse
        follow, stress = spring.stress, spring.strain(stress)
    out = follow(stress)
    # each pair of samples has the same level on the same path, with inner loops in between
    for one, other in [(3, 7), (7, 9), (2, 8), (8, 10), (4, 6), (1, 11)]:
        assert out[other] == pytest.approx(out[one], rel=1e-12), (one, other)
    # past the old peak, first loading continues as if the loops had not happened
    assert out[12] == pytest.approx(follow(stress[[0, 12]])[1], rel=1e-12)


@pytest.mark.parametrize("name", SPRINGS)
@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("count", [1, 2])
def test_derivatives_are_those_of_differences(name: str, moved: bool, count: int) -> None:
    """For prescribed stress and displacement, for one spring and with another one in series."""
    spring, heights = SPRINGS[name], [1e-3, 0.7e-3][:count]
    corners = np.array([0.0, 1.4, 0.31, 1.1, 0.23, 1.9, 0.05, 1.2, 0.52, 2.6, 0.41, 2.7, 0.0])
    time = np.arange(12.0 * 8 + 1)
    shape = np.interp(time, np.arange(0.0, time.size, 8.0), corners)
    names = [f"s1_{short}" for short in spring.law.own if getattr(spring, short) != 0.0]

    def run(own: ff.MicroscaleSpring, *asked: str) -> ff.Response:
        other = replace(WORN, sigma_plus=0.9e6, eps_star=0.35)
        chain = ff.Chain([own, other][:count], heights, 2e-5)
        move = ff.DisplacementDrive(0.28 * sum(heights) * shape)
        drive = move if moved else ff.StressDrive(1e6 * shape)
        return ff.simulate(chain, drive, time, sensitivities=asked)

    found = run(spring, *names)
    exact = found.sensitivities
    for full in names:
        short = full.removeprefix("s1_")
        value = getattr(spring, short)
        both = differences(lambda by, n=short, v=value: run(replace(spring, **{n: v + by})),
                           1e-5 * value, 2)  # fmt: skip
        for what, wanted in zip(("displacement", "base_stress"), both, strict=True):
            got = getattr(exact[full], what)
            size = np.abs(getattr(found, what)).max() / value
            close = 1e-6 * np.abs(got).max() + 1e-7 * size
            assert np.abs(got - wanted).max() <= close, (short, what)


def test_derivatives_behind_a_narrow_snap_that_all_have_passed() -> None:
    """All of branch a is then softened; the derivative by softening was once wrongly zero."""
    narrow = replace(WORN, spread_plus=0.02, relaxation=[(0.3, 1.0)])
    time = np.linspace(0.0, 4.0, 81)
    drive = ff.DisplacementDrive(0.9e-3 * (1.0 - np.cos(1.5 * np.pi * time)) / 2.0)

    def run(own: ff.MicroscaleSpring, *asked: str) -> ff.Response:
        chain = ff.Chain([own, replace(PLAIN, eta=1e5)], [1e-3, 0.7e-3], 2e-5)
        return ff.simulate(chain, drive, time, 1e-9, sensitivities=asked)

    exact = run(narrow, "s1_softening", "s1_weakening", "s1_stiffening").sensitivities
    assert narrow.fractions_along(run(narrow).base_stress)[1].max() == 1.0
    for full, got in exact.items():
        short = full.removeprefix("s1_")
        value = getattr(narrow, short)
        wanted = differences(lambda by, n=short, v=value: run(replace(narrow, **{n: v + by})),
                             1e-5 * value, 2)[0][0]  # fmt: skip
        away = np.abs(wanted - got.displacement[0]) <= 1e-3 * np.abs(wanted).max()
        assert np.abs(wanted).max() > 1e-6
        assert away.all(), short
