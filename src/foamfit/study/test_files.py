"""Find test files by files, folders and globs, and name them."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from foamfit.data.toml_file import motion_file
from foamfit.errors import InputError
from foamfit.report.folder import FILES
from foamfit.text import listed

ENDINGS = (".csv", ".txt", ".tsv", ".dat", ".gz", ".xlsx")
WANTED = f"a test is a table that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
# Stems of tables that list the specimens next to the tests.
_SPECIMENS = ("specimen", "specimens")
_WRITTEN = set[str]().union(*FILES.values())


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
    same = Counter((file.parent, file.stem.casefold()) for file in files)
    stems = [
        file.stem if same[file.parent, file.stem.casefold()] == 1 else file.name.replace(".", "-")
        for file in files
    ]
    names = list(stems)
    for depth in range(1, max(len(file.parts) for file in files)):
        counts = Counter(name.casefold() for name in names)
        for i, file in enumerate(files):
            if counts[names[i].casefold()] > 1:
                names[i] = "-".join([*file.parent.parts[1:][-depth:], stems[i]])
    taken = set[str]()
    for name in names:
        unique, count = name, 1
        while unique.casefold() in taken:  # "a-b.csv" and "a/b.csv"
            unique, count = f"{name}-{count + 1}", count + 1
        taken.add(unique.casefold())
        yield unique
