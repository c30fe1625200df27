"""Parameters and numbers in readable form: unit, digits, symbol."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from foamfit.parts import ParameterEstimate
from foamfit.springs.parameters import NUISANCE, any_param, family, split_name
from foamfit.text import number

UNITS = {
    "Pa": ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "kg": ((1.0, "kg"), (1e-3, "g"), (1e-6, "mg")),
    "m/s^2": ((1e3, "km/s²"), (1.0, "m/s²")),
}


def readable_unit(size: float, unit: str) -> tuple[float, str]:
    """Return factor and name of a suitable unit for numbers up to `size`, which is given in `unit`.

    A unit that is not in `UNITS` is kept.
    """
    scales = UNITS.get(unit, ((1.0, unit),))
    return next((scale for scale in scales if abs(size) >= scale[0]), scales[-1])


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
        """Append the unit, if there is one, to a number of this parameter."""
        return f"{number} {self.unit}".removesuffix(" –") if number else ""

    @property
    def tied(self) -> bool:
        """Whether an expression of other parameters gives the value."""
        return self.state == "fixed" and self.why.startswith("tied by")

    @property
    def matters(self) -> bool:
        """Whether the reason is worth showing: not determined, or a remark after a semicolon."""
        return self.state != "fixed" and (self.state != "determined" or ";" in self.why)


def readable(name: str, p: ParameterEstimate, given: tuple[float, str] | None = None) -> Readable:
    """Return a parameter in readable form, in a given unit (factor and name) or a suitable one.

    Numbers are rounded to two digits of the standard error; without one, to four digits.
    """
    size = p.value or p.stderr or 0.0
    if name in NUISANCE:  # the value may be far below the error
        size = max(abs(p.value), p.stderr or 0.0)
    factor, unit = given or readable_unit(size, p.unit)
    value = p.value / factor
    shown, stderr, interval, span = number(value), "", "", ""
    if math.isfinite(value) and p.stderr is not None and 0 < p.stderr < math.inf:
        shown, stderr, places = _rounded(value, p.stderr / factor)
        if p.ci95 is not None:
            interval = " to ".join(_fixed(bound / factor, places) for bound in p.ci95)
    if p.range is not None:  # two digits suffice, of the difference in a narrow range
        size, width = max(map(abs, p.range)), p.range[1] - p.range[0]
        digits = 2 + (math.floor(math.log10(size / width)) if 0.0 < 10.0 * width < size else 0)
        ends = (float(f"{bound / factor + 0.0:.{digits}g}") for bound in p.range)
        span = " to ".join(f"{end:g}".replace("-", "−") for end in ends)
    unit = {"": "–", "1": "–", "-": "–", "Pa s": "Pa·s", "Pa*s": "Pa·s"}.get(unit, unit)
    scale = f"{p.systematic / factor:.2g}" if p.systematic else ""
    rest = (p.state, p.why, p.ci95_method or "", span, scale)
    return Readable(name, symbol(name), shown, stderr, interval, unit, *rest)


def own_name(name: str, model: str) -> str:
    """Return the name of a parameter, without the spring if there is only one."""
    return name if "+" in model else name.removeprefix("s1_")


def in_unit(values: Sequence[float], unit: str) -> str:
    """Format one value, or the ends of an interval, in a suitable unit."""
    if not values:
        return ""
    factor, name = readable_unit(max(map(abs, values)), unit)
    return f"{' to '.join(number(value / factor) for value in values)} {name}".rstrip()


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


def _rounded(value: float, stderr: float) -> tuple[str, str, int]:
    """Return value and standard error to two digits of the error, and the number of decimals."""
    places = 1 - math.floor(math.log10(float(f"{stderr:.1e}")))
    most = 6 - math.floor(math.log10(abs(value))) if value else 6
    if places > most:  # tiny error, as with synthetic data: seven digits are enough
        return _fixed(value, most), f"{stderr:.1e}", most
    return _fixed(value, places), _fixed(stderr, places), places


def _fixed(value: float, places: int) -> str:
    shown = f"{round(value, places):.{max(places, 0)}f}"
    return (shown.lstrip("-") if float(shown) == 0 else shown).replace("-", "−")
