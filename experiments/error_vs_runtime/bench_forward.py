"""Benchmarks of the simulation; they are not tests and assert nothing about times.

    pip install ".[benchmark]"
    pytest experiments/error_vs_runtime/bench_forward.py --benchmark-group-by=group
    pytest experiments/error_vs_runtime/bench_forward.py -k springs --benchmark-json=before.json

The springs are those of `forward.py`, which compares foamfit with SciPy.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import foamfit as ff
from foamfit.solve.plan import plan

sys.path.insert(0, str(Path(__file__).parent))
import rivals as kinds

SIZES = (1, 10, 100, 1000)
SAMPLES = (100, 1000, 10_000, 100_000)


def loop(samples: int, by_stress: bool) -> np.ndarray:
    """Return a history past C1 and back: stress (Pa) or strain."""
    spring, s = kinds.MODEL_2.bistable, np.linspace(0.0, 1.0, samples)
    most = 1.15 * spring.sigma_hat_c if by_stress else 1.05 * spring.eps_hat_c
    return most * np.where(s < 0.5, np.sin(np.pi * s) ** 2, np.sin(np.pi * s) ** 4)


def kernel(chain: ff.Chain, drive: Any, time: np.ndarray) -> Any:
    """Return the bare simulation that the fit calls, as a function without arguments."""
    made = plan(chain, drive, time)
    rows, heights = chain.arrays.rows, chain.arrays.heights
    return lambda: made.run(rows, heights, everything=False)


@pytest.mark.parametrize(
    ("count", "samples"),
    [*((count, kinds.SAMPLES) for count in SIZES), *((1, samples) for samples in SAMPLES)],
)
@pytest.mark.parametrize("drive", ["stress", "displacement", "impact"])
def test_springs_and_samples(benchmark: Any, drive: str, count: int, samples: int) -> None:
    benchmark.group = f"{drive}, {'springs' if samples == kinds.SAMPLES else 'samples'}"
    t = np.linspace(0.0, kinds.LENGTH, samples)
    load = loop(samples, drive == "stress")
    given = {
        "stress": ff.StressDrive(load), "displacement": ff.DisplacementDrive(kinds.HEIGHT * load),
        "impact": ff.Impact(kinds.MASS, 2.2),
    }[drive]  # fmt: skip
    run = kernel(kinds.graded(count), given, t)
    run()
    benchmark.pedantic(run, rounds=3 if count == 1000 else 20)
