"""The notebooks run, and are stored as they should be; their sliders do what they say."""

import json

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS, ROOT, synthetic_impact, synthetic_loop
from foamfit.data.measurement import Measurement, Specimen
from foamfit.report.explore import POINTS, Turner, loop_of, plot_loop, rough_guess, turn
from foamfit.report.explore import UNITS as NAMES

NOTEBOOKS = ROOT / "notebooks"
LISTED = (
    "fit_a_new_test.ipynb",
    "fitted_against_published.ipynb",
    "turn_the_parameters.ipynb",
)
REAL = EXPERIMENTS / "foam-1" / "model-2-2.0mps-reconstruction.csv"


# ------------------------------------------------------------------------------- the notebooks


def test_every_notebook_is_listed():
    found = (path.name for path in NOTEBOOKS.rglob("*.ipynb") if "checkpoint" not in str(path))
    assert sorted(found) == sorted(LISTED)


@pytest.mark.parametrize("name", LISTED)
def test_notebook_is_stored_clean(name):
    content = json.loads((NOTEBOOKS / name).read_text(encoding="utf-8"))
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    assert set(content["metadata"]) == {"kernelspec", "language_info"}
    identities = [cell["id"] for cell in content["cells"]]
    assert len(set(identities)) == len(identities)
    for cell in content["cells"]:
        assert cell["metadata"] == {}
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


@pytest.mark.parametrize(("name", "folder"), [(LISTED[-1], ROOT)])
def test_notebook_runs_quietly_from_the_root(name, folder, tmp_path, monkeypatch):
    """Where they lie, all notebooks are run by nbmake: see testpaths in pyproject.toml."""
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))  # whatever the user's own start-up files do
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    before = sorted(folder.iterdir())
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert outputs
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert sorted(folder.iterdir()) == before


# ---------------------------------------------------------------------- the spring that is turned


def test_turn_gives_the_stress_of_the_spring_and_its_misfit():
    spring, measurement = synthetic_loop()
    strain, measured = loop_of(measurement)
    turned = turn(strain, measured, {name: getattr(spring, name) for name in NAMES})
    assert turned.trouble == ""
    assert turned.spring == spring
    np.testing.assert_array_equal(turned.stress, spring.stress(strain))
    assert turned.misfit == pytest.approx(0.005, rel=0.1)  # the noise of the loop


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("eps_c", 0.05, "eps_c = 0.05 is not admissible"), ("dsigma", -1e9, "at most 0")],
)
def test_turn_says_what_would_be_admissible(name, value, said):
    spring, measurement = synthetic_loop()
    values = {other: getattr(spring, other) for other in NAMES} | {name: value}
    turned = turn(*loop_of(measurement), values)
    assert turned.spring is turned.stress is turned.misfit is None
    assert said in turned.trouble


def test_turn_says_where_a_branch_ends():
    spring, measurement = synthetic_loop()
    values = {name: getattr(spring, name) for name in NAMES}
    strain, measured = loop_of(measurement)
    turned = turn(strain * 4.0, measured, values)  # past 1 + eps_star
    assert turned.spring == spring
    assert turned.stress is None
    assert "end of its branch" in turned.trouble


def drawn(spring):
    """Points named in the picture of a spring, and where they lie (strain, MPa)."""
    _, measurement = synthetic_loop()
    values = {name: getattr(spring, name) for name in NAMES}
    (ax,) = plot_loop(measurement, turn(*loop_of(measurement), values)).axes
    return {text.get_text(): text.xy for text in ax.texts if text.get_text() in POINTS}


def test_points_lie_on_the_branches_they_join():
    spring = ff.published["foam-1/model-1"].bistable
    found = drawn(spring)
    assert set(found) == {"A1", "C1", "C2", "A2"}
    hat_c = found["C1"][0]
    along = spring.stress([found["A1"][0], hat_c, hat_c + 1e-9, found["C2"][0], found["A2"][0]])
    expected = [1e6 * found[name][1] for name in ("A1", "C1", "C2", "A2")]
    np.testing.assert_allclose(along[[0, 1, 3, 4]], expected, rtol=1e-6, atol=1.0)


