"""A seeded part of experiments/stability: stiff and extreme scenes, and the judges themselves."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS
from foamfit.solve import simulation
from foamfit.solve.plan import plan

sys.path.insert(0, str(EXPERIMENTS / "stability"))
import fresh
import independent
import judges
import scenes
from scenes import Point, designed, scene_of, swept

RTOL = 1e-6
# Dashpot of S1 (Pa·s), mass above it (kg) and window (s) of the published foam-2 chain.
FOAM_2 = [(4.4e5, 1.05e-4, 1.16e-5), (8.1e5, 4.7e-4, 1.34e-5), (2.3e5, 5.4e-4, 1.96e-4),
          (8.2e4, 6.9e-4, 9.2e-4), (3e3, 5e-6, 6e-4)]  # fmt: skip
# Fresh scenes that were wrong, and some that were not.
FRESH = {
    "study": (4, 5, 11, 14, 16, 17, 18, 19),
    "base": (7, 20, 27, 31, 43, 44, 73, 55, 115),
    "gap": (1, 2, 9, 11, 13, 19, 21, 29, 4, 5),
    "turns": (1, 4, 6, 8, 11),
    "long": (0, 13, 14, 24),
}


def ended(point: Point) -> tuple[ff.Response | None, str]:
    """Answer of a scene, or why there is none; an answer holds only what is finite."""
    try:
        answer = ff.simulate(*scene_of(point), rtol=RTOL)
    except ff.SimulationError as refusal:
        return None, str(refusal)
    assert np.isfinite(answer.displacement).all()
    assert np.isfinite(answer.base_stress).all()
    return answer, ""


def judge(point: Point, answer: ff.Response) -> None:
    """Hold an answer to shorter steps, and to the balance of energy where that is affordable."""
    scene = scene_of(point)
    if answer.steps:
        implicit = answer.method == "Radau IIA"
        miss = judges.refined(scene, answer, RTOL, implicit=implicit, most=200_000)
        assert miss is not None
        assert miss <= RTOL, point
    balance = judges.balance_of(scene, answer, RTOL)
    if balance is not None:
        assert max(balance.energy, balance.impulse) <= 10.0 * RTOL, point


def cheap(point: Point) -> bool:
    """Leave to the study what takes a second or more."""
    vibration = (point.mass > 0.0 and point.springs > 1) or point.top_mass > 0.0
    rings = vibration and point.drive == "stress" and not (point.eta or point.site_eta)
    return point.springs <= (1 if vibration else 8) and point.samples <= 300 and not rings


# ------------------------------------------------------------------------------------- the scenes


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


AXES = ("kc_ratio", "dsigma_ratio", "kh_plus_ratio", "kh_minus_ratio", "mass", "eta", "site_eta")
AXES += ("velocity", "height", "springs", "samples", "history")


@pytest.mark.parametrize("axis", AXES)
def test_to_the_end_of_an_axis(axis: str) -> None:
    points = [point for name, point in swept() if name == axis and cheap(point)]
    ends = sorted(points, key=lambda p: getattr(p, axis))
    ends = [*ends[:2], *ends[-3:]]
    for point in ends:
        answer, _ = ended(point)
        if answer is not None and answer.steps < 3000:
            judge(point, answer)


# ----------------------------------------------------------------------------------- the refusals


def test_a_strain_at_the_end_of_its_branch_is_refused() -> None:
    _, why = ended(Point(velocity=100.0))  # a peak of 1e-15 s, between two samples
    assert "comes within" in why
    assert "of the end of its branch" in why


def test_a_chaotic_motion_is_refused() -> None:
    point = Point(drive="displacement", springs=8, mass=1e-6, samples=401, kc_ratio=1e3)
    _, why = ended(point)
    assert "vibrations let the least error grow" in why
    calm, _ = ended(dataclasses.replace(point, eta=1e3))
    assert calm is not None


def test_vibrations_that_cannot_be_followed_are_refused_by_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    point = Point(springs=2, kinds="unilateral+bistable", mass=1e-12, velocity=4.0)
    chain, drive, time = scene_of(point)
    rows = np.array([spring.row for spring in chain.springs])
    motion = plan(chain, drive, time).run(rows, np.array(chain.heights), 1e-9)
    assert motion.method == "Radau IIA"
    assert 1e-9 < motion.unresolved < 1e-2
    few = plan(chain, drive, time, max_steps=20_000)  # explicit: not enough
    with monkeypatch.context() as patch:
        patch.setattr(simulation, "plan", lambda *_, **__: few)
        with pytest.raises(ff.SimulationError, match="ask for no smaller rtol") as refusal:
            ff.simulate(chain, drive, time, rtol=1e-9)
    assert f"{motion.unresolved:.1g}" in str(refusal.value)
    massless = ff.Chain(chain.springs, chain.heights, chain.area)  # without any vibration
    want = ff.simulate(massless, drive, time, rtol=1e-9)
    assert judges.difference(motion, want) <= motion.unresolved


def test_damped_out_vibrations_are_accounted_for() -> None:
    """What implicit steps lose is inside what they say they lose."""
    point = Point(drive="displacement", springs=3, eta=10.0, mass=scenes.STRIKER, samples=101,
                  duration=25.0)  # fmt: skip
    right = judges.bare(scene_of(point), 1e-10, implicit=False)
    got = judges.bare(scene_of(point), RTOL, implicit=True)
    miss = judges.difference(got, right)
    assert miss <= got.unresolved + 10.0 * RTOL


def test_a_light_onsite_damper_beside_heavy_dashpots() -> None:
    """Explicit steps lose the velocity of the top to cancellation: implicit ones are chosen."""
    point = Point(drive="stress", eta=1e6, site_eta=1e-5, height=0.25, samples=21)
    answer, _ = ended(point)
    assert answer is not None
    assert answer.method == "Radau IIA"
    without = ff.simulate(*scene_of(dataclasses.replace(point, site_eta=0.0)), rtol=RTOL)
    assert judges.difference(answer, without) <= 1e-9  # the damper carries 1e-11 of the stress


def test_the_layer_after_a_jump_of_the_velocity_is_passed() -> None:
    """Heavy dashpots stop light masses in 1e-20 s at each sample: shorter than a clock can tell."""
    point = Point(drive="displacement", springs=4, eta=1e7, mass=2e-12, height=5e-6, samples=5)
    answer, why = ended(point)
    assert answer is not None, why
    free = ff.simulate(*scene_of(dataclasses.replace(point, mass=0.0)), rtol=RTOL)
    # at a sample the massless base stress is the mean of both sides, that of a mass the one before
    np.testing.assert_allclose(
        answer.displacement, free.displacement, rtol=0, atol=RTOL * free.displacement.max()
    )


@pytest.mark.parametrize("implicit", [True, False])
def test_a_single_sample_of_a_stress(implicit: bool) -> None:
    chain = ff.Chain([scenes.spring_of(Point(eta=10.0))] * 2, [1e-3, 1e-3], 1e-5)
    scene = (chain, ff.StressDrive([1e5]), np.zeros(1))
    assert judges.bare(scene, RTOL, implicit).base_stress == pytest.approx([1e5])


# ------------------------------------------------------------------------------------- the judges


def test_the_judges_see_a_wrong_answer() -> None:
    """A law that is 0.1 % off, a force that is 0.1 % off and a motion that is 0.1 % off."""
    point = Point(springs=2, kinds="linear+bistable", eta=100.0, velocity=3.0)
    scene = scene_of(point)
    drive = scene[1]
    assert isinstance(drive, ff.Impact)
    answer = ff.simulate(*scene, rtol=RTOL)
    fair = judges.balance_of(scene, answer, RTOL)
    assert fair is not None
    assert max(fair.energy, fair.impulse) <= 1e-6
    stop = float(answer.switches[0, 0])  # so far on first branches
    ends = np.linspace(0.0, stop * (1.0 - 1e-12), 60)
    inner = ends[:-1, None] + np.diff(ends)[:, None] * judges.NODES[None, :-1]
    grid = np.append(inner.ravel(), ends[-1])
    motion = judges.bare((scene[0], scene[1], grid), RTOL)
    right = judges.motion_balance(scene[0], scene[1], ends, motion)
    assert max(right.energy, right.impulse) < 1e-7
    other = scene_of(dataclasses.replace(point, k0=point.k0 * 1.001))[0]
    assert judges.motion_balance(other, scene[1], ends, motion).impulse > 5e-4
    stronger = motion._replace(base_stress=1.001 * motion.base_stress)
    assert judges.motion_balance(scene[0], scene[1], ends, stronger).impulse > 5e-4
    quicker = ff.Impact(drive.mass, 1.001 * drive.velocity)
    assert judges.motion_balance(scene[0], quicker, ends, motion).energy > 1e-6
    further = motion._replace(displacement=1.1 * motion.displacement)
    assert judges.motion_balance(scene[0], scene[1], ends, further).energy > 1e-4
    coarse = dataclasses.replace(answer, base_stress=answer.base_stress * (1.0 + 1e-5))
    miss = judges.refined(scene, coarse, RTOL, implicit=False, most=200_000)
    assert miss is not None
    assert miss > RTOL


def test_the_ripple_that_long_steps_pass_over_is_seen() -> None:
    """By the judge in closed form, and by the solver itself; with a light dashpot there is none."""
    point = Point(springs=2, kinds="unilateral+bistable", mass=1e-12, velocity=3.0)
    motion = judges.bare(scene_of(point), RTOL, implicit=True)
    ripple = judges.ripple_of(scene_of(point), motion, RTOL)
    assert ripple is not None
    assert RTOL < ripple <= motion.unresolved
    calm = dataclasses.replace(point, eta=0.1)
    answer, _ = ended(calm)
    assert answer is not None
    assert answer.method == "Radau IIA"
    assert judges.ripple_of(scene_of(calm), answer, RTOL) == pytest.approx(0.0, abs=1e-12)


def test_the_judges_work_is_that_of_the_law() -> None:
    spring = scenes.spring_of(Point())
    loop = np.interp(np.linspace(0, 2, 40_001), [0, 1, 2], [0.0, 0.75, 0.0])
    stress = spring.stress(loop)
    want = np.concatenate(([0.0], np.cumsum(0.5 * (stress[1:] + stress[:-1]) * np.diff(loop))))
    np.testing.assert_allclose(judges.work_of(spring, loop), want, atol=1e-7 * want.max())


def test_contact_lasts_until_the_blow_has_come_through() -> None:
    """Before it reaches the base of a long chain, only rounding presses there."""
    point = next(p for _, p in swept() if p.springs == 100 and p.kinds == "unilateral+bistable"
                 and p.drive == "impact" and p.mass > 0.0)  # fmt: skip
    chain, drive, time = scene_of(point)
    scene = plan(chain, drive, time)
    arrays = chain.arrays
    explicit = scene._replace(implicit=False).run(arrays.rows, arrays.heights, 1e-8)
    implicit = scene._replace(implicit=True).run(arrays.rows, arrays.heights, 1e-5)
    assert explicit.contact_end == pytest.approx(implicit.contact_end, rel=1e-5)
    miss = np.abs(explicit.base_stress - implicit.base_stress).max()
    assert miss <= 1e-4 * explicit.base_stress.max()


# --------------------------------------------------------------------------------- fresh scenes


def against_brute_force(
    chain: ff.Chain, drive: ff.Impact | ff.DisplacementDrive, time: np.ndarray, rtol: float
) -> tuple[ff.Response, independent.Truth]:
    """Hold an answer against the judge that shares nothing with the solver."""
    truth = independent.judge(chain, drive, time)
    assert not truth.why
    assert truth.unsure <= 0.1 * rtol
    answer = ff.simulate(chain, drive, time, rtol=rtol)
    assert independent.over_range(answer.displacement, truth.displacement) <= rtol
    assert independent.over_range(answer.base_stress, truth.base_stress) <= rtol
    return answer, truth


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_a_base_dashpot_under_a_mass(rtol: float) -> None:
    bistable = ff.BistableSpring(7.55e5, 2.87e7, -2.83e4, 0.129, 0.332, 1.45e6, 1.8e5)
    springs = [ff.LinearSpring(1.28e6, eta=1.25e5), bistable]
    chain = ff.Chain(springs, [0.352e-3, 0.338e-3], 2.7e-5, [5.24e-4, 0.0])
    scene = (chain, ff.Impact(1.05e-3, 0.964), np.linspace(0.0, 4.71e-4, 400))
    answer, truth = against_brute_force(*scene, rtol)
    assert answer.contact_end == pytest.approx(truth.contact_end, rel=3.0 * rtol)


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_contact_does_not_end_as_it_begins(rtol: float) -> None:
    bistable = ff.BistableSpring(15.1e6, 311e6, -1.23e6, 0.106, 0.307, 104e6, 5.93e6)
    springs = [ff.LinearSpring(7.59e6, eta=1.94e5), bistable]
    chain = ff.Chain(springs, [0.313e-3, 1.29e-3], 1.18e-5, [5.13e-7, 0.0])
    scene = (chain, ff.Impact(7e-3, 2.9), np.linspace(0.0, 4e-7, 101))
    answer, _ = against_brute_force(*scene, rtol)
    assert answer.contact_end is None


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize(("eta", "mass", "stop"), FOAM_2)
def test_the_base_dashpot_of_foam_2(eta: float, mass: float, stop: float, rtol: float) -> None:
    item = ff.published["foam-2"]
    base, top = item.chain.springs
    chain = ff.Chain([dataclasses.replace(base, eta=eta), top], item.chain.heights,
                     item.chain.area, [mass, 0.0])  # fmt: skip
    drive = ff.Impact(item.striker_mass, item.striker_velocity)
    against_brute_force(chain, drive, np.linspace(0.0, stop, 151), rtol)


def test_nothing_presses_behind_an_open_gap() -> None:
    """Nor does a parameter move the base stress there."""
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
