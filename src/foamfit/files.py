"""Write files and folders atomically.

Each is written under a temporary name, which contains the process, and renamed at the end. Files
left by a killed process are removed by the next process that writes to the same path.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import os
import platform
import re
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from foamfit.errors import InputError

_HOST = re.sub(r"[^\w-]", "-", platform.node())[:40] or "host"
# Identifies this process: its number may be used again later, or in another container.
_TOKEN = uuid4().hex[:8]
# Age, s, after which a temporary file counts as abandoned if its process cannot be checked.
_ABANDONED = 86400.0
_LARGEST = 2**30  # bytes of the largest file that is read


def check_file(path: Path) -> None:
    """Raise InputError if a file cannot be written."""
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder; name a file")
        if not path.parent.is_dir():
            raise InputError(f"{path} cannot be written: there is no folder {path.parent}")
        there, special = path.exists(), path.exists() and not path.is_file()
        free = special or os.access(path.resolve().parent, os.W_OK | os.X_OK)
        if not free or (there and not os.access(path, os.W_OK)):
            raise InputError(f"{path} cannot be written: permission denied")
    except (OSError, RuntimeError) as error:  # a name that is too long, a link to itself
        raise InputError(f"{path} cannot be written: {reason(error)}") from None


def read_whole(path: Path, most: int | None = None) -> bytes:
    """Read a file or a pipe, or its first `most` bytes; OSError for a device (may be endless)."""
    with path.open("rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
            raise OSError(errno.EINVAL, "it is a device, not a file")
        raw = file.read(_LARGEST + 1 if most is None else most)
    if len(raw) > _LARGEST:
        raise OSError(errno.EFBIG, f"it has more than {_LARGEST} bytes")
    return raw


def write_file(path: str | Path, content: bytes) -> None:
    """Write a file; if that fails, raise InputError and keep the older file."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a device or a pipe
            path.write_bytes(content)
            return
        target = path.resolve()  # a link stays a link
        with replacing(target, folder=False) as fresh:
            fresh.write_bytes(content)
            if target.exists():
                shutil.copymode(target, fresh)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path} cannot be written: {reason(error)}") from None


def csv_bytes(rows: Iterable[Iterable[object]]) -> bytes:
    """Return rows of cells as CSV, with an apostrophe before text that looks like a formula."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(map(_harmless, row) for row in rows)
    # A non-UTF-8 name keeps its bytes as an escape.
    return text.getvalue().encode("utf-8", "backslashreplace")


def _harmless(cell: object) -> object:
    if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        try:
            float(cell)
        except ValueError:
            return f"'{cell}"
    return cell


@contextmanager
def replacing(target: Path, *, folder: bool = True) -> Iterator[Path]:
    """Give the body a temporary path that replaces `target` (a resolved path) at the end.

    The path is an empty `folder`, or else a file that the body creates.
    """
    made = [parent for parent in target.parents if not parent.exists()]
    fresh, old = _beside(target, "new"), _beside(target, "old")
    try:
        sweep(target.parent, [target.name])
        if folder:
            fresh.mkdir(parents=True)
        yield fresh
        if folder and target.exists():
            target.rename(old)
        fresh.replace(target)
    except BaseException:  # also after KeyboardInterrupt the old content must stay
        if old.exists() and not target.exists():
            old.rename(target)
        _remove(fresh)
        for parent in made:
            with suppress(OSError):
                parent.rmdir()
        raise
    finally:
        if target.exists():  # otherwise the old content is the only copy
            _remove(old)


def _remove(path: Path) -> None:
    """Remove a file or a folder, ignoring errors."""
    shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):  # of a file
        path.unlink()


def reason(error: BaseException) -> str:
    """Return the operating system's message for a failed access to a file."""
    return getattr(error, "strerror", None) or str(error)


def _beside(path: Path, ending: str) -> Path:
    """Return a temporary path in the same folder."""
    owner = f"{_HOST}.{os.getpid()}.{_TOKEN}{uuid4().hex[:8]}"
    return path.with_name(f".{_short(path.name)}.{owner}.{ending}")


def _short(name: str) -> str:
    """Return the name, shortened if the file system may not accept it with a suffix."""
    raw = os.fsencode(name)
    return name if len(raw) <= 100 else f"{name[:20]}~{hashlib.sha256(raw).hexdigest()[:12]}"


_LEFT = re.compile(
    r"\.(?P<name>.+)\.(?P<host>[\w-]{1,40})\.(?P<process>\d+)\.(?P<token>[0-9a-f]{8})[0-9a-f]{8}"
    r"\.(?P<ending>new|old)",
    re.DOTALL,
)


def is_left(name: str) -> bool:
    """Return whether a name is a temporary name of foamfit."""
    return _LEFT.fullmatch(name) is not None


def sweep(folder: Path, names: Iterable[str]) -> None:
    """Remove temporary versions of these files and folders that ended processes have left.

    An older result that had been renamed is restored if nothing has taken its place.
    """
    if not folder.is_dir():
        return
    targets = {_short(name): folder / name for name in names}
    for left in list(folder.iterdir()):
        found = _LEFT.fullmatch(left.name)
        path = None if found is None else targets.get(found["name"])
        if found is None or path is None or _lives(found, left):
            continue
        if found["ending"] == "old" and not path.exists():
            with suppress(OSError):
                left.rename(path)
        else:
            _remove(left)


def _lives(found: re.Match[str], left: Path) -> bool:
    """Return whether the process that made a temporary file may still be running."""
    process = int(found["process"])
    # Processes of another machine, or on a system without POSIX signals, cannot be checked.
    if found["host"] != _HOST or os.name != "posix":
        with suppress(OSError):
            return time.time() - left.stat().st_mtime < _ABANDONED
        return True
    if process == os.getpid():
        return found["token"] == _TOKEN
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it belongs to another user
        pass
    return True
