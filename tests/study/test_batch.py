"""Batches: each result is complete or absent and made once, whatever fails; and the summary."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import fabricated
import foamfit as ff
from conftest import HEIGHT, synthetic_impact, without_pictures
from foamfit.cli import main
from foamfit.cli import many as command
from foamfit.report.studies import batch as batch_report
from foamfit.report.studies.batch import (
    MOST_ON_PAGE,
    Row,
    row_of,
    table_rows,
    write_comparison,
    write_page,
)
from foamfit.study import batch as module
from foamfit.study import batch_work, processes
from foamfit.study.batch_work import work
from foamfit.study.processes import ATTEMPTS, EndedError, Processes
from foamfit.terminal import TerminatedError
from inline import Inline

posix = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
QUICK = {"starts": 2, "intervals": "local"}  # a search from one start explores longer
TOML = (
    f'[specimen]\nheight = "{1e3 * HEIGHT} mm"\narea = "19.635 mm^2"\n'
    '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
)


def write(folder: Path, name: str, seed: int) -> None:
    _, test = synthetic_impact(noise=0.003, seed=seed, samples=101)
    columns = (1e3 * test.time, 1e-6 * test.stress, 1e3 * test.displacement)
    lines = [",".join(f"{x:.6f}" for x in row) for row in zip(*columns, strict=True)]
    header = "time (ms),stress (MPa),displacement (mm)"
    (folder / f"{name}.csv").write_text("\n".join([header, *lines]) + "\n")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Three tests, a CSV file that is not a test, and one TOML for all."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests").mkdir()
    for seed, name in enumerate("abc"):
        write(tmp_path / "tests", name, seed)
    (tmp_path / "tests" / "bad.csv").write_text("x,y\n1,2\n")
    (tmp_path / "foam.toml").write_text(TOML)
    return tmp_path


@pytest.fixture
def tried(monkeypatch):
    """Replace the fit by a fast one that records the names of the fitted tests."""
    found = []

    def fit(test, **options):
        found.append(test.name)
        return fabricated.result(measurement=test)

    monkeypatch.setattr(batch_work, "fit", fit)
    return found


def again(**changed):
    given = {"out": "out", "specimen": "foam.toml", "executor": Inline(), "report": False}
    return ff.batch("tests", **(given | changed))


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def numbers(out):
    """Return the fitted numbers as written to the files."""
    found = Path(out).glob("*/parameters.csv")
    return {path.parent.name: path.read_text() for path in sorted(found)}


def stamps(out):
    """Return the time at which each result was written."""
    return {p.parent.name: p.stat().st_mtime_ns for p in Path(out).glob("*/batch.json")}


# ------------------------------------------------------------------------- output


def test_the_same_numbers_with_any_number_of_processes_and_anywhere(here):
    (here / "tests/c.csv").unlink()
    again(out="one", executor=None, jobs=1, **QUICK)
    frame = again(out="two", executor=None, jobs=2, **QUICK)
    again(out="inline", **QUICK)
    made = numbers("one")
    assert list(made) == ["a", "b"]
    assert made == numbers("two") == numbers("inline")
    alone = ff.fit(ff.read_test("tests/b.csv", "foam.toml"), **QUICK)
    row = frame.set_index("test").loc
    assert row["b", "s1_k0"] == alone.params["s1_k0"].value
    assert names("two") == ["a", "b", "bad", "summary.csv", "summary.html", "summary.tex"]
    assert names("two/a") == [
        "batch.json", "curves.csv", "fit.json", "parameters.csv", "table.tex",
    ]  # fmt: skip
    assert row["bad", "status"] == "refused"
    assert row["bad", "error"].startswith("tests/bad.csv: ")
    with open("two/summary.csv", newline="") as file:
        head = next(csv.reader(file))
    curves = [f"misfit_{c}" for c in ("stress_time", "displacement_time", "stress_strain")]
    assert head[:8] == ["test", "file", "status", "error", *curves, "runtime_s"]
    parts = [f"s1_k0{part}" for part in ("", "_stderr", "_lo", "_hi", "_state")]
    assert head[8:13] == parts
    pd.testing.assert_frame_equal(frame, pd.read_csv("two/summary.csv"), check_dtype=False)


@pytest.fixture
def undrawn(monkeypatch):
    """Replace the figures of the tests and of their comparison by a few bytes."""
    without_pictures(monkeypatch)
    monkeypatch.setattr(batch_report, "plot_parameters", lambda *_, **__: None)
    monkeypatch.setattr(batch_report, "write_both", lambda *_: b"<svg/>")


def test_reports_are_there_unless_they_are_not_wanted(here, tried, undrawn):
    again(report=False)
    assert len(tried) == 3
    again(report=True, figure_width="two")  # the reports are missing
    assert len(tried) == 6
    assert {"report.html", "fit.png", "fit.pdf"} <= set(names("out/a"))
    assert 'href="a/report.html"' in Path("out/summary.html").read_text()
    again(report=False)
    assert len(tried) == 6


def test_figures_of_another_width_are_made_again_where_there_are_any(here, tried, undrawn):
    again(report=True, figure_width="two")
    assert len(tried) == 3
    again(report=True, figure_width="177.8 mm")  # two columns
    again(report=False)
    assert len(tried) == 3
    again(report=True, figure_width="one")
    assert len(tried) == 6
    again(report=True, figure_width="3.25 in")
    assert len(tried) == 6
    with pytest.raises(ff.InputError, match="the width of figures = 'narrow'"):
        again(report=True, figure_width="narrow")


def test_a_cycle_is_a_row_and_its_folder_is_in_that_of_the_test(here, monkeypatch):
    def fit_cycles(path, specimen, *, cycles, **options):
        assert cycles is None
        results = {1: fabricated.result(), 2: fabricated.result(status="ok")}
        return ff.CycleFits("a", "bistable", (1, 2, 3), results, {3: "it is cut"})

    monkeypatch.setattr(batch_work, "fit_cycles", fit_cycles)
    frame = again(cycle="all").set_index("test")
    assert list(frame.index[:3]) == ["a/cycle-1", "a/cycle-2", "a/cycle-3"]
    assert list(frame["status"][:3]) == ["warnings", "ok", "refused"]
    assert frame.loc["a/cycle-3", "error"] == "it is cut"
    assert {"batch.json", "cycle-1", "cycle-2", "cycles.csv", "cycles.json", "table.tex"} == set(
        names("out/a")
    )
    page = Path("out/summary.html").read_text(encoding="utf-8")
    assert f"{len(frame) // 3} tests, {len(frame)} cycles: " in page
    before = stamps("out")
    again(cycle="all")
    assert stamps("out") == before


# ------------------------------------------------------------------------- called again


def test_only_what_is_missing_or_has_changed_is_fitted(here, tried):
    first = again()
    assert tried == ["a", "b", "c"]
    before = stamps("out")
    pd.testing.assert_frame_equal(again(), first)
    assert tried == ["a", "b", "c"]
    assert stamps("out") == before  # the refused test is not retried either
    changes = (
        (lambda: write(here / "tests", "b", 7), {}, ["b"]),
        (lambda: write(here / "tests", "d", 8), {}, ["d"]),
        (lambda: (here / "out/a/batch.json").unlink(), {}, ["a"]),
        (lambda: (here / "foam.toml").write_text(TOML + '[noise]\nstress = "1 kPa"\n'), {}, None),
        (lambda: None, {"seed": 3}, None),
        (lambda: None, {"seed": 3, "fix": {"s1_eta": 0.0}}, None),
        (lambda: None, {"seed": 3, "fix": {"s1_eta": 0.0}, "fresh": True}, None),
        (lambda: None, {"seed": 3, "fix": {"s1_eta": 0.0}}, []),
    )
    for change, call, wanted in changes:
        tried.clear()
        change()
        again(**call)
        assert sorted(tried) == (["a", "b", "c", "d"] if wanted is None else wanted)


def test_another_version_fits_again(here, tried, monkeypatch):
    again()
    monkeypatch.setattr(batch_work, "version", lambda _: "99.0")
    monkeypatch.setattr("foamfit.results.version", lambda _: "99.0")
    tried.clear()
    again()
    assert tried == ["a", "b", "c"]


def test_a_test_that_became_unreadable_loses_its_old_result(here, tried):
    again()
    (here / "tests/a.csv").write_text("nothing")
    assert again().set_index("test").loc["a", "status"] == "refused"
    assert names("out/a") == ["batch.json"]
    write(here / "tests", "a", 0)
    assert again().set_index("test").loc["a", "status"] != "refused"


# ------------------------------------------------------------------------- failures


@posix
def test_a_broken_link_is_a_row(here, tried):
    (here / "tests/gone.csv").symlink_to("nowhere.csv")
    (here / "tests/loop.csv").symlink_to("loop.csv")
    rows = again().set_index("file")["error"]
    assert "no such file" in rows["tests/gone.csv"]
    assert "symbolic links" in rows["tests/loop.csv"]


def test_a_defect_is_a_row_and_ends_nothing(here, tried, monkeypatch):
    def fit(test, **options):
        if test.name == "b":
            raise ZeroDivisionError("of b")
        return fabricated.result(measurement=test)

    monkeypatch.setattr(batch_work, "fit", fit)
    row = again().set_index("test").loc["b"]
    assert row["status"] == "refused"
    assert "defect of foamfit, please report it (ZeroDivisionError: of b)" in row["error"]


def unfitted(task):
    """Work in another process with a fast fit; at module level so that it can be pickled."""
    batch_work.fit = lambda test, **_: fabricated.result(measurement=test)
    return work(task)


def failing(task):
    """Work like `unfitted`, but kill the process that fits test b."""
    if task.name == "b":
        os.kill(os.getpid(), signal.SIGKILL)
    return unfitted(task)


@posix
def test_a_test_that_kills_its_process_is_a_row_and_is_tried_again_when_called(
    here, tried, monkeypatch
):
    monkeypatch.setattr(module, "work", failing)
    frame = again(executor=None, jobs=2).set_index("test")
    assert "its process ended in every attempt" in frame.loc["b", "error"]
    assert list(numbers("out")) == ["a", "c"]
    assert not [name for name in names("out") if name.startswith(".")]
    before = stamps("out")
    monkeypatch.setattr(module, "work", work)
    assert again().set_index("test").loc["b", "status"] == "warnings"
    assert tried == ["b"]
    after = stamps("out")
    assert {name: after[name] for name in before} == before


# Kills its process at the first call; built without any import in that process.
SEEN_ONCE = """
import os, pathlib, signal
seen = pathlib.Path({path!r})
if not seen.exists():
    seen.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@posix
