"""The fields of a window: specimen, columns and options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import panel as pn

from foamfit.errors import InputError
from foamfit.options import FREED
from foamfit.page import preview as previews
from foamfit.page.desk import FIRST, QUANTITIES
from foamfit.page.widgets import FIELD, RELAXATIONS, STYLE, Field, grid
from foamfit.springs import laws

# Options shown at once, and options folded away; tick boxes stand for --fix and --vary.
CYCLES = ("cycle", "cycles")  # shown if a record has several
SHOWN = ("model", "drive", "relaxation", *CYCLES)
FOLDED = (
    *FREED,
    *("starts", "max_time", "seed", "interior_mass", "time_shift"),
    *("profile", "mcmc"),
)
# Options that change the curves of a model.
OF_CURVES = ("drive", "relaxation", "interior_mass", "time_shift", *FREED)
WRONG = FIELD + ".bk-input { border: 2px solid #b3261e; background: var(--bad); }"


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
            for channel, units in previews.UNITS.items()
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

    def fill(self, found: tuple[Mapping[str, str], str], *, cycles: bool) -> None:
        """Fill in the content of a TOML; with `cycles` the choice of cycles is cleared."""
        self._filling = True  # one check is enough
        quantities, self.rest.value = found
        for name, field in self.quantities.items():
            field.value = quantities.get(name, "")
        for field in self.cycles if cycles else ():
            field.value = ""
        self._filling = False

    def mark(self, wrong: str) -> None:
        """Mark the field of one quantity as wrong, and no other."""
        for name, field in self.quantities.items():
            field.stylesheets = [WRONG if name == wrong else FIELD]

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

    def add_column(self, channel: str, entry: Mapping[str, Any]) -> None:
        """Enter an entry of [columns] into the further TOML."""
        try:
            self.rest.value = previews.with_column(self.rest.value or "", channel, entry)
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
