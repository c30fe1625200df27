"""User-defined laws: registration from a file, refusals, simulation and fits."""

import dataclasses
import functools
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

import foamfit as ff
import power_law_damper
from foamfit.springs import laws
from foamfit.springs.laws import Law
from reference import differences

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
    spring = bouc_wen.make(VALUES, ())
    got = ff.simulate(chain_of(spring), drive, time)
    want = by_hand(time, lambda t: 0.4 * np.pi * np.sin(2.0 * np.pi * t))
    np.testing.assert_allclose(got.base_stress, want, rtol=0, atol=2e-5 * want.max())
    back = spring.strain(spring.stress(strain))
    np.testing.assert_allclose(back, strain, rtol=0, atol=1e-11)


_plain = njit(power_law_damper.stress)  # of the paper's spring alone


def _smeared(p, x, strain, branch):  # type: ignore[no-untyped-def]
    return _plain(p, x, strain, branch) + 0.0 * x[0]


def _still(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    out[0] = strain


@functools.cache
def copy(internal: int) -> Law:
    """Register the bistable law; with an internal variable that has no effect, if one is wanted."""
    given = (_smeared, _still) if internal else (power_law_damper.stress,)
    ends = {"ends": power_law_damper.ends, "switch": power_law_damper.switch}
    functions = ff.Functions(*given, **ends)
    copied = {"kind": f"copy-{internal}", "spring": None}
    return laws.register(
        dataclasses.replace(laws.bistable.LAW, functions=functions, internal=internal, **copied)
    )


def copy_of(spring: ff.BistableSpring, internal: int = 0) -> ff.springs.spring.Spring:
    """Return the same spring of a registered law."""
    return copy(internal).make(spring.values, spring.relaxation)


SEVEN = (5.5e6, 82.5e6, -0.18e6, 0.14, 0.31, 14.3e6, 2.34e6)
TIME = np.linspace(0.0, 1.2e-3, 121)
SHAPE = np.sin(np.pi * TIME / TIME[-1]) ** 2
DRIVES = {
    "impact": ff.Impact(7e-3, 1.5, gravity=200.0),
    "stress": ff.StressDrive(1.5e6 * SHAPE),
    "displacement": ff.DisplacementDrive(3.5e-4 * SHAPE),
}


def placed(spring: ff.springs.spring.Spring, place: str) -> ff.Chain:
    """Return a spring alone, below another one, or with a mass between them."""
    if place == "alone":
        return ff.Chain([spring], [1.19e-3], 1.9635e-5)
    above = ff.BistableSpring(*SEVEN, eta=40.0)
    masses = [1e-3, 0.0] if place == "below a mass" else None
    return ff.Chain([spring, above], [0.6e-3, 0.59e-3], 1.9635e-5, masses=masses)


@pytest.mark.parametrize("internal", [0, 1])
@pytest.mark.parametrize("place", ["alone", "in series", "below a mass"])
@pytest.mark.parametrize("relaxation", [(), ((0.4, 2e-4),)])
@pytest.mark.usefixtures("bouc_wen")  # removes laws registered here afterwards
def test_a_registered_copy_agrees_with_the_built_in_law(
    relaxation: tuple[tuple[float, float], ...], place: str, internal: int
) -> None:
    """Curves agree to 1e-8 and derivatives to 1e-5, where both laws take the same kind of steps."""
    spring = ff.BistableSpring(*SEVEN, 50.0, relaxation=relaxation)
    names = [f"s1_{name}" for name in laws.bistable.LAW.names]
    for kind, drive in DRIVES.items():
        one, other = (
            ff.simulate(placed(of, place), drive, TIME, 1e-9, sensitivities=names)
            for of in (spring, copy_of(spring, internal))
        )
        for a, b in ((one.base_stress, other.base_stress), (one.displacement, other.displacement)):
            np.testing.assert_allclose(b, a, 0, 1e-8 * np.abs(a).max(), err_msg=kind)
        for name in names:
            a, b = (r.sensitivities[name].displacement for r in (one, other))
            bar = 1e-5 * np.abs(a).max() + 1e-15
            np.testing.assert_allclose(b, a, 0, bar, err_msg=f"{kind}, {name}")


@pytest.mark.parametrize("place", ["alone", "in series", "below a mass"])
@pytest.mark.parametrize("drive", ["impact", "stress", "displacement"])
def test_derivatives_are_exact(bouc_wen: Law, drive: str, place: str) -> None:
    """They agree with differences of order 4, except at kinks of the curves."""
    given = {
        "impact": ff.Impact(0.05, 3.0),
        "stress": ff.StressDrive(4e5 * SHAPE + 1e4),
        "displacement": ff.DisplacementDrive(4e-3 * SHAPE + 1e-4),
    }[drive]
    time = (3.0 if drive == "impact" else 100.0) * TIME

    def run(values: np.ndarray, rtol: float, **more: object) -> ff.Response:
        own = bouc_wen.make((*values[:4], 30.0), ((values[4], 2e-4),))
        above, masses = ff.LinearSpring(4e6, eta=500.0), [2e-3, 0.0]
        chain = (
            chain_of(own)
            if place == "alone"
            else ff.Chain([own, above], [5e-3, 5e-3], AREA, masses if "mass" in place else None)
        )
        return ff.simulate(chain, given, time, rtol, **more)  # type: ignore[arg-type]

    values, names = np.array([*VALUES[:4], 0.3]), (*bouc_wen.own, "g1")
    found = run(values, 1e-9, sensitivities=[f"s1_{name}" for name in names])
    for i, name in enumerate(names):
        one = np.arange(5) == i
        moved, stress = differences(
            lambda by, one=one: run(values + by * one, 1e-10), 2e-3 * values[i]
        )
        own = found.sensitivities[f"s1_{name}"]
        for a, b in ((own.base_stress, stress), (own.displacement, moved)):
            bar = np.abs(b).max() + 1e-9 * np.abs(found.base_stress).max() / values[i]
            assert np.median(np.abs(a - b)) <= 1e-6 * bar
            assert np.mean(np.abs(a - b) > 1e-4 * bar) < 0.05


@pytest.mark.usefixtures("bouc_wen")
def test_a_law_with_an_interior_mass_agrees_with_scipy(bouc_wen: Law) -> None:
    """A linear spring at the base, a mass, a Bouc-Wen spring and the striker."""
    k, alpha, limit, n, _ = VALUES
    inside, striker, speed, stiff = 5e-3, 0.05, 3.0, 4e6
    time = np.linspace(0.0, 2e-3, 101)

    def rhs(_: float, y: np.ndarray) -> list[float]:
        u, v, w, q, z = y
        pace = (q - v) / 5e-3
        held = (abs(z) / limit) ** n if z * pace > 0 else 0.0
        upper = alpha * k * (w - u) / 5e-3 + (1.0 - alpha) * k * z
        lower = stiff * u / 5e-3
        return [v, (upper - lower) * AREA / inside, q, -upper * AREA / striker, pace * (1.0 - held)]

    want = solve_ivp(rhs, (0.0, time[-1]), [0.0, 0.0, 0.0, speed, 0.0], t_eval=time, rtol=1e-11,
                     atol=1e-13, max_step=1e-6)  # fmt: skip
    springs = [ff.LinearSpring(stiff), bouc_wen.make(VALUES, ())]
    chain = ff.Chain(springs, [5e-3, 5e-3], AREA, masses=[inside, 0.0])
    got = ff.simulate(chain, ff.Impact(striker, speed), time)
    contact = got.base_stress > 0.0
    for node, row in ((0, 0), (1, 2)):
        miss = np.abs(got.displacement[node] - want.y[row])[contact]
        assert miss.max() <= 3e-6 * want.y[2].max()


def test_relaxation_begins_at_zero_at_any_strain(bouc_wen: Law) -> None:
    """q = ∫ g exp(-(t - s)/τ) dσ/ds ds from the first sample on, whatever its strain or stress."""
    g, tau, time = 0.5, 0.2, np.linspace(0.0, 1.0, 101)
    spring, strain = bouc_wen.make(VALUES, [(g, tau)]), 0.1 + 0.2 * time
    law = bouc_wen.make(VALUES, ())
    drive = ff.DisplacementDrive(HEIGHT * strain)
    got = ff.simulate(chain_of(spring), drive, time, rtol=1e-9).base_stress
    assert got[0] == pytest.approx(law.stress([0.1])[0], rel=1e-9)
    fine = np.linspace(0.0, 1.0, 20_001)
    sigma = law.stress(0.1 + 0.2 * fine)
    held = g * np.trapezoid(np.exp((fine - 1.0) / tau) * np.gradient(sigma, fine), fine)
    assert got[-1] == pytest.approx(sigma[-1] + held, rel=1e-4)
    back = ff.simulate(chain_of(spring), ff.StressDrive(got), time)
    np.testing.assert_allclose(back.strain, strain, rtol=1e-4)


PLATEAU = ("loading", "plateau")


def _prony(p, x, strain, branch):  # type: ignore[no-untyped-def]
    elastic = p[0] * strain / (1.0 - strain)
    total = elastic
    for k in range(len(x)):
        total += p[1 + k] * (elastic + x[k])
    return total


def _fading(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    for k in range(len(x)):
        out[k] = -(p[0] * strain / (1.0 - strain) + x[k]) / p[1 + len(x) + k]


@functools.cache
def prony(terms: int, stepped: bool = False) -> Law:
    """A curve with terms of a Prony series as internal variables; `stepped` forbids closed form."""
    names = ["k", *(f"s{k}" for k in range(terms)), *(f"t{k}" for k in range(terms))]
    given = ff.Functions(_prony, decay=_fading, viscous=_no_stress) if stepped else ff.Functions(
        _prony, decay=_fading if terms else None
    )  # fmt: skip
    kind = f"prony-{terms}" + "-stepped" * stepped
    params = tuple(ff.Param(name) for name in names)
    return ff.register(ff.Law(kind=kind, params=params, internal=terms, functions=given))


def _no_stress(p, x, strain, rate, branch):  # type: ignore[no-untyped-def]
    return 0j


def _agree(got: ff.Response, want: ff.Response, names: dict[str, str], bar: float) -> None:
    """Stresses and derivatives agree; `names` are those of derivatives of both."""
    assert np.abs(got.base_stress - want.base_stress).max() < bar * want.base_stress.max()
    for own, other in names.items():
        one, two = got.sensitivities[own].base_stress, want.sensitivities[other].base_stress
        assert np.abs(one - two).max() < 2e-5 * np.abs(two).max(), own


def test_variables_that_decay_are_as_exact_as_relaxation(bouc_wen: Law) -> None:
    terms = [(0.3, 1e-6), (0.2, 0.7)]
    time = np.linspace(0.0, 1.0, 301)
    drive = ff.DisplacementDrive(HEIGHT * 0.4 * np.sin(3.0 * time) ** 2)
    names = {"s1_k": "s1_k", "s1_height": "s1_height"}
    for k in range(2):
        names |= {f"s1_s{k}": f"s1_g{k + 1}", f"s1_t{k}": f"s1_tau{k + 1}"}
    springs = (
        prony(2).make([2e6, *np.transpose(terms).ravel(), 0.0], ()),
        prony(0).make([2e6, 0.0], terms),
    )
    got, want = (
        ff.simulate(chain_of(one), drive, time, 1e-8, sensitivities=list(wanted))
        for one, wanted in zip(springs, (names, names.values()), strict=True)
    )
    assert got.method == want.method == "closed form"
    _agree(got, want, names, 1e-12)


def test_variables_that_decay_and_relaxation_agree_with_steps_in_time(bouc_wen: Law) -> None:
    time = np.linspace(0.0, 1.0, 101)
    drive = ff.DisplacementDrive(HEIGHT * (0.02 + 0.4 * np.sin(3.0 * time) ** 2))
    values, names = [2e6, 0.3, 0.5, 0.003, 0.2, 0.0], ["s1_k", "s1_s0", "s1_t1", "s1_g1", "s1_tau1"]
    got, want = (
        ff.simulate(
            chain_of(prony(2, stepped).make(values, [(0.4, 0.3)])), drive, time, 1e-9,
            sensitivities=names,
        )
        for stepped in (False, True)
    )  # fmt: skip
    assert got.method == "closed form" != want.method
    _agree(got, want, dict(zip(names, names, strict=True)), 1e-9)


@pytest.mark.parametrize("eta", [0.0, 40.0])
@pytest.mark.parametrize("drive", DRIVES)
def test_a_viscous_law_in_series_is_refused(bouc_wen: Law, drive: str, eta: float) -> None:
    still = prony(2, True).make([5e6, 0.5, 0.3, 1e-4, 5e-4, 0.0], ())
    both = [still, ff.BistableSpring(*SEVEN, eta=eta)]
    chain = ff.Chain(both, [0.6e-3, 0.59e-3], 1.9635e-5)
    with pytest.raises(ff.InputError, match=r"spring 1: .* needs a mass"):
        ff.simulate(chain, DRIVES[drive], TIME)


def _creeping(p, x, strain, branch):  # type: ignore[no-untyped-def]
    return p[0] * (strain - x[0])


def _creep(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    out[0] = p[1] * (strain - x[0]) ** 3


def test_a_nonlinear_decay_is_integrated_in_time(bouc_wen: Law) -> None:
    law = ff.register(ff.Law(
        kind="creep", params=(ff.Param("k"), ff.Param("c")), internal=1,
        functions=ff.Functions(_creeping, decay=_creep),
    ))  # fmt: skip
    time = np.linspace(0.0, 1.0, 201)
    strain = 0.3 * time
    got = ff.simulate(
        chain_of(law.make([1e6, 4e3, 0.0], ())), ff.DisplacementDrive(HEIGHT * strain), time, 1e-8
    )
    found = solve_ivp(lambda t, x: 4e3 * (0.3 * t - x) ** 3, (0.0, 1.0), [0.0], t_eval=time,
                      rtol=1e-11, atol=1e-14)  # fmt: skip
    want = 1e6 * (strain - found.y[0])
    assert got.method == "Dormand-Prince"
    assert np.abs(got.base_stress - want).max() < 1e-8 * want.max()


def _bent(p, x, strain, branch):  # type: ignore[no-untyped-def]
    return p[0] * strain if branch == 0 else 0.1 * p[0] + p[1] * (strain - 0.1)


def _beyond(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    out[1 - branch] = 0.1


def _across(p, x, strain, branch, up):  # type: ignore[no-untyped-def]
    return 1 - branch


@pytest.mark.usefixtures("bouc_wen")
def test_the_tangent_at_the_end_of_a_branch_is_that_of_the_branch() -> None:
    known = ff.register(
        Law(
            kind="bent",
            params=tuple(ff.Param(name, start=(1.0, "slope")) for name in ("k", "kh")),
            functions=ff.Functions(_bent, ends=_beyond, switch=_across),
            branches=dict.fromkeys(PLATEAU, ""),
        )
    )
    spring, strain = known.make((2e6, 1e5, 0.0), ()), [0.0, 0.05, 0.1, 0.2, 0.1 + 1e-12, 0.05]
    assert spring.branches(strain).tolist() == [PLATEAU[i] for i in (0, 0, 0, 1, 1, 0)]
    want = [2e6, 2e6, 2e6, 1e5, 1e5, 2e6]
    np.testing.assert_allclose(spring.tangent(strain), want, rtol=1e-6)


def _polynomial(p, x, strain, branch):  # type: ignore[no-untyped-def]
    total = 0j
    for i in range(len(p)):
        total += p[i] * (2.0 * strain) ** (i + 1)
    return total


@pytest.mark.usefixtures("bouc_wen")
def test_a_law_may_have_more_than_twenty_parameters() -> None:
    """σ = Σ p_i (2ε)^i, so that the derivative by each parameter is a power of the strain."""
    count, g, tau, eta = 26, 0.3, 0.4, 5e3
    functions = ff.Functions(_polynomial)
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
    other = ff.Functions(_polynomial)
    params = tuple(ff.Param(f"p{i}", start=(1.0, "slope")) for i in (1, 2))
    ff.register(Law(kind="again", params=params, functions=other))
    after = ff.simulate(chain, drive, time, sensitivities=names)
    np.testing.assert_array_equal(after.base_stress, before.base_stress)
    one, two = (run.sensitivities["s1_limit"].base_stress for run in (before, after))
    np.testing.assert_array_equal(two, one)


# ---------------------------------------------------------------------------- refusals


def changed(law: Law, **by: object) -> Law:
    return dataclasses.replace(law, **by)  # type: ignore[arg-type]


def _falling(p, x, strain, branch):  # type: ignore[no-untyped-def]
    return -p[0] * strain


def _infinite(p, x, strain, branch):  # type: ignore[no-untyped-def]
    return p[0] * strain / (0.2 - 0.2)


def _nothing(p, x, strain, rate, branch):  # type: ignore[no-untyped-def]
    pass


def _third(p, x, strain, branch, up):  # type: ignore[no-untyped-def]
    return 2


def test_a_wrong_law_gets_one_sentence(bouc_wen: Law) -> None:
    of = bouc_wen.functions
    assert isinstance(of, ff.Functions)

    def functions(**by: object) -> Law:
        return changed(bouc_wen, functions=of._replace(**by))

    def parameter(**by: object) -> Law:
        return changed(bouc_wen, params=(dataclasses.replace(bouc_wen.params[0], **by),))

    wrong = {
        "the function stress is missing": functions(stress=None),
        "the function along is missing": functions(along=None, switch=None, ends=None),
        "along fills the rates of internal variables": changed(bouc_wen, internal=0),
        "the function switch is missing": functions(switch=None),
        "internal must be a number": changed(bouc_wen, internal=33),
        "the function stress goes beyond": changed(functions(along=None), internal=0),
        "a branch has the number 2": functions(switch=_third),
        "the stress falls on loading": functions(stress=_falling),
        "the stress is not finite": functions(stress=_infinite),
        "its functions cannot be compiled": functions(viscous=_nothing),
        "the name is that of a law of foamfit": changed(bouc_wen, kind="bistable"),
        "its kind must be small letters": changed(bouc_wen, kind="Bouc Wen"),
        "it has no parameters": changed(bouc_wen, params=()),
        "parameter 'eta': the name is taken": parameter(name="eta"),
        "parameter 'k': its coordinate is a logarithm": parameter(bounds=(0.0, 1.0)),
    }
    for message, law in wrong.items():
        with pytest.raises(ff.InputError, match=f"^law '{law.kind}': .*{message}") as caught:
            ff.register(law)
        assert "\n" not in str(caught.value)
        assert law.kind in ("bistable", "bouc-wen") or law.kind not in laws.kinds()
    assert laws.law("bouc-wen") is bouc_wen


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
