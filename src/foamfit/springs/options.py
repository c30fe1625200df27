"""Options of a fit that free more parameters of some springs."""

from __future__ import annotations

from typing import NamedTuple


class Freed(NamedTuple):
    """The parameters that an option frees, and what it does, in a sentence."""

    names: tuple[str, ...]
    told: str


OPTIONS = {
    "stiffening": Freed(
        ("stiffening",), "Let branch a of microscale springs stiffen as the test says."
    ),
    "mullins": Freed(
        ("softening", "weakening"),
        "Let what has snapped once soften and weaken (microscale springs).",
    ),
}