def test_what_another_thread_imports_while_a_process_starts_stays_imported(monkeypatch):
    """`unittest.mock.patch.dict` would restore `sys.modules` and so drop the new module."""
    name = "foamfit_imported_in_the_meantime"
    monkeypatch.delitem(sys.modules, name, raising=False)
    script = sys.modules["__main__"]
    with processes._starting():
        assert sys.modules["__main__"] is not script
        sys.modules[name] = ModuleType(name)
    assert name in sys.modules
    assert sys.modules["__main__"] is script


def test_one_process_that_ends_takes_nothing_else_with_it(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with Processes(2) as pool:
        calls = [pool.submit(time.sleep, 0.05) for _ in range(6)]
        twice = pool.submit(os._exit, 1)
        once = pool.submit(exec, SEEN_ONCE.format(path=str(tmp_path / "seen")))
        threads = pool.submit(os.getenv, "OMP_NUM_THREADS")
        assert [call.result() for call in calls] == [None] * 6
        assert once.result() is None
        assert (tmp_path / "seen").exists()
        assert threads.result() == "1"
        with pytest.raises(EndedError, match=f"ended {ATTEMPTS} times"):
            twice.result()
    pool = Processes(1)
    sleeping = pool.submit(time.sleep, 60)
    while not sleeping.running():
        time.sleep(0.01)
    began = time.monotonic()
    pool.stop()
    assert time.monotonic() - began < 10
    assert sleeping.exception() is not None or sleeping.cancelled()


def shown(out):
    """Return the tests and their states from the page of a batch."""
    page = (Path(out) / "summary.html").read_text(encoding="utf-8")
    return re.findall(r'<tr><td><span[^>]*>(\w+)<.*?<span class="badge [^"]*">([^<]*)<', page)


@pytest.mark.parametrize("end", [KeyboardInterrupt, lambda: TerminatedError(signal.SIGTERM)])
def test_ctrl_c_and_sigterm_leave_what_is_done_and_a_summary(here, tried, end):
    def interrupt(state):
        raise end()

    with pytest.raises((KeyboardInterrupt, TerminatedError)):
        again(progress=interrupt)
    assert shown("out") == [
        ("a", "warnings"), ("b", "not fitted"), ("bad", "not fitted"), ("c", "not fitted"),
    ]  # fmt: skip


def test_what_is_killed_leaves_a_page_as_current_as_the_table(here, tried, monkeypatch):
    """A killed process cannot write anything afterwards, so the page must already be current."""
    monkeypatch.setattr(module, "PAUSE", 0.0)
    monkeypatch.setattr(module, "SHARE", 0.0)
    seen = list[tuple[list[tuple[str, str]], list[str]]]()

    def look(made):
        if len(made.rows) > 1:
            frame = pd.read_csv("out/summary.csv")
            seen.append((shown("out"), list(frame["status"])))

    again(progress=look)
    assert [len(one) for one, _ in seen] == [4, 4, 4]
    for page, table in seen:
        assert [status for _, status in page] == table
    assert [status for _, status in seen[0][0]] == ["warnings", *["not fitted"] * 3]


def test_the_pages_of_a_long_batch_take_a_fiftieth_of_its_time(here, tried, monkeypatch):
    """Each page takes longer than the one before, so the interval between pages grows."""
    clock, saved = [0.0], list[float]()

    def save(made, *, whole=False):
        saved.append(clock[0])
        clock[0] += 1.0  # s

    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(module.Batch, "save", save)

    def second(state):
        clock[0] += 1.0

    for number in range(20):
        shutil.copy(here / "tests/c.csv", here / f"tests/t{number:02d}.csv")
    again(progress=second)
    assert saved == [5.0, 25.0]  # s: after the interval, and at the end


def test_ctrl_c_leaves_what_is_done_and_a_summary(here, monkeypatch):
    monkeypatch.setattr(module, "work", unfitted)

    def interrupt(state):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        again(executor=None, jobs=1, progress=interrupt)
    frame = pd.read_csv("out/summary.csv").set_index("test")
    assert frame.loc["a", "status"] == "warnings"
    assert list(frame["status"][["b", "c"]]) == ["not fitted", "not fitted"]
    assert "call it again" in frame.loc["c", "error"]
    assert not [name for name in names("out") if name.startswith(".")]


def test_a_full_disk_ends_in_one_sentence_and_loses_nothing(here, tried, monkeypatch):
    real, written = batch_work.write_result, []

    def write_result(result, folder, **options):
        if written:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(1)
        real(result, folder, **options)

    monkeypatch.setattr(batch_work, "write_result", write_result)
    with pytest.raises(ff.InputError, match=r"No space left.*1 of 4 tests are done and kept"):
        again()
    assert list(numbers("out")) == ["a"]
    assert not [name for name in names("out") if name.startswith(".")]
    monkeypatch.setattr(batch_work, "write_result", real)
    tried.clear()
    again()
    assert tried == ["b", "c"]


def test_an_executor_that_ends_is_one_sentence_and_what_is_done_stays(here, tried):
    class Ending(Inline):
        count = 0

        def submit(self, fn, /, *args, **kwargs):
            self.count += 1
            if self.count > 1:
                raise RuntimeError("cannot schedule new futures after shutdown")
            return super().submit(fn, *args, **kwargs)

    with pytest.raises(ff.InputError, match=r"executor has ended.*1 of 4 tests are done"):
        again(executor=Ending())
    assert list(numbers("out")) == ["a"]


def test_memory_errors_and_other_versions_are_not_the_fault_of_a_test(here, monkeypatch):
    monkeypatch.setattr(batch_work, "fit", lambda *_, **__: (_ for _ in ()).throw(MemoryError()))
    frame = again().set_index("test")
    assert "its fit was lost (MemoryError" in frame.loc["a", "error"]
    assert names("out") == [
        "bad",
        "summary.csv",
        "summary.html",
        "summary.tex",
    ]  # no result of the test, so the next call retries it


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none/*.csv"], "none/*.csv: the glob matches no file"),
        (["tests", "--jobs", "2", "--scheduler", "tcp://x"], "--jobs and --scheduler exclude"),
        (["tests", "--fix", "s1_kx=1"], "'s1_kx' is not one of the model bistable"),
        (["tests", "--model", "auto", "--vary", "s1_eta"], "belong to one model"),
        (["tests", "--specimen", "none.toml"], "none.toml: no such file"),
        (["tests", "--model", "elastic"], "'elastic' is not a spring"),
        (["tests", "--out", "foam.toml"], "foam.toml is a file"),
        (["tests", "--out", "tests"], "tests holds a.csv, which foamfit did not write"),
        (["tests", "--cycle", "0"], "must be a number from 1 up"),
        (["tests", "--jobs", "0"], "--jobs"),
    ],
)
def test_a_wrong_call_is_one_sentence_and_nothing_is_written(here, monkeypatch, words, told):
    # Otherwise the announcement of a compilation could come before the refusal.
    monkeypatch.setattr(module.cache, "compiled", lambda *_: True)
    before = sorted(here.rglob("*"))
    result = run("batch", *words)
    assert (result.exit_code, result.stdout) == (1, "")
    assert re.fullmatch(r"foamfit: [^\n]+\n", result.stderr)
    assert told in result.stderr
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize("place", ["notes.txt", "a/notes.txt", "mine/notes.txt"])
def test_a_folder_with_files_of_others_is_refused(here, tried, place):
    again()
    (here / "out" / place).parent.mkdir(exist_ok=True)
    (here / "out" / place).write_text("mine")
    with pytest.raises(ff.InputError, match=f"out holds {place}, which foamfit did not write"):
        again(fresh=True)
    assert len(tried) == 3


# ------------------------------------------------------------------------- the command


def alive(process):
    """Return whether a process runs; an ended process that nobody waits for is a zombie."""
    import psutil

    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@posix
def test_killed_and_called_again_nothing_is_lost_or_done_twice(here, tried, monkeypatch):
    """Kill the process of the command: its workers end, and the next call resumes."""
    import psutil

    words = ["batch", "tests", "--specimen", "foam.toml", "--starts", "2", "--jobs", "2"]
    words += ["--no-report", "--quiet", "--out", "out"]
    with subprocess.Popen([sys.executable, "-m", "foamfit", *words]) as process:
        deadline = time.monotonic() + 60
        while not stamps("out") and time.monotonic() < deadline:
            time.sleep(0.02)
        others = psutil.Process(process.pid).children(recursive=True)
        process.kill()
    done = stamps("out")
    assert len(done) < 4
    assert len(others) >= 3
    # The traces of a process remain until the system has removed it, which takes a moment.
    psutil.wait_procs(others, timeout=20)
    assert not any(map(alive, others))
    done = stamps("out")
    monkeypatch.setattr(module, "Processes", lambda *_: Local())
    result = run(*words, "--jobs", "1")
    assert result.exit_code == 2  # bad.csv
    assert {*tried} == {"a", "b", "c"} - {*done}
    assert "1 of 4 tests has no acceptable fit" in result.stderr
    after = stamps("out")
    assert {name: after[name] for name in done} == done
    assert len(after) == 4
    assert not [name for name in names("out") if name.startswith(".")]


def test_the_command_prints_counts_parameters_and_refusals(here, tried, monkeypatch):
    monkeypatch.setattr(module, "Processes", lambda *_: Local())
    result = run("batch", "tests", "--specimen", "foam.toml", "--no-report", "--out", "out")
    assert result.exit_code == 2
    assert result.stdout.startswith("4 tests: 3 fitted with warnings and 1 refused\n")
    assert "\nbad: tests/bad.csv: " in result.stdout
    assert re.search(r"\ns1_k0 +5\.5 +5\.5 +5\.5 +3 of 3 +MPa\n", result.stdout)
    assert result.stdout.endswith("written to out: open out/summary.html\n")
    assert result.stderr == "foamfit: 1 of 4 tests has no acceptable fit; see out/summary.csv\n"
    words = ("--specimen", "foam.toml", "--no-report", "--out", "out")
    result = run("batch", "tests/a.csv", *words, "--json")
    assert result.exit_code == 0
    (row,) = json.loads(result.stdout)
    assert row["s1_k0_state"] == "determined"
    assert result.stderr == ""


class Local(Inline):
    """Executor that works in this process."""

    def stop(self):
        """Do nothing: there is no process to stop."""


def test_progress_says_done_wrong_left_and_how_long(here, monkeypatch):
    shown = []
    line = SimpleNamespace(progress=lambda share, what: shown.append((share, what)))
    monkeypatch.setattr(command, "progress_line", lambda *_: nullcontext(line))

    def fitted(*_, progress, **__):
        tests = range(10)
        progress(SimpleNamespace(rows=tests[:4], tests=tests, wrong=1, fitted=2))
        progress(SimpleNamespace(rows=tests, tests=tests, wrong=1, fitted=8))
        return SimpleNamespace(summary=[], out=here)

    monkeypatch.setattr(module, "run", fitted)
    run("batch", "tests", "--json")
    # Tests finished by an earlier call do not enter the estimate of the time left.
    assert shown == [
        (0.25, "4 done, 1 without a fit, 6 left"),
        (1.0, "10 done, 1 without a fit, 0 left"),
    ]


def test_without_dask_the_command_says_how_it_is_installed(here, monkeypatch):
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    result = run("batch", "tests", "--scheduler", "tcp://127.0.0.1:1")
    assert result.exit_code == 1
    assert result.stderr == (
        'foamfit: --scheduler needs Dask, which is not installed: pip install "foamfit[dask]"\n'
    )


def test_a_scheduler_that_does_not_answer_is_one_sentence(here, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(command, "PATIENCE", 0.3)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        result = run("batch", "tests", "--scheduler", address, "--out", "out")
        assert (result.exit_code, result.stdout) == (1, "")
        assert re.fullmatch(r"foamfit: --scheduler [^\n]+no Dask scheduler[^\n]+\n", result.stderr)
    assert not Path("out").exists()


@posix
def test_a_dask_cluster_loses_a_worker_and_no_test(here):
    """Two workers without access to this file system; one is killed during the batch."""
    distributed = pytest.importorskip("distributed")
    (here / "tests/bad.csv").unlink()
    (here / "elsewhere").mkdir()
    with distributed.LocalCluster(n_workers=0, dashboard_address=None) as cluster:
        call = [sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address]
        call += ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        processes = [subprocess.Popen(call, cwd=here / "elsewhere", **quiet) for _ in range(2)]

        def kill() -> None:
            while not stamps("out"):
                time.sleep(0.02)
            processes[1].kill()

        killer = threading.Thread(target=kill, daemon=True)
        try:
            killer.start()
            words = ["batch", "tests", "--specimen", "foam.toml", "--starts", "2", "--no-report"]
            words += ["--scheduler", cluster.scheduler_address, "--out", "out", "--quiet"]
            result = run(*words)
            assert result.exit_code == 0, result.output
            assert processes[1].wait(10) == -signal.SIGKILL
        finally:
            for process in processes:
                process.kill()
                process.wait()
    again(starts=2, out="local")
    assert len(numbers("out")) == 3
    assert numbers("out") == numbers("local")


def test_one_fit_compiles_what_all_need_before_the_others_start(here, monkeypatch):
    order, second = [], threading.Event()

    class Slow(ThreadPoolExecutor):
        def submit(self, fn, /, task):
            order.append(f"{task.name} given")
            if len(order) > 1:
                second.set()
            return super().submit(fn, task)

        def stop(self):
            """Do nothing: there is no process to stop."""

    def fit(test, **options):
        second.wait(60.0 if module.cache.compiled("follow") else 0.02)
        order.append(f"{test.name} fitted")
        return fabricated.result(measurement=test)

    monkeypatch.setattr(batch_work, "fit", fit)
    monkeypatch.setattr(module, "Processes", lambda *_: Slow(3))
    for compiled in (False, True):
        order.clear()
        second.clear()
        have = {"integrate", "follow"} if compiled else {"integrate"}
        monkeypatch.setattr(module.cache, "compiled", lambda name="integrate", h=have: name in h)
        again(executor=None, model="microscale", fresh=True)
        assert order[0] == "a given"
        assert (order[1] == "a fitted") != compiled


# ------------------------------------------------------------------------- the page


def rows_of(count):
    rng = np.random.default_rng(0)
    base = row_of("t", "t.csv", fabricated.result())
    for i in range(count):
        given = {
            name: replace(p, value=rng.normal(p.value or 1.0, 1e-2))
            for name, p in base.parameters.items()
        }
        status = ("ok", "warnings", "failed")[i % 3]
        yield Row(
            f"test-{i:04d}", f"data/test-{i:04d}.csv", status, None, base.misfit, 1.0, given,
        )  # fmt: skip
    yield Row("<b>", "<b>.csv", "refused", "no <height> & no width")


def test_parameters_of_all_tests_are_drawn_side_by_side(tmp_path):
    rows = list(rows_of(5))
    svg = write_comparison(rows, tmp_path, "a batch", width="one", pictures=True)
    assert names(tmp_path) == ["summary.pdf", "summary.png", "summary.tex"]
    text = (tmp_path / "summary.tex").read_text(encoding="utf-8")
    assert [line.split(" & ")[0] for line in text.splitlines() if line.startswith("test")] == [
        "test-0000", "test-0001", "test-0003", "test-0004",
    ]  # fmt: skip
    write_page(rows, tmp_path, "a batch", svg)
    assert "data:image/svg+xml" in (tmp_path / "summary.html").read_text(encoding="utf-8")


def test_the_page_of_a_thousand_tests_is_small_and_needs_nothing_else(tmp_path):
    rows = list(rows_of(1000))
    write_page(rows, tmp_path, "a batch")
    page = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert len(page) < 2_500_000
    assert not re.search(r"(src|href)=\"(https?:)?//", page)
    assert page.count("<tr>") == 1002
    assert "no &lt;height&gt; &amp; no width" in page
    assert page.count("<i>") >= 6000  # intervals


def test_the_page_has_no_misfit_that_no_test_has(tmp_path):
    cells = [fabricated.estimate("s1_kc", float(k)) for k in (1, 2, 40)]
    rows = [
        Row(f"t{i}", f"t{i}.csv", "ok", None, {"stress_strain": 0.01, "stress_time": None}, 1.0,
            {"s1_kc": cell})
        for i, cell in enumerate(cells)
    ]  # fmt: skip
    write_page(rows, tmp_path, "a batch")
    page = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert "misfit loop" in page
    assert "misfit u(t)" not in page
    assert "misfit σ(t)" not in page


def test_of_very_many_tests_the_page_shows_some_and_all_that_failed(tmp_path):
    rows = [Row(f"t{i}", "x.csv", "ok") for i in range(MOST_ON_PAGE + 5)]
    rows.append(Row("last", "x.csv", "refused", "why"))
    write_page(rows, tmp_path, "a batch")
    page = (tmp_path / "summary.html").read_text(encoding="utf-8")
    assert f"This page shows {MOST_ON_PAGE + 1} of them" in page
    assert "last" in page


def test_models_with_other_parameters_leave_cells_empty():
    one = Row("a", "a.csv", "ok", parameters={"s1_k0": fabricated.estimate("s1_k0", 1.0)})
    weak = fabricated.estimate("s1_kc", 2.0, state="weak")
    other = Row("b", "b.csv", "ok", parameters={"s1_kc": weak})
    first, second = table_rows([one, other])
    assert list(first) == list(second)
    assert first["s1_kc"] is None
    assert second["s1_kc_state"] == "weak"


def test_the_page_of_a_batch_shows_the_range_that_a_state_goes_by(tmp_path: Path) -> None:
    """A wide range makes a parameter undetermined, however narrow its interval is."""
    cell = fabricated.estimate(
        "s1_kc", 2e5, stderr=1e3, ci95=(1.98e5, 2.02e5), state="not determined", range=(4e4, 7.1e5)
    )
    rows = [Row(name, f"{name}.csv", "ok", parameters={"s1_kc": cell}) for name in "ab"]
    write_page(rows, tmp_path, "two tests")
    page = (tmp_path / "summary.html").read_text()
    assert "198.0 to 202.0; range 40 to 710" in page
