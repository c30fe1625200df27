"""The progress line of a fit on a terminal, and cases in which no line is shown."""

import logging
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import foamfit as ff
from conftest import RECONSTRUCTION, synthetic_impact, without_pictures
from foamfit import api, terminal as module
from foamfit.cli import main
from foamfit.terminal import ProgressLine, progress_line

pty = pytest.importorskip("pty")


class Terminal:
    """A pseudo terminal."""

    def __init__(self, columns: int = 80) -> None:
        import fcntl
        import struct
        import termios

        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        os.set_blocking(self.master, False)
        self.stream = os.fdopen(slave, "w", encoding="utf-8")

    def read(self) -> str:
        found = b""
        while True:
            try:
                found += os.read(self.master, 1 << 16)
            except BlockingIOError:
                return found.decode()


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    with made.stream:
        yield made
    os.close(made.master)


@pytest.fixture
def quick(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use an empty directory, no pictures, and a line that draws every update."""
    without_pictures(monkeypatch)
    monkeypatch.setattr(module, "REDRAWN", 0.0)
    monkeypatch.setattr(module, "APART", 0.0)


def shown(told: str) -> list[str]:
    return [line.strip() for line in told.split("\r") if line.strip()]


@pytest.mark.usefixtures("quick")
def test_a_terminal_shows_what_is_done_a_bar_the_best_misfit_and_the_time_left(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stderr", terminal.stream)
    monkeypatch.setattr(api.FitResult, "save", lambda *_, **__: None)
    with pytest.raises(SystemExit) as ended:
        main(["fit", str(RECONSTRUCTION), "--starts", "6", "--out", "r"])
    assert ended.value.code == 0
    told = terminal.read()
    lines = shown(told)
    assert "\n" not in told
    assert all(len(line) <= 80 for line in lines)
    assert any(
        re.fullmatch(r"fit: best misfit [\d.]+ %, [\d:?]+ left \|.+\| loop", o) for o in lines
    )
    assert any(line.endswith("| intervals") for line in lines)
    assert lines[-1].endswith("| writing the report")
    assert re.search(r", \d\d:\d\d left", told)
    found = [float(one) for one in re.findall(r"best misfit ([\d.]+) %", told)]
    assert found == sorted(found, reverse=True)
    assert told.endswith("\r")  # the line is erased
    curves = r"stress-time ([\d.]+) %, displacement-time ([\d.]+) %"
    said = re.search(curves, capsys.readouterr().out)
    assert said is not None
    ends = sorted(float(one) for one in said.groups())
    assert 0.9 * ends[0] <= found[-1] <= 1.1 * ends[1]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("option", ["--quiet", "--json"])
def test_nothing_is_shown_where_silence_is_asked_for(
    option: str, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", terminal.stream)
    with pytest.raises(SystemExit):
        main(["fit", str(RECONSTRUCTION), "--starts", "2", "--out", "r", option])
    assert terminal.read() == ""


@pytest.mark.usefixtures("quick")
def test_a_sentence_in_between_does_not_run_into_the_line(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, logger="foamfit")  # an earlier test may have raised it
    monkeypatch.setattr(sys, "stderr", terminal.stream)
    with progress_line(False, "fit") as line:
        line.progress(0.5, "loop")
        line.tell("72 refits, about 3 s")
        logging.getLogger("foamfit.solve").warning("foamfit: compiling the solver")
        line.progress(0.6, "intervals")
    told = terminal.read()
    assert re.search(r"\r +\rfoamfit: 72 refits, about 3 s\r?\n", told)
    assert re.search(r"\r +\rfoamfit: compiling the solver\r?\n", told)
    assert shown(told)[-1].endswith("| intervals")


@pytest.mark.parametrize("columns", [20, 50, 200])
def test_the_line_is_never_wider_than_the_terminal(columns: int) -> None:
    terminal = Terminal(columns)
    line = ProgressLine(terminal.stream, "fit")
    what = "model 3 of 9: linear+{micro} with relaxation and damping: refinement"
    line.progress(0.2, what)
    line.misfit = 0.0123
    line.progress(0.5, what)
    line._bar.refresh()
    told = shown(terminal.read())[-1]
    line.close()
    terminal.stream.close()
    os.close(terminal.master)
    assert len(told) <= columns
    if columns >= 50:
        assert re.match(r"fit: best misfit 1.2 %, [\d:]+ left \|", told)
    if columns == 200:
        assert told.endswith(f"| {what}")


def test_progress_rises_through_search_and_intervals() -> None:
    _, test = synthetic_impact()
    told: list[tuple[float, str]] = []
    ff.fit(test, starts=4, intervals="profile", progress=lambda *one: told.append(one))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert (shares[0], told[-1]) == (0.0, (1.0, "done"))
    steps = list(dict.fromkeys(what for _, what in told))
    assert steps[:4] == ["start values", "loop", "curves", "refinement"]
    assert len([what for _, what in told if what == "intervals"]) > 5
