"""Check a TOML file against tables of its keys, and convert its quantities to SI.

A table of keys maps each key to its check: a function of the value and of its place in the file,
for messages. It returns the value to use, or raises InputError.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from foamfit.data.units import parse_quantity, parse_uncertain, split_quantity
from foamfit.errors import InputError
from foamfit.files import read_whole

_LARGEST = 1_000_000  # characters of a TOML
LONGEST = 200  # characters of a name

Check = Callable[[Any, str], Any]


@dataclass(frozen=True)
class Rule:
    """Check of a value without a unit, and description of the valid values for messages."""

    valid: Callable[[Any], bool]
    right: str

    def __call__(self, value: Any, where: str) -> Any:
        """Return the value if it is valid."""
        if not self.valid(value):
            shown = repr(value) if len(repr(value)) <= LONGEST else f"{repr(value)[:LONGEST]} …"
            raise InputError(f"{where} = {shown} must be {self.right}.")
        return value


@dataclass(frozen=True)
class Quantity:
    """Check of a quantity: its SI unit, and an example."""

    si: str
    example: str
    positive: bool = True

    def __call__(self, value: Any, where: str) -> Any:
        """Return the quantity in SI."""
        return self._within(value, where, parse_quantity(value, self.si, where, self.example))

    def _within(self, value: Any, where: str, *numbers: float) -> float:
        """Return the first number; InputError if the numbers must be positive and are not."""
        if self.positive and min(numbers) <= 0.0:
            raise InputError(f'{where} = "{value}" must be positive, like "{self.example}".')
        return numbers[0]


class Stated(NamedTuple):
    """A quantity in SI and its standard deviation, None if the file does not state it."""

    value: float
    sigma: float | None


class Uncertain(Quantity):
    """Check of a quantity that may have a standard deviation; its SI unit, and an example."""

    def __call__(self, value: Any, where: str) -> Stated:
        """Return quantity and standard deviation in SI."""
        zero = not self.positive
        stated = Stated(*parse_uncertain(value, self.si, where, self.example, zero=zero))
        self._within(value, where, stated.value)
        return stated


class Span(Quantity):
    """Check of a range of positive quantities, like "0.5 to 6 m/s", or of a single one."""

    def __call__(self, value: Any, where: str) -> tuple[float, float]:
        """Return the ends in SI, in ascending order."""
        ends = value.split(" to ") if isinstance(value, str) else [value]
        first, last = (split_quantity(str(ends[i])) for i in (0, -1))
        if len(ends) == 2 and first and last and not first[1]:
            ends[0] = f"{ends[0]} {last[1]}"
        found = [parse_quantity(end, self.si, where, self.example) for end in ends]
        if len(found) > 2 or found[0] <= 0.0 or found != sorted(found):
            wanted = f'a range of positive values, like "{self.example}"'
            raise InputError(f'{where} = "{value}" must be {wanted}.')
        return found[0], found[-1]


@dataclass(frozen=True)
class Several:
    """Check of a list of at least one value; messages number each `item`, if that has a name."""

    each: Check
    right: str
    item: str = ""

    def __call__(self, value: Any, where: str) -> tuple[Any, ...]:
        """Return the checked values."""
        if not isinstance(value, list) or not value:
            raise InputError(f"{where} must be a list {self.right}.")
        places = (
            f"{where} {self.item} {i}" if self.item else where for i in range(1, 1 + len(value))
        )
        return tuple(map(self.each, value, places))


@dataclass(frozen=True)
class Table:
    """Check of a table within a table, as that of a channel."""

    keys: Mapping[str, Check]
    right: str
    needed: tuple[str, ...] = ()

    def __call__(self, value: Any, where: str) -> dict[str, Any]:
        """Return the checked values by key."""
        if not isinstance(value, dict):
            raise InputError(f"{where} must be like {self.right}.")
        return checked(value, self.keys, f"{where}:", self.needed)


def anything(value: Any, where: str) -> Any:
    """Return a value that is checked elsewhere."""
    return value


COUNT = Rule(lambda v: type(v) is int and v > 0, "a whole number from 1 up")
RANGE = Rule(
    lambda v: isinstance(v, tuple | list) and len(v) == 2 and all(map(COUNT.valid, v)),
    "the numbers of the first and the last one, like [1, 3]",
)
FLAG = Rule(lambda v: type(v) is bool, "true or false")


def read_bytes(path: Path, otherwise: str) -> bytes:
    """Read a file; `otherwise` ends the message of an error with what would be right."""
    try:
        return read_whole(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {otherwise}.") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({why}); {otherwise}.") from None


def load_toml(path: Path, otherwise: str) -> dict[str, Any]:
    """Load a TOML file; `otherwise` ends the message if the file is missing or unreadable."""
    raw = read_bytes(path, otherwise)
    if len(raw) > _LARGEST:
        raise InputError(f"{path}: has {len(raw)} characters; a TOML must have {_LARGEST} at most.")
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply; write a TOML of few levels.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; a TOML file must be.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}.") from None


def check_keys(where: str, given: Iterable[str], valid: Iterable[str]) -> None:
    """Raise InputError for an invalid key, and suggest similar valid ones."""
    valid = list(valid)
    for key in given:
        if key not in valid:
            key = key[:LONGEST]
            near = difflib.get_close_matches(key, valid, n=2, cutoff=0.4) or valid
            raise InputError(f"{where} has no key {key!r}; meant may be {', '.join(near)}.")


def table_of(document: Mapping[str, Any], name: str, within: str = "") -> dict[str, Any]:
    """Return a table of a document, empty if it is missing."""
    table = document.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"{within}{name} must be a table, [{within}{name}].")
    return table


def checked_tables(
    document: Mapping[str, Any], tables: Mapping[str, Mapping[str, Check]]
) -> dict[str, dict[str, Any]]:
    """Return the checked values of the tables of a document, by table and key."""
    return {
        name: checked(table_of(document, name), keys, f"[{name}]") for name, keys in tables.items()
    }


def checked(
    table: Mapping[str, Any], keys: Mapping[str, Check], where: str, needed: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the checked values of a table by key; keys that are not `needed` may be missing."""
    check_keys(where.removesuffix(":"), table, keys)
    for key in needed:
        if key not in table:
            check = keys[key]
            remedy = f"it must be {getattr(check, 'right', '')}"
            if isinstance(check, Quantity):
                example = f'"{check.example}"' if check.si else check.example
                remedy = f"give it like {key} = {example}"
            raise InputError(f"{where} {key} is missing; {remedy}.")
    return {key: keys[key](value, f"{where} {key}") for key, value in table.items()}
