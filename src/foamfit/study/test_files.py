"""From files, folders and globs to named tests."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from foamfit.data.toml_file import motion_file
from foamfit.errors import InputError
from foamfit.report.folder import (
    BATCH_FILES,
    CYCLES_FILES,
    JOINT_FILES,
    MARKS,
    PREDICTION_FILES,
    RESULT_FILES,
)
from foamfit.text import listed

ENDINGS = (".csv", ".txt", ".tsv", ".dat", ".gz", ".xlsx")
WANTED = f"a test is a table that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
# Stems of tables that say what the specimens are, beside the tests.
_SPECIMENS = ("specimen", "specimens")
_WRITTEN = (*RESULT_FILES, *CYCLES_FILES, *BATCH_FILES, *JOINT_FILES, *PREDICTION_FILES)


def find_tests(
    patterns: str | Path | Iterable[str | Path], base: str | Path = "."
) -> list[tuple[str, Path]]:
    """Find the tests that files, folders and globs name.

    Parameters
    ----------
    patterns : str, Path or several of them
        Files, folders, globs ("**" goes into folders). Of a folder, and of what a glob matches,
        tables are taken (`ENDINGS`) that are no list of specimens, no motion that a TOML beside
        them names as that of another test, and no result of foamfit. A file that is named itself
        is taken unless it is a TOML.
    base : str or Path
        The folder that relative ones start from.

    Returns
    -------
    list of (str, Path)
        Names and files in the order of the files, each file once. A name is the stem of its file;
        where two have the same, parent folders stand before it, joined by "-".

    Raises
    ------
    InputError
        If a glob matches no test, a folder has none, or nothing is there at all; the message names
        it. One of several that is not there is left to who reads it, as a broken link is.
    """
    given = [patterns] if isinstance(patterns, str | Path) else list(patterns)
    if not given:
        raise InputError("no test is named; give files, folders or globs")
    found = {_whole(path): path for one in given for path in _matches(one, Path(base))}
    paths = sorted(found.values())
    if not paths:
        raise InputError(f"{listed(map(str, given))}: a TOML is no test; name the tables beside it")
    if not any(map(os.path.lexists, paths)):
        raise InputError(f"{listed(map(str, given))}: no such file or folder; {WANTED}")
    return list(zip(_names(paths), paths, strict=True))


def _whole(path: Path) -> Path:
    """Absolute path of a file; `Path.resolve` refuses a link that leads to itself."""
    return Path(os.path.realpath(path))


def _matches(pattern: str | Path, base: Path) -> list[Path]:
    path = base / pattern
    if path.is_dir():
        there = _tests_in(path)
        if not there:
            raise InputError(f"{pattern}: the folder has no test; {WANTED}")
        return there
    if path.exists() or not glob.has_magic(str(pattern)):
        # One that is not there is refused where it is read. A shell's glob also names the TOMLs.
        return [] if path.suffix.lower() == ".toml" else [path]
    hits = [Path(hit) for hit in glob.glob(str(path), recursive=True)]
    motions = {path for folder in {hit.parent for hit in hits} for path in _motions(folder)}
    there = [hit for hit in hits if _is_test(hit) and _whole(hit) not in motions]
    there += [inner for hit in hits if hit.is_dir() for inner in _tests_in(hit)]
    if not there:
        why = "matches no file" if not hits else "matches no test"
        raise InputError(f"{pattern}: the glob {why}; {WANTED}")
    return there


def _tests_in(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if _is_test(path)]
    motions = _motions(folder) if files else set()
    return [path for path in files if _whole(path) not in motions]


def _motions(folder: Path) -> set[Path]:
    """Files that TOMLs in a folder name as the motion of a test."""
    found = map(motion_file, folder.glob("*.toml"))
    return {_whole(path) for path in found if path is not None}


def _is_test(path: Path) -> bool:
    """Whether a file is taken where it is not named itself."""
    if not path.is_file() and (path.is_dir() or not path.is_symlink()):
        return False  # a broken link is left to who reads it
    plain = path.with_suffix("") if path.suffix.lower() == ".gz" else path  # no .tar.gz
    if plain.suffix.lower() not in ENDINGS or plain.stem.lower() in _SPECIMENS:
        return False
    if path.name.startswith((".", "~$")):
        return False
    is_result = path.name in _WRITTEN and any(
        (path.parent / mark).is_file() for mark in (*MARKS, "summary.html")
    )
    return not is_result


def _names(paths: list[Path]) -> Iterator[str]:
    """Name each file by its stem, and by as many parents as tell it from the others."""
    wholes = [_whole(path) for path in paths]
    beside = Counter((whole.parent, whole.stem.casefold()) for whole in wholes)
    stems = [
        w.stem if beside[w.parent, w.stem.casefold()] == 1 else w.name.replace(".", "-")
        for w in wholes
    ]
    names = list(stems)
    for depth in range(1, max((len(whole.parts) for whole in wholes), default=0)):
        counts = Counter(name.casefold() for name in names)
        for i, whole in enumerate(wholes):
            if counts[names[i].casefold()] > 1:
                names[i] = "-".join([*whole.parent.parts[1:][-depth:], stems[i]])
    taken = set[str]()
    for name in names:
        unique, count = name, 1
        while unique.casefold() in taken:  # "a-b.csv" beside "a/b.csv"
            unique, count = f"{name}-{count + 1}", count + 1
        taken.add(unique.casefold())
        yield unique
