"""Several cycles as one history, and springs with memory, from the file to the prediction."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
from conftest import Inline, run, run_refused, write_csv
from foamfit import Chain
from foamfit.data.cycles import cycles_of
from foamfit.data.measurement import Measurement
from foamfit.fitting.curves import default_weights
from foamfit.fitting.objective import Objective
from foamfit.springs.model import Model

TRUTH = ff.MicroscaleSpring(
    5e5, 3e5, 0.25, 1.2e5, 0.4, 5.5e4, 0.6, stiffening=1.8, softening=0.7, weakening=0.4
)
AREA, HEIGHT = 5e-5, 0.01
HEAD = "time (s),force (N),displacement (mm)"
TOML = '[specimen]\nheight = "10 mm"\narea = "50 mm^2"\n'


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write four synthetic cycles of one spring with arbitrary zeros and noise, as a rig would."""
    folder, rng = tmp_path_factory.mktemp("cycles"), np.random.default_rng(5)
    corners = np.array([0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0, 0.55, 0.0, 0.0])
    times = np.array([0.0, 0.4, 2.0, 3.6, 3.9, 5.5, 7.1, 7.4, 9.0, 10.6, 10.9, 12.5, 14.1, 14.4])
    t = np.arange(0.0, 14.4, 0.025)
    strain = np.interp(t, times, corners)
    force = AREA * TRUTH.stress(strain) + 0.05 + rng.normal(0.0, 0.02, t.size)
    moved = 1e3 * HEIGHT * strain + 3.0
    return write_csv(folder / "foam.csv", HEAD, t + 1.0, force, moved, toml=TOML)


def test_cycles_are_read_as_one_history(record: Path) -> None:
    test = ff.read_test(record, cycles=(1, 3))
    assert (test.cycle, test.last_cycle, test.cycles) == (1, 3, (1, 2, 3, 4))
    assert test.displacement is not None
    spans = cycles_of(test)
    assert list(spans) == [1, 2, 3]
    for part in spans.values():
        assert test.displacement[part].max() == pytest.approx(0.55 * HEIGHT, rel=0.01)
    later = ff.read_test(record, cycles=(2, 3))
    assert list(cycles_of(later)) == [2, 3]
    alone = ff.read_test(record, cycle=2)
    assert len(cycles_of(alone)) == 0
    found = ff.fit(alone, model="microscale", mullins=True, starts=1, intervals="local")
    assert any("as if nothing had snapped before it" in note for note in found.notes)


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        (["--cycles", "3-1"], "'3-1' is not FIRST-LAST in that order, like 1-3"),
        (["--cycles", "2"], "'2' is not FIRST-LAST"),
        (["--cycles", "1-9"], "cycle 9 cannot be taken: the file has cycles 1 to 4"),
        (["--cycles", "1-3", "--cycle", "2"], "either --cycle or --cycles, not both"),
        (["--mullins"], "mullins needs a microscale spring, and the model 'bistable' has none"),
        (["--stiffening", "--model", "linear"], "stiffening needs a microscale spring"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(record: Path, given: list[str], wrong: str) -> None:
    assert wrong in run_refused("fit", record, *given)


def test_cycles_of_a_record_without_any_are_refused(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 60)
    columns = (t, 0.3 * t, 2e5 * t)
    path = write_csv(tmp_path / "a.csv", "time (s),strain,stress (Pa)", *columns, toml=TOML)
    with pytest.raises(ff.InputError, match="cycles 1 to 3 cannot be taken: the record has no"):
        ff.read_test(path, cycles=(1, 3))


def test_one_set_of_parameters_for_all_cycles_and_the_next(record: Path, tmp_path: Path) -> None:
    """Parameters identified from cycles 1 to 3 of the file predict the fourth cycle."""
    call = ["fit", str(record), "--model", "microscale", "--stiffening", "--mullins"]
    call += ["--cycles", "1-3", "--starts", "3", "--out", str(tmp_path / "fit"), "--quiet"]
    run(*call, "--no-report")
    content = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert (content["model"], content["stiffening"], content["mullins"]) == (
        "microscale", True, True,
    )  # fmt: skip
    assert (content["data"]["cycle"], content["data"]["last_cycle"]) == (1, 3)
    assert Model.of_result(content).laws[0].own[-3:] == ("stiffening", "softening", "weakening")
    for name in ("softening", "weakening", "sigma_plus", "k0"):
        found = content["parameters"][f"s1_{name}"]
        assert abs(found["value"] - getattr(TRUTH, name)) < 4.0 * found["stderr"], name
        assert found["state"] == "determined"
    run("predict", tmp_path / "fit", record, "--cycles", "1-4", "--draws", "60",
        "--out", tmp_path / "next", "--quiet", "--no-report")  # fmt: skip
    found = json.loads((tmp_path / "next" / "prediction.json").read_text())["by_cycle"]
    assert list(found) == ["1", "2", "3", "4"]
    assert found["4"]["misfit"] < 0.01
    assert found["4"]["inside"] > 0.85


def test_a_batch_and_a_toml_take_several_cycles(record: Path, tmp_path: Path) -> None:
    out = tmp_path / "runs"
    rows = ff.batch(
        [record], out=out, model="microscale", mullins=True, cycles=(1, 2), starts=2,
        report=False, max_time=20.0, intervals="local", executor=Inline(),
    )  # fmt: skip
    assert rows["status"].tolist() != ["refused"], rows["error"].tolist()
    content = json.loads((out / "foam" / "fit.json").read_text())
    assert (content["data"]["last_cycle"], content["mullins"]) == (2, True)
    toml = record.with_name("own.toml")
    toml.write_text(record.with_suffix(".toml").read_text() + "[window]\ncycles = [2, 4]\n")
    assert ff.read_test(record, toml).last_cycle == 4
    assert ff.read_test(record, toml, cycle=1).last_cycle is None
    toml.write_text(record.with_suffix(".toml").read_text() + "[window]\ncycles = 3\n")
    with pytest.raises(ff.InputError, match=r"\[window\] cycles = 3 must be the numbers"):
        ff.read_test(record, toml)


@pytest.fixture(scope="module")
def lifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Chain]:
    """Write two cycles, after a preload, of a spring that recovers more slowly than the platen."""
    folder, rng = tmp_path_factory.mktemp("lifted"), np.random.default_rng(3)
    spring = replace(TRUTH, relaxation=((0.8, 0.5),))
    chain = ff.Chain([spring], [HEIGHT], AREA)
    t = np.arange(0.0, 8.0, 0.01)
    strain = np.interp(t, [0.4, 2.0, 3.6, 3.9, 5.5, 7.1], [0.0, 0.55, 0.0, 0.0, 0.55, 0.0])
    stress = ff.simulate(chain, ff.DisplacementDrive(HEIGHT * strain), t).base_stress
    assert stress.min() < -2e3  # without separation, the stress would be tensile
    stress = np.maximum(stress, 0.0) + np.where(t < 0.4, 2e3, 0.0)
    force = AREA * (stress + rng.normal(0.0, 100.0, t.size)) + 0.05
    moved = 1e3 * HEIGHT * strain + 3.0
    return write_csv(folder / "foam.csv", HEAD, t, force, moved, toml=TOML), chain


