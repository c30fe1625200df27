"""Errors raised by foamfit, and Ctrl-C inside compiled code."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class InputError(ValueError):
    """A file, key, column, option or argument is wrong; the message says what would be right.

    Any other ValueError (numpy's LinAlgError, say) is a defect of foamfit. The command prints
    `lines`, which a user may copy into a file, below the message.
    """

    def __init__(self, message: str = "", lines: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.lines = lines


@contextmanager
def naming(path: object) -> Iterator[None]:
    """Name the file that is wrong at the beginning of an InputError of the body."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}", error.lines) from None


class SimulationError(RuntimeError):
    """A simulation cannot go on; the message says why. A simulation never returns NaN instead."""


@contextmanager
def as_signalled() -> Iterator[None]:
    """Raise Ctrl-C, or the end by a signal, as itself.

    Python turns it into a SystemError if it comes while a compiled loop returns its result.
    """
    try:
        yield
    except SystemError as error:
        first: BaseException | None = error
        while isinstance(first, SystemError):  # one for each nested compiled loop
            first = first.__cause__ or first.__context__
        if first is None or isinstance(first, Exception):
            raise
        raise first from None
