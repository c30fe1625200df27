"""foamfit: identify the parameters of hysteretic bistable springs from impact tests on foams.

Each name is imported when it is first used, so that the command starts quickly.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "BistableSpring": "springs.laws",
    "LinearSpring": "springs.laws",
    "MicroscaleSpring": "springs.laws",
    "Law": "springs.laws",
    "Functions": "springs.laws",
    "Param": "springs.laws",
    "register": "springs.laws",
    "Chain": "springs.chain",
    "Impact": "springs.chain",
    "StressDrive": "springs.chain",
    "DisplacementDrive": "springs.chain",
    "InputError": "errors",
    "SimulationError": "errors",
    "Response": "solve.simulation",
    "simulate": "solve.simulation",
    "published": "springs.published",
    "Measurement": "data.measurement",
    "read_test": "data.csv_file",
    "CycleFits": "report.studies.cycles",
    "fit_cycles": "study.cycles",
    "batch": "study.batch",
    "Prediction": "report.studies.prediction",
    "predict": "study.predict",
    "Plan": "report.studies.plan",
    "plan": "study.plan",
    "JointResult": "study.joint_result",
    "joint": "study.joint",
    "Card": "cards.card",
    "card": "cards.card",
    "FitResult": "api",
    "fit": "api",
    "load": "saved",
    "SavedJoint": "saved",
    "make_params": "fitting.problem",
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
