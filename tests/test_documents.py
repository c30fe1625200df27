"""Consistency of the documents: links, names and versions."""

import re
import tomllib

import pytest

import foamfit as ff
from conftest import ROOT

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("fits/*.md"), *ROOT.glob("docs/*.md")]
LINK = re.compile(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"")


def links(page):
    """Return the link targets of a page, except web addresses and anchors in the page."""
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


def test_the_page_on_laws_shows_the_law_of_the_notebook():
    page = (ROOT / "docs" / "own_law.md").read_text(encoding="utf-8")
    shown = re.search(r"```python\n(.*?)```", page, flags=re.DOTALL)[1]
    assert shown == (ROOT / "notebooks" / "bouc_wen.py").read_text(encoding="utf-8")


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 700
