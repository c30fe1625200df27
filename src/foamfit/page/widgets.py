"""Two inputs that Panel lacks, dropped files and rows of sliders, and pieces of HTML.

Both are plain inputs of the browser, with labels and keys; `templates` has their scripts.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import param
from jinja2 import Environment, FileSystemLoader
from panel.custom import JSComponent

TEMPLATES = Path(__file__).with_name("templates")


def style(name: str) -> str:
    """Return a style sheet of the page."""
    return (TEMPLATES / f"{name}.css").read_text(encoding="utf-8")


_PIECES = Environment(loader=FileSystemLoader(TEMPLATES), autoescape=True).get_template(
    "pieces.html"
)


def piece(name: str, *given: Any) -> str:
    """Return a piece of `templates/pieces.html`; all texts in it are escaped."""
    return str(getattr(_PIECES.module, name)(*given))


class Upload(JSComponent):
    """A place to drop files on; the server's answer to each is shown below."""

    address = param.String()
    limit = param.Integer()

    _esm = TEMPLATES / "upload.js"
    _stylesheets: ClassVar[list[str]] = [style("inputs"), style("upload")]


class Sliders(JSComponent):
    """A slider and a number for each parameter; messages name those moved or ticked."""

    rows = param.List()
    ticks = param.Boolean(doc="Whether each has a tick for a fit to hold it.")
    told = param.String()
    wrong = param.Boolean()

    _esm = TEMPLATES / "sliders.js"
    _stylesheets: ClassVar[list[str]] = [style("inputs"), style("sliders")]

    def show(self, values: Mapping[str, float]) -> None:
        """Move the sliders (in the units of their rows) without drawing."""
        self._send_msg({"values": dict(values)})

    def tell(self, sentence: str, wrong: bool = False) -> None:
        """Write a sentence above the sliders."""
        self.param.update(told=sentence, wrong=wrong)

    def drawn(self) -> None:
        """Say that the last move is drawn; the next may come."""
        self._send_msg({"drawn": True})


def message(event: Any) -> dict[str, Any]:
    """Return what a browser sent, which may be anything, as a dictionary."""
    return event.data if isinstance(event.data, dict) else {}
