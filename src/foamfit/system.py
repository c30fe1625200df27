"""What differs between operating systems: groups of processes and signals.

`POSIX` is False on Windows; the tests set it to False elsewhere to try that way.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from typing import Any

POSIX = os.name == "posix"
# Signals that ask a process to end: Ctrl-C, `kill`, and on POSIX the end of the terminal.
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def apart() -> dict[str, Any]:
    """Return arguments of `subprocess.Popen` that keep Ctrl-C in the terminal from a process."""
    if POSIX:
        return {"start_new_session": True}
    return {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}


def end_all(process: subprocess.Popen[Any]) -> None:
    """Kill a process that was started `apart`; on POSIX also the processes that it has started.

    Elsewhere these end by themselves when their pipe to the process closes.
    """
    if process.poll() is None:
        with suppress(ProcessLookupError, PermissionError):
            if POSIX:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
    process.wait()


def at_end(loop: asyncio.AbstractEventLoop, call: Callable[[], object]) -> None:
    """Let an event loop call a function when the process is asked to end."""
    for number in ENDING:
        if POSIX:
            loop.add_signal_handler(number, call)
        else:
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(call))
