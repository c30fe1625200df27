"""Templates of HTML pages and of terminal output."""

from __future__ import annotations

import functools
import json
import math
import sys
from base64 import b64encode
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foamfit import text
from foamfit.report.readable import in_unit

if TYPE_CHECKING:
    from jinja2 import Environment


@functools.cache
def environment() -> Environment:
    """Return the templates of all pages, texts and cards, with filters that format numbers."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
    from jinja2.bccache import Bucket, FileSystemBytecodeCache

    class Compiled(FileSystemBytecodeCache):
        """Keeps compiled templates beside the compiled modules, if that folder can be written."""

        def dump_bytecode(self, bucket: Bucket) -> None:
            if not sys.dont_write_bytecode:
                with suppress(OSError):
                    super().dump_bytecode(bucket)

    made = Environment(
        loader=ChoiceLoader([PackageLoader(f"foamfit.{of}") for of in ("report", "cards", "page")]),
        extensions=["jinja2.ext.do"],
        autoescape=select_autoescape(("html",)),
        bytecode_cache=Compiled(str(Path(__file__).with_name("__pycache__"))),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("percent", "engineering", "significant", "signed", "number", "field", "warning"):
        made.filters[name] = getattr(text, name)
    made.filters.update(counted=text.counted, listed=text.listed, in_unit=in_unit, exp=math.exp)
    made.filters.update(paragraphs=_paragraphs, aligned=_aligned)
    made.filters["svg"] = lambda svg: "data:image/svg+xml;base64," + b64encode(svg).decode()
    made.filters["quoted"] = functools.partial(json.dumps, ensure_ascii=False)
    made.filters["filename"] = lambda path: Path(path).name
    made.filters["spoken"] = lambda name: name.replace("_", "-")
    made.globals["version"] = version("foamfit")
    return made


def page(name: str, **values: Any) -> str:
    """Render an HTML page."""
    return environment().get_template(f"{name}.html").render(**values)


def words(name: str, **values: Any) -> str:
    """Render a text for the terminal, without a final newline."""
    return environment().get_template(f"{name}.txt").render(**values).rstrip("\n")


def sentences(name: str, **values: Any) -> tuple[str, ...]:
    """Render a text with one sentence per line and return its lines without the empty ones."""
    return tuple(line for line in words(name, **values).splitlines() if line.strip())


def table(name: str, **values: Any) -> list[list[str]]:
    """Render a text with one row per line and return its cells, which "¦" separates."""
    return [line.split("¦") for line in words(name, **values).splitlines()]


def _paragraphs(content: str, indent: int = 2) -> str:
    """Wrap each line of a text as a separate paragraph; keep empty lines."""
    lines = (text.wrapped(line, indent) or [""] for line in content.split("\n"))
    return "\n".join(line for paragraph in lines for line in paragraph)


def _aligned(rows: Any, **options: Any) -> str:
    return "\n".join(text.aligned(list(rows), **options))
