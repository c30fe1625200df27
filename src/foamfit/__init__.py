"""foamfit: identify the parameters of hysteretic bistable springs from impact tests on foams.

Names are loaded when they are first used, so that the command starts fast.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "BistableSpring": "spring",
    "LinearSpring": "spring",
    "Chain": "chain",
    "Impact": "chain",
    "StressDrive": "chain",
    "DisplacementDrive": "chain",
    "InputError": "errors",
    "SimulationError": "errors",
    "Response": "simulation",
    "simulate": "simulation",
    "published": "literature",
    "Measurement": "measurement",
    "read_test": "reading",
    "FitResult": "result",
    "fit": "identification",
    "make_params": "problem",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("foamfit")
    if name not in _HOME:
        raise AttributeError(f"module 'foamfit' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"foamfit.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
