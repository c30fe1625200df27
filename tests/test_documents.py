"""What the documents promise about each other: links, names and versions."""

import itertools
import json
import re
import tomllib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import foamfit as ff
from conftest import ROOT
from foamfit.springs import laws

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("fits/*.md"), *ROOT.glob("docs/*.md")]
LINK = re.compile(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"")


def links(page):
    """Targets of the links of a page, without those on the web and within the page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = (a or b for a, b in LINK.findall(text))
    return [t.partition("#")[0] for t in targets if not t.startswith(("http", "#"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    for target in links(page):
        source = target.replace("gallery/", "../notebooks/", 1)  # docs/conf.py copies these
        assert (page.parent / source).exists(), target


def test_every_public_name_is_in_the_reference():
    reference = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\.\. auto\w+:: (\w+)", reference, flags=re.MULTILINE)
    assert sorted(ff.__all__) == sorted(set(listed) - {"foamfit"})


def test_the_changelog_begins_with_the_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, flags=re.MULTILINE)[1] == project["version"]


# ------------------------------------------------------------------------------- a law of one's own

OWN_LAW = (ROOT / "docs" / "own_law.md").read_text(encoding="utf-8")
LAW_FILE = re.search(r"```python\n(.*?)```", OWN_LAW, flags=re.DOTALL)[1]
VALUES = {"k0": 5e5, "sigma_h": 8e4, "eps_h": 0.06, "beta": 0.6, "n": 1.4}


@pytest.fixture(scope="module")
def bouc_wen(tmp_path_factory):
    """The law of the documentation, known while a test of it runs."""
    before = dict(laws._LAWS)
    path = tmp_path_factory.mktemp("law") / "bouc_wen.py"
    path.write_text(LAW_FILE, encoding="utf-8")
    (law,) = laws.load_file(path)
    yield law
    laws._LAWS.clear()
    laws._LAWS.update(before)


def test_the_law_of_the_documentation_solves_its_equation(bouc_wen):
    corners = [0.0, 0.6, 0.3, 0.5]
    spring = bouc_wen.make([*VALUES.values(), 0.0], ())
    zeta = 0.0
    for start, end in itertools.pairwise(corners):
        way = np.sign(end - start)

        def slope(_, z, way=way):
            bent = VALUES["beta"] * np.sign(z * way) + 1.0 - VALUES["beta"]
            return (1.0 - np.abs(z) ** VALUES["n"] * bent) / VALUES["eps_h"]

        zeta = solve_ivp(slope, (start, end), [zeta], rtol=1e-10, atol=1e-12).y[0, -1]
    expected = VALUES["k0"] * 0.5 / 0.5 + VALUES["sigma_h"] * zeta
    fine = np.interp(np.linspace(0, 3, 301), range(4), corners)
    for strain in (corners, fine):  # whatever the steps on the way
        assert spring.stress(strain)[-1] == pytest.approx(expected, rel=1e-5)


def test_a_derivative_at_a_limit_of_the_law_is_one_sided(bouc_wen):
    strain = np.concatenate([np.linspace(0.0, 0.5, 50), np.linspace(0.5, 0.3, 20)])

    def response(beta, wanted=()):
        chain = ff.Chain(
            [bouc_wen.make([*(VALUES | {"beta": beta}).values(), 0.0], ())], [1e-2], 1e-4
        )
        drive = ff.DisplacementDrive(1e-2 * strain)
        return ff.simulate(chain, drive, np.arange(strain.size), sensitivities=wanted)

    found = response(1.0, ["s1_beta"])
    change = (found.base_stress - response(0.999).base_stress) / 0.001
    slope = found.sensitivities["s1_beta"].base_stress
    np.testing.assert_allclose(slope, change, rtol=0.02, atol=1e-3 * np.abs(change).max())


def test_the_notebook_has_the_law_of_the_documentation():
    notebook = ROOT / "notebooks" / "a_law_of_your_own.ipynb"
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    law = next("".join(cell["source"]) for cell in cells if cell["id"] == "law")
    assert LAW_FILE.strip().endswith(law)
