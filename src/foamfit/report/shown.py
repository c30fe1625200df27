"""Results as Python and notebooks show them, and their folders."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from foamfit.report.figures import TWO, inches
from foamfit.report.folder import check_target, save_whole
from foamfit.report.readable import Readable
from foamfit.text import wrapped


def brief(title: str, line: str, rows: Sequence[Readable]) -> str:
    """Return a result in a few lines: a line about it, and its parameters."""
    marks = {"weak": " (weak)", "not determined": " (not determined)"}
    values = (f"{p.label} {p.with_unit(p.with_error)}{marks.get(p.state, '')}" for p in rows)
    return "\n".join([*wrapped(f"{title}: {line}", 2), *wrapped(", ".join(values), 2)])


class Result:
    """A result that Python shows in a few lines and a folder keeps."""

    _kind: ClassVar[str]  # the file that identifies it, one of `folder.FILES`

    def write(self, folder: Path, *, pages: bool, width: str) -> None:
        """Write all files into an existing folder; pages and figures only with `pages`."""
        raise NotImplementedError

    @property
    def failed(self) -> bool:
        """Whether no acceptable fit was found."""
        return getattr(self, "status", "") == "failed"

    def text(self, *, verbose: bool = False) -> str:
        """Return the text that the command prints; only that of a fit may be `verbose`."""
        raise NotImplementedError

    def to_json_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file of the result: SI, plain types, None if missing."""
        raise NotImplementedError

    def printed(self) -> dict[str, Any]:
        """Return what the command prints as JSON."""
        return self.to_json_dict()

    def save(
        self,
        folder: str | Path,
        *,
        report: bool = True,
        figure_width: str = TWO,
        force: bool = False,
    ) -> Path:
        """Write the result folder and return its path; an older folder is replaced at the end.

        A result of another kind, such as a joint fit, is replaced only with `force`. Without
        `report`, neither pages nor figures are written. `figure_width` is "one" or "two" columns,
        or a length ("85 mm"); ", untitled" after it omits the titles.
        """
        inches(figure_width)  # rejects an invalid width
        check_target(folder, of=None if force else self._kind)
        return save_whole(folder, partial(self.write, pages=report, width=figure_width))
