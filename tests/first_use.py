"""Compile loops that many tests need but a first fit does not: `python first_use.py along`.

conftest.py runs this script in parallel processes, before or during the tests.
"""

import gc
import sys
from pathlib import Path

import numpy as np

import foamfit as ff

TIME = np.linspace(0.0, 1.0, 50)


def microscale(*relaxation: tuple[float, float]) -> ff.Chain:
    """Return a chain of one microscale spring."""
    spring = ff.MicroscaleSpring(5.5e5, 2.5e5, 0.08, 1.3e5, 0.4, 5.5e4, 0.77, relaxation=relaxation)
    return ff.Chain([spring], [1e-2], 1e-4)


def along() -> None:
    """Compile a microscale spring, with and without relaxation, under displacement and stress."""
    moved = ff.DisplacementDrive(3e-3 * np.sin(np.pi * TIME))
    pressed = ff.StressDrive(1e5 * np.sin(np.pi * TIME))
    for chain, drive in (
        (microscale(), moved), (microscale(), pressed), (microscale((0.5, 0.2)), moved),
    ):  # fmt: skip
        ff.simulate(chain, drive, TIME, sensitivities=["s1_kc"])


def judge() -> None:
    """Compile the brute-force reference of the stability study."""
    sys.path.append(str(Path(__file__).parents[1] / "experiments" / "stability"))
    from independent import follow

    follow(microscale(), ff.Impact(7e-3, 2.0), 1e-3 * TIME, 1e-6)


if __name__ == "__main__":
    gc.disable()  # compiled objects live until exit
    {"along": along, "judge": judge}[sys.argv[1]]()
