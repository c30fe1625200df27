"""Find and name test files; STUDY.toml: tests that are fitted together, and kinds of parameters."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from foamfit.data import toml_file
from foamfit.data.toml_file import Check, Rule, checked, motion_file, table_of, toml_beside
from foamfit.errors import InputError, naming
from foamfit.options import FREED, KINDS, OF_FIT
from foamfit.report.folder import FILES
from foamfit.springs.model import Model
from foamfit.springs.parameters import NUISANCE
from foamfit.text import listed

AUTO = "auto"  # kind of a parameter for which the evidence decides between `KINDS`
ENDINGS = (".csv", ".txt", ".tsv", ".dat", ".gz", ".xlsx")
WANTED = f"a test is a table that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
_SPECIMENS = ("specimen", "specimens")  # stems of tables that list them next to the tests
_WRITTEN = set[str]().union(*FILES.values())


def _text(right: str) -> Rule:
    return Rule(lambda v: isinstance(v, str) and bool(v.strip()), f"text, like {right}")


_PATTERNS = Rule(
    lambda v: isinstance(v, str) or (isinstance(v, list) and all(isinstance(p, str) for p in v)),
    'a list like tests = ["runs/*.csv"]',
)
_KEYS: dict[str, Check] = {
    "name": _text('name = "new heel"'),
    "tests": _PATTERNS,
    "model": _text('model = "microscale"'),
    "specimen": _text('specimen = "foam.toml"'),
    "cycle": toml_file.COUNT,
    "cycles": toml_file.RANGE,
    **{n: Rule(OF_FIT[n].admits, OF_FIT[n].right) for n in ("drive", "seed", "starts")},
    **dict.fromkeys(FREED, toml_file.FLAG),
    **dict.fromkeys(("relaxation", "specimens", "parameters"), toml_file.anything),
}


@dataclass(frozen=True)
class Study:
    """The content of a study file."""

    path: Path
    name: str
    tests: tuple[tuple[str, Path, Path | None], ...]  # name, file, TOML (None: next to the file)
    model: str
    relaxation: int
    drive: str | None
    kinds: Mapping[str, str]  # by parameter, one of `options.KINDS` or "auto"
    held: Mapping[str, float]  # values of fixed parameters, SI
    seed: int = 0
    cycle: int | None = None
    starts: int | None = None
    cycles: tuple[int, int] | None = None  # first and last of several cycles fitted as one history


def read_study(path: str | Path) -> Study:
    """Read and check a study file; InputError names the file and the wrong or missing key."""
    path = Path(path)
    content = toml_file.load_toml(path, "a study is a TOML with tests, model and [parameters]")
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
    with naming("tests"):
        found = find_tests(content["tests"], path.parent)
    if len(found) < 2:
        why = f"tests names {'one test' if found else 'none'}; a joint fit needs at least two"
        raise InputError(why)
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
            why = f"{where} = {value!r} must be one of {wanted}, or a number (SI) to fix it"
            raise InputError(why)
    return kinds, held


def find_tests(
    patterns: str | Path | Iterable[str | Path], base: str | Path = "."
) -> list[tuple[str, Path]]:
    """Find tests by files, folders and globs ("**" includes subfolders), relative to `base`.

    In folders and among the matches of a glob, only tables (`ENDINGS`) are tests, except lists of
    specimens, motion files named in the TOML of another test, and results of foamfit. A file that
    is given by its own name is always a test unless it is a TOML. Returns names and files, sorted
    by file, each file once. The name is the stem of the file; equal names are prefixed by parent
    folders, joined by "-".

    Raises
    ------
    InputError
        If a glob or folder contains no test, or no file exists; the message names it. One missing
        file among several, or a broken link, is not an error until it is read.
    """
    given = [patterns] if isinstance(patterns, str | Path) else list(patterns)
    if not given:
        raise InputError("no test is given; give files, folders or globs")
    found = {_real(path): path for pattern in given for path in _matches(pattern, Path(base))}
    paths = sorted(found.values())
    if not paths:
        raise InputError(f"{listed(map(str, given))}: a TOML is not a test; give its table")
    if not any(map(os.path.lexists, paths)):
        raise InputError(f"{listed(map(str, given))}: no such file or folder; {WANTED}")
    return list(zip(_names(paths), paths, strict=True))


def _real(path: Path) -> Path:
    """Return the absolute path of a file; `Path.resolve` fails for a link to itself."""
    return Path(os.path.realpath(path))


def _matches(pattern: str | Path, base: Path) -> list[Path]:
    path = base / pattern
    if folder := path.is_dir():
        hits = list(path.iterdir())
    elif path.exists() or not glob.has_magic(str(pattern)):
        # A missing file fails when it is read. A glob expanded by the shell may include TOMLs.
        return [] if path.suffix.lower() == ".toml" else [path]
    else:
        hits = [Path(hit) for hit in glob.glob(str(path), recursive=True)]
        hits += [inner for hit in hits if hit.is_dir() for inner in hit.iterdir()]
    files = [hit for hit in hits if _is_test(hit)]
    tomls = (toml for place in {file.parent for file in files} for toml in place.glob("*.toml"))
    motions = {_real(motion) for motion in map(motion_file, tomls) if motion is not None}
    tests = [file for file in files if _real(file) not in motions]
    if not tests:
        matched = f"the glob matches no {'test' if hits else 'file'}"
        why = "the folder has no test" if folder else matched
        raise InputError(f"{pattern}: {why}; {WANTED}")
    return tests


def _is_test(path: Path) -> bool:
    """Return whether a file of a folder or among the matches of a glob is a test."""
    if not path.is_file() and (path.is_dir() or not path.is_symlink()):
        return False  # a broken link to a table is a test, and fails when it is read
    plain = path.with_suffix("") if path.suffix.lower() == ".gz" else path  # excludes .tar.gz
    if plain.suffix.lower() not in ENDINGS or plain.stem.lower() in _SPECIMENS:
        return False
    if path.name.startswith((".", "~$")):
        return False
    marks = ((path.parent / mark).is_file() for mark in (*FILES, "summary.html"))
    return not (path.name in _WRITTEN and any(marks))


def _names(paths: list[Path]) -> Iterator[str]:
    """Name each file by its stem and as many parent folders as make the name unique."""
    files = [_real(path) for path in paths]
    tomls = [toml_beside(file) for file in files]  # that of a.csv.gz is a.toml
    same = Counter(str(toml).casefold() for toml in tomls)
    stems = [
        toml.stem if same[str(toml).casefold()] == 1 else file.name.replace(".", "-")
        for toml, file in zip(tomls, files, strict=True)
    ]
    names = list(stems)
    for depth in range(1, max(len(file.parts) for file in files)):
        counts = Counter(name.casefold() for name in names)
        for i, file in enumerate(files):
            if counts[names[i].casefold()] > 1:
                names[i] = "-".join([*file.parent.parts[1:][-depth:], stems[i]])
    taken = {own for written in FILES.values() for own in written}
    for name in names:
        unique, count = name, 1
        while unique.casefold() in taken:  # "a-b.csv" and "a/b.csv"
            unique, count = f"{name}-{count + 1}", count + 1
        taken.add(unique.casefold())
        yield unique
