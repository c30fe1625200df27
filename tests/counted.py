"""Count what a run calls: the functions of its laws, rates of the state, steps, samples.

Compiled loops call laws, and the parts that only some scenes need, by addresses that
`layout.lay_out` writes into the record of a run. `counting` replaces these addresses by those of
Python functions, which count a call and then make it.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import foamfit as ff
from foamfit.solve import plan as planned
from foamfit.solve.layout import Layout, Shape, lay_out
from foamfit.solve.run import ADDRESSES, AT, KIND, NUMBERS

_F, _I, _P = ctypes.c_double, ctypes.c_int64, ctypes.c_void_p
# Results and arguments of the functions of a law (`compiled.contract`) and of a run.
OF_LAW = {
    "begin": (_F, _P, _P),
    "evaluate": (_F, _P, _P, _P, _P, _I, _I, _P),
    "switch": (_F, _P, _P, _I, _P),
    "settle": (_F, _P, _P, _F),
    "strain": (_F, _P, _P, _F),
}
OF_RUN = {
    "rates_at": (None, _P, _P, _P, _I, _F, _I),
    "group_at": (_F, _P, _I, _P, _P, _I, _F),
    "inside_at": (None, _P, _I, _I, _I, _P, _P, _P, _P),
    "change_at": (None, _P, _I, _I, _P),
    "step_at": (_I, _P, _I, _F, _F, _F),
    "drive_at": (_I, _P, _I, _I),
    "write_at": (None, _P, _P, _F, _I, _I),
}
assert set(OF_RUN) == set(ADDRESSES)
assert len(OF_LAW) == KIND  # the addresses come first among the integers of a spring


class Counts(Counter[str]):
    """Calls by name, points at which laws were evaluated, and the layout of the last run."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes: dict[str, int] = {}
        self._callbacks: dict[tuple[int, str], Any] = {}  # keeps their addresses valid

    def _replaced(self, address: int, kinds: tuple[Any, ...], name: str) -> int:
        """Return the address of a function that counts its calls and makes them."""
        if (address, name) not in self._callbacks:
            kind = ctypes.CFUNCTYPE(*kinds)
            real = kind(address)

            def call(*given: Any) -> Any:
                self._note(name, given)
                return real(*given)

            self._callbacks[address, name] = kind(call)
        return ctypes.cast(self._callbacks[address, name], ctypes.c_void_p).value or 0

    def _note(self, name: str, given: tuple[Any, ...]) -> None:
        self[name] += 1
        if name.endswith(": evaluate"):
            self[f"{name}d points"] += given[4]
            self[f"{name}d slopes"] += given[4] * (given[5] == 1)
        if name == "rates":
            self["tangents"] += self.sizes["p"] * (given[3] > 0)

    def lay_out(self, shape: Shape, integrated: bool = True) -> Layout:
        """Lay out a run whose calls are counted."""
        layout = lay_out(shape, integrated)
        words = layout.words.copy()
        for name, kinds in OF_RUN.items():
            if address := int(words[AT[name]]):
                words[AT[name]] = self._replaced(address, kinds, name.removesuffix("_at"))
        first = int(words[AT["numbers"]])
        for i, law in enumerate(shape.laws):
            at = first + i * NUMBERS
            for k, (name, kinds) in enumerate(OF_LAW.items()):
                words[at + k] = self._replaced(int(words[at + k]), kinds, f"{law.kind}: {name}")
        self.sizes = {name: int(words[AT[name]]) for name in ("nodes", "base", "carries", "p")}
        return Layout(words, layout.floats)


@contextmanager
def counting() -> Iterator[Counts]:
    """Count the calls of all runs of plans in the body."""
    counts = Counts()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planned, "lay_out", counts.lay_out)
        yield counts


def counted_run(scene: planned.Plan, chain: ff.Chain) -> tuple[Counts, planned.Motion]:
    """Return the counts of one run, and the motion."""
    with counting() as counts:
        motion = scene.run(chain.arrays.rows, chain.arrays.heights)
    return counts, motion


def during(work: Callable[[], Any]) -> tuple[Counts, Any]:
    """Return the counts of some work, and its result."""
    with counting() as counts:
        result = work()
    return counts, result
