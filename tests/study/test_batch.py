"""Batches: each result is complete or absent and made once, whatever fails; and the summary."""

import csv
import errno
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import fabricated
import foamfit as ff
from conftest import HEIGHT, Inline, posix, run, run_refused, synthetic_impact, write_csv
from foamfit import files
from foamfit.cli import fit as command
from foamfit.report.listing import Row, row_of, write_comparison, write_page
from foamfit.study import batch as module
from foamfit.study.batch import work
from foamfit.terminal import TerminatedError

QUICK = {"starts": 2, "intervals": "local"}  # a search from one start explores longer
TOML = (
    f'[specimen]\nheight = "{1e3 * HEIGHT} mm"\narea = "19.635 mm^2"\n'
    '[striker]\nmass = "7 g"\nvelocity = "2 m/s"\n'
)


def write(folder: Path, name: str, seed: int) -> None:
    _, test = synthetic_impact(noise=0.003, seed=seed, samples=101)
    columns = (1e3 * test.time, 1e-6 * test.stress, 1e3 * test.displacement)
    head = "time (ms),stress (MPa),displacement (mm)"
    write_csv(folder / f"{name}.csv", head, *columns, fmt="%.6f")


@pytest.fixture
def here(here):
    """Three tests, a CSV file that is not a test, and one TOML for all."""
    (here / "tests").mkdir()
    for seed, name in enumerate("abc"):
        write(here / "tests", name, seed)
    (here / "tests" / "bad.csv").write_text("x,y\n1,2\n")
    (here / "foam.toml").write_text(TOML)
    return here


@pytest.fixture
def tried(monkeypatch):
    """Replace the fit by a fast one that records the names of the fitted tests."""
    found = []

    def fit(test, **options):
        found.append(test.name)
        return fabricated.result(measurement=test)

    monkeypatch.setattr(module, "fit", fit)
    return found


def again(**changed):
    given = {"out": "out", "specimen": "foam.toml", "executor": Inline(), "report": False}
    return ff.batch("tests", **(given | changed))


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def numbers(out):
    """Return the fitted numbers as written to the files."""
    found = Path(out).glob("*/parameters.csv")
    return {path.parent.name: path.read_text() for path in sorted(found)}


def stamps(out):
    """Return the time at which each result was written."""
    return {p.parent.name: p.stat().st_mtime_ns for p in Path(out).glob("[!.]*/batch.json")}


def test_the_same_numbers_in_this_process_and_in_two_others(here):
    (here / "tests/c.csv").unlink()
    again(out="inline", **QUICK)
    frame = again(out="two", executor=None, jobs=2, **QUICK)
    made = numbers("two")
    assert list(made) == ["a", "b"]
    assert made == numbers("inline")
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


def test_a_cycle_is_a_row_and_its_folder_is_in_that_of_the_test(here, monkeypatch):
    def fit_cycles(path, specimen, *, cycles, **options):
        assert cycles is None
        results = {1: fabricated.result(), 2: fabricated.result(status="ok")}
        return ff.CycleFits("a", "bistable", (1, 2, 3), results, {3: "it is cut"})

    monkeypatch.setattr(module, "fit_cycles", fit_cycles)
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


def test_a_defect_is_a_row_and_ends_nothing(here, tried, monkeypatch):
    def fit(test, **options):
        if test.name == "b":
            raise ZeroDivisionError("of b")
        return fabricated.result(measurement=test)

    monkeypatch.setattr(module, "fit", fit)
    row = again().set_index("test").loc["b"]
    assert row["status"] == "refused"
    assert "defect of foamfit, please report it (ZeroDivisionError: of b)" in row["error"]


def unfitted(task):
    """Work in another process with a fast fit; at module level so that it can be pickled."""
    module.fit = lambda test, **_: fabricated.result(measurement=test)
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
    assert "its process ended before it was fitted" in frame.loc["b", "error"]
    assert list(numbers("out")) == ["a", "c"]
    assert not [name for name in names("out") if name.startswith(".")]
    before = stamps("out")
    monkeypatch.setattr(module, "work", work)
    assert again().set_index("test").loc["b", "status"] == "warnings"
    assert tried == ["b"]
    after = stamps("out")
    assert {name: after[name] for name in before} == before


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


def test_a_full_disk_ends_in_one_sentence_and_loses_nothing(here, tried, monkeypatch):
    real, written = module.write_result, []

    def write_result(result, folder, **options):
        if written:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(1)
        real(result, folder, **options)

    monkeypatch.setattr(module, "write_result", write_result)
    with pytest.raises(ff.InputError, match=r"No space left.*1 of 4 tests are done and kept"):
        again()
    assert list(numbers("out")) == ["a"]
    assert not [name for name in names("out") if name.startswith(".")]
    monkeypatch.setattr(module, "write_result", real)
    tried.clear()
    again()
    assert tried == ["b", "c"]


