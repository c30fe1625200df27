"""Wrong calibrations and faulty channels: each changes the record of a synthetic impact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rig import Record


def stated(velocity: float = 1.0, mass: float = 1.0) -> Callable[[Record], Record]:
    """Multiply velocity and mass in the TOML."""

    def changed(record: Record) -> Record:
        said = f"{velocity * record.rig.velocity:.12g} m/s"
        return replace(
            record, toml_velocity=said, rig=replace(record.rig, mass=mass * record.rig.mass)
        )

    return changed


def sensed(
    change: Callable[[np.ndarray, np.ndarray, float], np.ndarray],
) -> Callable[[Record], Record]:
    """Change the force, given its samples, the time over the time under load, and its range."""

    def changed(record: Record) -> Record:
        force, lasts = record.channels["force"], record.course.end
        since = (record.time - record.truth["contact_time"]) / lasts
        channels = record.channels | {"force": change(force, since, float(np.ptp(force)))}
        return replace(record, channels=channels)

    return changed


def clipped(share: float) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray]:
    """Clip the force at a share of its range."""
    return lambda force, _, size: np.minimum(force, np.min(force) + share * size)


def ringing(force: np.ndarray, since: np.ndarray, size: float) -> np.ndarray:
    """Add a decaying vibration that starts at contact."""
    after = np.maximum(since, 0.0)
    return force + 0.05 * size * np.exp(-6.0 * after) * np.sin(2.0 * np.pi * 15.0 * after)


FAULTS: dict[str, Callable[[Record], Record]] = {
    "nothing wrong": lambda record: record,
    "velocity -10 %": stated(velocity=0.9),
    "velocity +10 %": stated(velocity=1.1),
    "mass -20 %": stated(mass=0.8),
    "mass +25 %": stated(mass=1.25),
    "force x 0.8": sensed(lambda force, *_: 0.8 * force),
    "force x 1.25": sensed(lambda force, *_: 1.25 * force),
    "clipped at 80 %": sensed(clipped(0.8)),
    "clipped at 60 %": sensed(clipped(0.6)),
    "drift of 5 %": sensed(lambda force, since, size: force + 0.05 * size * since),
    "ringing, 5 %": sensed(ringing),
    "lag of 3 %": sensed(lambda force, since, _: np.interp(since - 0.03, since, force)),
}
