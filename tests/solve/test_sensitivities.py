"""Sensitivities computed with a simulation against central differences."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from test_memory import AREA, BISTABLE, LINEAR, chain, names_of, value_of, with_value

import foamfit as ff
from foamfit.solve.plan import Motion, plan
from foamfit.springs.chain import Drive
from foamfit.springs.laws.record import BEGUN, HEAVIER, MOVED as MOVED_BY, STRUCK
from foamfit.springs.spring import Spring
from reference import differences

TIME = np.linspace(0.0, 8e-4, 81)
SOFT = ff.BistableSpring(2e6, 60e6, -0.3446e6, 0.35, 0.71, 6.8e6, 1.05e6)
PAIR = [LINEAR, SOFT]
IMPACT = ff.Impact(7e-3, 2.0)
PULSE = np.sin(np.pi * TIME / TIME[-1]) ** 2
MOTION, STRESS = ff.DisplacementDrive(0.5e-3 * PULSE), ff.StressDrive(6e6 * PULSE)
HELD = ff.LinearSpring(60e6, unilateral=True)
PULLED = ff.DisplacementDrive(0.5e-3 * PULSE - 4e-5 * TIME / TIME[-1])
MOVED = ff.DisplacementDrive(0.5e-3 * PULSE + 1e-5)


def damped(springs: list[Spring], *eta: float) -> list[Spring]:
    return [replace(spring, eta=own) for spring, own in zip(springs, eta, strict=True)]


SCENES: dict[str, tuple[ff.Chain, Drive]] = {
    "impact": (chain([BISTABLE]), IMPACT),
    "impact, dashpot and onsite damper": (chain(damped([BISTABLE], 20.0), site=15.0), IMPACT),
    "two springs": (chain(PAIR), IMPACT),
    "two springs, onsite damper": (chain(PAIR, site=30.0), IMPACT),
    "interior mass": (chain(PAIR, [5e-5, 0.0]), IMPACT),
    "interior mass, onsite damper": (chain(PAIR, [5e-5, 0.0], 30.0), IMPACT),
    "all damped": (chain(damped(PAIR, 20.0, 30.0)), IMPACT),
    "one of three damped": (chain(damped([*PAIR, BISTABLE], 0.0, 30.0, 0.0)), IMPACT),
    "unilateral": (chain([HELD, SOFT], site=30.0), IMPACT),
    "unilateral, mass": (chain([HELD, BISTABLE], [5e-6, 0.0]), ff.Impact(7e-3, 0.7)),
    "gravity": (chain(PAIR, [5e-5, 0.0], 30.0), ff.Impact(7e-3, 2.0, 2e3)),
    "motion": (chain([BISTABLE]), MOTION),
    "motion, dashpot": (chain(damped([BISTABLE], 20.0)), MOTION),
    "motion of two": (chain(PAIR), MOTION),
    "motion of two, one damped": (chain(damped(PAIR, 0.0, 30.0)), MOTION),
    "motion of two from a strain, damped": (chain(damped(PAIR, 20.0, 30.0)), MOVED),
    "motion of two, interior mass": (chain(PAIR, [5e-5, 0.0]), MOTION),
    "motion that opens a gap": (chain([HELD, SOFT]), PULLED),
    "motion that opens a gap, damped": (chain(damped([HELD, SOFT], 0.0, 30.0)), PULLED),
    "motion that opens a gap, interior mass": (chain([HELD, SOFT], [5e-5, 0.0]), PULLED),
    "stress": (chain([BISTABLE]), STRESS),
    "stress, dashpot": (chain(damped([BISTABLE], 40.0)), STRESS),
    "stress on two": (chain(PAIR), STRESS),
    "stress on two, one damped": (chain(damped(PAIR, 0.0, 30.0)), STRESS),
    "stress, viscous top": (chain(damped(PAIR, 0.0, 30.0), site=300.0), STRESS),
    "stress on a mass": (chain(PAIR, [0.0, 1e-5]), STRESS),
}

# Implicit steps restart at each sample of a drive, so stiff scenes use a quarter of the samples.
SPARSE = TIME[::4]
FEW = {
    "moved": ff.DisplacementDrive(MOVED.displacement[::4]),
    "pulled": ff.DisplacementDrive(PULLED.displacement[::4]),
    "stress": ff.StressDrive(STRESS.stress[::4]),
}

# Scenes with transients far shorter than the test, which explicit steps would have to resolve.
# Tighter tolerances take too long, and at this one second-order differences are accurate enough.
STIFF: dict[str, tuple[ff.Chain, Drive]] = {
    "stiff: heavy and light dashpot": (chain(damped(PAIR, 1e5, 1e-2)), IMPACT),
    "stiff: light mass, onsite damper, gravity": (
        chain(damped(PAIR, 50.0, 30.0), [1e-8, 0.0], 1e3), ff.Impact(7e-3, 2.0, 2e3)),
    "stiff: one of three damped": (chain(damped([*PAIR, BISTABLE], 0.0, 1e-2, 0.0)), IMPACT),
    "stiff: motion of two": (chain(damped(PAIR, 1e-2, 1e-2)), FEW["moved"]),
    "stiff: motion that opens a gap": (
        chain(damped([HELD, SOFT], 0.0, 30.0), [1e-8, 0.0]),
        FEW["pulled"],
    ),
    "stiff: stress, viscous top": (chain(damped(PAIR, 0.0, 1e-1), site=300.0), FEW["stress"]),
}  # fmt: skip


@pytest.mark.parametrize("label", [*SCENES, *STIFF])
def test_sensitivities_against_differences(label: str) -> None:
    """Within 1e-6 of the response's own range, away from switches of branch."""
    usual = label in SCENES
    scene, drive = SCENES[label] if usual else STIFF[label]
    time = TIME if usual else SPARSE
    rtol, step = (1e-13, 2e-5) if usual else (1e-9, 2e-5)
    names = names_of(scene)[:: 1 if usual else 4]  # implicit steps are slow
    got = ff.simulate(scene, drive, time, rtol, sensitivities=names)
    assert got.steps == 0 or got.method == ("Dormand-Prince" if label in SCENES else "Radau IIA")
    events = [*got.switches[:, 0], *([got.contact_end] if got.contact_end else [])]
    away = np.all(np.abs(time[:, None] - np.array([events])) > 2e-3 * time[-1], axis=1)
    assert away.mean() > 0.8
    for name in names:
        size = value_of(scene, name)

        def bare(by: float, name: str = name, size: float = size) -> Motion:
            other = with_value(scene, name, size + by)
            return plan(other, drive, time).run(other.arrays.rows, other.arrays.heights, rtol)

        wanted = differences(bare, step * size, 4 if usual else 2)
        own = got.sensitivities[name]
        ranges = (np.ptp(got.displacement[-1]), np.ptp(got.base_stress))
        for expected, exact, scale in zip(
            wanted, (own.displacement, own.base_stress), ranges, strict=True
        ):
            allowed = 1e-6 * max(abs(size) * float(np.ptp(expected)), scale)
            assert np.all(np.abs(size * (exact - expected))[..., away] <= allowed), name


