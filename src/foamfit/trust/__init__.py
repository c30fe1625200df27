"""How certain the parameters are, and which of them the test determines.

`best_point` holds what was computed at the best point, `covariance` and `intervals` give numbers,
`checklist` asks what a good fit must pass, `conclude` gives each parameter its state; `residuals`
tells noise from an error of the law, `ranges` what the latter leaves open, and `sentences.toml` has
the words for all of it. A newcomer may skip `profile`, `resample` and `evidence`.
"""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any

SENTENCES: dict[str, Any] = tomllib.loads(
    files(__package__).joinpath("sentences.toml").read_text(encoding="utf-8")
)


def say(section: str, key: str, **facts: object) -> str:
    """Fill the facts into a sentence of a section, such as "why" or "check.noise"."""
    table = SENTENCES
    for part in section.split("."):
        table = table[part]
    return str(table[key]).format(**facts)
