"""The rate of a test: its mean strain rate on loading."""

from __future__ import annotations

import numpy as np

from foamfit.data.measurement import Measurement

# Samples above this share of the largest displacement say when it is reached; a test that stays
# there so many times longer than it took to get there is held.
TOP, HELD = 0.95, 1.0


def loading_rate(measurement: Measurement) -> float | None:
    """Mean strain rate on loading, from contact to the largest strain, 1/s; None without time.

    The largest strain is where a parabola through the top of the motion has its apex: the largest
    sample of a noisy one may lie far off. Where the motion is held there, loading ends at the
    start of that. The motion of an impact may be integrated from its force; None without any.
    """
    if measurement.time is None or measurement.displacement is None:
        return None
    time = measurement.time - measurement.time[0]
    motion = measurement.displacement - measurement.displacement[0]
    height, most, peak = measurement.specimen.height, float(motion.max()), int(np.argmax(motion))
    if most <= 0.0 or time[peak] <= 0.0:
        return None
    high = motion >= TOP * most
    first = int(np.argmax(high))
    until = peak + int(np.argmin(high[peak:])) if not high[peak:].all() else motion.size
    reached, when = float(time[first]) / TOP, float(time[peak])
    if time[until - 1] - time[first] > HELD * reached > 0.0:
        return most / height / reached
    if until - first > 4:
        bend, slope, _ = np.polyfit(time[first:until] - when, motion[first:until], 2)
        apex = when - slope / (2.0 * bend) if bend < 0.0 else when
        when = apex if time[first] <= apex <= time[until - 1] else when
    return float(most / height / when)
