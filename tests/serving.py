"""The page served by the command in a separate process."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from conftest import EXPERIMENTS


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Serve the page for all tests of a module."""
    with serving(tmp_path_factory.mktemp("files")) as page:
        yield page


@contextmanager
def serving(files):
    """Serve the page and yield its address, process and folder of files."""
    process = subprocess.Popen(
        [sys.executable, "-m", "foamfit", "page", "--no-browser"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"TMPDIR": str(files), "MPLBACKEND": "Agg"}, cwd=EXPERIMENTS.parent,
    )  # fmt: skip
    address = process.stdout.readline().strip()
    assert address.startswith("http://127.0.0.1:"), process.stderr.read()
    port, token = address.split(":")[2].split("/")[:2]
    yield SimpleNamespace(
        address=address, port=int(port), token=token, files=files, process=process
    )
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors, errors
    assert list(files.iterdir()) == []  # no files are left behind
