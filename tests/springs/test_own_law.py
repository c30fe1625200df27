"""User-defined laws: registration from a file, refusals, simulation and fits."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import foamfit as ff
from foamfit.springs import kernels, laws
from foamfit.springs.laws import Law, followed

FILE = Path(__file__).parents[2] / "notebooks" / "bouc_wen.py"
VALUES = (2e6, 0.3, 0.1, 1.5, 0.0)
HEIGHT, AREA = 1e-2, 1e-3


@pytest.fixture(scope="module")
def bouc_wen() -> Iterator[Law]:
    before = dict(laws._LAWS)
    (law,) = laws.load_file(FILE)
    yield law
    laws._LAWS.clear()
    laws._LAWS.update(before)
    laws._TEXTS.clear()  # a new process would compile the laws again


def chain_of(spring: ff.springs.spring.Spring, **more: float) -> ff.Chain:
    return ff.Chain([spring], [HEIGHT], AREA, **more)


def by_hand(time: np.ndarray, strain_rate: object) -> np.ndarray:
    """Integrate the Bouc-Wen stress under a strain rate, a function of time, with SciPy."""
    k, alpha, limit, n, _ = VALUES

    def rhs(t: float, y: np.ndarray) -> list[float]:
        rate = strain_rate(t)  # type: ignore[operator]
        held = (abs(y[1]) / limit) ** n if y[1] * rate > 0 else 0.0
        return [rate, rate * (1.0 - held)]

    found = solve_ivp(rhs, (time[0], time[-1]), [0.0, 0.0], t_eval=time, rtol=1e-10, atol=1e-12,
                      max_step=time[-1] / 2000)  # fmt: skip
    return alpha * k * found.y[0] + (1.0 - alpha) * k * found.y[1]


def test_the_law_follows_a_motion_as_scipy_does(bouc_wen: Law) -> None:
    time = np.linspace(0.0, 1.0, 401)
    strain = 0.4 * np.sin(np.pi * time) ** 2
    drive = ff.DisplacementDrive(HEIGHT * strain)
    got = ff.simulate(chain_of(bouc_wen.make(VALUES, ())), drive, time)
    want = by_hand(time, lambda t: 0.4 * np.pi * np.sin(2.0 * np.pi * t))
    np.testing.assert_allclose(got.base_stress, want, rtol=0, atol=2e-5 * want.max())
    np.testing.assert_allclose(
        bouc_wen.make(VALUES, ()).strain(got.base_stress), strain, rtol=0, atol=1e-12
    )


def test_an_impact_agrees_with_scipy(bouc_wen: Law) -> None:
    k, alpha, limit, n, _ = VALUES
    mass, speed, time = 0.5, 2.0, np.linspace(0.0, 4e-3, 201)

    def rhs(_: float, y: np.ndarray) -> list[float]:
        w, v, z = y
        held = (abs(z) / limit) ** n if z * v > 0 else 0.0
        stress = alpha * k * w / HEIGHT + (1.0 - alpha) * k * z
        return [v, -stress * AREA / mass, v / HEIGHT * (1.0 - held)]

    want = solve_ivp(rhs, (0.0, time[-1]), [0.0, speed, 0.0], t_eval=time, rtol=1e-10, atol=1e-14,
                     max_step=2e-6)  # fmt: skip
    got = ff.simulate(chain_of(bouc_wen.make(VALUES, ())), ff.Impact(mass, speed), time)
    np.testing.assert_allclose(got.displacement[0], want.y[0], rtol=0, atol=3e-6 * want.y[0].max())


def _either(values, row):  # type: ignore[no-untyped-def]
    if values[0] > 0.0:
        return kernels.fill_microscale(values[1:], row)
    return kernels.fill_bistable(values[1:], row)


PAPERS = {"bistable": laws.bistable.LAW, "microscale": laws.microscale.LAW}


@functools.cache
def either() -> Law:
    """Register both laws of the paper as one user-defined law, which the generic steps follow.

    One law saves compilation, as the steps are compiled per law; its first parameter selects one.
    """
    which = ff.Param("which", coordinate="value", start=(0.0, "one"), admissible="finite")
    of = PAPERS["bistable"]
    own = [dataclasses.replace(one, admissible="finite") for one in of.params]
    functions = PAPERS["microscale"].loaded_functions()._replace(fill=_either)  # follow both
    searched = ("which", *of.searched)
    copied = {"kind": "copy", "spring": None, "columns": 16, "states": 18, "searched": searched}
    return laws.register(
        dataclasses.replace(of, params=(which, *own), functions=functions, **copied)
    )


def copy_of(spring: ff.BistableSpring | ff.MicroscaleSpring) -> ff.springs.spring.Spring:
    """Return the same spring as a user-defined law, which the generic steps follow."""
    which = float(isinstance(spring, ff.MicroscaleSpring))
    return either().make((which, *spring.values), spring.relaxation)


@pytest.mark.usefixtures("bouc_wen")  # removes laws registered here afterwards
def test_steps_of_any_law_agree_with_the_solver_of_the_papers_laws() -> None:
    """One test for all cases, because each test process would compile the steps again."""
    for kind, relaxation, drive in itertools.product(
        PAPERS, [(), [(0.4, 2e-4)]], ["impact", "stress", "displacement"]
    ):
        steps_agree(kind, relaxation, drive)


def steps_agree(kind: str, relaxation: list[tuple[float, float]], drive: str) -> None:
    """Assert that generic steps give the curves and derivatives of one of the paper's laws."""
    spring: ff.BistableSpring | ff.MicroscaleSpring = (
        ff.BistableSpring(5.5e6, 82.5e6, -0.18e6, 0.14, 0.31, 14.3e6, 2.34e6, 50.0,
                          relaxation=relaxation)
        if kind == "bistable"
        else ff.MicroscaleSpring(5.5e6, 2.5e6, 0.3, 1.3e6, 0.4, 5.5e5, 0.6, 50.0,
                                 relaxation=relaxation)
    )  # fmt: skip
    time = np.linspace(0.0, 1.2e-3, 121)
    shape = np.sin(np.pi * time / time[-1]) ** 2
    given = {
        "impact": ff.Impact(7e-3, 1.5, gravity=200.0),
        "stress": ff.StressDrive(1.5e6 * shape),
        "displacement": ff.DisplacementDrive(3.5e-4 * shape),
    }[drive]
    one, other = (
        ff.simulate(ff.Chain([of], [1.19e-3], 1.9635e-5), given, time, 5e-5, sensitivities=NAMES)
        for of in (spring, copy_of(spring))
    )
    for a, b in ((one.base_stress, other.base_stress), (one.displacement, other.displacement)):
        np.testing.assert_allclose(b, a, 0, 2e-4 * np.abs(a).max(), err_msg=f"{kind}, {drive}")
    for name in NAMES:
        a, b = (r.sensitivities[name].displacement for r in (one, other))
        bar = 2e-2 * max(np.abs(a).max(), 1e-18)
        np.testing.assert_allclose(b, a, 0, bar, err_msg=f"{kind}, {drive}")


