"""STUDY.toml: the tests that are fitted together, and the kinds of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from foamfit.data.toml_file import COUNT, FLAG, RANGE, Rule, check_keys, load_toml
from foamfit.errors import InputError
from foamfit.fitting.links import KINDS
from foamfit.options import DRIVES, FREED, OF_FIT
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.study.test_files import find_tests

# Kind of a parameter for which the evidence decides between `KINDS`.
AUTO = "auto"
_EXAMPLES = {"tests": 'tests = ["runs/*.csv"]', "model": 'model = "microscale"'}


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


_RULES = {
    "name": Rule(_is_text, 'text, like name = "new heel"'),
    "specimen": Rule(_is_text, 'text, like specimen = "foam.toml"'),
    "seed": Rule(lambda v: type(v) is int and v >= 0, OF_FIT["seed"].right),
    "cycle": COUNT,
    "cycles": Rule(RANGE.valid, f"{RANGE.right}, without cycle"),
    "starts": COUNT,
    "drive": Rule(lambda v: v in DRIVES, OF_FIT["drive"].right),
    **dict.fromkeys(FREED, FLAG),
}
_KEYS = (*_RULES, "tests", "model", "relaxation", "specimens", "parameters")


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
    seed: int
    cycle: int | None
    starts: int | None
    cycles: tuple[int, int] | None = None  # first and last of several cycles fitted as one history


def read_study(path: str | Path) -> Study:
    """Read and check a study file; InputError names the file and the wrong or missing key."""
    path = Path(path)
    content = load_toml(path, "a study is a TOML with tests, model and [parameters]")
    check_keys(f"{path}:", content, _KEYS)
    try:
        return _read(path, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(path: Path, content: Mapping[str, Any]) -> Study:
    for key in ("tests", "model"):
        if key not in content:
            raise InputError(f"{key} is missing; give it like {_EXAMPLES[key]}")
    for key, rule in _RULES.items():
        both = key == "cycles" and "cycle" in content
        if key in content and (both or not rule.valid(content[key])):
            raise InputError(f"{key} = {content[key]!r} must be {rule.right}")
    model = Model.of_result(content)
    tests = _tests(path, content)
    kinds, held = _parameters(content.get("parameters", {}), model)
    return Study(
        path=path,
        name=content.get("name") or path.stem,
        tests=tests,
        model=model.name,
        relaxation=model.relaxation,
        drive=content.get("drive"),
        kinds=kinds,
        held=held,
        seed=content.get("seed", 0),
        cycle=content.get("cycle"),
        cycles=tuple(content["cycles"]) if "cycles" in content else None,
        starts=content.get("starts"),
    )


def _tests(path: Path, content: Mapping[str, Any]) -> tuple[tuple[str, Path, Path | None], ...]:
    """Return tests with their TOML: from [specimens], or else the key specimen."""
    patterns = content["tests"]
    patterns = [patterns] if isinstance(patterns, str) else patterns
    if not isinstance(patterns, list) or not all(isinstance(p, str) for p in patterns):
        raise InputError(f"tests must be a list like {_EXAMPLES['tests']}")
    try:
        found = find_tests(patterns, path.parent)
    except InputError as error:
        raise InputError(f"tests: {error}") from None
    if len(found) < 2:
        raise InputError(
            f"tests names {'one test' if found else 'none'}; a joint fit needs at least two"
        )
    specimens, names = content.get("specimens", {}), [name for name, _ in found]
    if not isinstance(specimens, dict):
        raise InputError(f'specimens must be a table of tests, like {names[0]} = "a.toml"')
    check_keys("[specimens]", specimens, names)
    for name, value in specimens.items():
        if not isinstance(value, str):
            raise InputError(f"[specimens] {name} = {value!r} must be the name of a TOML")
    pairs = ((test, specimens.get(test[0], content.get("specimen"))) for test in found)
    return tuple((*test, None if toml is None else path.parent / toml) for test, toml in pairs)


def _parameters(table: Any, model: Model) -> tuple[dict[str, str], dict[str, float]]:
    """Return kinds, and values of fixed parameters, from the table [parameters]."""
    if not isinstance(table, dict):
        raise InputError('parameters must be a table, like s1_k0 = "shared"')
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
