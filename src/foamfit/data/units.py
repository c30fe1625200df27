"""Parse quantities and units and convert them to SI; no other module does this."""

from __future__ import annotations

import functools
import re
from typing import Any

from foamfit.errors import InputError

# Usual spellings of units that headers may write in capitals: "MM", "MPA".
_USUAL = ["s", "ms", "us", "m", "cm", "mm", "um", "N", "kN", "mN", "Pa", "kPa", "MPa", "GPa"]
_USUAL += ["m/s", "mm/s", "m/s^2", "V", "mV"]
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
# Largest and, inverted, smallest magnitude of a quantity in SI; its square is still finite.
LARGEST = 1e30
_PLUS_MINUS = re.compile(r"±|\+/[-−]")


@functools.cache
def _registry() -> Any:
    import pint

    registry: Any
    try:  # parsing the definitions takes longer than most fits, so pint caches them on disk
        registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=":auto:")
    except OSError:
        registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("microstrain = 1e-6 = ustrain")
    registry.define("px = pixel")  # of a camera; pint's is 1/96 inch
    return registry


@functools.cache
def _unit(text: str) -> Any:
    """Return the unit as a pint quantity of magnitude 1, or None if pint does not know it."""
    text = text.strip().replace("·", "*").replace("^", "**")
    # "seed 2014", "x10 N", "1e3 N", "9**9**9", and a µm that lost its µ, which pint would read as m
    if re.search(r"\d\d|\d\W+\d|\de[+-]?\d|[?¿\ufffd]", text):
        return None
    text = re.sub(r"(?<=[A-Za-z])(-?\d)", r"**\1", text)  # m/s2
    if text in {"-", "–", "1"}:
        text = ""
    registry = _registry()
    try:
        return registry.Quantity(1.0, registry.parse_units(text))
    except Exception:  # pint and its tokenizer raise many different exceptions
        return None


def _spellings(text: str) -> list[str]:
    usual = [unit for unit in _USUAL if unit.casefold() == text.strip().casefold()]
    inches = ["thou"] if text.strip().casefold() in ("mil", "mils") else []  # pint's are angles
    return [text, *usual, text.lower(), *inches]


def is_unit(text: str, *, any_case: bool = False) -> bool:
    """Return whether a text is a unit; with `any_case` also in unusual capitals."""
    return any(_unit(t) is not None for t in (_spellings(text) if any_case else [text]))


def factor(unit: str, si: str, *, times: str = "") -> float | None:
    """Return the conversion factor from `unit` · `times` to `si`, "" if dimensionless.

    Case is ignored: the first spelling of the right dimension is used. None if the unit is unknown
    or has another dimension.
    """
    for spelling in _spellings(unit):
        known = _unit(spelling)
        if known is not None and (known * _unit(times)).check(_unit(si).dimensionality):
            return float((known * _unit(times)).to(si or "dimensionless").magnitude)
    return None


def split_quantity(text: str) -> tuple[float, str] | None:
    """Split "4444.4 N/V" into number and unit; None if the text does not start with a number."""
    match = _QUANTITY.fullmatch(text)
    return (float(match[1]), match[2]) if match else None


def parse_quantity(value: object, si: str, where: str, example: str) -> float:
    """Convert a quantity such as "1.19 mm" to `si`; `where` and `example` are for messages."""
    number, sigma = parse_uncertain(value, si, where, example)
    if sigma is not None:
        wrong = f'{where} = "{value}" has a ±, which has no meaning here'
        raise InputError(f'{wrong}; give it like "{example}".')
    return number


def parse_uncertain(
    value: object, si: str, where: str, example: str, *, zero: bool = False
) -> tuple[float, float | None]:
    """Convert a quantity and its standard deviation (None without one) to the unit `si`.

    Examples: "1.75 ± 0.01 m/s", "1.19 mm +/- 5 um", "5 mm ± 1 %" (of the value). The standard
    deviation must be less than the value, unless `zero` is a valid value. A quantity without a
    unit may also be a number.
    """
    value = repr(value) if type(value) in (int, float) and not si else value
    text, spread = split_uncertain(value)
    number = _in_si(text, si)
    if isinstance(number, str):
        shown = f'"{value}"' if split_quantity(text) else repr(value)
        raise InputError(f'{where} = {shown} {number}; give it like "{example}".')
    if not spread:
        return number, None
    amount, unit = split_quantity(spread) or (0.0, "")
    share = unit == "%"
    sigma = abs(number) * amount / 100.0 if share else _in_si(spread, si)
    if isinstance(sigma, str):
        wrong = sigma
    elif sigma < 0.0:
        wrong = "must not be negative"
    elif sigma >= abs(number) and (share or not zero):
        wrong = "must be less than the value"
    else:
        return number, sigma
    right = example if "±" in example else f"{example} ± 1 %"
    raise InputError(f'{where} = "{value}": the ± {wrong}; give it like "{right}".')


def split_uncertain(value: object) -> tuple[str, str]:
    """Split "1.75 ± 0.01 m/s" into "1.75 m/s" and "0.01 m/s", or "" without a ±."""
    if not isinstance(value, str):
        return "", ""
    inside = re.sub(r"^\s*\((.*)\)", r"\1", value)  # (1.75 ± 0.01) m/s
    nominal, *more = _PLUS_MINUS.split(inside, maxsplit=1)
    if not more:
        return value, ""
    value_parts, spread_parts = split_quantity(nominal), split_quantity(more[0])
    if value_parts and spread_parts and not value_parts[1].strip() and spread_parts[1] != "%":
        nominal = f"{nominal} {spread_parts[1]}"  # one unit for both
    return nominal.strip(), more[0].strip() or "nothing"


def _in_si(text: str, si: str) -> float | str:
    """Return a quantity in the unit `si`, or the reason why it is invalid."""
    parts = split_quantity(text)
    if parts is None:
        return "is not a quantity"
    number, unit = parts
    if re.match(r"[_',]\d", unit):
        return "must be written with a decimal point and without separators"
    known = _unit(unit)
    if known is None:
        return "has an unknown unit"
    if not known.check(_unit(si).dimensionality):
        return "has the wrong dimension"
    in_si = number * float(known.to(si or "dimensionless").magnitude)
    if in_si and not 1.0 / LARGEST < abs(in_si) < LARGEST:
        return f"must be between {1.0 / LARGEST:g} and {LARGEST:g} in SI"
    return in_si