NAMES = ("s1_k0", "s1_eta")


@pytest.mark.usefixtures("bouc_wen")
def test_a_derivative_at_a_limit_of_a_law_is_one_sided() -> None:
    """Δσ must not be positive, so only one side of 0 is admissible."""
    spring = ff.BistableSpring(5.5e6, 82.5e6, 0.0, 0.14, 0.31, 14.3e6, 2.34e6)
    time = np.linspace(0.0, 1.0, 81)
    drive = ff.DisplacementDrive(4e-4 * np.sin(np.pi * time) ** 2)
    one, other = (
        ff.simulate(ff.Chain([of], [1e-3], 1e-5), drive, time, sensitivities=["s1_dsigma"])
        .sensitivities["s1_dsigma"].base_stress
        for of in (spring, copy_of(spring))
    )  # fmt: skip
    assert np.abs(one).max() > 0.5
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-3)


def test_a_law_stands_in_a_chain(bouc_wen: Law) -> None:
    springs = [ff.LinearSpring(4e6), bouc_wen.make(VALUES, ())]
    time = np.linspace(0.0, 1.0, 101)
    moved = 3e-3 * np.sin(np.pi * time)
    got = ff.simulate(ff.Chain(springs, [4e-3, 6e-3], AREA), ff.DisplacementDrive(moved), time)
    np.testing.assert_allclose(got.displacement[-1], moved, rtol=0, atol=1e-9)
    own = np.diff(got.displacement, axis=0, prepend=0.0) / np.array([[4e-3], [6e-3]])
    for spring, strain in zip(springs, own, strict=True):
        np.testing.assert_allclose(spring.stress(strain), got.base_stress, rtol=1e-8, atol=1.0)


