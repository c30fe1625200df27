"""The samples of a file on their way to a test: a `Record`, and the `Window` to look at."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import Array, Dropped, interior_channel, interior_node

MIN_ROWS = 10  # samples of a test


@dataclass(frozen=True)
class Window:
    """The part of a file to look at: times in s as the file counts them, and which cycle."""

    start: float | None = None
    end: float | None = None
    cycle: int = 1


@dataclass(frozen=True, eq=False)
class Record:
    """The channels of a test in SI, each of shape (n,) or None where the file lacks it.

    Time in s, stress in Pa, displacement of the top in m, velocity of the top in m/s and its
    deceleration in m/s² (like the stress that causes it, it is positive in compression). `interior`
    holds the displacement of masses inside in m, 1 for the one above spring 1. `excess` is what the
    file has beyond the straight line that bridges an outlier, 0 elsewhere, for each channel that
    has outliers. `clipped` marks the samples at which the force is clipped. `numbers` holds the row
    number in the file of each sample (None: they count from 1), and `dropped` the rows of the file
    that were left out so far.
    """

    time: Array | None
    stress: Array
    displacement: Array | None
    velocity: Array | None = None
    acceleration: Array | None = None
    interior: dict[int, Array] = field(default_factory=dict)
    excess: dict[str, Array] = field(default_factory=dict)
    clipped: NDArray[np.bool_] | None = None
    numbers: NDArray[np.int64] | None = None
    dropped: tuple[Dropped, ...] = ()

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.stress)

    @property
    def row_numbers(self) -> NDArray[np.int64]:
        """Row number in the file of each sample, shape (n,)."""
        return np.arange(1, len(self) + 1) if self.numbers is None else self.numbers

    @property
    def instants(self) -> Array:
        """Time, or the sample's number where there is none, shape (n,)."""
        return np.arange(len(self), dtype=np.float64) if self.time is None else self.time

    def curves(self, *more: str) -> dict[str, Array]:
        """Stress, displacement, `more` and displacements inside, as far as they are there."""
        names = ("stress", "displacement", *more, *map(interior_channel, self.interior))
        found = {name: self.channel(name) for name in names}
        return {name: values for name, values in found.items() if values is not None}

    def channel(self, name: str) -> Array | None:
        """Return a channel by its name; "displacement_1" is the mass inside above spring 1."""
        node = interior_node(name)
        values: Array | None = getattr(self, name) if node is None else self.interior.get(node)
        return values

    def changed(self, name: str, values: Array) -> Record:
        """Put other values into a channel."""
        node = interior_node(name)
        if node is None:
            return replace(self, **{name: values})  # type: ignore[arg-type]
        return replace(self, interior=self.interior | {node: values})

    def rows(self, which: slice | NDArray[np.bool_]) -> Record:
        """Keep some rows of every channel; those that `without` leaves out are counted, too."""
        kept: dict[str, Any] = {}
        for item in fields(self):
            values = getattr(self, item.name)
            if isinstance(values, dict):
                kept[item.name] = {key: v[which] for key, v in values.items()}
            elif isinstance(values, np.ndarray):
                kept[item.name] = values[which]
        return replace(self, **kept)

    def without(self, gone: slice | NDArray[np.bool_], why: str) -> Record:
        """Leave out some rows of every channel, and count them with the reason."""
        numbers = self.row_numbers
        lost = numbers[gone]
        if not lost.size:
            return self
        kept = np.ones(len(self), dtype=bool)
        kept[gone] = False
        dropped = (*self.dropped, Dropped.of(lost, why))
        return replace(self, numbers=numbers, dropped=dropped).rows(kept)

    def between(self, first: int, end: int, before: str, after: str) -> Record:
        """Keep the samples from `first` up to `end`; the reasons count what lies outside."""
        return self.without(slice(end, None), after).without(slice(0, first), before)
