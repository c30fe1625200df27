"""Files are written completely, never replace foreign files, and leave no remnants."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

import fabricated
import foamfit.api
import foamfit.report.folder
from conftest import RECONSTRUCTION, posix, run, run_refused, without_pictures
from foamfit.errors import InputError
from foamfit.files import check_file, csv_bytes, replacing, write_file
from foamfit.report import figures
from foamfit.report.folder import check_target, load_result
from foamfit.report.listing import row_of, write_summary
from foamfit.report.plots import plot_fit


@pytest.fixture(autouse=True)
def small(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pictures, so that saving is fast."""
    without_pictures(monkeypatch)
    png = b"\x89PNG" + bytes(20)
    monkeypatch.setattr(figures, "images", lambda _, *forms: [png for _ in forms])


def names(folder: Path | str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def gone() -> int:
    """Return the id of a process that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return process.pid


def left_behind(path: Path, ending: str, process: int) -> Path:
    """Return the path of a remnant that the process with this id would leave next to `path`."""
    with suppress(InterruptedError), replacing(path.parent / "apart" / path.name) as fresh:
        raise InterruptedError
    named, found = re.subn(rf"\.{os.getpid()}\.\w{{8}}", f".{process}.{8 * '0'}", fresh.name)
    assert found == 1
    assert named.endswith(".new")
    return path.with_name(named.removesuffix("new") + ending)


def test_a_folder_a_link_or_a_json_of_others_is_not_what_a_fit_writes(here: Path) -> None:
    ladder = fabricated.result().save("r") / "ladder.csv"
    ladder.mkdir()
    with pytest.raises(InputError, match=r"holds ladder\.csv"):
        check_target("r")
    ladder.rmdir()
    ladder.symlink_to(here)
    with pytest.raises(InputError, match=r"holds ladder\.csv"):
        check_target("r")
    for text in ("{}", "[]", "no json", '{"schema": "of another program"}'):
        (here / "s").mkdir(exist_ok=True)
        (here / "s" / "fit.json").write_text(text)
        with pytest.raises(InputError, match="no foamfit result"):
            check_target("s")


@pytest.mark.parametrize("out", [".", "..", "{here}", "../link"])
def test_the_current_directory_is_refused(here: Path, out: str) -> None:
    (here / "cwd").mkdir()
    (here / "link").symlink_to(here / "cwd")
    os.chdir(here / "cwd")
    path = out.format(here=here / "cwd")
    assert "current directory" in run_refused("fit", RECONSTRUCTION, "--out", path)


def test_a_full_disk_leaves_the_older_file(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = row_of("a", "a.csv", fabricated.result())
    write = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for path, make in (
        (here / "summary.csv", lambda path: write_summary([row], path.parent)),
        (here / "b.png", lambda path: figures.save(plot_fit(fabricated.result()), path)),
    ):
        path.write_text("older")
        with pytest.raises(InputError, match="No space left on device"):
            make(path)
        assert path.read_text() == "older"
    assert names(here) == ["b.png", "summary.csv"]


def test_no_text_of_a_table_is_a_formula(here: Path) -> None:
    """A spreadsheet would evaluate a test name such as =1+1 and could even start programs."""
    texts = ("=1+1", "@SUM(1)", "+1+1", "-1+1", "\t=1", "a=1", "-2.5e-3", "-", "-inf")
    told = csv_bytes([texts, (-1.5, None, "")]).decode().splitlines()
    assert told == ["'=1+1,'@SUM(1),'+1+1,'-1+1,'\t=1,a=1,-2.5e-3,'-,-inf", "-1.5,,"]
    write_summary([row_of("=1+1", "=1+1.csv", fabricated.result())], here)
    text = Path("summary.csv").read_text()
    assert all(line[0] == "'" for line in text.splitlines()[1:])
    assert ",=" not in text


TABLES = ["curves.csv", "fit.json", "parameters.csv", "table.tex"]
CALL = ("fit", str(RECONSTRUCTION), "--starts", "1", "--max-time", "0.1", "--out", "r")


def test_what_cannot_be_written_in_the_end_is_saved_beside(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(_: object, folder: Path, **__: object) -> None:
        if folder.name == "r":
            raise InputError("the result cannot be written to r: No space; choose another folder")
        save(*(_, folder), **__)

    save = foamfit.api.FitResult.save
    monkeypatch.setattr(foamfit.api.FitResult, "save", denied)
    result = run(*CALL, "--no-report", code=1)
    (saved,) = names(here)
    assert result.stderr.endswith(f"to r: No space; it is in {saved} instead\n")
    assert load_result(saved)["model"] == "bistable"


def test_a_report_that_fails_loses_no_numbers(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> str:
        raise ZeroDivisionError("of a figure")

    monkeypatch.setattr(foamfit.report.folder, "render_report", fail)
    assert "of a figure" in run(*CALL, code=70).stderr
    assert load_result("r")["model"] == "bistable"
    assert names(here / "r") == TABLES


def test_without_a_report_there_are_tables_alone(here: Path) -> None:
    assert run(*CALL, "--no-report", code=(0, 2)).stdout.endswith("\nwritten to r\n")
    assert names(here / "r") == TABLES
    assert names(fabricated.result().save("s", report=False)) == TABLES
    told = run_refused(*CALL, "--no-report", "--open")
    assert "--open and --no-report exclude each other" in told


def test_a_file_keeps_its_link_its_mode_and_a_device_what_it_is(here: Path) -> None:
    target = here / "deep" / "a.csv"
    target.parent.mkdir()
    target.write_text("older")
    target.chmod(0o640)
    (here / "link.csv").symlink_to(target)
    write_file("link.csv", b"newer")
    assert (here / "link.csv").is_symlink()
    assert target.read_bytes() == b"newer"
    assert target.stat().st_mode & 0o777 == 0o640
    if os.name == "posix":
        os.mkfifo("pipe")
        with subprocess.Popen(["cat", "pipe"], stdout=subprocess.PIPE) as reader:
            check_file(Path("pipe"))
            write_file("pipe", b"through")
            assert reader.communicate()[0] == b"through"
        assert Path("pipe").is_fifo()


@posix
def test_what_a_killed_process_left_is_swept_and_nothing_else(here: Path) -> None:
    target = here / "r"
    dead = left_behind(target, "new", gone())
    others = [
        left_behind(target, "new", os.getppid()),  # still running
        left_behind(here / "another", "new", gone()),
        here / ".r.notes.new",
        here / ".r.abcdef123456.new",
        here / re.sub(r"^\.r\.[\w-]+", ".r.another-machine", dead.name),
    ]
    for folder in (dead, *others):
        folder.mkdir()
        (folder / "fit.json").write_text("{")
    recycled = left_behind(target, "new", os.getpid())  # from an earlier process with our id
    recycled.mkdir()
    fabricated.result().save("r")
    assert names(here) == sorted([*(path.name for path in others), "r"])
    a_day = time.time() - 100_000.0
    os.utime(others[-1], (a_day, a_day))  # a process of another machine cannot be asked
    with replacing(target):
        pass
    assert not others[-1].exists()


@posix
def test_an_older_result_that_a_killed_process_put_aside_comes_back(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fabricated.result(seed=1).save("r")
    (here / "r").rename(left_behind(here / "r", "old", gone()))

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(foamfit.report.folder, "figures_of", fail)
    with pytest.raises(RuntimeError):
        fabricated.result(seed=2).save("r")
    assert load_result("r")["seed"] == 1
    assert names(here) == ["r"]


KILLED = """
import time
from pathlib import Path
from foamfit.cli import main
from foamfit.files import replacing
import click

@main.command()
def write():
    with replacing(Path("r").resolve()) as fresh:
        (fresh / "fit.json").write_text("half")
        print("half", flush=True)
        while True:
            time.sleep(0.05)

main(["write"])
"""


@posix
@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL", "SIGINT"])
def test_a_signal_while_writing(here: Path, name: str) -> None:
    """SIGTERM and Ctrl-C clean up and print a message; after SIGKILL the next write cleans up."""
    with subprocess.Popen(
        [sys.executable, "-c", KILLED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "half\n"
        assert [left for left in names(here) if left.startswith(".r.")]
        process.send_signal(getattr(signal, name))  # Windows lacks SIGKILL
        told = process.communicate()[1].strip()
    if name == "SIGKILL":
        assert [left for left in names(here) if left.startswith(".r.")]
        with replacing(here / "r"):
            pass
        assert names(here) == ["r"]
    else:
        assert process.returncode == 128 + signal.Signals[name]
        assert re.fullmatch(r"foamfit: (ended by SIGTERM|interrupted by Ctrl-C)", told)
        assert names(here) == []
