"""Nuisance parameters: priors, rows averaged in blocks, and noise of a driving motion."""

from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
import rig
from conftest import AREA, HEIGHT, loop_measurement, synthetic_impact
from foamfit.data.measurement import Measurement, Noise, Specimen
from foamfit.fitting.curves import default_weights
from foamfit.fitting.objective import Objective
from foamfit.fitting.problem import fix_and_vary, make_params
from foamfit.one_model import Options
from foamfit.springs.model import Model

SPRING = ff.MicroscaleSpring(
    k0=5.5e5, kc=4e5, eps_star=0.3, sigma_plus=1.1e5, spread_plus=0.4, sigma_minus=7e4,
    spread_minus=0.6,
)  # fmt: skip
OF_SPRING = [*SPRING.values, 0.0]


@pytest.mark.parametrize(
    ("fixed", "why"),
    [
        ({"velocity": 0.0}, "velocity = 0 is not admissible: it must be positive"),
        ({"striker_mass": -1.0}, "striker_mass = -1 is not admissible: it must be positive"),
        ({"contact_time": np.nan}, "contact_time = nan is not admissible: it must be finite"),
    ],
)
def test_held_unknowns_are_refused_by_name_where_they_cannot_be(fixed, why):
    test = synthetic_impact()[1]
    params = fix_and_vary(make_params(test), "bistable", fixed, [])
    with pytest.raises(ff.InputError, match=why):
        ff.fit(test, params=params)


def in_blocks(test: Measurement, size: int) -> Measurement:
    """Return the test with `size` rows averaged in each sample."""

    def mean(x: np.ndarray) -> np.ndarray:
        return x.reshape(-1, size).mean(axis=1)

    noise = Noise(*(level / size**0.5 for level in (test.noise.stress, test.noise.displacement)))
    return replace(
        test, time=mean(test.time), stress=mean(test.stress), noise=noise, block=size,
        displacement=mean(test.displacement),
    )  # fmt: skip


def test_curves_are_averaged_in_the_same_blocks_as_the_rows():
    """This includes blocks with kinks and jumps."""
    spring, test = synthetic_impact(eta=20.0, samples=500)
    clean = in_blocks(replace(synthetic_impact(eta=20.0, samples=500, noise=0.0)[1],
                              noise=test.noise), 5)  # fmt: skip
    weights = default_weights(clean, "impact")
    off = []
    for made in (clean, replace(clean, block=1)):
        one = Objective(made, Model.parse("bistable"), "impact", weights)
        values = [*spring.seven, 20.0, 0.0, *(one.usual[name] for name in one.nuisance)]
        off.append(np.abs(one.residual(np.array(values))).max())
    assert off[0] < 2e-3 < 0.05 < off[1]  # the curve at mid-block differs from the block mean


@pytest.fixture(scope="module")
def driven() -> Objective:
    """Objective of a slow loop of a microscale spring with a noisy driving motion."""
    strain = 0.5 * np.sin(np.pi * np.linspace(0.0, 1.0, 400)) ** 2
    rng = np.random.default_rng(2)
    stress, noise = SPRING.stress(strain), 0.002 * 0.5 * HEIGHT
    stress += 1e2 * rng.standard_normal(400)
    motion = strain * HEIGHT + noise * rng.standard_normal(400)
    test = loop_measurement(stress, motion, Specimen(HEIGHT, AREA), np.linspace(0.0, 4.0, 400))
    test = replace(test, noise=Noise(1e2, noise))
    return Objective(test, Model.parse("microscale"), "displacement", {"stress_strain": 1.0})


def test_a_driving_motion_is_smooth_and_what_is_unsure_of_it_moves_the_residual(driven):
    """The residual changes as in a simulation with a motion shifted along one of its modes."""
    motion, time = driven.scenes.motion, driven.time
    clean = 0.5 * HEIGHT * np.sin(np.pi * time / 4.0) ** 2
    level = driven.measurement.noise.displacement
    assert np.sqrt(np.mean((motion.at(time) - clean) ** 2)) < 0.4 * level
    assert motion.turns == pytest.approx([2.0], abs=0.05)
    values = np.array([*OF_SPRING, *(driven.usual[name] for name in driven.nuisance)])
    changes = driven.by_motion(values)
    clock = np.union1d(time, motion.turns)
    modes = motion.modes(clock)
    assert changes.shape == (driven.n_data, modes.shape[1])
    chain, rows = ff.Chain([SPRING], [HEIGHT], AREA), np.searchsorted(clock, time)
    largest = np.abs(changes).max()
    for found, mode in zip(changes.T, modes.T, strict=True):
        sides = [
            ff.simulate(chain, ff.DisplacementDrive(motion.at(clock) + side * mode), clock)
            for side in (-0.5, 0.5)
        ]
        below, above = (np.maximum(one.base_stress, 0.0) for one in sides)  # it is loose
        wanted = (above - below)[rows]
        wanted *= driven.factor("stress_strain")
        np.testing.assert_allclose(found, wanted, atol=1e-4 * largest)


