"""Templates of HTML pages and of what the terminal prints."""

from __future__ import annotations

import base64
import functools
import math
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from foamfit import text
from foamfit.report.readable import in_unit

if TYPE_CHECKING:
    from jinja2 import Environment


@functools.cache
def environment() -> Environment:
    """Return the templates of all pages, texts and cards, with the filters that write numbers."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape

    made = Environment(
        loader=ChoiceLoader([PackageLoader(f"foamfit.{of}") for of in ("report", "cards", "page")]),
        extensions=["jinja2.ext.do"],
        autoescape=select_autoescape(("html",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("percent", "engineering", "significant", "signed", "number", "field"):
        made.filters[name] = getattr(text, name)
    made.filters.update(counted=text.counted, listed=text.listed, in_unit=in_unit, exp=math.exp)
    made.filters.update(paragraphs=_paragraphs, aligned=_aligned)
    made.filters["png"] = lambda png: "data:image/png;base64," + base64.b64encode(png).decode()
    made.filters["spoken"] = lambda name: name.replace("_", "-")
    made.globals["version"] = version("foamfit")
    return made


def page(name: str, **values: Any) -> str:
    """Return a page in HTML."""
    return environment().get_template(f"{name}.html").render(**values)


def words(name: str, **values: Any) -> str:
    """Return a text for the terminal, without a newline at its end."""
    return environment().get_template(f"{name}.txt").render(**values).rstrip("\n")


def sentences(name: str, **values: Any) -> tuple[str, ...]:
    """Return the lines of a text, a sentence each."""
    return tuple(words(name, **values).splitlines())


def table(name: str, **values: Any) -> list[list[str]]:
    """Return the cells of a table whose rows are the lines of a text, separated by "¦"."""
    return [line.split("¦") for line in words(name, **values).splitlines()]


def _paragraphs(told: str, indent: int = 2) -> str:
    """Wrap each line of a text as a paragraph of its own; empty lines stay."""
    lines = (text.wrapped(one, indent) or [""] for one in told.split("\n"))
    return "\n".join(line for paragraph in lines for line in paragraph)


def _aligned(rows: Any, **options: Any) -> str:
    return "\n".join(text.aligned(list(rows), **options))
