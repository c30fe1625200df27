"""Convert results to plain JSON types and back, by the fields and types of their dataclasses.

An array that is also a column of the CSV file is stored as a reference, `{"column": name}`.
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import PurePath
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError, UnknownLawError
from foamfit.springs.spring import Spring

Columns = Mapping[str, Array]
_hints = cache(get_type_hints)  # which takes most of the time of `build`
_PARAMETER = ("value", "vary", "min", "max", "stderr", "expr")
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Turn errors of reading a result in the body into an InputError of one sentence."""
    try:
        yield
    except UnknownLawError as error:
        raise InputError(f"{what} cannot be read here: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:  # InputError among them
        fault = "a value is of the wrong kind"
        if isinstance(error, InputError | KeyError):
            fault = str(error) if isinstance(error, InputError) else f"{error} is missing"
        raise InputError(f"{what} cannot be read back: {fault}; fit again") from None


def plain(value: Any, columns: Columns | None = None) -> Any:
    """Return a value in JSON types; a dataclass becomes an object of its fields.

    Fields that are None and have "omitted" in their metadata are left out. A number that is not
    finite becomes its name, or None without `columns`.
    """
    if hasattr(value, "valuesdict"):  # lmfit's parameters, whose own writer pickles functions
        value = {n: {key: getattr(one, key) for key in _PARAMETER} for n, one in value.items()}
    if isinstance(value, Mapping):
        return {str(key): plain(item, columns) for key, item in value.items()}
    if isinstance(value, Spring):
        relaxation = [list(term) for term in value.relaxation]
        return {"kind": value.law.kind, "values": list(value.values), "relaxation": relaxation}
    if is_dataclass(value):
        kept = ((one.name, getattr(value, one.name), one.metadata) for one in fields(value))
        shown = {n: x for n, x, about in kept if x is not None or "omitted" not in about}
        return plain(shown, columns)
    if isinstance(value, np.ndarray):
        pairs = (columns or {}).items()
        same = (name for name, one in pairs if np.array_equal(one, value, equal_nan=True))
        name = next(same, None)
        return plain(value.tolist(), columns) if name is None else {"column": name}
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple):
        return [plain(item, columns) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if columns is None else str(value)
    return value


def decode(hint: Any, value: Any, columns: Columns) -> Any:
    """Invert `plain` for a value of type `hint`; raises the errors of `build`."""
    origin, inner = get_origin(hint), get_args(hint)
    if hasattr(origin, "__value__"):  # NDArray of NumPy 2.5 is a type alias with a parameter
        return decode(origin.__value__[inner], value, columns)
    if origin in (Union, types.UnionType):
        arms = [arm for arm in inner if arm is not type(None)]
        return None if value is None else decode(arms[0] if len(arms) == 1 else Any, value, columns)
    if origin is np.ndarray:  # NDArray[kind]: its last argument is dtype[kind]
        given = columns[value["column"]] if isinstance(value, Mapping) else _finite_or_not(value)
        return np.array(given, dtype=get_args(inner[-1])[0])
    if origin is tuple:
        each = (inner[0],) * len(value) if inner[-1] is Ellipsis else inner
        return tuple(decode(one, item, columns) for one, item in zip(each, value, strict=True))
    if origin in (dict, Mapping):
        return {inner[0](key): decode(inner[1], item, columns) for key, item in value.items()}
    if hint is float:
        return math.nan if value is None else float(value)
    if hint is str:
        return "" if value is None else value
    if hint is Spring:
        from foamfit.springs import laws

        pairs = [(g, tau) for g, tau in value["relaxation"]]
        return laws.law(value["kind"]).make(value["values"], pairs)
    if hasattr(hint, "valuesdict"):
        return _parameters(hint(), _finite_or_not(value))
    if is_dataclass(hint):
        return build(hint, value, columns)
    if isinstance(hint, type) and issubclass(hint, PurePath):
        return hint(value)
    return _finite_or_not(value) if hint is Any else value


def build(made: Any, content: Mapping[str, Any], columns: Columns, **names: Any) -> Any:
    """Make a dataclass from its encoded fields; fields with a default may be missing.

    `names` are the names in its annotations that its module imports for typing only. Raises
    KeyError, TypeError, ValueError or AttributeError if a field is missing or invalid.
    """
    hints = get_type_hints(made, localns=names) if names else _hints(made)
    given = {}
    for one in fields(made):
        missing = one.default is MISSING and one.default_factory is MISSING
        if missing or one.name in content:
            given[one.name] = decode(hints[one.name], content[one.name], columns)
    return made(**given)


def _parameters(params: Any, content: Mapping[str, Any]) -> Any:
    for name, one in content.items():
        params.add(name, **{key: one[key] for key in ("value", "vary", "min", "max")})
        params[name].stderr = one["stderr"]
    for name, one in content.items():
        if one["expr"] is not None:
            params[name].expr = one["expr"]
    return params


def _finite_or_not(value: Any) -> Any:
    """Replace the names of numbers that are not finite by the numbers."""
    if isinstance(value, Mapping):
        return {key: _finite_or_not(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite_or_not(item) for item in value]
    return _NOT_FINITE.get(value, value) if isinstance(value, str) else value