def test_memory_errors_and_other_versions_are_not_the_fault_of_a_test(here, monkeypatch):
    monkeypatch.setattr(module, "fit", lambda *_, **__: (_ for _ in ()).throw(MemoryError()))
    frame = again().set_index("test")
    assert "its fit was lost (MemoryError" in frame.loc["a", "error"]
    # There is no result of the test, so the next call retries it.
    assert names("out") == ["bad", "summary.csv", "summary.html", "summary.tex"]


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
    monkeypatch.setattr("foamfit.solve.cache.compiled", lambda *_: True)
    before = sorted(here.rglob("*"))
    assert told in run_refused("batch", *words)
    assert sorted(here.rglob("*")) == before


@pytest.mark.parametrize("place", ["notes.txt", "a/notes.txt", "mine/notes.txt", "fit.png"])
def test_a_folder_with_files_of_others_is_refused(here, tried, place):
    again()
    (here / "out" / place).parent.mkdir(exist_ok=True)
    (here / "out" / place).write_text("mine")
    with pytest.raises(ff.InputError, match=f"out holds {place}, which foamfit did not write"):
        again(fresh=True)
    assert len(tried) == 3


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
        deadline = time.monotonic() + 180
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
    left = Path(f"out/.c.{files._HOST}.4194303.0123456789abcdef.new")  # of an ended process
    left.mkdir()
    (left / "half").touch()
    monkeypatch.setattr(module, "Processes", lambda *_: Inline())
    result = run(*words, "--jobs", "1", code=2)  # bad.csv
    assert {*tried} == {"a", "b", "c"} - {*done}
    assert "1 of 4 tests has no acceptable fit" in result.stderr
    after = stamps("out")
    assert {name: after[name] for name in done} == done
    assert len(after) == 4
    assert not [name for name in names("out") if name.startswith(".")]


def test_the_command_prints_counts_parameters_and_refusals(here, tried, monkeypatch):
    monkeypatch.setattr(module, "Processes", lambda *_: Inline())
    words = ("--specimen", "foam.toml", "--no-report", "--out", "out")
    result = run("batch", "tests", *words, code=2)
    assert result.stdout.startswith("4 tests: 3 fitted with warnings and 1 refused\n")
    assert "\nbad: tests/bad.csv: " in result.stdout
    assert re.search(r"\ns1_k0 +MPa +5\.500 +5\.500 +5\.500 +3 of 3\n", result.stdout)
    assert result.stdout.endswith("written to out: open out/summary.html\n")
    assert result.stderr == "foamfit: 1 of 4 tests has no acceptable fit; see out/summary.csv\n"
    result = run("batch", "tests/a.csv", *words, "--json")
    (row,) = json.loads(result.stdout)
    assert row["s1_k0_state"] == "determined"
    assert result.stderr == ""


def test_a_scheduler_that_cannot_be_reached_is_one_sentence(here, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(command, "PATIENCE", 0.3)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        told = run_refused("batch", "tests", "--scheduler", address, "--out", "out")
        assert re.match(r"foamfit: --scheduler .+no Dask scheduler", told)
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    told = run_refused("batch", "tests", "--scheduler", "tcp://127.0.0.1:1")
    assert told.endswith('is not installed: pip install "foamfit[dask]"\n')
    assert not Path("out").exists()


def test_a_worker_that_sees_other_files_is_a_row(here, tried):
    class Elsewhere(Inline):
        def submit(self, fn, task):
            return super().submit(fn, replace(task, where=here / "elsewhere"))

    (here / "elsewhere").mkdir()
    row = again(executor=Elsewhere()).set_index("test").loc["a"]
    assert row["status"] == "refused"
    assert "does not see the same files" in row["error"]
    assert not tried


@posix
def test_a_dask_cluster_loses_a_worker_and_no_test(here):
    """Two workers in another folder; one is killed during the batch."""
    distributed = pytest.importorskip("distributed")
    (here / "tests/bad.csv").unlink()
    (here / "elsewhere").mkdir()
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0") as cluster:
        call = [sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address]
        call += ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        processes = [subprocess.Popen(call, cwd=here / "elsewhere", **quiet) for _ in range(2)]

        def kill() -> None:
            while not stamps("out"):
                time.sleep(0.02)
            processes[1].kill()
            processes[1].wait()  # until then its number is that of a process

        killer = threading.Thread(target=kill, daemon=True)
        try:
            killer.start()
            words = ["batch", "tests", "--specimen", "foam.toml", "--starts", "2", "--no-report"]
            words += ["--scheduler", cluster.scheduler_address, "--out", "out", "--quiet"]
            run(*words)
            assert processes[1].wait(10) == -signal.SIGKILL
        finally:
            for process in processes:
                process.kill()
                process.wait()
    again(starts=2, out="local")
    assert len(numbers("out")) == 3
    assert numbers("out") == numbers("local")


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
