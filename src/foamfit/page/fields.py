"""The options of `foamfit fit` as fields of the page: its names, lists, defaults and help."""

from __future__ import annotations

from typing import Any

import click
import panel as pn

from foamfit.cli.fit import fit as fit_command

RELAXATIONS = 4  # numbers of terms that are listed
OPTIONS = {
    one.name: one for one in fit_command.params if isinstance(one, click.Option) and one.name
}


class Field:
    """One option of the command: a field with its name, default and help."""

    def __init__(self, name: str, listed: list[Any] | None = None, **style: Any) -> None:
        option = OPTIONS[name]
        self.flag = option.opts[-1]
        self.default = option.default if isinstance(option.default, str | int) else None
        unit = f" ({(option.metavar or '').replace('SECONDS', 'seconds')})"
        self.label = (
            f"{name.replace('_', ' ').capitalize()}{unit.replace(' ()', '')}: {option.help}"
        )
        made: dict[str, Any] = {"name": self.label, **style}
        if isinstance(option.type, click.Choice):
            listed = [*option.type.choices]
        if listed is not None:
            some = {str(one): one for one in listed}
            made["options"] = {"default": ""} | some if self.default is None else some
            made["value"] = "" if self.default is None else self.default
            self.widget = pn.widgets.Select(**made)
        elif option.is_flag:
            # A group of one: screen readers do not read the label of Panel's single checkbox.
            self.widget = pn.widgets.CheckBoxGroup(options=[self.label], **style)
        else:
            shown = "" if self.default is None else str(self.default)
            self.widget = pn.widgets.TextInput(value=shown, **made)

    def arguments(self) -> list[str]:
        """Return the arguments for what is filled in; none for the default."""
        value = self.widget.value
        if isinstance(value, list):
            return [self.flag] if value else []
        text = "" if value is None else str(value).strip()
        return [] if text in ("", str(self.default)) else [self.flag, text]
