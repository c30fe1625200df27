"""Compile loops that a first fit does not need and many tests do: `python first_use.py many`.

Called in processes of their own by conftest.py, before or beside the tests.
"""

from __future__ import annotations

import sys

import numpy as np

import foamfit as ff


def many() -> None:
    """Springs that count as one."""
    time = np.linspace(0.0, 1e-3, 3)
    spring = ff.published["foam-1/model-1"].bistable
    chain = ff.Chain([spring] * 12, [1e-3] * 12, 2e-5)
    assert ff.simulate(chain, ff.Impact(7e-3, 2.0), time).method == "aggregate"


def memory() -> None:
    """A microscale spring without and with relaxation, along a motion and a stress, and struck."""
    time = np.linspace(0.0, 1.0, 50)
    for relaxation in ((), ((0.5, 0.2),)):
        spring = ff.MicroscaleSpring(
            5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, relaxation=relaxation
        )
        chain = ff.Chain([spring], [1e-2], 1e-4)
        drives: list[ff.Drive] = [ff.DisplacementDrive(3e-3 * np.sin(np.pi * time))]
        if not relaxation:
            drives.append(ff.StressDrive(1e5 * np.sin(np.pi * time)))
        for drive in drives:
            ff.simulate(chain, drive, time, sensitivities=["s1_kc"])
    struck = ff.simulate(chain, ff.Impact(7e-3, 2.0), 1e-3 * time, sensitivities=["s1_kc"])
    assert struck.method == "Taylor series"


if __name__ == "__main__":
    {"many": many, "memory": memory}[sys.argv[1]]()
