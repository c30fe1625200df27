"""Text in figures stays editable: embedded TrueType fonts that map glyphs to characters."""

from __future__ import annotations

import functools
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import pytest

import fabricated
from drawn import figures
from foamfit.report.figures import image
from foamfit.report.plots import plot_fit


def objects(pdf: bytes) -> dict[int, bytes]:
    """Return the objects of a PDF with decompressed streams."""
    found = {}
    for number, body in re.findall(rb"(\d+) 0 obj\s(.*?)\sendobj", pdf, re.DOTALL):
        head, mark, rest = body.partition(b"stream\n")
        stream = rest.rpartition(b"\nendstream")[0] if mark else b""
        if b"/FlateDecode" in head:
            stream = zlib.decompress(stream)
        found[int(number)] = head + stream
    return found


def fonts(pdf: bytes) -> list[tuple[str, bool]]:
    """Return the type of each font and whether a TrueType file is embedded."""
    there = objects(pdf).values()
    kinds = [
        kind.decode()
        for body in there if b"/Type /Font " in body or b"/Type /Font\n" in body
        for kind in re.findall(rb"/Subtype /(\w+)", body)[:1]
    ]  # fmt: skip
    embedded = b"".join(there).count(b"/FontFile2")
    whole = [kind for kind in kinds if kind != "CIDFontType2"]  # part of a Type0 font
    return [(kind, embedded >= len(whole)) for kind in whole]


def letters(pdf: bytes) -> set[str]:
    """Return the characters to which the glyphs of a PDF are mapped."""
    found = set[str]()
    for body in objects(pdf).values():
        if b"beginbfrange" in body or b"beginbfchar" in body:
            for line in re.findall(rb"<\w+> (?:<\w+> )?\[?(<[\w<> ]+>)", body):
                for code in re.findall(rb"<(\w+)>", line):
                    found.add(bytes.fromhex(code.decode()).decode("utf-16-be"))
            ranges = re.sub(rb"\[[^]]*\]", b"", body)  # ranges without a list of codes
            for first, last, code in re.findall(rb"<(\w+)> <(\w+)> <(\w+)>", ranges):
                span = int(last, 16) - int(first, 16)
                found |= {chr(int(code, 16) + i) for i in range(span + 1)}
    return found


@functools.cache
def pictures(form: str) -> dict[str, bytes]:
    """Return two figures as files; together they contain all kinds of characters."""
    given = dict(figures())
    return {name: image(given[name], form) for name in ("microscale, relaxing", "comparison")}


def test_every_letter_is_that_of_an_embedded_truetype_font() -> None:
    for name, pdf in pictures("pdf").items():
        kinds = fonts(pdf)
        assert kinds, name
        assert all(kind in ("TrueType", "Type0") and whole for kind, whole in kinds), name
        assert b"/Type3" not in pdf, name


@pytest.mark.parametrize("form", ["pdf", "svg"])
def test_greek_letters_indices_and_minus_signs_are_characters(form: str) -> None:
    text = set[str]()
    for content in pictures(form).values():
        if form == "pdf":
            text |= letters(content)
        else:
            text |= set("".join(ElementTree.fromstring(content).itertext()))
    assert set("σεΔ₊₋−–·kh%") <= text


def test_an_svg_holds_its_words_as_text(tmp_path: Path) -> None:
    plot_fit(fabricated.result(), tmp_path / "fit.svg")
    root = ElementTree.fromstring((tmp_path / "fit.svg").read_text(encoding="utf-8"))
    words = {"".join(one.itertext()) for one in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"stress (MPa)", "time (µs)", "A1", "springs along measured strain"} <= words
