"""Errors raised by foamfit, and Ctrl-C as what it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class InputError(ValueError):
    """A file, key, column, option or argument is wrong; the message says what would be right.

    Any other ValueError, as numpy's LinAlgError is one, is a defect of foamfit. The command shows
    `lines`, what is to be written into a file, beneath the message.
    """

    def __init__(self, message: str = "", lines: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.lines = lines


class SimulationError(RuntimeError):
    """A simulation cannot go on; the message says why. A simulation never returns NaN instead."""


@contextmanager
def as_signalled() -> Iterator[None]:
    """Raise Ctrl-C, or the end by a signal, as itself.

    Where it comes while a compiled loop hands over its result Python makes a SystemError of it.
    """
    try:
        yield
    except SystemError as error:
        first: BaseException | None = error
        while isinstance(first, SystemError):  # one for each compiled loop that called the next
            first = first.__cause__ or first.__context__
        if first is None or isinstance(first, Exception):
            raise
        raise first from None
