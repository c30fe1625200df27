"""Units: text becomes numbers in SI here and nowhere else."""

from __future__ import annotations

import functools
import re
from typing import Any

from foamfit.errors import InputError

# For headers in capitals: "MM" is a millimetre as a displacement, "MPA" a megapascal.
_USUAL = ["s", "ms", "us", "m", "cm", "mm", "um", "N", "kN", "mN", "Pa", "kPa", "MPa", "GPa"]
_USUAL += ["m/s", "mm/s", "m/s^2", "V", "mV"]
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
# No quantity of a test is larger in SI, or smaller than the inverse; the square is still finite.
LARGEST = 1e30
_PLUS_MINUS = re.compile(r"±|\+/[-−]")


@functools.cache
def _registry() -> Any:
    import pint

    registry: Any
    try:  # parsing pint's definitions takes longer than most fits: it keeps them in a cache
        registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=":auto:")
    except OSError:
        registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("microstrain = 1e-6 = ustrain")
    return registry


@functools.cache
def _unit(text: str) -> Any:
    """One of the unit as a pint quantity, or None where pint does not know it."""
    text = text.strip().replace("·", "*").replace("^", "**")
    text = re.sub(r"(?<=[A-Za-z])(-?\d)", r"**\1", text)  # m/s2
    if text in {"-", "–", "1"}:
        text = ""
    try:
        return _registry().Quantity(1.0, _registry().parse_units(text))
    except Exception:  # pint and its tokenizer raise a dozen kinds of errors
        return None


def _spellings(text: str) -> list[str]:
    usual = [unit for unit in _USUAL if unit.casefold() == text.strip().casefold()]
    return [text, *usual, text.lower()]


def is_unit(text: str, *, any_case: bool = False) -> bool:
    """Tell whether a text is a unit; with `any_case` also if only its capitals are unusual."""
    return any(_unit(t) is not None for t in (_spellings(text) if any_case else [text]))


def factor(unit: str, si: str, *, times: str = "") -> float | None:
    """Return what a number in `unit` · `times` is multiplied by to be in `si`, "" for none.

    The unit may be in whatever case; the first spelling of the right kind counts. None if it is
    unknown or of another kind.
    """
    for spelling in _spellings(unit):
        one = _unit(spelling)
        if one is not None and (one * _unit(times)).check(_unit(si).dimensionality):
            return float((one * _unit(times)).to(si or "dimensionless").magnitude)
    return None


def split_quantity(text: str) -> tuple[float, str] | None:
    """Split "4444.4 N/V" into its number and its unit; None where no number stands first."""
    match = _QUANTITY.fullmatch(text)
    return (float(match[1]), match[2]) if match else None


def parse_quantity(value: object, si: str, where: str, example: str) -> float:
    """Read a quantity such as "1.19 mm" in the unit `si`; `where` and `example` are for errors."""
    number, sigma = parse_uncertain(value, si, where, example)
    if sigma is not None:
        wrong = f'{where} = "{value}" has a ±, which has no meaning there'
        raise InputError(f'{wrong}; give it like "{example}".')
    return number


def parse_uncertain(
    value: object, si: str, where: str, example: str, *, zero: bool = False
) -> tuple[float, float | None]:
    """Read a quantity in the unit `si` and its standard deviation, None where it has none.

    It is written like "1.75 ± 0.01 m/s", "1.19 mm +/- 5 um" or "5 mm ± 1 %" (of the value). The
    standard deviation must be less than the value, unless that may be `zero`.
    """
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
    """Split "1.75 ± 0.01 m/s" into "1.75 m/s" and "0.01 m/s"; the second is "" without a ±."""
    if not isinstance(value, str):
        return "", ""
    inside = re.sub(r"^\s*\((.*)\)", r"\1", value)  # (1.75 ± 0.01) m/s
    nominal, *more = _PLUS_MINUS.split(inside, maxsplit=1)
    if not more:
        return value, ""
    one, two = split_quantity(nominal), split_quantity(more[0])
    if one and two and not one[1].strip() and two[1] != "%":  # one unit for both
        nominal = f"{nominal} {two[1]}"
    return nominal.strip(), more[0].strip() or "nothing"


def _in_si(text: str, si: str) -> float | str:
    """Return a quantity in the unit `si`, or what is wrong with it."""
    parts = split_quantity(text)
    if parts is None:
        return "is no quantity"
    number, unit = parts
    if re.match(r"[_',]\d", unit):
        return "must be written with a decimal point and without separators"
    one = _unit(unit)
    if one is None:
        return "has an unknown unit"
    if not one.check(_unit(si).dimensionality):
        return "is of another kind"
    in_si = number * float(one.to(si or "dimensionless").magnitude)
    if in_si and not 1.0 / LARGEST < abs(in_si) < LARGEST:
        return f"must be between {1.0 / LARGEST:g} and {LARGEST:g} in SI"
    return in_si
