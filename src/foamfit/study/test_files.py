"""The files of several tests, named one by one, by folder or by glob, and a name for each."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from foamfit.errors import InputError

# Endings of the files that a folder is searched for.
TABLES = (".csv", ".tsv", ".txt", ".dat")


def find_tests(patterns: Iterable[str | Path], base: str | Path = ".") -> list[tuple[str, Path]]:
    """Files of tests with a name for each, sorted by name.

    Parameters
    ----------
    patterns : iterable of str or Path
        Files, folders (all tables in them: `TABLES`) and globs ("**" for folders at any depth).
    base : str or Path
        What relative ones are relative to.

    Returns
    -------
    list of (str, Path)
        Each file once. The name is that of the file without its ending; where two would have the
        same, with as many folders before it as tell them apart.

    Raises
    ------
    InputError
        If a glob matches nothing, a folder holds no table or a file is not there; it is named.
    """
    found = dict[Path, Path]()
    for pattern in patterns:
        for path in _matches(str(pattern), Path(base)):
            found.setdefault(path.resolve(), path)
    return sorted(zip(_names(list(found)), found.values(), strict=True))


def _matches(pattern: str, base: Path) -> list[Path]:
    """Files of one pattern."""
    path = base / pattern
    if path.is_dir():
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() in TABLES and p.is_file())
        if not inside:
            raise InputError(
                f"the folder {path} holds no test; it must hold files that end in "
                f"{', '.join(TABLES)}"
            )
        return inside
    if path.exists():
        return [path]
    if not glob.has_magic(pattern):
        raise InputError(f"{path}: no such file; name a test, a folder or a glob like 'runs/*.csv'")
    paths = sorted(Path(one) for one in glob.glob(str(path), recursive=True))
    paths = [one for one in paths if one.is_file()]
    if not paths:
        raise InputError(f"no file matches '{pattern}' in {base}; name one that is there")
    return paths


def _names(paths: list[Path]) -> list[str]:
    """A name for each of different paths, as short as tells them apart."""
    names = [path.stem for path in paths]
    for depth in range(1, max((len(path.parts) for path in paths), default=1) + 1):
        twice = {name for name in names if names.count(name) > 1}
        if not twice:
            return names
        for i, path in enumerate(paths):
            if names[i] in twice:
                folders = path.parent.parts[-depth:]
                names[i] = "-".join([*(part.strip("/\\:") for part in folders), path.stem])
    twice = {name for name in names if names.count(name) > 1}  # one folder, other endings
    return [
        f"{name}{path.suffix}" if name in twice else name
        for name, path in zip(names, paths, strict=True)
    ]
