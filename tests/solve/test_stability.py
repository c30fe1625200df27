"""A seeded subset of experiments/stability: stiff and extreme scenes, and the judges."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
import fresh
import independent
from foamfit.solve import simulation
from foamfit.solve.plan import Motion, plan
from scenes import HISTORIES, Point, designed, scene_of

RTOL = 1e-6
# Random scenes, by number: some with former errors and some without.
FRESH = {
    "study": (4, 5, 11, 14, 16, 17, 18, 19),
    "base": (7, 20, 27, 31, 43, 44, 73, 55, 115),
    "gap": (1, 2, 9, 11, 13, 19, 21, 29, 4, 5),
    "turns": (1, 4, 6, 8, 11),
    "long": (0, 13, 14, 24),
}


def ended(point: Point) -> tuple[ff.Response | None, str]:
    """Return the response of a scene, which must be finite, or the message of the refusal."""
    try:
        answer = ff.simulate(*scene_of(point), rtol=RTOL)
    except ff.SimulationError as refusal:
        return None, str(refusal)
    assert np.isfinite(answer.displacement).all()
    assert np.isfinite(answer.base_stress).all()
    return answer, ""


def bare(point: Point, rtol: float, implicit: bool | None) -> Motion:
    """Run a scene once, without the check of `simulate` with shorter steps."""
    chain, drive, time = scene_of(point)
    made = plan(chain, drive, time).changed(implicit=implicit)
    return made.run(chain.arrays.rows, chain.arrays.heights, rtol)


def difference(one: ff.Response | Motion, other: ff.Response | Motion) -> float:
    """Return the largest difference of displacement or base stress, relative to its range."""
    return max(
        independent.over_range(one.displacement, other.displacement),
        independent.over_range(one.base_stress, other.base_stress),
    )


def judge(point: Point, answer: ff.Response) -> None:
    """Compare a response with shorter steps and, where affordable, with brute force."""
    if answer.steps:
        finer = (  # the finer one only if the first is not resolved
            bare(point, fine * RTOL, implicit=answer.method == "Radau IIA") for fine in (1e-2, 1e-4)
        )
        resolved = (motion for motion in finer if motion.unresolved <= RTOL)
        assert any(difference(answer, motion) <= RTOL for motion in resolved), point
    truth = independent.judge(*scene_of(point), 180_000)
    if not truth.why and truth.unsure <= 0.1 * RTOL:
        assert difference(answer, truth) <= RTOL, point


def cheap(point: Point) -> bool:
    """Return whether a scene takes less than a second; the study covers the others."""
    vibration = (point.mass > 0.0 and point.springs > 1) or point.top_mass > 0.0
    rings = vibration and point.drive == "stress" and not (point.eta or point.site_eta)
    return point.springs <= (1 if vibration else 8) and point.samples <= 300 and not rings


HIT = Point(velocity=3.0)
TWO = Point(kinds="unilateral+bistable", springs=2, eta=10.0, mass=5e-6, velocity=3.0)
PRESSED = Point(drive="stress", springs=2, eta=100.0, duration=100.0)
WEIGHED = Point(drive="stress", top_mass=5e-6, site_eta=10.0)
MOVED = Point(drive="displacement", springs=3, eta=10.0, duration=100.0)
DAMPERS = (0.0, 1e-6, 1e6, 1e7, 1e8)
SWEEPS = {  # two scenes at the low end of an axis, and three at the high one
    "kc_ratio": (1.0, 10.0, 1e3, 1e4, 1e5), "dsigma_ratio": (-0.99, -0.98, -0.5, -1e-6, 0.0),
    "kh_plus_ratio": (0.0, 1e-6, 0.1, 10.0, 100.0), "eta": DAMPERS, "site_eta": DAMPERS,
    "kh_minus_ratio": (0.0, 1e-6, 0.1, 10.0, 100.0), "velocity": (1e-3, 1e-2, 30.0, 60.0, 100.0),
    "height": (1e-6, 1e-5, 1e-2, 0.1, 1.0),
}  # fmt: skip
ENDS = {axis: [replace(HIT, **{axis: one}) for one in given] for axis, given in SWEEPS.items()} | {
    "mass": [replace(TWO, mass=0.0)],
    "springs": [HIT, replace(TWO, springs=1), *(replace(HIT, springs=n) for n in (2, 5))],
    "samples": [
        *(replace(one, samples=5) for one in (HIT, PRESSED)),
        *(replace(one, samples=100) for one in (PRESSED, WEIGHED, MOVED)),
    ],
    "history": [replace(one, history=own) for own in HISTORIES for one in (PRESSED, MOVED)],
}


@pytest.mark.parametrize("part", range(4))
def test_designed_scenes(part: int) -> None:
    points = [point for point in designed(240, seed=11) if cheap(point)][part::4]
    assert len(points) >= 25
    answered = 0
    for point in points:
        answer, why = ended(point)
        assert (answer is None) == bool(why)
        if answer is not None and answer.steps < 5000:
            judge(point, answer)
            answered += 1
    assert answered >= 0.8 * len(points)


@pytest.mark.parametrize("axis", ENDS)
def test_to_the_end_of_an_axis(axis: str) -> None:
    for point in ENDS[axis]:
        answer, _ = ended(point)
        if answer is not None and answer.steps < 3000:
            judge(point, answer)


def test_a_strain_at_the_end_of_its_branch_is_refused() -> None:
    _, why = ended(Point(velocity=100.0))  # a peak of 1e-15 s, between two samples
    assert "comes within" in why
    assert "of the end of its branch" in why


@pytest.mark.parametrize("rtol", [RTOL, 1e-11])  # also where no steps can be shorter
def test_a_chaotic_motion_is_refused(rtol: float) -> None:
    point = Point(drive="displacement", springs=8, mass=1e-6, samples=401, kc_ratio=1e3)
    with pytest.raises(ff.SimulationError, match="vibrations amplify the smallest error"):
        ff.simulate(*scene_of(point), rtol=rtol)
    calm, _ = ended(replace(point, eta=1e3))
    assert calm is not None


def test_vibrations_that_cannot_be_followed_are_refused_by_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    point = Point(springs=2, kinds="unilateral+bistable", mass=1e-12, velocity=4.0)
    chain, drive, time = scene_of(point)
    motion = plan(chain, drive, time).run(*chain.arrays[:2], 1e-9)
    assert motion.method == "Radau IIA"
    assert 1e-9 < motion.unresolved < 1e-2
    few = plan(chain, drive, time, max_steps=20_000)  # too few for explicit steps
    with monkeypatch.context() as patch:
        patch.setattr(simulation, "plan", lambda *_, **__: few)
        with pytest.raises(ff.SimulationError, match="use an rtol no smaller") as refusal:
            ff.simulate(chain, drive, time, rtol=1e-9)
    assert f"{motion.unresolved:.1g}" in str(refusal.value)
    massless = ff.Chain(chain.springs, chain.heights, chain.area)  # no vibration
    want = ff.simulate(massless, drive, time, rtol=1e-9)
    assert difference(motion, want) <= motion.unresolved


def test_a_light_onsite_damper_beside_heavy_dashpots() -> None:
    """Cancellation spoils the velocity of the top in explicit steps: implicit ones are chosen."""
    point = Point(drive="stress", eta=1e6, site_eta=1e-5, height=0.25, samples=21)
    answer, _ = ended(point)
    assert answer is not None
    assert answer.method == "Radau IIA"
    without = ff.simulate(*scene_of(replace(point, site_eta=0.0)), rtol=RTOL)
    assert difference(answer, without) <= 1e-9  # the damper carries 1e-11 of the stress


def test_the_layer_after_a_jump_of_the_velocity_is_passed() -> None:
    """Heavy dashpots stop light masses within 1e-20 s after each sample, below an ulp of time."""
    point = Point(drive="displacement", springs=4, eta=1e7, mass=2e-12, height=5e-6, samples=5)
    answer, why = ended(point)
    assert answer is not None, why
    free = ff.simulate(*scene_of(replace(point, mass=0.0)), rtol=RTOL)
    # Base stress jumps at samples: without masses it is the mean of both sides, with masses the
    # value before the jump.
    np.testing.assert_allclose(
        answer.displacement, free.displacement, rtol=0, atol=RTOL * free.displacement.max()
    )


def test_contact_lasts_until_the_blow_has_come_through() -> None:
    """Before the wave reaches the base of a long chain, the stress there is only rounding."""
    point = replace(TWO, springs=100)
    explicit, implicit = bare(point, 1e-8, implicit=False), bare(point, 1e-5, implicit=True)
    assert explicit.contact_end == pytest.approx(implicit.contact_end, rel=1e-5)
    miss = np.abs(explicit.base_stress - implicit.base_stress).max()
    assert miss <= 1e-4 * explicit.base_stress.max()


def test_nothing_presses_behind_an_open_gap() -> None:
    """Behind an open gap, base stress and its sensitivities are zero."""
    item = ff.published["foam-2"]
    chain = ff.Chain(item.chain.springs, item.chain.heights, item.chain.area)
    time = np.linspace(0.0, 1e-3, 101)
    motion = np.interp(time, [0.0, 5e-4, 1e-3], [0.0, 0.55 * chain.height, -1e-5])
    names = ("s1_k0", "s2_k0", "s1_height")
    answer = ff.simulate(chain, ff.DisplacementDrive(motion), time, sensitivities=names)
    assert answer.base_stress[-1] == 0.0
    for name in names:
        assert answer.sensitivities[name].base_stress[-1] == 0.0


@pytest.mark.parametrize("family", FRESH)
def test_fresh_scenes(family: str) -> None:
    judged = 0
    for number in FRESH[family]:
        for line in fresh.lines_of((family, number, (1e-6,)), 100_000):
            if line["judge"] != "judged":
                continue
            judged += 1
            assert line["outcome"] in ("answer", "refused"), line
            if line["outcome"] == "answer":
                assert line["error"] <= 1.0, line
    assert judged >= 0.6 * len(FRESH[family])
