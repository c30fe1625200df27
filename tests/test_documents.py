"""Documents: snippets run, command lines are understood; links, names and versions agree."""

import re
import shlex
import shutil
import tomllib

import matplotlib.pyplot as plt
import pytest

import foamfit as ff
from conftest import RECONSTRUCTION, ROOT, small_pictures
from foamfit.cli import main
from foamfit.springs import laws

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"```(\w*)\n(.*?)```", flags=re.DOTALL)


def blocks(page, *languages):
    """Return the fenced blocks of a page in some languages."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [text for language, text in found if language in languages]


@pytest.fixture(scope="module")
def fitted():
    """The fit of the reconstruction that the pages use."""
    return ff.fit(ff.read_test(RECONSTRUCTION), model="bistable", starts=2)


@pytest.fixture
def place(here, monkeypatch, fitted):
    """A folder like that of a user, in which fits and pictures take little time."""
    (here / "experiments").symlink_to(ROOT / "experiments")
    shutil.copy(RECONSTRUCTION, here / "TEST.csv")
    shutil.copy(RECONSTRUCTION.with_suffix(".toml"), here / "TEST.toml")
    shutil.copy(ROOT / "notebooks/bouc_wen.py", here)
    fitted.save(here / "fits/TEST/bistable", report=False)
    monkeypatch.syspath_prepend(here)
    small_pictures(monkeypatch)
    own = ff.fit

    def fit(test, model="bistable", **more):
        quick = {"starts": 2, "intervals": "local", "max_time": 1.0}
        return own(test, model=model, **quick | more) if more or model != "bistable" else fitted

    monkeypatch.setattr(ff, "fit", fit)
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    monkeypatch.setattr(laws, "_TEXTS", dict(laws._TEXTS))
    return here


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page, "python")], ids=lambda page: page.name
)
def test_the_snippets_of_a_page_run_in_turn(page, place, fitted):
    _, axes = plt.subplots(1, 2)
    known = {"ff": ff, "result": fitted, "test": fitted.measurement, "axes": axes}
    for text in blocks(page, "python"):
        exec(compile(text, page.name, "exec"), known)
    plt.close("all")


LINES = [
    (page.name, line.strip())
    for page in PAGES
    for text in blocks(page, "", "bash", "sh", "console")
    for line in text.splitlines()
    if line.strip().startswith("foamfit ")
]


@pytest.mark.parametrize(("page", "line"), LINES, ids=lambda one: one[:60])
def test_a_command_of_a_page_is_understood(page, line, place):
    _, name, *arguments = shlex.split(line.split("  #")[0].split(" # ")[0])
    command = main.commands[name]
    command.make_context(name, [one for one in arguments if one != "…"])


def test_the_commands_in_the_table_of_the_first_page_are_all_commands():
    text = (ROOT / "docs/start.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `foamfit (\w+)", text, flags=re.MULTILINE)) == set(main.commands)


LINKED = [*ROOT.glob("*.md"), *ROOT.glob("fits/*.md"), *ROOT.glob("docs/*.md")]
LINK = re.compile(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"")


def links(page):
    """Return the link targets of a page, except web addresses and anchors in the page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = (a or b for a, b in LINK.findall(text))
    return [t.partition("#")[0] for t in targets if not t.startswith(("http", "#"))]


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(ROOT)))
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
