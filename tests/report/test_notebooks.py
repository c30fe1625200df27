"""The notebooks are stored with the outputs of their code, and their numbers are those of today."""

import json
import re
import runpy
from importlib import import_module

import nbformat
import numpy as np
import pytest

import foamfit as ff
from conftest import ROOT

NOTEBOOKS = ROOT / "notebooks"
LISTED = sorted(path.name for path in NOTEBOOKS.glob("*.ipynb"))
RUN = ("a_law_of_your_own.ipynb", "fit_a_new_test.ipynb")
PLACE = re.compile(r"/(?:tmp|home|root|opt|usr|Users)/|[A-Z]:\\|\b0x[0-9a-f]{6,}")
NUMBER = re.compile(r"[-−+]?\d+\.\d+(?:e[-+]\d+)?(?! s\b)")  # no run times


def outputs_of(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def text_of(notebook):
    """Return all printed text of a notebook, without warnings."""
    each = [one for one in outputs_of(notebook) if one.get("name") != "stderr"]
    return "\n".join(o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in each)


@pytest.mark.parametrize("name", LISTED)
def test_a_notebook_is_stored_as_notebooks_run_py_leaves_it(name):
    assert f"](gallery/{name})" in (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    path = NOTEBOOKS / name
    notebook, digest = nbformat.read(path, 4), runpy.run_path(str(NOTEBOOKS / "run.py"))["digest"]
    assert notebook.metadata["run"] == digest(notebook), f"python notebooks/run.py {path}"
    outputs = outputs_of(notebook)
    assert not [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert not PLACE.findall(text_of(notebook) + json.dumps([o.get("metadata") for o in outputs]))
    assert 1 <= sum("image/png" in output.get("data", {}) for output in outputs) <= 4
    assert path.stat().st_size < 1_000_000
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert all(hasattr(ff, used) for used in re.findall(r"\bff\.(\w+)", code))
    for module, names in re.findall(r"^from (foamfit[\w.]*) import (.+)$", code, re.MULTILINE):
        assert all(hasattr(import_module(module), one) for one in names.split(", "))


@pytest.mark.parametrize("name", RUN)
def test_the_numbers_of_a_notebook_are_those_stored(name, tmp_path, monkeypatch):
    from nbclient import NotebookClient

    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # ignore the user's start-up files
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    stored = NUMBER.findall(text_of(notebook).replace("−", "-"))
    resources = {"metadata": {"path": str(NOTEBOOKS)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    found = NUMBER.findall(text_of(notebook).replace("−", "-"))
    np.testing.assert_allclose(np.array(found, float), np.array(stored, float), rtol=0.02)
