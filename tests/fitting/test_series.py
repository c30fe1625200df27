"""Two springs in series: exchanges between springs, and intervals that hold the truth."""

import numpy as np
import pytest

import foamfit as ff
from conftest import NAMES, loop_measurement
from foamfit.data.measurement import Specimen
from foamfit.springs.model import Model, exchanges

SOFT = ff.BistableSpring(2.0e6, 9e7, -9e4, 0.055, 0.22, 6e5, 1.1e5)
STIFF = ff.BistableSpring(1.2e6, 3e7, -6e4, 0.20, 0.50, 3e5, 2.2e5)


def common_loop():
    """Return displacement (m), time (s) and stress (Pa) of a loop of both springs in series."""
    chain = ff.Chain([STIFF, SOFT], [0.005, 0.005], 4.5e-5)  # the fit must swap them
    motion = 0.0037 * np.concatenate([np.linspace(0, 1, 150), np.linspace(1, 0, 150)[1:]])
    time = np.linspace(0.0, 4.0, motion.size)
    found = ff.simulate(chain, ff.DisplacementDrive(motion), time)
    return motion, time, found.base_stress


@pytest.mark.parametrize("law", ["bistable", "microscale"])
def test_an_exchange_keeps_the_stresses_at_which_springs_snap(law):
    model = Model.parse(f"{law}+{law}")
    values = np.ones(len(model.names))
    springs = (
        [SOFT.seven, STIFF.seven]
        if law == "bistable"
        else [(1e6, 3e6, 0.5, 2e5, 0.3, 8e4, 0.5), (2e6, 4e6, 0.6, 4e5, 0.2, 2e5, 0.4)]
    )
    for i, seven in enumerate(springs, start=1):
        first = model.index[f"s{i}_k0"]
        values[first : first + 7] = seven
    places = [model.index[f"s{i}_k0"] for i in (1, 2)]

    def snaps(vector):
        if law == "microscale":
            return sorted(float(vector[first + 3]) for first in places)
        return sorted(float(vector[f] * vector[f + 3] / (1 - vector[f + 3])) for f in places)

    def stiffnesses(vector):
        return sorted(float(vector[first]) for first in places)

    made = list(exchanges(model, values))
    assert len(made) == 63  # 2⁷/2 partitions of seven properties, minus the one without exchange
    assert len({tuple(vector) for vector in made}) == 63
    for vector in made:
        assert snaps(vector) == pytest.approx(snaps(values))
        assert stiffnesses(vector) == pytest.approx(stiffnesses(values))


def test_intervals_of_two_springs_hold_the_truth():
    """With 0.2 % noise, at least 85 % of the intervals contain the true value."""
    motion, time, stress = common_loop()
    rng = np.random.default_rng(3)
    noisy = stress + 0.002 * np.ptp(stress) * rng.standard_normal(stress.size)
    test = loop_measurement(noisy, motion, Specimen(0.01, 4.5e-5, heights=(0.005, 0.005)), time)
    result = ff.fit(test, model="bistable+bistable", drive="displacement", starts=12)
    base, top = result.chain.springs
    assert base.sigma_a < 0.7 * top.sigma_a
    assert result.curves.interior == {}
    assert "displacement_1_time" not in result.misfit
    held = []
    for number, spring in ((1, SOFT), (2, STIFF)):
        for name, true in zip(NAMES, spring.seven, strict=True):
            item = result.parameters[f"s{number}_{name}"]
            if item.ci95 is not None:
                held.append(item.ci95[0] <= true <= item.ci95[1])
    assert len(held) >= 10
    assert np.mean(held) >= 0.85


@pytest.mark.parametrize("seed", [1, 2])
def test_two_springs_are_found_in_a_loop_of_many_kinks(seed):
    """Starts drawn at random had no right kink for some branch: misfits of 2 %, in 5 of 8 seeds."""
    long = ff.BistableSpring(2.343e6, 1.337e8, -1.184e5, 0.2537, 0.4623, 3.286e6, 7.377e5)
    stiff = ff.BistableSpring(2.781e7, 4.918e8, -1.246e5, 0.07821, 0.1792, 4.263e6, 1.359e7)
    chain, time = ff.Chain([long, stiff], [0.005, 0.005], 4.5e-5), np.linspace(0.0, 20.0, 300)
    motion = 3.31e-3 * (1.0 - np.abs(time / 10.0 - 1.0))
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), time).base_stress
    noise = 5e-4 * np.random.default_rng(3).standard_normal((2, 300))
    noisy = [x + np.ptp(x) * of_x for x, of_x in zip((stress, motion), noise, strict=True)]
    test = loop_measurement(*noisy, Specimen(0.01, 4.5e-5, heights=(0.005, 0.005)), time)
    result = ff.fit(test, model="bistable+bistable", seed=seed, intervals="local")
    assert result.misfit["stress_time"] < 1e-3
