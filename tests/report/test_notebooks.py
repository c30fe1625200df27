"""The notebooks are stored with their outputs and run without errors."""

import json
import re
import runpy

import nbformat
import pytest

from conftest import ROOT

NOTEBOOKS = ROOT / "notebooks"
LISTED = (
    "a_chain_along_its_loop.ipynb",
    "a_law_of_your_own.ipynb",
    "fit_a_new_test.ipynb",
    "fitted_against_published.ipynb",
    "what_changes_by_cycle.ipynb",
    "which_test_next.ipynb",
    "turn_the_parameters.ipynb",
)
PLACE = re.compile(r"/(?:tmp|home|root|opt|usr|Users)/|[A-Z]:\\|\b0x[0-9a-f]{6,}")


def test_every_notebook_is_listed():
    found = (path.name for path in NOTEBOOKS.rglob("*.ipynb") if "checkpoint" not in str(path))
    assert sorted(found) == sorted(LISTED)
    gallery = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert all(f"](gallery/{name})" in gallery for name in LISTED)


@pytest.mark.parametrize("name", LISTED)
def test_a_notebook_is_stored_as_notebooks_run_py_leaves_it(name):
    path = NOTEBOOKS / name
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    digest = runpy.run_path(str(NOTEBOOKS / "run.py"))["digest"]
    assert notebook.metadata["run"] == digest(notebook), f"python notebooks/run.py {path}"
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
    text = json.dumps([{**o, "data": without_pictures(o)} for o in outputs], ensure_ascii=False)
    assert not PLACE.findall(text)
    assert 1 <= sum("image/png" in output.get("data", {}) for output in outputs) <= 4
    assert path.stat().st_size < 1_000_000


def without_pictures(output):
    """Return the text of an output without its pictures."""
    return {kind: one for kind, one in output.get("data", {}).items() if "image" not in kind}


@pytest.mark.parametrize("name", [LISTED[-1]])
def test_notebook_runs_quietly_from_the_root(name, tmp_path, monkeypatch):
    """nbmake runs the other notebooks in their own folder: see addopts in pyproject.toml.

    The notebook runs in a copy of the root made of links, so that it sees no files of other tests.
    """
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # ignore the user's start-up files
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
