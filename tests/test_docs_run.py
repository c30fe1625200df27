"""The snippets of README and documentation run, and their command lines are understood."""

import re
import shlex
import shutil

import matplotlib.pyplot as plt
import pytest

import foamfit as ff
from conftest import RECONSTRUCTION, ROOT
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
    return ff.fit(ff.read_test(RECONSTRUCTION), model="bistable")


@pytest.fixture
def place(tmp_path, monkeypatch, fitted):
    """A folder like that of a user, in which the same test is fitted only once."""
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    shutil.copy(RECONSTRUCTION, tmp_path / "TEST.csv")
    shutil.copy(RECONSTRUCTION.with_suffix(".toml"), tmp_path / "TEST.toml")
    shutil.copy(ROOT / "notebooks/bouc_wen.py", tmp_path)
    fitted.save(tmp_path / "fits/TEST/bistable", report=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    own = ff.fit

    def fit(test, model="bistable", **more):
        return own(test, model=model, **more) if more or model != "bistable" else fitted

    monkeypatch.setattr(ff, "fit", fit)
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    monkeypatch.setattr(laws, "_TEXTS", dict(laws._TEXTS))
    return tmp_path


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
