"""Chains of springs with memory: the explicit integrator against an independent one."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import foamfit as ff
from foamfit.solve.plan import plan
from foamfit.springs.chain import Drive
from foamfit.springs.parameters import direction
from foamfit.springs.spring import Spring
from independent import Array, follow, over_range
from reference import differences

AREA = 1.9635e-5
TIME = np.linspace(0.0, 3e-3, 61)
MICRO = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 0.4, 5.5e5, 0.6)
FOAM = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.08, 1.3e6, 0.41, 5.5e5, 0.77)
SHARP = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.0e6, 1e-3, 5.5e5, 2e-3)
WIDE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 2.0, 2.5e5, 1.7)
CROSSED = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 9.0e5, 0.3, 7.0e5, 0.8)  # hysteretic below
ABOVE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 9.0e5, 0.8, 7.0e5, 0.4)  # hysteretic above
REVERSIBLE = ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 6.0e5, 0.5, 7.0e5, 0.5)
WORN = replace(FOAM, eps_star=0.25, stiffening=1.6, softening=0.7, weakening=0.45)
STIFF = replace(CROSSED, stiffening=0.6, softening=0.4, weakening=0.2)
LATE = replace(ABOVE, stiffening=2.5, softening=0.2, weakening=0.15)
BISTABLE = ff.BistableSpring(5.5e6, 82.5e6, -0.17907e6, 0.14, 0.31, 14.3e6, 2.3375e6)
LINEAR = ff.LinearSpring(60e6)
GAP = ff.LinearSpring(60e6, unilateral=True)
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
    """Return a piecewise linear history with inner loops."""
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
    "impact, unilateral base": (chain([GAP, relaxing(MICRO)]), IMPACT),
    "impact, unilateral base, interior mass": (
        chain([GAP, relaxing(MICRO)], [1e-3, 0.0]), IMPACT),
    "impact, gap between masses": (chain([relaxing(FOAM), GAP], [2e-3, 0.0]), IMPACT),
    "motion of two": (chain([LINEAR, MICRO]), MOVED),
    "motion of three": (chain([FOAM, WIDE, BISTABLE]), motion(0.4e-3)),
    "motion of two, relaxing": (chain([relaxing(FOAM), relaxing(MICRO, TWO)]), MOVED),
    "motion of two, bistable": (chain([relaxing(BISTABLE), relaxing(MICRO)]), MOVED),
    "motion of two, one damped": (chain([relaxing(FOAM), damped(MICRO, 200.0)]), MOVED),
    "motion of two, both damped": (
        chain([damped(relaxing(FOAM), 200.0), damped(MICRO, 200.0)]), MOVED),
    "motion of two, interior mass": (chain([LINEAR, relaxing(MICRO)], [1e-3, 0.0]), MOVED),
    "stress, relaxing": (chain([relaxing(MICRO)]), stress(2e6)),
    "stress, dashpot": (chain([damped(MICRO, 200.0)]), stress(2e6)),
    "stress on two, relaxing": (chain([relaxing(FOAM), relaxing(MICRO, TWO)]), stress(2e6)),
    "stress on two, one damped": (chain([relaxing(FOAM), damped(MICRO, 200.0)]), stress(2e6)),
    "stress, viscous top": (chain([relaxing(FOAM), MICRO], site=1e3), stress(2e6)),
    "stress on a mass": (chain([relaxing(FOAM), MICRO], [0.0, 1e-4]), stress(1.5e6)),
    "stress, bistable relaxing": (chain([relaxing(BISTABLE)]), stress(5e6)),
    # Trial steps that are far too long must not decide that a branch is flat.
    "stress on two, bistable, fast term": (
        chain([relaxing(BISTABLE, [(1.7, 1e-6)]), relaxing(FOAM)]), stress(1.5e6)),
    "impact, remembering": (chain([WORN]), IMPACT),
    "impact, remembering, relaxation, dashpot": (chain([damped(relaxing(STIFF), 60.0)]), IMPACT),
    "impact, remembering, interior mass": (chain([WORN, relaxing(LATE)], [3e-3, 0.0]), IMPACT),
    "impact on three, two remembering": (
        chain([WORN, LINEAR, relaxing(STIFF)], [2e-3, 1e-3, 0.0]), ff.Impact(7e-3, 1.2)),
    "motion of two, remembering": (chain([relaxing(WORN), relaxing(LATE, TWO)]), MOVED),
    "motion of two, remembering, one damped": (chain([WORN, damped(STIFF, 200.0)]), MOVED),
    "stress, remembering, relaxing": (chain([relaxing(STIFF)]), stress(2e6)),
    "stress on two, remembering, damped": (
        chain([relaxing(LATE), damped(WORN, 200.0)]), stress(2e6)),
}  # fmt: skip


def names_of(given: ff.Chain) -> list[str]:
    """Return the names of all parameters of the chain that are not zero."""
    names = []
    for i, spring in enumerate(given.springs, start=1):
        own = list(spring.law.names)
        for k in range(1, len(spring.relaxation) + 1):
            own += [f"g{k}", f"tau{k}"]
        names += [f"s{i}_{n}" for n in [*own, "height"]]
    return [name for name in (*names, "site_eta") if value_of(given, name) != 0.0]


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
    return ff.Chain(springs, heights, given.area, given.masses, site)


def changed(given: ff.Chain, drive: Drive, name: str, by: float) -> ff.Response:
    """Simulate with one value changed."""
    other = with_value(given, name, value_of(given, name) + by)
    return ff.simulate(other, drive, TIME, 1e-10)


# Rounding makes springs reverse repeatedly here, which stops the judge.
TURNING = ("motion of two", "motion of three", "impact, gap between masses", "stress, viscous top")


@pytest.mark.parametrize("name", [name for name in SCENES if name not in TURNING])
def test_a_motion_is_as_exact_as_asked_for(name: str) -> None:
    given, drive = SCENES[name]
    truth = follow(given, drive, TIME)
    assert not truth.why
    for rtol in (1e-4, 1e-6, 1e-8):
        got = ff.simulate(given, drive, TIME, rtol)
        assert over_range(got.base_stress, truth.base_stress) < rtol
        assert max(map(over_range, got.displacement, truth.displacement)) < rtol
        assert got.method == "Dormand-Prince"
        if truth.contact_end is not None:
            assert got.contact_end == pytest.approx(truth.contact_end, rel=rtol)


@pytest.mark.parametrize(
    "name", ["motion of two, relaxing", "motion of two, bistable", "stress on two, relaxing"]
)
def test_between_close_samples_springs_that_relax_in_series_take_one_step(name: str) -> None:
    """The steps of `series`: far within the tolerance, with derivatives of second order."""
    (given, drive), time = SCENES[name], np.linspace(0.0, 3e-3, 3001)
    close = type(drive)(np.interp(time, TIME, vars(drive)[next(iter(vars(drive)))]))
    scene = plan(given, close, time)
    wanted = np.array([direction(given.laws, one, given.relaxation) for one in names_of(given)])
    runs = [
        scene.run(given.arrays.rows, given.arrays.heights, rtol, directions=wanted)
        for rtol in (1e-4, 1e-10)
    ]
    truth = follow(given, drive, TIME)
    assert over_range(runs[0].base_stress[::50], truth.base_stress) < 1e-9
    assert max(map(over_range, runs[0].displacement[:, ::50], truth.displacement)) < 1e-9
    what = "displacement" if isinstance(drive, ff.StressDrive) else "base_stress"
    got, exact = (getattr(run.slopes, what).reshape(len(wanted), -1) for run in runs)
    sizes = np.abs(exact).max(axis=1)
    assert 1e-7 < (np.abs(got - exact).max(axis=1)[sizes > 0.0] / sizes[sizes > 0.0]).max() < 2e-5


EXACT = [
    "impact, two terms, dashpot, onsite damper", "impact, wide", "impact, hysteretic below",
    "impact, hysteretic above", "impact, bistable relaxing", "impact on three",
    "motion of two, relaxing", "motion of two, both damped", "motion of two, interior mass",
    "motion of three",
    "stress on two, one damped", "stress, viscous top", "impact, gap between masses",
    "impact, interior mass, two microscale",
    "impact, remembering, relaxation, dashpot", "impact, remembering, interior mass",
    "motion of two, remembering", "stress on two, remembering, damped",
]  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_derivatives_by_all_parameters_are_those_of_differences(name: str) -> None:
    given, drive = SCENES[name]
    names = names_of(given)
    run = ff.simulate(given, drive, TIME, 1e-10, sensitivities=names)
    away = np.abs(TIME - (run.contact_end or -1.0)) > 6e-5  # derivatives jump at the end of contact
    for short in names:
        value, misses = value_of(given, short), []
        # The wide step for derivatives that are nearly zero, the short one beside switches.
        for step in (1e-3 * value, 1e-4 * value):
            both = differences(partial(changed, given, drive, short), step)
            misses.append([])
            for what, wanted in zip(("displacement", "base_stress"), both, strict=True):
                got = getattr(run.sensitivities[short], what)
                size = max(np.abs(got).max(), 2e-5 * np.abs(getattr(run, what)).max() / abs(value))
                misses[-1].append(np.abs(wanted - got)[..., away].max() / size)
            if np.min(misses, axis=0).max() < 1e-6:
                break
        assert np.min(misses, axis=0).max() < 1e-6, short


@pytest.mark.parametrize("moved", [True, False])
def test_a_chain_may_start_loaded(moved: bool) -> None:
    """The loaded chain starts in equilibrium, with no overstress."""
    given = chain([relaxing(MICRO), relaxing(BISTABLE), FOAM])
    shape = 0.3 + 0.5 * np.sin(np.linspace(0.0, 6.0, TIME.size))
    drive: Drive = ff.DisplacementDrive(4e-4 * shape) if moved else ff.StressDrive(1.2e6 * shape)
    names = names_of(given)
    run = ff.simulate(given, drive, TIME, 1e-10, sensitivities=names)
    strain = np.diff(run.displacement[:, 0], prepend=0.0) / given.heights
    loaded = [s.stress(np.array([0.0, e]))[-1] for s, e in zip(given.springs, strain, strict=True)]
    assert loaded == pytest.approx([run.base_stress[0]] * 3, rel=1e-12)
    for short in names:
        value = value_of(given, short)
        both = differences(partial(changed, given, drive, short), 3e-5 * value, 2)
        for what, wanted in zip(("displacement", "base_stress"), both, strict=True):
            got = getattr(run.sensitivities[short], what)
            size = max(np.abs(got).max(), 1e-4 * np.abs(getattr(run, what)).max() / abs(value))
            assert np.abs(wanted - got).max() < 2e-6 * size, (short, what)


def test_contact_ends_where_the_whole_stress_does() -> None:
    """Relaxation brings the total stress to zero while the equilibrium stress still compresses."""
    given = chain([relaxing(MICRO)])
    run = ff.simulate(given, IMPACT, TIME, 1e-8)
    assert run.contact_end is not None
    last = int(np.searchsorted(TIME, run.contact_end)) - 1
    strain = run.displacement[0, : last + 1] / given.height
    assert MICRO.stress(strain)[-1] > 0.1 * run.base_stress.max()
    assert run.base_stress[last] < 0.1 * run.base_stress.max()


def test_a_gap_opens_and_closes_beside_springs_with_memory() -> None:
    """Between masses a gap opens while the base is in compression; at the base it ends contact."""
    between = ff.simulate(*SCENES["impact, gap between masses"], TIME, 1e-8)
    open_now = np.diff(between.displacement, axis=0)[0] < 0.0
    pressed = between.base_stress > 0.0
    assert (open_now & pressed).sum() > 3
    assert (~open_now & pressed).sum() > 3
    assert (
        (between.switches[:, 1] == 1) & (between.switches[:, 3] != between.switches[:, 2])
    ).any()
    for masses in (None, [1e-3, 0.0]):
        two = [
            ff.simulate(chain([k, relaxing(MICRO)], masses), IMPACT, TIME) for k in (GAP, LINEAR)
        ]
        assert two[0].contact_end == pytest.approx(two[1].contact_end, rel=1e-9)
        assert two[0].base_stress == pytest.approx(two[1].base_stress, rel=1e-9, abs=1.0)


@pytest.mark.parametrize(
    ("given", "drive", "limit"),
    [
        (chain([relaxing(MICRO, [(0.5, 1e-12)])]), IMPACT, chain([MICRO])),
        (chain([LINEAR, relaxing(MICRO, [(0.5, 1e-11)])]), MOVED, chain([LINEAR, MICRO])),
        (chain([damped(MICRO, 1e-5), FOAM]), MOVED, chain([MICRO, FOAM])),
    ],
    ids=["term", "term above a linear spring", "dashpot"],
)
def test_what_is_too_fast_for_explicit_steps_has_its_limit(
    given: ff.Chain, drive: Drive, limit: ff.Chain
) -> None:
    """A term or a dashpot next to nothing changes nothing."""
    got, want = ff.simulate(given, drive, TIME), ff.simulate(limit, drive, TIME, 1e-9)
    assert got.method == "Radau IIA"
    assert over_range(got.base_stress, want.base_stress) < 1e-6
    assert max(map(over_range, got.displacement, want.displacement)) < 1e-6


@pytest.mark.parametrize(
    ("given", "drive", "culprit"),
    [
        (chain([damped(MICRO, 1e-7), FOAM]), MOVED, "dashpot"),
        (chain([MICRO, FOAM], [1e-16, 0.0]), IMPACT, "mass"),
    ],
)
def test_what_no_steps_can_follow_is_refused_by_name(
    given: ff.Chain, drive: Drive, culprit: str
) -> None:
    with pytest.raises(ff.SimulationError, match="too fast") as refused:
        ff.simulate(given, drive, TIME)
    assert culprit in str(refused.value)
