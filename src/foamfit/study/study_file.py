"""STUDY.toml: the tests that are fitted together, and the kinds of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from foamfit.data.toml_file import (
    COUNT,
    FLAG,
    RANGE,
    Check,
    Rule,
    anything,
    checked,
    load_toml,
    table_of,
)
from foamfit.errors import InputError, naming
from foamfit.fitting.links import KINDS
from foamfit.options import FREED, OF_FIT
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.study.test_files import find_tests

# Kind of a parameter for which the evidence decides between `KINDS`.
AUTO = "auto"


def _text(right: str) -> Rule:
    return Rule(lambda v: isinstance(v, str) and bool(v.strip()), f"text, like {right}")


def _of_fit(name: str) -> Rule:
    """Check of an option of a fit."""
    return Rule(OF_FIT[name].admits, OF_FIT[name].right)


_PATTERNS = Rule(
    lambda v: isinstance(v, str) or (isinstance(v, list) and all(isinstance(p, str) for p in v)),
    'a list like tests = ["runs/*.csv"]',
)
_KEYS: dict[str, Check] = {
    "name": _text('name = "new heel"'),
    "tests": _PATTERNS,
    "model": _text('model = "microscale"'),
    "specimen": _text('specimen = "foam.toml"'),
    "cycle": COUNT,
    "cycles": RANGE,
    **{name: _of_fit(name) for name in ("drive", "seed", "starts")},
    **dict.fromkeys(FREED, FLAG),
    **dict.fromkeys(("relaxation", "specimens", "parameters"), anything),
}


@dataclass(frozen=True)
class Study:
    """The content of a study file.

    `kinds` maps parameters to one of `links.KINDS` or "auto"; `held` maps fixed parameters to their
    values (SI).
    """

    path: Path
    name: str
    tests: tuple[tuple[str, Path, Path | None], ...]  # name, file, TOML (None: next to the file)
    model: str
    relaxation: int
    drive: str | None
    kinds: Mapping[str, str]
    held: Mapping[str, float]
    seed: int = 0
    cycle: int | None = None
    starts: int | None = None
    cycles: tuple[int, int] | None = None  # first and last of several cycles fitted as one history


def read_study(path: str | Path) -> Study:
    """Read and check a study file; InputError names the file and the wrong or missing key."""
    path = Path(path)
    content = load_toml(path, "a study is a TOML with tests, model and [parameters]")
    found = checked(content, _KEYS, f"{path}:", ["tests", "model"])
    with naming(path):
        if {"cycle", "cycles"} <= content.keys():
            raise InputError("give either cycle or cycles, not both")
        model = Model.of_result(content)
        kinds, held = _parameters(table_of(content, "parameters"), model)
        given = {name: found[name] for name in ("seed", "cycle", "starts") if name in found}
        return Study(
            path=path,
            name=content.get("name") or path.stem,
            tests=_tests(path, content),
            model=model.name,
            relaxation=model.relaxation,
            drive=content.get("drive"),
            kinds=kinds,
            held=held,
            cycles=tuple(content["cycles"]) if "cycles" in content else None,
            **given,
        )


def _tests(path: Path, content: Mapping[str, Any]) -> tuple[tuple[str, Path, Path | None], ...]:
    """Return tests with their TOML: from [specimens], or else the key specimen."""
    try:
        found = find_tests(content["tests"], path.parent)
    except InputError as error:
        raise InputError(f"tests: {error}") from None
    if len(found) < 2:
        raise InputError(
            f"tests names {'one test' if found else 'none'}; a joint fit needs at least two"
        )
    toml, specimens = _text('"a.toml"'), table_of(content, "specimens")
    own = checked(specimens, dict.fromkeys([name for name, _ in found], toml), "[specimens]")
    pairs = ((test, own.get(test[0], content.get("specimen"))) for test in found)
    return tuple((*test, None if toml is None else path.parent / toml) for test, toml in pairs)


def _parameters(table: Mapping[str, Any], model: Model) -> tuple[dict[str, str], dict[str, float]]:
    """Return kinds, and values of fixed parameters, from the table [parameters]."""
    kinds, held = dict[str, str](), dict[str, float]()
    for name, value in table.items():
        where = f"[parameters] {name}"
        if name not in (*model.names, *NUISANCE):
            with_terms = f" with relaxation = {model.relaxation}" if model.relaxation else ""
            raise InputError(
                f"{where} is not a parameter of the model {model.name}{with_terms}; its parameters "
                f"are {', '.join(model.names)}"
            )
        if name in NUISANCE and value in (*KINDS, AUTO) and value != "own":
            raise InputError(
                f'{where} = "{value}" is impossible: each test has its own contact, zeros, striker '
                f'and clock; leave it out, make it "own", or give a number (SI) to fix it'
            )
        if value in (*KINDS, AUTO):
            kinds[name] = str(value)
        elif isinstance(value, Real) and not isinstance(value, bool):
            held[name] = float(value)
        else:
            wanted = ", ".join((*KINDS, AUTO))
            raise InputError(
                f"{where} = {value!r} must be one of {wanted}, or a number (SI) to fix it"
            )
    return kinds, held