def with_change(drive: Drive, what: int, by: float) -> Drive:
    """Return a drive of another velocity, mass or motion in contact."""
    if isinstance(drive, ff.Impact):
        faster, heavier = by * (what == STRUCK), by * AREA * (what == HEAVIER)
        return ff.Impact(drive.mass + heavier, drive.velocity + faster, drive.gravity)
    moved = drive.displacement
    return ff.DisplacementDrive(np.where(moved > 0.0, moved + by, moved))


BY_DRIVE = {label: one for label, one in SCENES.items() if not isinstance(one[1], ff.StressDrive)}
SIZES = {MOVED_BY: 5e-4, BEGUN: TIME[-1], STRUCK: 2.0, HEAVIER: 7e-3 / AREA}


@pytest.mark.parametrize("label", BY_DRIVE)
def test_derivatives_by_the_drive_against_differences(label: str) -> None:
    """By contact time, velocity and areal mass of an impact, and by a shift of a motion."""
    scene, drive = BY_DRIVE[label]
    impact = isinstance(drive, ff.Impact)
    time = TIME - 2.5e-5 if impact else TIME  # the striker approaches
    kinds = (BEGUN, STRUCK, HEAVIER) if impact else (MOVED_BY,)

    def run(what: int, by: float, *directions: tuple[int, int]) -> Motion:
        there = plan(scene, with_change(drive, what, by), time - by * (what == BEGUN))
        asked = np.array(directions, np.int64).reshape(-1, 2)
        given = scene.arrays.rows, scene.arrays.heights, 1e-12
        return there.run(*given, directions=asked)

    got = run(0, 0.0, *((-1, what) for what in kinds))
    events = [0.0 if impact else -1.0, got.contact_end, *got.switches[:, 0]]
    near = np.abs(time[:, None] - np.array([events])) < 4e-3 * time[-1]
    away = ~near.any(axis=1)
    assert away.mean() > 0.8
    for k, what in enumerate(kinds):
        step = 2e-5 * SIZES[what]
        wanted = differences(partial(run, what), step)
        for name, expected in zip(("displacement", "base_stress"), wanted, strict=True):
            off = np.abs(getattr(got.slopes, name)[k] - expected)[..., away]
            if (what, name) == (MOVED_BY, "displacement"):
                off = off[:-1]  # the top is prescribed
            scale = float(np.ptp(getattr(got, name))) / SIZES[what]
            assert np.all(off <= 1e-6 * max(float(np.ptp(expected)), scale)), (what, name)


