"""The laws of springs: built-in ones, and those that users register.

`law(kind)` returns the record of a kind of spring, on which all code outside `springs` relies.
"""

from __future__ import annotations

import copyreg
import sys
from collections.abc import Callable, Collection, Mapping
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from foamfit.errors import InputError
from foamfit.options import FREED
from foamfit.springs.laws import bistable, linear, microscale
from foamfit.springs.laws.bistable import BistableSpring as BistableSpring
from foamfit.springs.laws.linear import LinearSpring as LinearSpring
from foamfit.springs.laws.microscale import MicroscaleSpring as MicroscaleSpring
from foamfit.springs.laws.record import Functions as Functions, Law as Law, Param as Param

ENTRY_POINTS = "foamfit.laws"
_BUILT_IN = (bistable.LAW, linear.LAW, linear.UNILATERAL_LAW, *microscale.LAWS)
_LAWS = {law.kind: law for law in _BUILT_IN}
PAPER = tuple(_LAWS)  # built-in laws
_TEXTS: dict[str, str] = {}  # text of each loaded law file, by path
_asked_packages: list[bool] = []


def law(kind: str) -> Law:
    """Return the record of a kind of spring; InputError if it is unknown."""
    if kind not in _LAWS:
        _load_packages()
    if kind not in _LAWS:
        raise InputError(f"'{kind}' is not a spring; it must be one of {', '.join(kinds())}")
    return _LAWS[kind]


def _by_kind(one: Law) -> tuple[Callable[[str], Law], tuple[str]]:
    """Pickle a record by its name, because its functions cannot be pickled."""
    return law, (one.kind,)


copyreg.pickle(Law, _by_kind)


def kinds() -> tuple[str, ...]:
    """Return the names of all laws, built-in ones first, without variants by options."""
    _load_packages()
    return tuple(kind for kind, law in _LAWS.items() if not law.word)


def records() -> tuple[Law, ...]:
    """Return the records of all laws, including variants by options."""
    _load_packages()
    return tuple(_LAWS.values())


def options_of(kind: str) -> tuple[str, ...]:
    """Return the options that free further parameters of a law."""
    return tuple(one for one in FREED if f"{kind}, {one}" in _LAWS)


def with_options(kind: str, options: Collection[str]) -> str:
    """Return the name of a law's variant with those of the options that it has."""
    return ", ".join((kind, *(one for one in options_of(kind) if one in options)))


def is_registered(kind: str) -> bool:
    """Return whether a law is registered, not built in."""
    return kind in _LAWS and kind not in PAPER


def register(law: Law) -> Law:
    """Register a law, so that its kind can be used in the name of a model.

    Parameters
    ----------
    law
        The record. It replaces a registered law of the same name; built-in laws cannot be replaced.

    Returns
    -------
    Law
        The registered record; its method `make` makes springs.

    Raises
    ------
    InputError
        If the record is wrong: an invalid name, a missing function, a stress that is not finite, or
        a branch on which the stress falls.
    """
    from foamfit.springs.laws.checked import check

    known = check(law, (*PAPER, "auto"))  # its functions stay compiled for its springs
    _LAWS[known.kind] = known
    return known


def load_file(path: str | Path) -> tuple[Law, ...]:
    """Run a Python file and register the laws that it defines.

    Parameters
    ----------
    path
        A file with one or more `Law` records at its top level. As it is code, only the command line
        may name it.

    Returns
    -------
    tuple of Law

    Raises
    ------
    InputError
        If the file cannot be read or run, or contains no law or a wrong one; the message names the
        file.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a Python file that defines a Law")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the file cannot be read ({error})") from None
    return _load(str(path), text)


def texts() -> dict[str, str]:
    """Return the texts of all loaded law files, by path, for `load_texts`."""
    return dict(_TEXTS)


def load_texts(given: Mapping[str, str]) -> None:
    """Register the laws that another process has loaded from files; see `load_file`."""
    for path, text in given.items():
        if _TEXTS.get(path) != text:
            _load(path, text)


def _load(path: str, text: str) -> tuple[Law, ...]:
    """Register the laws of a text; a text loaded before is not compiled again."""
    found = _run(path, str(Path(path).resolve().parent), text)
    _LAWS.update({one.kind: one for one in found})
    _TEXTS[path] = text
    return found


@cache
def _run(path: str, folder: str, text: str) -> tuple[Law, ...]:
    """Run the text of a law file, and register all of its laws or none."""
    before = dict(_LAWS)
    module = ModuleType(f"foamfit_law_{Path(path).stem}")
    module.__file__ = path
    sys.modules[module.__name__] = module
    sys.path.insert(0, folder)  # so that it can import modules next to it
    try:
        exec(compile(text, path, "exec"), module.__dict__)
        given = [one for one in vars(module).values() if isinstance(one, Law)]
        kinds_of = {one.kind: one for one in given if before.get(one.kind) is not one}
        found = tuple(register(one) for one in kinds_of.values())
    except (Exception, SystemExit) as error:
        _LAWS.clear()
        _LAWS.update(before)
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from None
        what = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path}: the file cannot be run ({what})") from None
    finally:
        sys.path.remove(folder)
    if not found:
        raise InputError(f"{path}: the file defines no law; make a foamfit.Law at its top level")
    return found


def _load_packages() -> None:
    """Register the laws of installed packages, once."""
    if _asked_packages:
        return
    _asked_packages.append(True)
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            found = entry.load()
        except Exception as error:
            raise InputError(
                f"law '{entry.name}' of {entry.value} cannot be loaded: {error}"
            ) from None
        for one in found if isinstance(found, tuple | list) else (found,):
            register(one)
