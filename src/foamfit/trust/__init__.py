"""Uncertainty of the parameters, and which of them the test determines.

After the search, `settle` decides which nuisance parameters stay free, and weighs the residuals.
`best_point` contains the curves, residuals and slopes at the best point (`joint_point` that of
several tests); `residuals` separates noise from model error; `covariance` and `intervals` compute
the uncertainty due to noise, `refits` profiles and the ranges due to model error; `checklist` tests
the quality of a fit; `conclude` assembles the result and gives each parameter its state. All
sentences are in `sentences.toml`. A newcomer may skip `refits` and `evidence`.
"""

from __future__ import annotations

import tomllib
from functools import cache, reduce
from importlib.resources import files
from operator import getitem
from typing import TYPE_CHECKING, Any

from foamfit import text

if TYPE_CHECKING:
    from jinja2 import Environment

_TEXT = files(__package__).joinpath("sentences.toml").read_text(encoding="utf-8")
SENTENCES: dict[str, Any] = tomllib.loads(_TEXT)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    every: Any = SENTENCES
    loader = FunctionLoader(lambda place: str(reduce(getitem, place.split("."), every)))
    environment = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    filters = (text.percent, text.engineering, text.listed)
    environment.filters |= {function.__name__: function for function in filters}
    environment.filters |= {"fmt": format, "spoken": lambda name: name.replace("_", "-")}
    return environment


def say(section: str, key: str, **facts: object) -> str:
    """Return a sentence of a section, such as "why" or "check.noise", filled with facts."""
    return _environment().get_template(f"{section}.{key}").render(facts)
