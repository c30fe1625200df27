"""--open shows the report in the browser, or reports that no browser was found."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

import fabricated
import foamfit as ff
from conftest import EXPERIMENTS, without_pictures
from foamfit import api
from foamfit.cli import main

RECONSTRUCTION = EXPERIMENTS / "foam-1" / "model-1-2.0mps-reconstruction.csv"


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
    return CliRunner().invoke(main, ["fit", str(RECONSTRUCTION), "--out", "r", *args])


@pytest.mark.parametrize(("status", "code"), [("ok", 0), ("warnings", 0), ("failed", 2)])
def test_the_report_is_opened_whatever_was_found(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, status: str, code: int
) -> None:
    assert fit(monkeypatch, "--open", status=status).exit_code == code
    assert opened == [(Path.cwd() / "r" / "report.html").as_uri()]


def test_nothing_is_opened_unasked_or_where_nothing_is_found(
    opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fit(monkeypatch).exit_code == 0
    assert CliRunner().invoke(main, ["fit", "none.csv", "--open"]).exit_code == 1
    assert opened == []


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
    told = CliRunner().invoke(main, [*command, "--open", "--json"])
    assert told.exit_code == 1
    assert told.stderr == ("foamfit: --open and --json exclude each other; leave one of them out\n")


def test_cycles_open_their_picture(opened: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    failed = {1: fabricated.result(status="failed")}
    found = ff.CycleFits("foam", "bistable", (1,), failed, {})
    monkeypatch.setattr(ff.CycleFits, "save", lambda *_, **__: None)
    monkeypatch.setattr("foamfit.study.cycles.fit_cycles", lambda *_, **__: found)
    monkeypatch.setattr("foamfit.report.studies.cycles.cycles_text", lambda _: "told")
    told = CliRunner().invoke(
        main, ["fit", str(RECONSTRUCTION), "--cycle", "all", "--out", "r", "--open"]
    )
    assert told.exit_code == 2
    assert opened == [(Path.cwd() / "r" / "cycles.png").as_uri()]