def test_the_stress_between_cycles_is_the_zero(lifted: tuple[Path, Chain]) -> None:
    offset = 0.05 / AREA
    history = ff.read_test(lifted[0], cycles=(1, 2))
    assert history.origins["stress_zero"] == pytest.approx(offset, abs=50.0)
    assert 5.0 < history.zeros["stress"] < 100.0
    assert any("between the first two cycles" in note for note in history.notes)
    one = ff.read_test(lifted[0])  # one cycle has no unloaded gap after it
    assert one.origins["stress_zero"] == pytest.approx(offset + 2e3, abs=50.0)


def test_a_specimen_that_has_lost_contact_bears_no_tension(lifted: tuple[Path, Chain]) -> None:
    file, chain = lifted
    history = ff.read_test(file, cycles=(1, 2))
    law = "microscale, stiffening, mullins"
    test = replace(history, noise=replace(history.noise, stress=100.0))
    spring = chain.springs[0]
    own = [getattr(spring, name) for name in Model((law,)).laws[0].own]
    values = np.array([*own, 0.0, 0.8, 0.5, 0.0])

    def of(one: Measurement, **given: bool) -> tuple[Objective, np.ndarray]:
        weights = default_weights(one, "displacement")
        made = Objective(one, Model((law,), 1), "displacement", weights, **given)
        return made, np.append(values, [made.usual[name] for name in made.nuisance])

    made, point = of(test)
    curve = made.simulate(point).curves["stress_strain"]
    lost = curve == 0.0
    assert curve.min() == 0.0
    assert lost.sum() > 20
    assert np.std(made.residual(point)[: made.n_data]) == pytest.approx(1.0, abs=0.2)
    pulling, there = of(replace(test, last_cycle=None), glued=True)
    assert pulling.simulate(there).curves["stress_strain"].min() < -2e3
    alone, _ = of(replace(test, last_cycle=None))  # a record without tension
    assert np.array_equal(alone.simulate(point).curves["stress_strain"], curve)
    # Derivatives are zero where contact is lost; elsewhere they equal central differences.
    places = np.arange(len(own))
    slopes = made.jacobian(point, places)
    assert not slopes[: lost.size][lost].any()
    step = 1e-4 * point[3]
    sides = [made.residual(point + side * step * (np.arange(point.size) == 3)) for side in (-1, 1)]
    differences = (sides[1] - sides[0]) / (2.0 * step)
    assert np.abs(slopes[:, 3] - differences).max() < 1e-2 * np.abs(differences).max()
