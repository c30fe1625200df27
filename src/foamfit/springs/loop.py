"""A measured loop, from which laws read start values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from foamfit.arrays import Array

CORNERS = 8  # corners of the polygon along loading, and along unloading


@dataclass(frozen=True, eq=False)
class Loop:
    """Loading and unloading stress (Pa) of a measured loop as functions of strain."""

    strain: Array
    stress: Array

    @cached_property
    def kinks(self) -> tuple[Array, Array, Array, Array]:
        """Return candidates for A1, C1, C2 and A2: strain and stress (k, 2) of bends of the loop.

        On loading the slope falls at A1 and rises at C1 (or the loop turns there). On unloading it
        falls at C2 and rises at A2 (or the loop ends).
        """
        peak = int(np.argmax(self.strain))
        ways = slice(peak + 1), slice(peak, None)
        up, down = (corners(self.strain[w], self.stress[w], CORNERS) for w in ways)
        out = []
        for line in (up, down[::-1]):
            steps = np.diff(line, axis=0)
            slopes = np.arctan2(
                steps[:, 1] / np.ptp(self.stress), steps[:, 0] / np.ptp(self.strain)
            )
            falls = np.append(False, np.append(np.diff(slopes) < 0.0, False))
            out.append((line[falls], line[1:-1][~falls[1:-1]]))
        (a1, c1), (a2, c2) = out
        a1 = a1 if len(a1) else up[1:2]
        return a1, np.vstack([c1, up[-1]]), np.vstack([c2, down[0]]), np.vstack([a2, down[-1]])

    def at(self, strain: float, *, loading: bool) -> float:
        """Return the stress (Pa) on loading up to the largest strain, or on unloading."""
        peak = int(np.argmax(self.strain))
        way = slice(peak + 1) if loading else slice(None, peak - 1 if peak else None, -1)
        return float(np.interp(strain, np.maximum.accumulate(self.strain[way]), self.stress[way]))


def corners(strain: Array, stress: Array, count: int) -> Array:
    """Return the corners of a polygon that approximates a curve, (count, 2), with its ends.

    Each new corner is the sample farthest from the polygon so far, relative to the ranges of the
    curve.
    """
    x, y = strain / (np.ptp(strain) or 1.0), stress / (np.ptp(stress) or 1.0)
    chosen = [0, x.size - 1]
    for _ in range(min(count, x.size) - 2):
        parts = np.clip(np.searchsorted(chosen, np.arange(x.size)), 1, len(chosen) - 1)
        low, high = np.array(chosen)[parts - 1], np.array(chosen)[parts]
        dx, dy = x[high] - x[low], y[high] - y[low]
        off = np.abs((x - x[low]) * dy - (y - y[low]) * dx) / np.maximum(np.hypot(dx, dy), 1e-12)
        chosen = sorted({*chosen, int(np.argmax(off))})
    return np.column_stack([strain, stress])[chosen]
