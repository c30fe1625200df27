"""--open shows the report in the browser, or reports that no browser was found."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

import fabricated
from conftest import RECONSTRUCTION, run, run_refused, without_pictures
from foamfit import api


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a browser and return the list of opened addresses."""
    found: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(found.append(address)) or True)
    without_pictures(monkeypatch)
    return found


def fit(monkeypatch: pytest.MonkeyPatch, *args: str, **changed: Any) -> Result:
    made = fabricated.result(**changed)
    monkeypatch.setattr(api, "fit", lambda *_, **__: made)
    return run("fit", str(RECONSTRUCTION), "--out", "r", *args)


@pytest.mark.parametrize(("status", "code"), [("ok", 0), ("warnings", 0), ("failed", 2)])
def test_the_report_is_opened_whatever_was_found(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, status: str, code: int
) -> None:
    assert fit(monkeypatch, "--open", status=status).exit_code == code
    assert opened == [(Path.cwd() / "r" / "report.html").as_uri()]


@pytest.mark.parametrize("failure", [False, webbrowser.Error("could not locate runnable browser")])
def test_without_a_browser_a_sentence_says_so_and_the_exit_code_stays(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, failure: Any
) -> None:
    def refuse(_: str) -> bool:
        if failure:
            raise failure
        return False

    monkeypatch.setattr(webbrowser, "open", refuse)
    told = fit(monkeypatch, "--open", "--quiet")
    assert told.exit_code == 0
    assert told.stdout == ""
    path = Path("r") / "report.html"
    assert told.stderr == f"foamfit: no browser could be opened; open {path} by hand\n"


@pytest.mark.parametrize(
    "command",
    [["fit", "a.csv"], ["batch", "a.csv"], ["joint", "a.toml"], ["predict", "r", "a.csv"]],
)
def test_json_for_a_program_and_a_browser_exclude_each_other(
    opened: list[str], command: list[str]
) -> None:
    told = run_refused(*command, "--open", "--json")
    assert told == "foamfit: --open and --json exclude each other; leave one of them out\n"
