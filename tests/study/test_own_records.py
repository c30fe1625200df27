"""Parameters of the record (contact, zeros, velocity) in joint fits, predictions and intervals.

The impacts are synthetic records of a rig (`experiments/recovery/rig.py`, which shares no code
with foamfit). Each has its own clock, zeros and striker.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
import rig
from foamfit.springs.parameters import NUISANCE
from foamfit.study.identified import read_source

SPRING = tuple(f"s1_{name}" for name in (
    "k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta",
))  # fmt: skip
# Recorded from before contact; from contact on; with a velocity ± 1 %; force only.
SETUPS = (
    rig.Impact(before=0.4, samples=250),
    rig.Impact(trimmed=True, samples=250),
    rig.Impact(velocity_sd=0.01, samples=250),
    rig.Impact(channels=("force",), samples=250),
)
FASTER = (1.0, 0.9, 1.1, 1.05)


def write_impacts(folder: Path, seed: int, setups=SETUPS) -> list[rig.Record]:
    """Write impacts t0, t1, … on one spring by strikers of different velocities."""
    drawn = rig.drawn_impact(setups[0], np.random.default_rng([seed, 1])).rig
    records = []
    with pytest.MonkeyPatch.context() as patch:
        for i, (setup, factor) in enumerate(zip(setups, FASTER, strict=False)):
            one = replace(drawn, velocity=factor * drawn.velocity)
            course = one.run(0.0, 100.0 * one.heights[0] / one.velocity)
            patch.setattr(rig, "drawn_impact", lambda *_, course=course: course)
            records.append(rig.impact(setup, 100 * seed + i))
            rig.write(records[-1], folder, f"t{i}")
    return records


def fit_together(folder: Path, seed: int):
    records = write_impacts(folder, seed)
    shared = "\n".join(f'{name} = "shared"' for name in SPRING)
    (folder / "study.toml").write_text(
        f'tests = ["t*.csv"]\nmodel = "bistable"\nstarts = 2\n[parameters]\n{shared}\n'
    )
    return records, ff.joint(folder / "study.toml")


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    folder = tmp_path_factory.mktemp("impacts")
    return folder, *fit_together(folder, 0)


def test_each_test_has_its_own_contact_zero_and_striker(together):
    _, records, found = together
    content = json.loads(json.dumps(found.to_json_dict(), allow_nan=False))["parameters"]
    assert list(content)[-len(set(content) & set(NUISANCE)) :] == [
        name for name in NUISANCE if name in content
    ]  # after the parameters of the springs
    assert content.keys() & NUISANCE.keys() == {
        "contact_time", "displacement_zero", "stress_zero", "velocity",
    }  # fmt: skip
    tests = {name: set(content[name]["tests"]) for name in content if name in NUISANCE}
    assert tests["contact_time"] == {"t0", "t1", "t2", "t3"}
    assert tests["displacement_zero"] == {"t0", "t1", "t2"}  # t3 records force only
    assert tests["velocity"] == {"t2"}
    for name in ("contact_time", "displacement_zero", "velocity"):
        assert content[name]["kind"] == "own"
        for test, one in content[name]["tests"].items():
            truth = records[int(test[1:])].truth[name]  # in the clock and zeros of the file
            assert abs(one["value"] - truth) < 4.0 * one["stderr"]
            assert one["ci95"][0] < one["value"] < one["ci95"][1]


def test_intervals_of_shared_values_hold_the_truth(together, tmp_path):
    """Over 20 draws, 93 % do (147 of 158). Of the 16 intervals here, one may miss."""
    inside, off = [], []
    for records, found in (together[1:], fit_together(tmp_path, 1)):
        for name in SPRING:
            one, truth = found.parameters[name], records[0].truth[name]
            inside.append(one.ci95[0] <= truth <= one.ci95[1])
            off.append(abs(one.value - truth) / one.stderr)
    assert np.mean(inside) > 0.9
    assert max(off) < 4.0


@pytest.fixture(scope="module")
def fitted(together):
    folder, _, _ = together
    return ff.fit(ff.read_test(folder / "t0.csv"), starts=2, intervals="local")


def test_an_unseen_impact_is_aligned_before_it_is_compared(together, fitted):
    folder, records, found = together
    for result in (found, fitted):
        for i in (0, 2, 3):
            made, truth = ff.predict(result, folder / f"t{i}.csv", draws=60), records[i].truth
            assert made.aligned["contact_time"] == pytest.approx(
                truth["contact_time"], abs=0.02 * records[i].course.end
            )
            assert made.parameters.keys() == {*SPRING, "site_eta"}
            assert all(share > 0.9 for share in made.inside.values())
            assert "not predicted (with the springs fixed)" in " ".join(made.sentences)
            assert made.to_json_dict()["aligned"] == made.aligned


def test_nothing_of_a_record_is_carried_to_another(together, fitted):
    source = read_source(fitted)
    assert not {*source.parameters, *source.correlation[0]} & NUISANCE.keys()
    assert set(source.correlation[0]) == set(fitted.correlation.names) - NUISANCE.keys()
    # the same impact written in two ways gets the same prediction
    folder, records, _ = together
    other = folder / "other"
    other.mkdir()
    moved = {name: values[20:].copy() for name, values in records[0].channels.items()}
    moved["displacement"] += 2e-3
    rig.write(replace(records[0], time=records[0].time[20:] + 5.0, channels=moved), other, "t0")
    one, two = (ff.predict(fitted, f / "t0.csv", draws=60) for f in (folder, other))
    assert two.aligned["contact_time"] - one.aligned["contact_time"] == pytest.approx(5.0, abs=1e-6)
    for curve, off in one.misfit.items():
        assert off == pytest.approx(two.misfit[curve], rel=0.05)


def write_slow(folder: Path, seeds, law="microscale", rows=400):
    """Write slow tests of one spring; the displacement has noise of 0.3 % of its range."""
    setup = rig.Slow(law=law, rows=rows)
    course = rig.drawn_slow(setup, np.random.default_rng([seeds[0], 1]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig, "drawn_slow", lambda *_: course)
        return [rig.write(rig.slow(setup, seed), folder, f"t{seed}") for seed in seeds]


def test_the_band_holds_what_a_noisy_motion_leaves_uncertain(tmp_path):
    """Over 20 springs, each predicted from one fit, the band contains 94 to 96 % of the samples."""
    first, *others = write_slow(tmp_path, range(10, 15))
    result = ff.fit(ff.read_test(first), model="microscale", starts=2, intervals="local")
    made = [ff.predict(result, path, draws=60) for path in others]
    assert 0.93 < np.mean([one.inside["stress_strain"] for one in made]) < 0.99
    for one in made:
        curve = one.curves["stress_strain"]
        assert curve.half_width_of("motion") > 0.0
        assert "stress half width, motion (Pa)" in one.columns


def test_what_nothing_shows_cannot_vary(together):
    test = ff.read_test(together[0] / "t1.csv")
    params = ff.make_params(test)
    params["acceleration_zero"].set(vary=True)
    with pytest.raises(ff.InputError, match="'acceleration_zero' cannot vary"):
        ff.fit(test, params=params)
