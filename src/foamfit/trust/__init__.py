"""How certain the parameters are, and which of them the test determines.

`best_point` holds what was computed at the best point, `covariance` and `intervals` give numbers,
`checklist` asks what a good fit must pass, `conclude` gives each parameter its state; `residuals`
tells noise from an error of the law, `ranges` what the latter leaves open, and `sentences.toml` has
the words for all of it. A newcomer may skip `profile`, `markov_chain` and `evidence`.
"""

from __future__ import annotations

import functools
import tomllib
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from foamfit import text

if TYPE_CHECKING:
    from jinja2 import Environment, Template

SENTENCES: dict[str, Any] = tomllib.loads(
    files(__package__).joinpath("sentences.toml").read_text(encoding="utf-8")
)


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, StrictUndefined

    made = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    filters = (text.percent, text.engineering, text.listed, text.quantity)
    made.filters |= {one.__name__: one for one in filters}
    made.filters |= {"fmt": format, "spoken": lambda name: name.replace("_", "-")}
    return made


@functools.cache
def _template(section: str, key: str) -> Template:
    table = SENTENCES
    for part in section.split("."):
        table = table[part]
    return _environment().from_string(table[key])


def say(section: str, key: str, **facts: object) -> str:
    """Fill the facts into a sentence of a section, such as "why" or "check.noise"."""
    return _template(section, key).render(facts)
