"""Inputs of the page, and pieces of HTML.

Panel has no inputs for dropped files and rows of sliders; here they are plain HTML inputs with
labels and keyboard control (scripts in `templates`). A field is an option of `foamfit fit`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import panel as pn
import param
from panel.custom import JSComponent

from foamfit.options import OPTIONS
from foamfit.report.render import environment

TEMPLATES = Path(__file__).with_name("templates")
WIDE: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
RELAXATIONS = 4  # choices for the number of terms: 0 to 3


def style(name: str) -> str:
    """Return a style sheet of the page."""
    return (TEMPLATES / f"{name}.css").read_text(encoding="utf-8")


def piece(name: str, *given: Any) -> str:
    """Return a piece of `templates/pieces.html`, with all texts escaped."""
    return str(getattr(environment().get_template("pieces.html").module, name)(*given))


class Upload(JSComponent):
    """An area to drop files on; the answer of the server is shown below."""

    address = param.String()
    limit = param.Integer()

    _esm = TEMPLATES / "upload.js"
    _stylesheets: ClassVar[list[str]] = [style("inputs"), style("upload")]


class Sliders(JSComponent):
    """A slider and a number for each parameter; messages name those moved or ticked."""

    rows = param.List()
    ticks = param.Boolean(doc="Whether each has a tick box that fixes it in a fit.")
    told = param.String()
    wrong = param.Boolean()

    _esm = TEMPLATES / "sliders.js"
    _stylesheets: ClassVar[list[str]] = [style("inputs"), style("sliders")]

    def show(self, values: Mapping[str, float]) -> None:
        """Move the sliders (values in the units of their rows) without drawing."""
        self._send_msg({"values": dict(values)})

    def tell(self, sentence: str, wrong: bool = False) -> None:
        """Write a sentence above the sliders."""
        self.param.update(told=sentence, wrong=wrong)

    def drawn(self) -> None:
        """Report that the last move has been drawn, so that the next can be sent."""
        self._send_msg({"drawn": True})


def message(event: Any) -> dict[str, Any]:
    """Return the data of a message as a dictionary; a browser may send anything."""
    return event.data if isinstance(event.data, dict) else {}


class Field:
    """An input for one option of the command, with its name, default and help."""

    def __init__(self, name: str, listed: list[Any] | None = None, **style: Any) -> None:
        option = OPTIONS[name]
        self.flag, self.default = option.flag, option.default
        like = option.unit or option.metavar
        words = name.replace("_", " ").capitalize()
        self.label = f"{words}{f' ({like})' if like else ''}: {option.text}"
        made: dict[str, Any] = {"name": self.label, **style}
        listed = [*option.choices] or listed
        if listed is not None:
            some = {str(one): one for one in listed}
            made["options"] = {"default": ""} | some if self.default is None else some
            made["value"] = "" if self.default is None else self.default
            self.widget = pn.widgets.Select(**made)
        elif option.kind == "bool":
            # A group with one box: screen readers do not read the label of Panel's single checkbox.
            self.widget = pn.widgets.CheckBoxGroup(options=[self.label], **style)
        else:
            shown = "" if self.default is None else str(self.default)
            self.widget = pn.widgets.TextInput(value=shown, **made)

    def arguments(self) -> list[str]:
        """Return the arguments for the value filled in; none for the default."""
        value = self.widget.value
        if isinstance(value, list):
            return [self.flag] if value else []
        text = "" if value is None else str(value).strip()
        return [] if text in ("", str(self.default)) else [self.flag, text]