def test_a_dashpot_of_zero_has_a_sensitivity() -> None:
    """The one-sided derivative at η = 0, in all springs and at the top."""
    for springs, drive in (([BISTABLE], IMPACT), (PAIR, IMPACT), ([BISTABLE], MOTION)):
        scene = chain(springs)
        names = [f"s{i}_eta" for i in range(1, len(springs) + 1)] + ["site_eta"]
        got = ff.simulate(scene, drive, TIME, 1e-12, sensitivities=names)
        for name in names:
            other = ff.simulate(with_value(scene, name, 1e-2), drive, TIME, 1e-12)
            events = [*got.switches[:, 0], *([got.contact_end] if got.contact_end else [])]
            near = np.abs(TIME[:, None] - np.array([events])) < 1e-2 * TIME[-1]
            away = ~near.any(axis=1)
            away[0] = False  # a light dashpot causes a short transient at first contact
            expected = (other.base_stress - got.base_stress) / 1e-2
            miss = np.abs(got.sensitivities[name].base_stress - expected)[away]
            assert miss.max() <= 2e-3 * max(np.abs(expected).max(), 1e-300), (name, drive)


def test_sensitivities_do_not_change_the_response() -> None:
    for scene, drive in STIFF.values():
        if drive is FEW["moved"]:  # slow, and another scene has a prescribed motion
            continue
        alone = ff.simulate(scene, drive, SPARSE)
        got = ff.simulate(scene, drive, SPARSE, sensitivities=names_of(scene))
        np.testing.assert_array_equal(got.displacement, alone.displacement)
        np.testing.assert_array_equal(got.base_stress, alone.base_stress)
        assert got.contact_end == alone.contact_end


def test_a_name_that_is_no_parameter_is_refused() -> None:
    for name in ("s2_k0", "kc", "s1_kx", "s1_kc ", ""):
        with pytest.raises(ValueError, match="is not a parameter of this chain"):
            ff.simulate(chain([BISTABLE]), IMPACT, TIME, sensitivities=[name])
