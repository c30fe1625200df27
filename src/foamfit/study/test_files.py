"""From files, folders and globs to named tests."""

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
# Stems of tables that say what the specimens are, beside the tests.
_SPECIMENS = ("specimen", "specimens")
_WRITTEN = set[str]().union(*FILES.values())


def find_tests(
    patterns: str | Path | Iterable[str | Path], base: str | Path = "."
) -> list[tuple[str, Path]]:
    """Find the tests that files, folders and globs ("**" goes into folders) name, from `base`.

    From a folder, and from what a glob matches, it takes the tables (`ENDINGS`), but no list of
    specimens, no motion file that the TOML of another test names, and no result of foamfit. A file
    that is named itself is taken unless it is a TOML. Returned are names and files in the order of
    the files, each file once. The name is the stem of the file; where two are the same, the parent
    folders are put before it, joined by "-".

    Raises
    ------
    InputError
        If a glob matches no test, a folder has none, or nothing is there at all; the message names
        it. A missing file among several is refused where it is read, as a broken link is.
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
    """The files of one pattern."""
    path = base / pattern
    if folder := path.is_dir():
        hits = list(path.iterdir())
    elif path.exists() or not glob.has_magic(str(pattern)):
        # One that is not there is refused where it is read. A shell's glob also names the TOMLs.
        return [] if path.suffix.lower() == ".toml" else [path]
    else:
        hits = [Path(hit) for hit in glob.glob(str(path), recursive=True)]
        hits += [inner for hit in hits if hit.is_dir() for inner in hit.iterdir()]
    files = [hit for hit in hits if _is_test(hit)]
    tomls = (toml for place in {file.parent for file in files} for toml in place.glob("*.toml"))
    motions = {_whole(motion) for motion in map(motion_file, tomls) if motion is not None}
    there = [file for file in files if _whole(file) not in motions]
    if not there:
        matched = f"the glob matches no {'test' if hits else 'file'}"
        why = "the folder has no test" if folder else matched
        raise InputError(f"{pattern}: {why}; {WANTED}")
    return there


def _is_test(path: Path) -> bool:
    """Whether a file is taken where it is not named itself."""
    if not path.is_file() and (path.is_dir() or not path.is_symlink()):
        return False  # a broken link is refused where it is read
    plain = path.with_suffix("") if path.suffix.lower() == ".gz" else path  # no .tar.gz
    if plain.suffix.lower() not in ENDINGS or plain.stem.lower() in _SPECIMENS:
        return False
    if path.name.startswith((".", "~$")):
        return False
    marks = ((path.parent / mark).is_file() for mark in (*FILES, "summary.html"))
    return not (path.name in _WRITTEN and any(marks))


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
