"""The notebooks run, and are stored as they should be."""

import json

import pytest

from conftest import ROOT

NOTEBOOKS = ROOT / "notebooks"
LISTED = (
    "a_law_of_your_own.ipynb",
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
    """Where they lie, the other notebooks are run by nbmake: see addopts in pyproject.toml.

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
    shown = [o["data"]["text/html"] for o in outputs if "text/html" in o.get("data", {})]
    assert any("Sliders" in html and "s1_k0" in html for html in shown)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert sorted(folder.iterdir()) == before
