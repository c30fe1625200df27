"""The notebooks run, and are stored as they should be; what their sliders draw is right."""

import json
from dataclasses import replace

import numpy as np
import pytest

import foamfit as ff
from conftest import ROOT, synthetic_impact, synthetic_loop
from foamfit.data.measurement import Measurement, Specimen
from foamfit.report.explore import POINTS, plot_loop, rough_guess
from foamfit.report.explore import UNITS as NAMES

NOTEBOOKS = ROOT / "notebooks"
LISTED = (
    "fit_a_new_test.ipynb",
    "fitted_against_published.ipynb",
    "what_changes_by_cycle.ipynb",
    "turn_the_parameters.ipynb",
)


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


@pytest.mark.parametrize("name", [LISTED[-1]])
def test_notebook_runs_quietly_from_the_root(name, tmp_path, monkeypatch):
    """Where they lie, all notebooks are run by nbmake: see testpaths in pyproject.toml.

    The root is one of links to what is in it, where no other test leaves files meanwhile.
    """
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # whatever start-up files do
    folder = tmp_path / "root"
    folder.mkdir()
    for path in ROOT.iterdir():
        (folder / path.name).symlink_to(path)
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    before = sorted(folder.iterdir())
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("application/vnd.jupyter.widget-view+json" in o.get("data", {}) for o in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert sorted(folder.iterdir()) == before


# ---------------------------------------------------------------------- the spring that is turned


def drawn(values, measurement=None):
    """The axes of the picture of a spring over a measured loop."""
    (ax,) = plot_loop(measurement or synthetic_loop()[1], values).axes
    return ax


def texts(ax):
    return " ".join(" ".join(text.get_text().split()) for text in ax.texts)


def points(spring):
    """Points named in the picture of a spring, and where they lie (strain, MPa)."""
    ax = drawn({name: getattr(spring, name) for name in NAMES})
    return {text.get_text(): text.xy for text in ax.texts if text.get_text() in POINTS}


def test_the_picture_has_the_stress_of_the_spring_and_its_misfit():
    spring, measurement = synthetic_loop()
    ax = drawn({name: getattr(spring, name) for name in NAMES}, measurement)
    strain, stress = ax.lines[1].get_data()
    np.testing.assert_allclose(1e6 * stress, spring.stress(strain))
    assert "misfit 0.5% of the range" in texts(ax)  # the noise of the loop


@pytest.mark.parametrize(
    ("changed", "stretch", "said"),
    [
        ({"eps_c": 0.05}, 1.0, "eps_c = 0.05 is not admissible"),
        ({"dsigma": -1e9}, 1.0, "at most 0"),
        ({}, 4.0, "end of its branch"),  # past 1 + eps_star
    ],
)
def test_what_is_not_admissible_is_said_and_leaves_the_measured_loop(changed, stretch, said):
    spring, measurement = synthetic_loop()
    measurement = replace(measurement, displacement=stretch * measurement.displacement)
    ax = drawn({name: getattr(spring, name) for name in NAMES} | changed, measurement)
    assert said in texts(ax)
    assert len(ax.lines) == 1


def test_points_lie_on_the_branches_they_join():
    spring = ff.published["foam-1/model-1"].bistable
    found = points(spring)
    assert set(found) == {"A1", "C1", "C2", "A2"}
    hat_c = found["C1"][0]
    along = spring.stress([found["A1"][0], hat_c, hat_c + 1e-9, found["C2"][0], found["A2"][0]])
    expected = [1e6 * found[name][1] for name in ("A1", "C1", "C2", "A2")]
    np.testing.assert_allclose(along[[0, 1, 3, 4]], expected, rtol=1e-6, atol=1.0)


def test_points_leave_out_a2_where_the_branches_do_not_meet():
    spring = ff.BistableSpring(1e6, 50e6, -5e4, 0.3, 0.6, 2e6, 1e9)
    assert spring.eps_hat_a is None
    assert set(points(spring)) == {"A1", "C1", "C2"}


@pytest.mark.parametrize("make", [synthetic_impact, synthetic_loop])
def test_rough_guess_can_be_drawn_but_is_no_fit(make):
    _, measurement = make()
    told = texts(drawn(rough_guess(measurement), measurement))
    assert 5.0 < float(told.split("misfit ")[1].split("%")[0]) < 30.0


def test_loop_needs_stress_and_displacement():
    bare = Measurement("bare", None, "", None, np.zeros(3), None, Specimen(1e-3, 1e-5))
    with pytest.raises(ff.InputError, match="bare: a loop needs a force or stress column, and a"):
        plot_loop(bare, {})