def test_points_leave_out_a2_where_the_branches_do_not_meet():
    spring = ff.BistableSpring(1e6, 50e6, -5e4, 0.3, 0.6, 2e6, 1e9)
    assert spring.eps_hat_a is None
    assert set(drawn(spring)) == {"A1", "C1", "C2"}


@pytest.mark.parametrize("make", [synthetic_impact, synthetic_loop])
def test_rough_guess_can_be_drawn_but_is_no_fit(make):
    _, measurement = make()
    turned = turn(*loop_of(measurement), rough_guess(measurement))
    assert 0.05 < turned.misfit < 0.3


def test_loop_needs_stress_and_displacement():
    bare = Measurement("bare", None, "", None, np.zeros(3), None, Specimen(1e-3, 1e-5))
    with pytest.raises(ff.InputError, match="bare: a loop needs a force or stress column, and a"):
        loop_of(bare)


def test_what_is_not_admissible_leaves_the_measured_loop():
    _, measurement = synthetic_loop()
    values = rough_guess(measurement) | {"eps_c": 0.01}
    (ax,) = plot_loop(measurement, turn(*loop_of(measurement), values)).axes
    assert len(ax.lines) == 1
    assert [text.get_text() for text in ax.texts] == ["not admissible"]


# ----------------------------------------------------------------------------------- the sliders


@pytest.fixture
def turner():
    return Turner(ff.read_test(REAL))


def test_moving_a_slider_redraws(turner):
    before, picture = turner.turned.misfit, turner.image.value
    turner.sliders["eps_a"].value *= 1.5
    assert turner.turned.misfit != before
    assert turner.turned.spring.eps_a == turner.sliders["eps_a"].value
    assert turner.image.value != picture
    assert bytes(turner.image.value).startswith(b"\x89PNG")
    assert turner.sentence == ""


def test_what_is_not_admissible_is_said_and_not_fitted(turner):
    turner.set({"eps_c": 0.01})
    assert turner.sentence == turner.turned.trouble
    assert "eps_c = 0.01 is not admissible" in turner.sentence
    turner.fit_from_here()
    assert turner.result is None
    assert "eps_c = 0.01 is not admissible" in turner.sentence
    assert not turner.buttons["fit from here"].disabled


def test_reset_moves_back(turner):
    start = turner.values
    turner.set({"k0": 9e9, "dsigma": -1e5})  # beyond the slider, which widens
    assert turner.values["k0"] == pytest.approx(9e9)
    turner.buttons["reset"].click()
    assert turner.values == pytest.approx(start)


def test_fit_from_here_moves_the_sliders_to_the_fit(turner):
    turner.buttons["fit from here"].click()
    assert turner.result.status == "ok"
    assert turner.sentence.startswith("Fitted in the impact drive")
    assert turner.result.drive == "impact"
    assert turner.turned.misfit < 0.04
    published = ff.published["foam-1/model-2"].bistable
    for name in ("eps_a", "eps_c", "kh_plus", "kc"):
        assert turner.values[name] == pytest.approx(getattr(published, name), rel=0.05)
        assert turner.values[name] == pytest.approx(turner.result.params[f"s1_{name}"].value)


def test_a_fit_that_cannot_be_made_is_said(turner, monkeypatch):
    def refuse(*_, **__):
        raise ff.SimulationError("nothing could be simulated")

    monkeypatch.setattr("foamfit.api.fit", refuse)
    turner.fit_from_here()
    assert turner.panel.children[1].value == "No fit: nothing could be simulated"
    assert not turner.buttons["fit from here"].disabled


def test_start_from_a_spring_of_ones_own():
    spring = ff.published["foam-1/model-2"].bistable
    turner = Turner(ff.read_test(REAL), spring)
    assert turner.turned.misfit < 0.04
    turner.reset()
    assert turner.values == pytest.approx({name: getattr(spring, name) for name in NAMES})
