"""The contact time that the first rise of a channel shows, on made records of other laws."""

from __future__ import annotations

import numpy as np
import pytest

from foamfit.data.contact import rise_of
from foamfit.data.noise import estimated_noise

CONTACT, PEAK = 0.37, 1.0  # s, and the largest stress, one second later


def rise(kind: str, since: np.ndarray) -> np.ndarray:
    """Return a made rise of the stress, by the time since contact (s)."""
    x = np.maximum(since, 0.0)
    shape = {
        "kink": x,
        "soft": x**2,
        "jump": np.where(since >= 0.0, 0.08 + 0.92 * x, 0.0),
        "plateau": np.minimum(6.0 * x, 0.3) + 0.7 * x**4,
        "late kink": 0.1 * x + 9.0 * np.maximum(x - 0.9, 0.0),
    }[kind]
    return PEAK * shape


@pytest.mark.parametrize("kind", ["kink", "soft", "jump", "plateau", "late kink"])
@pytest.mark.parametrize("noise", [1e-3, 1e-2])
@pytest.mark.parametrize("rows", [150, 2000])
def test_the_standard_error_covers_the_true_contact(kind, noise, rows):
    """Of 24 records none is off by more than four standard errors, their RMS is at most 1.7."""
    off = []
    for seed in range(24):
        rng = np.random.default_rng([seed, rows])
        step = 1.0 / rows
        time = np.arange(-0.3, 1.0, step) + rng.uniform(0.0, step) + CONTACT
        clean = rise(kind, time - CONTACT)
        values = clean + noise * rng.standard_normal(time.size)
        before = int(np.searchsorted(time, CONTACT))
        values -= values[: before - 2].mean()
        found = rise_of(time, values, estimated_noise(values), before - 2, noise / before**0.5)
        assert found.error > 0.2 * step
        off.append((found.time - CONTACT) / found.error)
    assert np.max(np.abs(off)) < 4.0
    assert np.sqrt(np.mean(np.square(off))) < 1.7
