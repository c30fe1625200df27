"""The sentences of `sentences.toml`, which say how sure a fit is."""

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
