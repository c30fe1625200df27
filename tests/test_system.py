"""Processes as Windows starts them, tried here; for the end of the page see serving.py."""

import multiprocessing
import time
from pathlib import Path

from foamfit import terminal
from foamfit.page import worker
from foamfit.study.processes import Processes, context_of


def test_processes_without_a_fork_server_are_spawned(monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    with Processes(1) as pool:
        assert pool.submit(pow, 2, 5).result(timeout=60) == 32


def test_a_fit_of_the_page_without_a_fork_server_is_spawned(monkeypatch, tmp_path):
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    monkeypatch.setattr(worker, "processes", lambda: context_of(()))
    absent = tmp_path / "absent.csv"
    fit = worker.Worker(worker.Job(absent, absent.with_suffix(".toml"), tmp_path / "fit"))
    while fit.ended is None:
        time.sleep(0.02)
    assert "absent.toml: no such file" in fit.ended


def test_no_other_module_uses_what_windows_lacks():
    lacking = "SIGHUP killpg add_signal_handler start_new_session os.fork( .is_mount("
    for path in Path(terminal.__file__).parent.rglob("*.py"):
        if path != Path(terminal.__file__):
            text = path.read_text(encoding="utf-8")
            assert not [word for word in lacking.split() if word in text], path
