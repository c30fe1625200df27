"""Templates of pages and of terminal output, and parameters and numbers in readable form."""

from __future__ import annotations

import functools
import json
import math
import sys
from base64 import b64encode
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit import text
from foamfit.parts import ParameterEstimate
from foamfit.springs.parameters import NUISANCE, any_param, family, split_name
from foamfit.text import UNITS, fixed, number, readable_unit, with_error

if TYPE_CHECKING:
    from jinja2 import Environment

APART = 1e3  # ratio of two numbers from which each has a unit of its own, if it has prefixes
NOTHING = 1e-4  # a number below this share of another is zero beside it, if units have no prefix


@functools.cache
def environment() -> Environment:
    """Return the templates of all pages, texts and cards, with filters that format numbers."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
    from jinja2.bccache import Bucket, FileSystemBytecodeCache

    class Compiled(FileSystemBytecodeCache):
        """Keeps compiled templates beside the compiled modules, if that folder can be written."""

        def dump_bytecode(self, bucket: Bucket) -> None:
            if not sys.dont_write_bytecode:
                with suppress(OSError):
                    super().dump_bytecode(bucket)

    made = Environment(
        loader=ChoiceLoader([PackageLoader(f"foamfit.{of}") for of in ("report", "cards", "page")]),
        extensions=["jinja2.ext.do"],
        autoescape=select_autoescape(("html",)),
        bytecode_cache=Compiled(str(Path(__file__).with_name("__pycache__"))),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("percent", "engineering", "significant", "signed", "number", "field", "warning"):
        made.filters[name] = getattr(text, name)
    made.filters.update(counted=text.counted, listed=text.listed, in_unit=in_unit, exp=math.exp)
    made.filters["paragraphs"] = _paragraphs
    made.filters["aligned"] = lambda rows, **more: "\n".join(text.aligned(list(rows), **more))
    made.filters["svg"] = lambda svg: "data:image/svg+xml;base64," + b64encode(svg).decode()
    made.filters["quoted"] = functools.partial(json.dumps, ensure_ascii=False)
    made.filters["filename"] = lambda path: Path(path).name
    made.filters["spoken"] = lambda name: name.replace("_", "-")
    made.globals["version"] = version("foamfit")
    return made


def page(name: str, **values: Any) -> str:
    """Render an HTML page."""
    return environment().get_template(f"{name}.html").render(**values)


def words(name: str, **values: Any) -> str:
    """Render a text for the terminal, without a final newline."""
    return environment().get_template(f"{name}.txt").render(**values).rstrip("\n")


def sentences(name: str, **values: Any) -> tuple[str, ...]:
    """Render a text with one sentence per line and return its lines without the empty ones."""
    return tuple(line for line in words(name, **values).splitlines() if line.strip())


def table(name: str, **values: Any) -> list[list[str]]:
    """Render a text with one row per line and return its cells, which "¦" separates."""
    return [line.split("¦") for line in words(name, **values).splitlines()]


def _paragraphs(content: str, indent: int = 2) -> str:
    """Wrap each line of a text as a separate paragraph; keep empty lines."""
    lines = (text.wrapped(line, indent) or [""] for line in content.split("\n"))
    return "\n".join(line for paragraph in lines for line in paragraph)


@dataclass(frozen=True)
class Readable:
    """A parameter in a suitable unit, with numbers rounded to its uncertainty."""

    name: str
    symbol: tuple[str, str]  # symbol and index
    value: str
    stderr: str
    interval: str
    unit: str
    state: str
    why: str
    method: str = ""
    range: str = ""
    systematic: str = ""

    @property
    def label(self) -> str:
        """The name in reports; for parameters of springs, the name in fit.json."""
        return NUISANCE[self.name].what if self.name in NUISANCE else self.name

    @property
    def with_error(self) -> str:
        """The value with its standard error, if there is one."""
        return f"{self.value} ± {self.stderr}" if self.stderr else self.value

    def with_unit(self, number: str) -> str:
        """Append the unit, if there is one, to a number of this parameter that has none."""
        own = not number or number[-1].isalpha()
        return number if own else f"{number} {self.unit}".removesuffix(" –")

    @property
    def told(self) -> str:
        """Name, value, standard error and unit."""
        return f"{self.label} {self.with_unit(self.with_error)}"

    @property
    def tied(self) -> bool:
        """Whether an expression of other parameters gives the value."""
        return self.state == "fixed" and self.why.startswith("tied by")

    @property
    def matters(self) -> bool:
        """Whether the reason is worth showing: not determined, or a remark after a semicolon."""
        return self.state != "fixed" and (self.state != "determined" or ";" in self.why)


def readable(name: str, p: ParameterEstimate, given: tuple[float, str] | None = None) -> Readable:
    """Return a parameter in readable form, in a given unit (factor and name) or a suitable one."""
    half = abs(p.ci95[1] - p.ci95[0]) / 2.0 if p.ci95 else 0.0
    sizes = [abs(p.value), p.stderr or 0.0, half]  # the value may be far below its error
    factor, unit = given or readable_unit(max(filter(math.isfinite, sizes), default=0.0), p.unit)
    value = p.value / factor
    shown, stderr, interval = number(value), "", ""  # four digits, or two of the standard error
    if math.isfinite(value) and p.stderr is not None and 0 < p.stderr < math.inf:
        shown, stderr, places = with_error(value, p.stderr / factor)
        if p.ci95 is not None:
            interval = " to ".join(fixed(bound / factor, places) for bound in p.ci95)
    span = "" if p.range is None else _span(p.range, p.unit, factor)
    least = NOTHING * max(sizes)  # what is less comes from rounding
    scale = f"{p.systematic / factor:.2g}" if p.systematic and p.systematic > least else ""
    rest = (p.state, p.why, p.ci95_method or "", span, scale)
    return Readable(name, symbol(name), shown, stderr, interval, unit or "–", *rest)


def _span(ends: tuple[float, float], unit: str, factor: float) -> str:
    """Write the ends of a range with two digits, or more in a narrow one.

    Both are in the unit of the `factor`, unless they lie decades apart or far above it.
    """
    least, most = sorted(map(abs, ends))
    width = ends[1] - ends[0]
    digits = 2 + (math.floor(math.log10(most / width)) if 0.0 < 10.0 * width < most else 0)
    if UNITS.get(unit, [])[1:] and (0.0 < APART * least <= most or most >= 10.0 * APART * factor):
        return in_unit(ends, unit, digits)
    seen = (end / factor if abs(end) > NOTHING * most else 0.0 for end in ends)
    return " to ".join(_few(end, digits) for end in seen)


def own_name(name: str, model: str) -> str:
    """Return the name of a parameter, without the spring if there is only one."""
    return name if "+" in model else name.removeprefix("s1_")


def in_unit(values: Sequence[float], unit: str, digits: int = 4) -> str:
    """Format one value, or the ends of an interval, in a suitable unit.

    Ends that lie decades apart have a unit each: "17 kPa to 170 GPa".
    """
    sizes = [abs(value) for value in values if value]
    if UNITS.get(unit, [])[1:] and sizes and max(sizes) >= APART * min(sizes):
        return " to ".join(in_unit([value], unit, digits) for value in values)
    factor, name = readable_unit(max(sizes, default=0.0), unit)
    return f"{' to '.join(_few(value / factor, digits) for value in values)} {name}".rstrip()


def _few(value: float, digits: int) -> str:
    return number(float(f"{value:.{digits}g}"), digits)


def symbol(name: str) -> tuple[str, str]:
    """Return the symbol of a parameter and its index: k and "c,2" for s2_kc."""
    spring, short = split_name(name)
    if name in NUISANCE:
        return NUISANCE[name].symbol
    if spring < 0:
        return ("η", "site") if name == "site_eta" else (name, "")
    stem, index = any_param(short).symbol
    term = short.removeprefix(family(short))  # number of the relaxation term
    return stem, ",".join(filter(None, (index, term, str(spring + 1))))