def test_springs_that_relax_start_at_the_contact_and_not_at_the_first_sample():
    """The relaxing stress includes the contribution of the strain before the first sample."""
    spring = replace(SPRING, relaxation=[(0.8, 0.4)])
    time = np.linspace(0.0, 4.0, 401)
    w = HEIGHT * np.interp(time, [0.0, 2.0, 4.0], [0.0, 0.5, 0.0])
    chain = ff.Chain([spring], [HEIGHT], AREA)
    stress = ff.simulate(chain, ff.DisplacementDrive(w), time).base_stress
    test = loop_measurement(stress[3:], w[3:], Specimen(HEIGHT, AREA), time[3:])
    test = replace(test, noise=Noise(1e2, 0.0), contact="stress")
    model = Model.parse("microscale", relaxation=1)
    objective = Objective(test, model, "displacement", {"stress_strain": 1.0})
    known = dict(zip(Model.parse("microscale").names, OF_SPRING, strict=True)) | objective.usual
    known |= {"s1_g1": 0.8, "s1_tau1": 0.4}
    values = np.array([known[name] for name in (*model.names, *objective.nuisance)])
    off = objective.residual(values) / objective.span("stress_strain")
    assert np.abs(off).max() < 1e-5
    late = Objective(replace(test, contact="file"), model, "displacement", {"stress_strain": 1.0})
    assert np.abs(late.residual(values) / late.span("stress_strain")).max() > 1e-3


def test_residuals_of_a_driven_loop_are_weighed_by_their_full_covariance(driven):
    """The covariance includes noise and motion; after weighting, that of the noise remains."""
    values = np.array([*OF_SPRING, *(driven.usual[name] for name in driven.nuisance)])
    one = replace(driven)
    plain, slopes = one.residual(values), one.jacobian(values, np.arange(7))
    assert one.weigh_motion(values)
    weighing, uncertain = one.weighing, one.by_motion(values)
    whole = np.diag(weighing.levels**2) + uncertain @ uncertain.T
    assert np.sqrt(np.diag(whole) / weighing.levels**2).max() > 1.5
    left = weighing(weighing(whole).T)
    np.testing.assert_allclose(left, np.diag(weighing.levels**2), atol=1e-9 * whole.max())
    np.testing.assert_array_equal(one.residual(values), weighing(plain))
    np.testing.assert_array_equal(one.jacobian(values, np.arange(7)), weighing(slopes))


@pytest.mark.parametrize("terms", [0, 2])
@pytest.mark.parametrize(
    ("model", "mullins"),
    [("microscale", False), ("microscale", True), ("linear+microscale", False)],
)
def test_the_derivative_by_the_zero_of_a_driving_motion_is_that_of_differences(
    model, mullins, terms
):
    """Contact is lost between the loops, at an instant when the motion does not rest."""
    time = np.linspace(0.0, 8.0, 401)
    strain = 0.35 * (0.5 - 0.5 * np.cos(np.pi * time)) + 0.05 * np.sin(1.3 * time) + 0.06
    test = loop_measurement(1e5 * strain, strain * HEIGHT, Specimen(HEIGHT, AREA), time)
    test = replace(test, noise=Noise(1e3, 1e-9))
    problem = Options(relaxation=terms, mullins=mullins).problem(test, model, None)
    values = problem.vector()
    top = f"s{1 + model.count('+')}"
    for name in Model.parse("microscale").names[:7]:
        values[problem.index[name.replace("s1", top)]] = getattr(SPRING, name[3:])
    for i in range(terms):
        for name, value in (("g", 0.5), ("tau", 3.0**i)):
            values[problem.index[f"{top}_{name}{i + 1}"]] = value
    place = problem.index["displacement_zero"]
    values[place] = 0.07 * HEIGHT
    names = ("s1_k0", "displacement_zero")
    step = 1e-6 * HEIGHT
    sides = []
    for side in (-1.0, 1.0):
        there = values.copy()
        there[place] += side * step
        sides.append(problem.objective.simulate(there).curves["stress_strain"])
    places = np.array([problem.index[name] for name in names])
    slopes = problem.objective.simulate(values, places=places).slopes
    found, wanted = slopes["stress_strain"][1], (sides[1] - sides[0]) / (2.0 * step)
    assert (strain < 0.07).any()
    assert np.linalg.norm(found - wanted) < 1e-3 * np.linalg.norm(wanted)


def test_a_steep_branch_is_weighed_by_the_noise_of_the_motion(tmp_path):
    """Plain least squares follows this record 5 % closer, and misses the start of branch c."""
    record = rig.slow(rig.Slow("bistable", noise=1e-3), 4001)
    test = ff.read_test(rig.write(record, tmp_path))
    result = ff.fit(test, model="bistable", intervals="local", seed=0)
    for name in ("s1_kc", "s1_eps_c"):
        low, high = result.parameters[name].ci95
        assert low < record.truth[name] < high
