"""Terminal output: all encodings, no control characters, exit codes, and --open."""

import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import time
import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fabricated
from conftest import RECONSTRUCTION, posix, run, run_refused, small_pictures, without_pictures
from foamfit import api, terminal
from foamfit.errors import InputError
from foamfit.terminal import ending_cleanly, printable

ODD = "foam \x1b[31mred\x1b[0m\x07\x9b2J\u202eback χ"


@pytest.fixture(autouse=True)
def small(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the figures by small files."""
    small_pictures(monkeypatch)


def quick(monkeypatch: pytest.MonkeyPatch, *, light: bool = True, **changed: object) -> None:
    """Replace the fit by a fabricated result, and write no pictures if `light`."""
    made = fabricated.result(**changed)
    monkeypatch.setattr(api, "fit", lambda *_, **__: made)
    if light:
        without_pictures(monkeypatch)


# ---------------------------------------------------------------- encodings


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_every_command_prints_in_every_encoding(
    here: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    notes = ("The reduced χ² is 1, σ_a ± −3.",)
    quick(monkeypatch, status="ok", notes=notes)
    told = run("fit", RECONSTRUCTION, "--json", "--out", "r", encoding=encoding)
    assert told.stderr == ""
    assert told.stdout_bytes.isascii()
    assert json.loads(told.stdout_bytes)["notes"] == list(notes)
    for args in (
        ["check", RECONSTRUCTION],
        ["published"],
        ["compare", "r", "--published", "foam-1/model-1"],
        ["fit", RECONSTRUCTION, "--out", "r", "--force"],
        ["fit", "--help"],
    ):
        told = run(*args, encoding=encoding)
        assert told.stderr == "", args
        assert re.fullmatch(r"(?s)(?!.*\\u2212).+", told.stdout_bytes.decode(encoding))  # but "-"
    quick(monkeypatch, status="failed")
    again = ("--json", "--force", "--out", "r")
    run("fit", RECONSTRUCTION, *again, code=2, encoding=encoding)
    assert r"\u03c7.csv" in run("check", "χ.csv", code=1, encoding=encoding).stderr


@posix
def test_an_output_that_is_full_is_one_sentence() -> None:
    command = f"{sys.executable} -m foamfit published > /dev/full"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.fullmatch(
        r"foamfit: standard output cannot be written: No space [^\n]+\n", done.stderr
    )


@posix
def test_a_reader_that_has_enough_changes_no_exit_code() -> None:
    command = f'({sys.executable} -m foamfit published; echo "code $?" >&2) | true'
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == "code 0\n"


# ---------------------------------------------------------------- control characters


def test_no_control_character_of_a_name_reaches_the_terminal(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named = replace(fabricated.result().measurement, name=ODD)
    quick(monkeypatch, status="failed", measurement=named)
    toml = RECONSTRUCTION.with_suffix(".toml").read_text()
    escaped = json.dumps(ODD)
    renamed = [line for line in toml.splitlines() if not line.startswith("name = ")]
    (here / "odd.toml").write_text("\n".join([f"name = {escaped}", *renamed]))
    (here / "bad.toml").write_text(f"{escaped} = 1\n" + toml)
    for args in (
        ["fit", RECONSTRUCTION, "--out", "out\x1b[5m"],
        ["fit", RECONSTRUCTION, "--out", "r", "--json"],
        ["compare", "r", "--published", "foam-1/model-1"],
        ["check", RECONSTRUCTION, "--specimen", "odd.toml"],
        ["check", RECONSTRUCTION, "--specimen", "bad.toml"],
        ["check", "none\x1b[31m.csv"],
        ["fit", "--bogus\x1b[31m"],
        ["fit", RECONSTRUCTION, "--fix", "\x1b[31m"],
    ):
        told = run(*args, code=(0, 1, 2))
        said = told.stdout + told.stderr
        assert said.strip(), args
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", said), args
        assert re.search(r"\\(x|u00)1b|U\+001B", said), args
    assert printable("a\tb\nc\x1b") == "a\tb\nc\\x1b"


@posix
def test_a_name_that_is_no_unicode_is_written_and_printed(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python decodes a file name in another encoding to such a name."""
    name = os.fsdecode(b"foam \xe9")
    named = replace(fabricated.result().measurement, name=name)
    quick(monkeypatch, light=False, measurement=named)
    told = run("fit", RECONSTRUCTION, "--out", "r")
    assert told.stderr == ""
    assert json.loads((here / "r" / "fit.json").read_text(encoding="utf-8"))["test"] == name
    run("compare", "r", "--published", "foam-1/model-1")


# ---------------------------------------------------------------- origin of errors


def broken(error: BaseException):
    def fail(*_: object, **__: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("x is wrong"), 1, "x is wrong"),
        (np.linalg.LinAlgError("SVD did not converge"), 70, "a defect of foamfit"),
        (ValueError("operands could not be broadcast"), 70, "a defect of foamfit"),
        (KeyboardInterrupt(), 130, "interrupted by Ctrl-C"),
        (terminal.TerminatedError(signal.SIGTERM), 143, "ended by SIGTERM"),
    ],
)
def test_only_input_errors_are_the_users(
    here: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, words: str
) -> None:
    monkeypatch.setattr(api, "fit", broken(error))
    told = run("fit", RECONSTRUCTION, "--out", "r", code=code)
    assert told.stdout == ""
    assert re.fullmatch(rf"\n?foamfit: [^\n]*{words}[^\n]*\n", told.stderr)
    assert not (here / "r").exists()
    if code == 70:
        monkeypatch.setenv("FOAMFIT_TRACEBACK", "1")
        assert run("fit", RECONSTRUCTION, "--out", "r", code=1).exception is error


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_code_that_cannot_raise_is_not_lost(number: signal.Signals) -> None:
    """A signal may arrive in such code, as in the callbacks with which numba loads functions."""
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))
    hook = sys.unraisablehook

    def run_on() -> None:
        callback()
        for _ in range(500):  # a long sleep would end before the handler is called
            time.sleep(0.01)

    with pytest.raises((KeyboardInterrupt, terminal.TerminatedError)), ending_cleanly():
        run_on()
    assert sys.unraisablehook is hook