def test_relaxation_begins_at_zero_at_any_strain(bouc_wen: Law) -> None:
    """q = ∫ g exp(-(t - s)/τ) dσ/ds ds from the first sample on, whatever its strain or stress."""
    g, tau, time = 0.5, 0.2, np.linspace(0.0, 1.0, 101)
    spring, strain = bouc_wen.make(VALUES, [(g, tau)]), 0.1 + 0.2 * time
    law = bouc_wen.make(VALUES, ())
    got = ff.simulate(chain_of(spring), ff.DisplacementDrive(HEIGHT * strain), time).base_stress
    assert got[0] == pytest.approx(law.stress([0.1])[0], rel=1e-9)
    fine = np.linspace(0.0, 1.0, 20_001)
    sigma = law.stress(0.1 + 0.2 * fine)
    held = g * np.trapezoid(np.exp((fine - 1.0) / tau) * np.gradient(sigma, fine), fine)
    assert got[-1] == pytest.approx(sigma[-1] + held, rel=1e-4)
    back = ff.simulate(chain_of(spring), ff.StressDrive(got), time)
    np.testing.assert_allclose(back.strain, strain, rtol=1e-4)


def test_the_tangent_follows_the_motion_at_a_cost_that_grows_with_its_length(
    bouc_wen: Law,
) -> None:
    """Bouc-Wen loading and unloading have different slopes; n² steps would take minutes."""
    k, alpha, limit, n, _ = VALUES
    spring, ways = bouc_wen.make(VALUES, ()), ((0.0, 0.4), (0.4, 0.05), (0.05, 0.05), (0.05, 0.6))
    strain = np.concatenate([np.linspace(*way, 10_000)[1:] for way in ways])
    z = (spring.stress(strain) / k - alpha * strain) / (1.0 - alpha)
    way = np.repeat([1.0, -1.0, -1.0, 1.0], 9_999)
    slope = np.where(z * way > 0.0, 1.0 - np.abs(z / limit) ** n, 1.0)
    want = alpha * k + (1.0 - alpha) * k * slope
    np.testing.assert_allclose(spring.tangent(strain), want, rtol=1e-5)


PLATEAU = ("loading", "plateau")


def _bent(row, state, strain):  # type: ignore[no-untyped-def]
    state[0] = strain
    stiff = row[0] if strain <= 0.1 else row[1]
    state[1] = row[0] * min(strain, 0.1) + stiff * max(strain - 0.1, 0.0)
    state[2] = 0.0 if strain <= 0.1 else 1.0


def _beyond(row, state, strain):  # type: ignore[no-untyped-def]
    return (strain > 0.1) != (state[2] == 1.0)


def _across(row, state, up):  # type: ignore[no-untyped-def]
    state[0], state[1], state[2] = 0.1, 0.1 * row[0], 1.0 if up else 0.0


def _copied(values, row):  # type: ignore[no-untyped-def]
    for i in range(values.size):
        row[i] = values[i]
    return True


def _at_rest(row, state):  # type: ignore[no-untyped-def]
    state[:] = 0.0


