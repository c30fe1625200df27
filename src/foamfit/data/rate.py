"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import numpy as np

from foamfit.data.measurement import Measurement

# The peak is where the displacement first comes this close to its largest value, as a share of it:
# where the machine holds the peak, noise would put the largest value anywhere in the hold.
NEAR_PEAK = 1e-3


def loading_rate(measurement: Measurement) -> float | None:
    """Mean strain rate on loading (1/s): strain at the peak over the time from contact to it.

    The motion of an impact may be integrated from its force. None where the test has no time or no
    motion.
    """
    time, moved = measurement.time, measurement.displacement
    if time is None or moved is None:
        return None
    peak = int(np.argmax(moved >= (1.0 - NEAR_PEAK) * np.max(moved)))
    after = float(time[peak])  # time zero is where contact starts
    strain = float(moved[peak]) / measurement.specimen.height
    return strain / after if after > 0.0 and strain > 0.0 else None
