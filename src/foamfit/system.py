"""What differs between operating systems: signals.

`POSIX` is False on Windows; the tests set it to False elsewhere to try that way.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable

POSIX = os.name == "posix"
# Signals that ask a process to end: Ctrl-C, `kill`, and on POSIX the end of the terminal.
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


def at_end(loop: asyncio.AbstractEventLoop, call: Callable[[], object]) -> None:
    """Let an event loop call a function when the process is asked to end."""
    for number in ENDING:
        if POSIX:
            loop.add_signal_handler(number, call)
        else:
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(call))
