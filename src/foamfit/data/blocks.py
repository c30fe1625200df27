"""Means of blocks of rows, to which long records are reduced, and their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from foamfit.arrays import Mask, means
from foamfit.data.measurement import NoiseLevel, Record
from foamfit.data.noise import averaged, noise_level, smooth

_MAX_ROWS = 1500  # more samples than this are averaged in blocks
_BLOCKS = 1000  # number of these blocks, at most, unless a ramp would have too few
_OF_RAMP = 100  # blocks of the fastest ramp
_MOST_BLOCKS = 10_000
_LAG = _OF_RAMP // 10
# Blocks move if means of _LAG of them differ by more than this share of the range, and by more than
# this many standard deviations of noise.
_MOVES, _BEYOND = 0.005, 6.0
_SEVERAL = 2.0  # median number of measured rows in a block from which they are averaged


def without_holds(record: Record, *, impact: bool = False) -> tuple[Record, int]:
    """Leave out most rows of long holds and rests; return also the rows in a block of `thin`.

    An impact has none. The means of a few large blocks of a ramp would not lie on the curves.
    Between many cycles there is nothing to leave out: they have more blocks.
    """
    n = len(record)
    size = -(-n // _BLOCKS) if n > _MAX_ROWS else 1
    if impact or record.time is None or size == 1:
        return record, size
    values = record.stress if record.displacement is None else record.displacement
    steady = smooth(values, size // 2 + 1)
    tenths = [int(np.argmax(steady >= 0.1 * k * steady.max())) for k in range(1, 11)]
    block = max(1, 10 * int(np.diff(tenths).min()) // _OF_RAMP)
    if 2 * block > size:
        return record, size
    while (moving := _moving(record, block)).sum() > _MOST_BLOCKS and block < size:
        block *= 2
    quiet = np.flatnonzero(~moving)
    wanted = max(_BLOCKS - int(moving.sum()), _BLOCKS // 4)
    moving[quiet[:: max(1, quiet.size // wanted)]] = True
    gone = ~np.repeat(moving, block)[:n]
    return record.without(gone, "in a hold or rest that fewer rows describe as well"), block


def _moving(record: Record, block: int) -> Mask:
    """Return the blocks around which motion or stress changes by more than noise.

    Means over a tenth of a ramp are compared, beside which noise is small.
    """
    blocks = -(-len(record) // block)
    if blocks < 4 * _LAG:
        return np.ones(blocks, dtype=bool)
    edges, out = np.arange(0, len(record), block), np.zeros(blocks)
    for values in (record.stress, record.displacement):
        if values is not None:
            mean = np.convolve(means(values, edges), np.full(_LAG, 1.0 / _LAG), "valid")
            noise = _BEYOND * noise_level(values) * np.sqrt(2.0 / (block * _LAG))
            moves = np.abs(mean[_LAG:] - mean[:-_LAG]) > max(noise, _MOVES * float(np.ptp(values)))
            out += np.convolve(moves, np.ones(2 * _LAG))
    return out > 0.5


def thin(record: Record, size: int) -> Record:
    """Average a long record in blocks of some rows, which also reduces its noise.

    A channel that was not measured at every row is averaged if blocks have several measured rows.
    Otherwise it is interpolated at the time of the block, because averages of an interpolated curve
    would be biased.
    """
    if size == 1:
        return record
    edges = np.arange(0, len(record), size)
    middle = means(record.instants, edges)
    note = f"{len(record)} samples are averaged in {len(edges)} blocks of {size}."
    time = None if record.time is None else middle
    thinned = Record(time, record.stress, None, notes=(*record.notes, note))
    for name, values in record.curves("acceleration").items():
        mean, taken = means(values, edges), record.sampled.get(name)
        if taken is not None:
            count = np.add.reduceat(taken.astype(np.int64), edges)
            several = (usual := float(np.median(count))) >= _SEVERAL
            mean = mean if several else np.interp(middle, record.instants, values)
            measured = count >= 0.5 * usual if several else count > 0
            if not several or not measured.all():
                thinned = replace(thinned, sampled=thinned.sampled | {name: measured})
        thinned = thinned.changed(name, mean)
    return thinned


def noise_of_blocks(level: NoiseLevel, block: int, taken: Mask | None) -> NoiseLevel:
    """Return the noise of blocks of samples if only those `taken` were measured."""
    edges = np.arange(0, 0 if taken is None else taken.size, block)
    if taken is None or np.median(np.add.reduceat(taken.astype(np.int64), edges)) >= _SEVERAL:
        return averaged(level, block)
    return replace(level, time=max(level.time * float(taken.mean()), 1.0))
