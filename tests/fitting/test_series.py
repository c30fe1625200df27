"""Two springs in series: exchanges between springs, and intervals that hold the truth."""

import numpy as np
import pytest

import foamfit as ff
import rig
import truth
from conftest import AREA, HEIGHT, NAMES, loop_measurement
from foamfit.data.measurement import Specimen
from foamfit.fitting.problem import make_problem
from foamfit.fitting.together import Links
from foamfit.springs.model import Model, exchanges
from foamfit.study.joint_fit import fit_jointly, parameters_of

SOFT = ff.BistableSpring(2.0e6, 9e7, -9e4, 0.055, 0.22, 6e5, 1.1e5)
STIFF = ff.BistableSpring(1.2e6, 3e7, -6e4, 0.20, 0.50, 3e5, 2.2e5)
SEVENS = {
    "bistable": [SOFT.seven, STIFF.seven],
    "microscale": [(1e6, 3e6, 0.5, 2e5, 0.3, 8e4, 0.5), (2e6, 4e6, 0.6, 4e5, 0.2, 2e5, 0.4)],
}


@pytest.mark.parametrize(("law", "springs"), SEVENS.items())
def test_an_exchange_keeps_the_stresses_at_which_springs_snap(law, springs):
    model = Model.parse(f"{law}+{law}")
    values, places = np.ones(len(model.names)), [model.index[f"s{i}_k0"] for i in (1, 2)]
    for first, seven in zip(places, springs, strict=True):
        values[first : first + 7] = seven

    def kept(vector):
        """Return the stresses at which the springs snap, and their stiffnesses."""
        own = [vector[first : first + 7] for first in places]
        snaps = [x[3] if law == "microscale" else x[0] * x[3] / (1 - x[3]) for x in own]
        return sorted(snaps) + sorted(x[0] for x in own)

    made = list(exchanges(model, values))
    assert len(made) == 63  # 2⁷/2 partitions of seven properties, minus the one without exchange
    assert len({tuple(vector) for vector in made}) == 63
    for vector in made:
        assert kept(vector) == pytest.approx(kept(values))


def test_intervals_of_two_springs_hold_the_truth():
    """With 0.2 % noise, at least 85 % of the intervals contain the true value."""
    chain = ff.Chain([STIFF, SOFT], [0.005, 0.005], 4.5e-5)  # the fit must swap them
    time = np.linspace(0.0, 4.0, 151)
    motion = 0.0037 * (1.0 - np.abs(0.5 * time - 1.0))
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), time).base_stress
    rng = np.random.default_rng(3)
    noisy = stress + 0.002 * np.ptp(stress) * rng.standard_normal(stress.size)
    test = loop_measurement(noisy, motion, Specimen(0.01, 4.5e-5, heights=(0.005, 0.005)), time)
    result = ff.fit(test, model="bistable+bistable", drive="displacement", starts=12)
    base, top = result.chain.springs
    assert base.sigma_a < 0.7 * top.sigma_a
    assert result.curves.interior == {}
    assert "displacement_1_time" not in result.misfit
    names = [f"s{number}_{name}" for number in (1, 2) for name in NAMES]
    pairs = zip(names, (*SOFT.seven, *STIFF.seven), strict=True)
    known = [(result.parameters[name].ci95, true) for name, true in pairs]
    held = [ci95[0] <= true <= ci95[1] for ci95, true in known if ci95 is not None]
    assert len(held) >= 10
    assert np.mean(held) >= 0.85


@pytest.mark.parametrize("seed", [1, 2])
def test_two_springs_are_found_in_a_loop_of_many_kinks(seed):
    """Starts drawn at random had no right kink for some branch: misfits of 2 %, in 5 of 8 seeds."""
    long = ff.BistableSpring(2.343e6, 1.337e8, -1.184e5, 0.2537, 0.4623, 3.286e6, 7.377e5)
    stiff = ff.BistableSpring(2.781e7, 4.918e8, -1.246e5, 0.07821, 0.1792, 4.263e6, 1.359e7)
    chain, time = ff.Chain([long, stiff], [0.005, 0.005], 4.5e-5), np.linspace(0.0, 20.0, 150)
    motion = 3.31e-3 * (1.0 - np.abs(time / 10.0 - 1.0))
    stress = ff.simulate(chain, ff.DisplacementDrive(motion), time).base_stress
    noise = 5e-4 * np.random.default_rng(3).standard_normal((2, 150))
    noisy = [x + np.ptp(x) * of_x for x, of_x in zip((stress, motion), noise, strict=True)]
    test = loop_measurement(*noisy, Specimen(0.01, 4.5e-5, heights=(0.005, 0.005)), time)
    result = ff.fit(test, model="bistable+bistable", seed=seed, intervals="local")
    assert result.misfit["stress_time"] < 1e-3


def test_a_joint_fit_exchanges_branches_between_springs(tmp_path):
    """From exchanged branches c, a descent alone called the wrong values determined."""
    soft = truth.Bistable(6.27e6, 1.01e8, -2.03e6, 0.318, 0.498, 7.18e6, 1.25e6)
    stiff = truth.Bistable(1.64e7, 3.7e8, -1.51e6, 0.307, 0.499, 4.36e7, 8.88e6)
    problems, vectors = [], []
    for seed, speed in enumerate((4.0, 5.3)):
        course = truth.Rig((soft, stiff), (6e-4, 6e-4), AREA, 7e-3, speed).run(0.0, 0.03)
        made = rig.recorded(rig.Impact(samples=150), course, seed)
        test = ff.read_test(rig.write(made, tmp_path, f"{seed}"))
        problems.append(make_problem(test, "bistable+bistable", "impact", None, None, False))
        values = made.truth | {"s1_kc": stiff.kc, "s2_kc": soft.kc}
        vectors.append(problems[-1].vector())
        names = problems[-1].model.names
        for name in names:
            vectors[-1][problems[-1].index[name]] = values.get(name, HEIGHT)
    links = Links(dict.fromkeys(names, "shared"))
    found = parameters_of(fit_jointly(problems, links, [vectors]), ("0", "1"))
    for name in ("s1_kc", "s2_kc"):
        assert found[name].state == "weak"
        assert found[name].ci95[0] < made.truth[name] < found[name].ci95[1]
