"""Units: text becomes numbers in SI here and nowhere else."""

from __future__ import annotations

import functools
import re
from typing import Any

from foamfit.errors import InputError

# Usual units, for headers in capitals: "MM" is millimetre as a displacement, "MPA" megapascal.
_USUAL = ["s", "ms", "us", "m", "cm", "mm", "um", "N", "kN", "mN", "Pa", "kPa", "MPa", "GPa"]
_USUAL += ["m/s", "mm/s", "m/s^2", "V", "mV"]
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*)")


@functools.cache
def _registry() -> Any:
    import pint

    make = functools.partial(pint.UnitRegistry, autoconvert_offset_to_baseunit=True)
    try:  # parsing pint's definitions takes longer than most fits: it keeps them in a cache
        registry: Any = make(cache_folder=":auto:")
    except OSError:
        registry = make()
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
    except Exception:  # pint and the tokenizer beneath it have a dozen ways of saying no
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
    parts = split_quantity(value) if isinstance(value, str) else None
    if parts is None:
        raise InputError(f'{where} = {value!r} is no quantity; give it like "{example}".')
    number, unit = parts
    if re.match(r"[_',]\d", unit):
        raise InputError(
            f'{where} = "{value}" must be written with a decimal point and without separators, '
            f'like "{example}".'
        )
    one = _unit(unit)
    if one is None:
        raise InputError(f'{where} = "{value}" has an unknown unit; give it like "{example}".')
    if not one.check(_unit(si).dimensionality):
        raise InputError(f'{where} = "{value}" is of another kind; give it like "{example}".')
    return number * float(one.to(si).magnitude)
