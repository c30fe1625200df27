"""Options of a fit that free further parameters of some springs."""

from __future__ import annotations

from typing import NamedTuple


class Freed(NamedTuple):
    """The parameters that an option frees, and its help text."""

    names: tuple[str, ...]
    told: str


OPTIONS = {
    "stiffening": Freed(("stiffening",), "Fit the stiffening of branch a of microscale springs."),
    "mullins": Freed(
        ("softening", "weakening"),
        "Fit softening and weakening after the first snap of microscale springs.",
    ),
}
