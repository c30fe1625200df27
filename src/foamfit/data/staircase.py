"""Channels that are held: a slow sensor repeats each value while the stress goes on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from foamfit.data.measurement import Array, NoiseLevel
from foamfit.data.noise import residual_noise
from foamfit.data.record import MIN_ROWS, Record


def fresh_samples(values: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples at which a value is new, and for how many samples each is held."""
    fresh = np.append(0, np.flatnonzero(np.diff(values) != 0.0) + 1)
    return fresh, np.diff(np.append(fresh, len(values)))


def is_staircase(values: Array) -> bool:
    """Whether most samples repeat the one before."""
    return bool(np.median(fresh_samples(values)[1]) >= 2)


def noise_of_held(record: Record) -> dict[str, NoiseLevel]:
    """Noise of the displacements that are held, from the samples where they are fresh."""
    levels = {}
    for name, values in record.curves().items():
        fresh = values[fresh_samples(values)[0]]
        if name != "stress" and is_staircase(values) and len(fresh) >= MIN_ROWS:
            how = f"estimated from what local cubics leave of {len(fresh)} fresh samples"
            step = len(values) / len(fresh)
            levels[name] = NoiseLevel(residual_noise(fresh)[0], False, how, step)
    return levels


def fill_staircase(record: Record) -> tuple[Record, list[str]]:
    """Interpolate displacements that are held while the stress goes on.

    The instants where a value is fresh are kept. A much longer hold is a real one: it lasts
    until one usual step before the next fresh value.
    """
    notes, time = [], record.instants
    for name, values in record.curves().items():
        fresh, lengths = fresh_samples(values)
        step = int(np.median(lengths))
        if name == "stress" or len(lengths) < MIN_ROWS or step < 2:
            continue
        knots = np.union1d(fresh, (fresh + lengths - step)[lengths > 3 * step])
        record = record.changed(name, np.interp(time, time[knots], values[knots]))
        shown = "The displacement" if name == "displacement" else name
        notes.append(
            f"{shown} is held for about {step} samples at a time; it is interpolated between the "
            f"{len(fresh)} instants where it is fresh."
        )
    return record, notes
