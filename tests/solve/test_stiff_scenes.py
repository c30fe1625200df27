"""The implicit integrator: its order, and its results against other solvers and limits."""

from itertools import pairwise

import numpy as np
import pytest
from test_simulation import (
    AREA,
    BASE_2,
    BASE_3,
    CASES,
    CHAINS,
    FOAM_1,
    FOAM_2,
    MODEL_1,
    THREE,
    TIME,
    TOP_2,
    TOP_3,
    TWO,
    case,
    damped,
    errors,
    history,
)

import foamfit as ff
from foamfit.solve.plan import EXPLICIT_STEPS, RADAU, Motion, plan
from foamfit.springs.chain import Drive

PAIRS = {"model-3": (BASE_3, TOP_3, THREE, FOAM_1), "foam-2": (BASE_2, TOP_2, TWO, FOAM_2)}


def run(
    chain: ff.Chain, load: Drive, rtol: float, implicit: bool | None = True, time: np.ndarray = TIME
) -> Motion:
    """Run a scene with implicit or explicit steps (None: chosen by the package)."""
    scene = plan(chain, load, time).changed(implicit=implicit)
    return scene.run(chain.arrays.rows, chain.arrays.heights, rtol)


def struck(name: str, eta: float = 0.0, mass: float = 0.0) -> tuple[ff.Chain, ff.Impact]:
    base, top, heights, blow = PAIRS[name]
    springs = (damped(base, eta), damped(top, eta))
    return ff.Chain(springs, heights, AREA, (mass, 0.0)), blow


def integrated(name: str, drive: str) -> bool:
    """Return whether a case needs an integrator; an undamped chain in equilibrium does not."""
    chain = CHAINS[name]
    masses = (chain.masses or ()) if drive == "stress" else (chain.masses or ())[:-1]
    dashpots = any(spring.eta for spring in chain.springs)
    alone = drive == "displacement" and len(chain.springs) == 1
    onsite = chain.site_damping > 0.0 and drive == "stress"
    return drive.endswith("impact") or any(masses) or onsite or (dashpots and not alone)


def rings(name: str) -> bool:
    """Return whether a mass vibrates undamped, which takes many slow implicit steps."""
    return (", mass" in name and "dashpot" not in name) or "own mass" in name


CALM = [item for item in CASES if integrated(*item) and not rings(item[0])]
RINGING = [("foam-2, mass", "impact"), ("model-3, mass", "impact")]


@pytest.mark.parametrize(
    ("name", "drive", "rtol", "bar"),
    [(*item, 1e-6, 1e-6) for item in (*CALM, *RINGING)] + [(*item, 1e-9, 1e-8) for item in CALM],
)
def test_against_reference(name: str, drive: str, rtol: float, bar: float) -> None:
    want, load = case(name, drive)
    got = run(CHAINS[name], load, rtol)
    assert max(errors(got, want)) <= bar
    assert got.method == RADAU
    usual = ff.simulate(CHAINS[name], load, TIME, rtol=rtol)
    assert len(got.switches) >= len(usual.switches)
    if want.contact_end is not None:
        assert got.contact_end == pytest.approx(want.contact_end, rel=bar)
    assert got.steps < 3000


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("eta", [1e6, 1e4, 100.0, 1.0])
@pytest.mark.parametrize(("rtol", "bar"), [(1e-6, 1e-8), (1e-9, 1e-10)])
def test_dashpots_like_explicit_steps(name: str, eta: float, rtol: float, bar: float) -> None:
    scene = struck(name, eta)
    want = run(*scene, 1e-11, implicit=False)
    got = run(*scene, rtol)
    assert max(errors(got, want)) <= bar
    # with heavy dashpots the striker separates so slowly that explicit steps are no more accurate
    assert got.contact_end == pytest.approx(want.contact_end, rel=bar if eta < 1e6 else 1e-4)
    assert got.steps < 1000


def test_flat_branch_under_stress_is_refused() -> None:
    flat = ff.BistableSpring(2e6, 60e6, -0.3e6, 0.35, 0.66, 0.0, 0.0)
    chain = ff.Chain((damped(BASE_3, 100.0), flat), THREE, AREA)
    load = ff.StressDrive(history() * 3e6)
    for choice in (True, False):
        with pytest.raises(ff.SimulationError, match="flat branch"):
            run(chain, load, 1e-6, implicit=choice)


@pytest.mark.parametrize("name", PAIRS)
def test_light_dashpots_tend_to_none(name: str) -> None:
    limit = run(*struck(name), 1e-10, implicit=False)
    miss = []
    for eta in (1.0, 1e-2, 1e-4, 1e-6):
        got = run(*struck(name, eta), 1e-9, implicit=None)
        assert got.method == RADAU
        assert got.steps < 500
        miss.append(max(errors(got, limit)))
    for more, less in pairwise(miss):  # linear in eta
        assert less == pytest.approx(0.01 * more, rel=0.2)
    got = run(*struck(name, 1e-8), 1e-9, implicit=None)
    assert max(errors(got, limit)) <= 1e-9
    assert got.contact_end == pytest.approx(limit.contact_end, rel=1e-9)


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("mass", [1e-12, 1e-14, 1e-20])
def test_light_masses_tend_to_none(name: str, mass: float) -> None:
    limit = run(*struck(name), 1e-10, implicit=False)
    got = run(*struck(name, mass=mass), 1e-6, implicit=None)
    assert got.method == RADAU
    assert got.steps < 2000
    assert max(errors(got, limit)) <= 1e-6
    assert got.contact_end == pytest.approx(limit.contact_end, rel=1e-6)


