"""Inputs of the page: widgets, pieces of HTML, and the fields of a window.

Panel's sliders have no names for screen readers, so here they are plain HTML inputs with labels
(`templates/sliders.js`). A field is an option of `foamfit fit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import panel as pn
import param
from panel.custom import JSComponent

from foamfit.errors import InputError, SimulationError
from foamfit.options import FREED, OPTIONS
from foamfit.page.desk import FIRST, QUANTITIES, UNITS, Fields, with_column
from foamfit.report.render import environment
from foamfit.springs import laws

TEMPLATES = Path(__file__).with_name("templates")
WIDE: dict[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
RELAXATIONS = 4  # choices for the number of terms: 0 to 3


def style(name: str) -> str:
    """Return a style sheet of the page."""
    return (TEMPLATES / f"{name}.css").read_text(encoding="utf-8")


def piece(name: str, *given: Any) -> str:
    """Return a piece of `templates/pieces.html`, with all texts escaped."""
    return str(getattr(environment().get_template("pieces.html").module, name)(*given))


STYLE: dict[str, Any] = {**WIDE, "stylesheets": [style("field")], "margin": (3, 0)}


def text() -> Any:
    """Return an empty pane for text, which must be escaped before it is put there."""
    return pn.pane.HTML("", stylesheets=[style("text")], sizing_mode="stretch_width", margin=(4, 0))


def soft(text: str) -> str:
    """Return a text as a paragraph in a muted colour."""
    return piece("paragraph", text, "soft")


def wrong(error: object) -> str:
    """Return an error as a paragraph, "" for none; unexpected errors are called defects."""
    text = str(error)
    if not isinstance(error, str | InputError | SimulationError | OSError):
        text = f"This is a defect of foamfit, please report it ({type(error).__name__}: {error})."
    return piece("paragraph", text, "error") if text else ""


def button(name: str, do: Callable[[Any], None], kind: str = "default", **more: Any) -> Any:
    """Return a button that calls a function."""
    made = pn.widgets.Button(name=name, button_type=kind, **STYLE, **more)
    made.on_click(do)
    return made


def grid(parts: list[Any], width: float, *, visible: bool = False) -> pn.Column:
    """Arrange parts side by side, each at least `width` rem wide."""
    style = (
        ":host { display: grid; gap: .4rem; "
        f"grid-template-columns: repeat(auto-fit, minmax(min(100%, {width}rem), 1fr)); }} "
        ".scroll-button { display: none; }"  # it would take the place of a part
    )
    # The outer column is hidden, because a grid itself would stay visible.
    return pn.Column(pn.Column(*parts, stylesheets=[style], **WIDE), visible=visible, **WIDE)


class Sliders(JSComponent):
    """A slider and a number for each parameter; messages name those moved or ticked."""

    rows = param.List()
    ticks = param.Boolean(doc="Whether each has a tick box that fixes it in a fit.")
    waiting = param.Boolean(doc="Whether they are about to be replaced and cannot be moved.")
    told = param.String(doc="A sentence above the sliders.")
    wrong = param.Boolean(doc="Whether that sentence is an error.")

    _esm = TEMPLATES / "sliders.js"
    _stylesheets: ClassVar[list[str]] = [style("inputs"), style("sliders")]

    def show(self, values: Mapping[str, float]) -> None:
        """Move the sliders (values in the units of their rows) without drawing."""
        self._send_msg({"values": dict(values)})

    def drawn(self) -> None:
        """Report that the last move has been drawn, so that the next can be sent."""
        self._send_msg({"drawn": True})


class Field:
    """An input for one option of the command, with its name, default and help."""

    def __init__(self, name: str, listed: list[Any] | None = None, **style: Any) -> None:
        option = OPTIONS[name]
        self.flag, self.default = option.flag, option.default
        like = option.unit or option.metavar
        words = name.replace("_", " ").capitalize()
        self.label = f"{words}{f' ({like})' if like else ''}: {option.text}"
        made: dict[str, Any] = {"name": self.label, **style}
        value = "" if self.default is None else self.default
        if (listed := [*option.choices] or listed) is not None:
            unset = {"default": ""} if self.default is None else {}
            options = unset | {str(one): one for one in listed}
            self.widget = pn.widgets.Select(options=options, value=value, **made)
        elif option.kind == "bool":
            # A group with one box: screen readers do not read the label of Panel's single checkbox.
            self.widget = pn.widgets.CheckBoxGroup(options=[self.label], **style)
        else:
            self.widget = pn.widgets.TextInput(value=str(value), **made)

    def arguments(self) -> list[str]:
        """Return the arguments for the value filled in; none for the default."""
        if isinstance(value := self.widget.value, list):
            return [self.flag] if value else []
        text = "" if value is None else str(value).strip()
        return [] if text in ("", str(self.default)) else [self.flag, text]


# Options shown at once, and options folded away; tick boxes stand for --fix and --vary.
CYCLES = ("cycle", "cycles")  # shown if a record has several
SHOWN = ("model", "drive", "relaxation", *CYCLES)
APART = (*SHOWN, "specimen", "fix", "vary")
FOLDED = [name for name, one in OPTIONS.items() if not one.python_only and name not in APART]
# Options that change the curves of a model.
OF_CURVES = ("drive", "relaxation", "interior_mass", "time_shift", *FREED)


class Inputs:
    """The fields; `tested` is called if one changes the test, `modelled` if it changes curves."""

    def __init__(
        self, tested: Callable[[], None], modelled: Callable[[], None], wrong: Callable[..., None]
    ) -> None:
        self._filling = False
        self._tested, self._modelled, self._wrong = tested, modelled, wrong
        text, select = (partial(getattr(pn.widgets, n), **STYLE) for n in ("TextInput", "Select"))
        self.quantities = {
            name: text(name=label, placeholder=f"like {example}")
            for name, (label, example) in QUANTITIES.items()
        }
        self.rest = pn.widgets.TextAreaInput(
            name="Further TOML: name, [columns], [noise], [window]",
            placeholder='[columns]\nforce = { column = "Load", unit = "kN" }',
            rows=4,
            max_length=20_000,
            **STYLE,
        )
        self.pickers = {
            channel: (
                select(name=f"Column of the {channel}", options=[""]),
                select(name=f"Unit of the {channel}", options=["", *filter(None, units)]),
            )
            for channel, units in UNITS.items()
        }
        lists = {"model": models(), "relaxation": [*range(RELAXATIONS)]}
        self.options = {name: Field(name, lists.get(name), **STYLE) for name in (*SHOWN, *FOLDED)}
        self.model, _, self.relaxation, *self.cycles = (self.options[n].widget for n in SHOWN)
        self.show_cycles(1)
        self.of_test = (*self.quantities.values(), self.rest, *self.cycles)
        for field in self.of_test:
            field.param.watch(lambda _: self._changed(), "value")
        for name in ("model", *OF_CURVES):
            self.options[name].widget.param.watch(lambda _: self._modelled(), "value")
        for channel, pair in self.pickers.items():
            for field in pair:
                field.param.watch(partial(self._picked, channel), "value")

    @property
    def parts(self) -> dict[str, list[Any]]:
        """The widgets by the place of the template."""
        fields = [*self.quantities.values()]
        return {
            "test": [grid(fields[:FIRST], 8.0, visible=True)],
            "specimen": [*fields[FIRST:], self.rest],
            "columns": [grid([*pair], 8.0, visible=True) for pair in self.pickers.values()],
            "model": [self.options[name].widget for name in SHOWN],
            "more": [self.options[name].widget for name in FOLDED],
        }

    @property
    def auto(self) -> bool:
        """Whether models are to be compared."""
        return bool(self.model.value == "auto")

    def given(self) -> tuple[dict[str, str], str, list[str]]:
        """Return the quantities, the further TOML and the arguments that choose cycles."""
        quantities = {name: field.value or "" for name, field in self.quantities.items()}
        which = [argument for name in CYCLES for argument in self.options[name].arguments()]
        return quantities, self.rest.value or "", which

    def arguments(self) -> list[str]:
        """Return the arguments of `foamfit fit` for the options filled in."""
        hidden = {"relaxation": self.auto} | dict.fromkeys(CYCLES, not self.cycles[0].visible)
        shown = (field for name, field in self.options.items() if not hidden.get(name))
        return [argument for field in shown for argument in field.arguments()]

    def fill(self, found: Fields, *, cycles: bool) -> None:
        """Fill in the content of a TOML; with `cycles` the choice of cycles is cleared."""
        self._filling = True  # one check is enough
        quantities, self.rest.value = found
        for name, field in self.quantities.items():
            field.value = quantities.get(name, "")
        for field in self.cycles if cycles else ():
            field.value = ""
        self._filling = False

    def show_cycles(self, count: int) -> None:
        """Show the fields that choose cycles if a record has several."""
        for field in self.cycles:
            field.visible = count > 1
        self.cycles[0].name = f"{self.options['cycle'].label} This record has {count}."

    def hold(self, disabled: bool) -> None:
        """Disable the fields of the test during a fit."""
        for field in self.of_test:
            field.disabled = disabled

    def offer(self, headers: tuple[str, ...]) -> None:
        """List the headers of a file as choices of columns."""
        self._filling = True
        for column, _ in self.pickers.values():
            if column.options != ["", *headers]:
                column.param.update(options=["", *headers], value="")
        self._filling = False

    def add_column(self, channel: str, entry: Mapping[str, Any], event: Any = None) -> None:
        """Enter an entry of [columns] into the further TOML."""
        try:
            self.rest.value = with_column(self.rest.value or "", channel, entry)
        except InputError as error:
            self._wrong(error)

    def _picked(self, channel: str, event: Any) -> None:
        """Enter the column and unit that were chosen from the lists."""
        if self._filling:
            return
        column, unit = (field.value for field in self.pickers[channel])
        entry = {"column": column} | ({"unit": unit} if unit else {})
        self.add_column(channel, entry if column else {})

    def _changed(self) -> None:
        if not self._filling:
            self._tested()


def models() -> list[str]:
    """Return the models in the list: each law alone, on a linear spring, and twice."""
    alone = [kind for kind in laws.kinds() if laws.law(kind).hysteretic]
    return ["auto", *alone, *(f"linear+{one}" for one in alone), *(f"{one}+{one}" for one in alone)]