@pytest.mark.usefixtures("bouc_wen")
def test_the_tangent_at_the_end_of_a_branch_is_that_of_the_branch() -> None:
    known = ff.register(
        Law(
            kind="bent",
            params=tuple(ff.Param(name, start=(1.0, "slope")) for name in ("k", "kh")),
            functions=ff.Functions(_copied, _at_rest, _beyond, _across, _bent),
            branches=dict.fromkeys(PLATEAU, ""),
        )
    )
    spring, strain = known.make((2e6, 1e5, 0.0), ()), [0.0, 0.05, 0.1, 0.2, 0.1 + 1e-12, 0.05]
    assert spring.branches(strain).tolist() == [PLATEAU[i] for i in (0, 0, 0, 1, 1, 0)]
    want = [2e6, 2e6, 2e6, 1e5, 1e5, 2e6]
    np.testing.assert_allclose(spring.tangent(strain), want, rtol=1e-6)


def _polynomial(row, state, strain):  # type: ignore[no-untyped-def]
    state[0], state[1] = strain, 0.0
    for i in range(row.size):
        state[1] += row[i] * (2.0 * strain) ** (i + 1)


def _never(row, state, strain):  # type: ignore[no-untyped-def]
    return False


@pytest.mark.usefixtures("bouc_wen")
def test_a_law_may_have_more_than_twenty_parameters() -> None:
    """σ = Σ p_i (2ε)^i, so that the derivative by each parameter is a power of the strain."""
    count, g, tau, eta = 26, 0.3, 0.4, 5e3
    functions = ff.Functions(_copied, _at_rest, _never, _across, _polynomial)
    params = tuple(ff.Param(f"p{i}", start=(1.0, "slope")) for i in range(1, count + 1))
    known = ff.register(Law(kind="polynomial", params=params, functions=functions))
    time, values = np.linspace(0.0, 1.0, 41), np.linspace(1e6, 2e6, count)
    names = [f"s1_p{i}" for i in range(1, count + 1)]
    drive = ff.DisplacementDrive(0.5 * HEIGHT * time)
    quiet = chain_of(known.make((*values, 0.0), ()))
    got = ff.simulate(quiet, drive, time, sensitivities=names).sensitivities
    for i, name in enumerate(names, 1):
        np.testing.assert_allclose(got[name].base_stress, time**i, rtol=0, atol=1e-9)
    relaxing = chain_of(known.make((*values, eta), [(g, tau)]))
    more = ff.simulate(relaxing, drive, time, sensitivities=["s1_eta", "s1_g1", "s1_tau1"])
    own = {name: one.base_stress for name, one in more.sensitivities.items()}
    np.testing.assert_allclose(own["s1_eta"], 0.5, rtol=1e-6)
    fine = np.linspace(0.0, 1.0, 20_001)
    rate = np.gradient(quiet.springs[0].stress(0.5 * fine), fine)
    late = np.exp((fine - 1.0) / tau)
    assert own["s1_g1"][-1] == pytest.approx(np.trapezoid(late * rate, fine), rel=1e-4)
    by_tau = g * np.trapezoid(late * rate * (1.0 - fine) / tau**2, fine)
    assert own["s1_tau1"][-1] == pytest.approx(by_tau, rel=1e-3)


def test_a_chain_keeps_its_law_when_the_name_is_registered_again(bouc_wen: Law) -> None:
    functions = bouc_wen.functions
    assert isinstance(functions, ff.Functions)
    first = ff.register(changed(bouc_wen, kind="again", spring=None))
    chain, time = chain_of(first.make(VALUES, ())), np.linspace(0.0, 1.0, 21)
    drive, names = ff.DisplacementDrive(0.2 * HEIGHT * time), ["s1_limit"]
    before = ff.simulate(chain, drive, time, sensitivities=names)
    other = ff.Functions(_copied, _at_rest, _never, _across, _polynomial)
    params = tuple(ff.Param(f"p{i}", start=(1.0, "slope")) for i in (1, 2))
    ff.register(Law(kind="again", params=params, functions=other))
    after = ff.simulate(chain, drive, time, sensitivities=names)
    np.testing.assert_array_equal(after.base_stress, before.base_stress)
    one, two = (run.sensitivities["s1_limit"].base_stress for run in (before, after))
    np.testing.assert_array_equal(two, one)