@pytest.mark.parametrize("mass", [1e-14, 1e-12, 1e-10])
def test_the_vibration_that_steps_pass_over_is_owned_up_to(mass: float) -> None:
    """Steps of 100 radians report the amplitude in closed form of a mass between two springs."""
    chain, blow = struck("foam-2", mass=mass)
    below, above = (s.k0 / h for s, h in zip(chain.springs, chain.heights, strict=True))
    rate = np.sqrt((below + above) / (mass / AREA))
    time = np.linspace(0.0, 5000.0 / rate, 41)
    got = run(chain, blow, 1e-1, time=time)
    assert got.steps <= 10
    speed = blow.velocity * above / (below + above)  # mean velocity of the mass, initially 0
    ripple = below * speed / rate
    assert got.unresolved * got.base_stress.max() == pytest.approx(ripple, rel=0.01)
    want = run(chain, blow, 1e-8, implicit=False, time=time)
    miss = np.abs(got.base_stress - want.base_stress).max()
    assert miss == pytest.approx(ripple, rel=0.01)


@pytest.mark.parametrize("eta", [0.0, 1e-3])
def test_vibration_that_is_lost_is_refused_or_followed(eta: float) -> None:
    chain, blow = struck("foam-2", eta, 1e-11)
    time = np.linspace(0.0, 6e-5, 41)
    want = run(chain, blow, 1e-10, implicit=False, time=time)
    got = run(chain, blow, 1e-6, time=time)
    miss = errors(got, want)[1]
    assert miss <= got.unresolved + 1e-6
    if eta > 0.0:  # it decays within a few hundred steps
        assert miss <= 1e-6
    else:
        assert got.unresolved > 1e-6
    answer = ff.simulate(chain, blow, time)
    assert np.abs(answer.base_stress - want.base_stress).max() <= 1e-6 * np.ptp(want.base_stress)


@pytest.mark.parametrize("eta", [1e6, 1e7, 1e8])
def test_contact_with_heavy_dashpots_ends_as_in_closed_form(eta: float) -> None:
    """m w″ + c w′ + k w = 0: the base stress -m w″ is zero at 2 ln(b/a)/(b - a)."""
    spring, height, blow = ff.LinearSpring(5.5e6, eta), 1.19e-3, ff.Impact(7e-3, 1.75)
    m, c, k = blow.mass / AREA, eta / height, spring.k0 / height
    b = 0.5 * (c + np.sqrt(c * c - 4.0 * m * k)) / m
    a = k / (m * b)
    end = 2.0 * np.log(b / a) / (b - a)
    chain = ff.Chain((spring,), (height,), AREA)
    for choice in (True, None):  # None: also where explicit steps could manage a short history
        got = run(chain, blow, 1e-6, implicit=choice, time=np.linspace(0.0, 3.0 * end, 31))
        assert got.contact_end == pytest.approx(end, rel=1e-7)
        assert got.steps < 400


def test_the_choice() -> None:
    blow = ff.Impact(7e-3, 1.75)
    methods = {
        name: ff.simulate(CHAINS[name], blow, TIME).method
        for name in ("model-1", "model-2, dashpot", "model-3", "model-3, mass", "foam-2, mass")
    }
    assert set(methods.values()) == {EXPLICIT_STEPS}
    still = ff.simulate(CHAINS["model-3"], ff.StressDrive(0.0 * TIME), TIME)
    assert still.method == "closed form"
    light = struck("foam-2", mass=1e-12)  # its vibration is 1e-5 of the base stress
    for scene, rtol in (
        (struck("foam-2", 1e-2), 1e-6),
        (light, 1e-4),
        (struck("model-3", 1e8), 1e-6),
    ):
        got = ff.simulate(scene[0], scene[1], TIME, rtol)
        assert got.method == RADAU
        assert got.steps < 1000
        assert got.solver == "second order"


def test_the_bound_on_steps() -> None:
    chain, load = struck("foam-2", 1e-2)
    few = plan(chain, load, TIME, max_steps=5).changed(implicit=True)
    with pytest.raises(ff.SimulationError, match="bound of 5 steps"):
        few.run(chain.arrays.rows, chain.arrays.heights, 1e-6)


@pytest.mark.parametrize("implicit", [True, False])
def test_a_switch_shortly_before_the_end_of_contact_is_found(implicit: bool) -> None:
    """Whatever the steps: a gap at the base opens in the same step as a spring leaves branch c."""
    want, blow = case("foam-2", "impact")
    for rtol in np.geomspace(1e-4, 1e-10, 25):
        got = run(CHAINS["foam-2"], blow, rtol, implicit)
        assert got.switches[:, 1:4].tolist() == [[1, 0, 1], [1, 1, 2], [1, 2, 3]]
        assert got.contact_end == pytest.approx(want.contact_end, rel=100.0 * rtol)


def long_chain(n: int, kind: str) -> ff.Chain:
    eta = 1.0 if kind == "damped" else 0.0
    springs = [damped((MODEL_1, TOP_3)[i % 2], eta) for i in range(n)]
    masses = (1e-12,) * (n - 1) + (0.0,) if kind == "masses" else None
    return ff.Chain(springs, (1.19e-3 / n,) * n, AREA, masses)


@pytest.mark.parametrize("kind", ["massless", "damped", "masses"])
def test_a_long_chain_behaves_as_a_short_one(kind: str) -> None:
    """Alternating springs of equal heights represent the same foam for any number of springs."""
    found = []
    for n in (20, 100):
        got = run(long_chain(n, kind), ff.Impact(7e-3, 2.0), 1e-5)
        assert len(got.switches) == 2 * n
        assert got.steps < 3000
        found.append((got.contact_end, got.base_stress.max()))
    rel = 1e-3 if kind == "masses" else 1e-6
    assert found[1] == pytest.approx(found[0], rel=rel)