def test_a_command_leaves_the_signals_as_they_were(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    quick(monkeypatch)
    run("fit", RECONSTRUCTION, "--out", "r", "--quiet")
    assert [signal.getsignal(number) for number in numbers] == before


# ---------------------------------------------------------------- the report in the browser


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a browser and return the list of opened addresses."""
    found: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(found.append(address)) or True)
    return found


@pytest.mark.parametrize(("status", "code"), [("ok", 0), ("warnings", 0), ("failed", 2)])
def test_the_report_is_opened_whatever_was_found(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, status: str, code: int
) -> None:
    quick(monkeypatch, status=status)
    run("fit", RECONSTRUCTION, "--out", "r", "--open", code=code)
    assert opened == [(Path.cwd() / "r" / "report.html").as_uri()]


@pytest.mark.parametrize("failure", [False, webbrowser.Error("could not locate runnable browser")])
def test_without_a_browser_a_sentence_says_so_and_the_exit_code_stays(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, failure: bool | Exception
) -> None:
    def refuse(_: str) -> bool:
        if isinstance(failure, Exception):
            raise failure
        return False

    monkeypatch.setattr(webbrowser, "open", refuse)
    quick(monkeypatch)
    told = run("fit", RECONSTRUCTION, "--out", "r", "--open", "--quiet")
    assert told.stdout == ""
    path = Path("r") / "report.html"
    assert told.stderr == f"foamfit: no browser could be opened; open {path} by hand\n"


@pytest.mark.parametrize(
    "command",
    [["fit", "a.csv"], ["batch", "a.csv"], ["joint", "a.toml"], ["predict", "r", "a.csv"]],
)
def test_json_for_a_program_and_a_browser_exclude_each_other(command: list[str]) -> None:
    told = run_refused(*command, "--open", "--json")
    assert told == "foamfit: --open and --json exclude each other; leave one of them out\n"