# ---------------------------------------------------------------------------- refusals


def changed(law: Law, **by: object) -> Law:
    return dataclasses.replace(law, **by)  # type: ignore[arg-type]


def _falling(row, state, strain):  # type: ignore[no-untyped-def]
    state[0], state[1] = strain, -row[0] * strain


def _infinite(row, state, strain):  # type: ignore[no-untyped-def]
    state[0], state[1] = strain, row[0] * strain / (0.2 - 0.2)


def _nothing(row, state, rate, h):  # type: ignore[no-untyped-def]
    pass


def test_a_wrong_law_gets_one_sentence(bouc_wen: Law) -> None:
    of = bouc_wen.functions
    assert isinstance(of, ff.Functions)
    first = bouc_wen.params[0]
    wrong = {
        "the function settle is missing": changed(bouc_wen, functions=of._replace(settle=None)),
        "a function goes beyond": changed(bouc_wen, states=3),
        "the stress falls on loading": changed(bouc_wen, functions=of._replace(settle=_falling)),
        "the stress is not finite": changed(bouc_wen, functions=of._replace(settle=_infinite)),
        "its functions cannot be compiled": changed(
            bouc_wen, functions=of._replace(viscous=_nothing)
        ),
        "the name is that of a law of foamfit": changed(bouc_wen, kind="bistable"),
        "its kind must be small letters": changed(bouc_wen, kind="Bouc Wen"),
        "it has no parameters": changed(bouc_wen, params=()),
        "parameter 'eta': the name is taken": changed(
            bouc_wen, params=(dataclasses.replace(first, name="eta"),)
        ),
        "parameter 'k': its coordinate is a logarithm": changed(
            bouc_wen, params=(dataclasses.replace(first, bounds=(0.0, 1.0)),)
        ),
    }
    for message, law in wrong.items():
        with pytest.raises(ff.InputError, match=f"^law '{law.kind}': .*{message}") as caught:
            ff.register(law)
        assert "\n" not in str(caught.value)
        assert law.kind in ("bistable", "bouc-wen") or law.kind not in laws.kinds()
    assert laws.law("bouc-wen") is bouc_wen


def test_what_is_compiled_to_try_a_law_follows_its_springs(bouc_wen: Law) -> None:
    known = laws.register(changed(bouc_wen, kind="once", spring=None))
    before = followed._along.cache_info().misses
    known.make(VALUES, ()).stress([0.0, 0.1])
    assert followed._along.cache_info().misses == before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("x = 1\n", "the file defines no law"),
        ("1 / 0\n", r"the file cannot be run \(ZeroDivisionError"),
        ("def f(:\n", r"the file cannot be run \(SyntaxError"),
    ],
)
def test_a_wrong_law_file_gets_one_sentence(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "law.py"
    if text is not None:
        path.write_text(text)
    known = laws.kinds()
    with pytest.raises(ff.InputError, match=message) as caught:
        laws.load_file(path)
    assert str(path) in str(caught.value)
    assert laws.kinds() == known


def test_a_law_is_pickled_by_its_name(bouc_wen: Law) -> None:
    spring = bouc_wen.make(VALUES, [(0.1, 2.0)])
    again = pickle.loads(pickle.dumps(spring))
    assert again == spring
    assert again.law is bouc_wen


def test_parameters_that_are_not_admissible_are_refused(bouc_wen: Law) -> None:
    with pytest.raises(ff.InputError, match=r"^k = -1 is not admissible: it must be positive"):
        bouc_wen.make((-1.0, *VALUES[1:]), ())
