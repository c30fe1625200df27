"""Inputs of the page, and pieces of HTML.

Panel's sliders have no names for screen readers, so here they are plain HTML inputs with labels
(`templates/sliders.js`). A field is an option of `foamfit fit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import panel as pn
import param
from panel.custom import JSComponent

from foamfit.errors import InputError, SimulationError
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


FIELD = style("field")
STYLE: dict[str, Any] = {"stylesheets": [FIELD], "sizing_mode": "stretch_width", "margin": (3, 0)}


def text() -> Any:
    """Return an empty pane for text, which must be escaped before it is put there."""
    return pn.pane.HTML("", stylesheets=[style("text")], sizing_mode="stretch_width", margin=(4, 0))


def soft(text: str) -> str:
    """Return a text as a paragraph in a muted colour."""
    return piece("paragraph", text, "soft")


def wrong(error: object) -> str:
    """Return an error as a paragraph, "" for none; unexpected errors are called defects."""
    text = str(error)
    if isinstance(error, Exception) and not isinstance(
        error, InputError | SimulationError | OSError
    ):
        text = f"This is a defect of foamfit, please report it ({type(error).__name__}: {error})."
    return piece("paragraph", text, "error") if text else ""


def button(name: str, do: Callable[[Any], None], kind: str = "default", **more: Any) -> Any:
    """Return a button that calls a function."""
    made = pn.widgets.Button(name=name, button_type=kind, **STYLE, **more)
    made.on_click(do)
    return made


def grid(parts: list[Any], width: float, *, visible: bool = False) -> pn.Column:
    """Arrange parts side by side, each at least `width` rem wide.

    The outer column is hidden, because a grid itself would stay visible.
    """
    style = (
        ":host { display: grid; gap: .4rem; "
        f"grid-template-columns: repeat(auto-fit, minmax(min(100%, {width}rem), 1fr)); }} "
        ".scroll-button { display: none; }"  # it would take the place of a part
    )
    return pn.Column(pn.Column(*parts, stylesheets=[style], **WIDE), visible=visible, **WIDE)


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
