"""What the header of a column says: the channel that it names, and the unit of its numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from foamfit.data.measurement import interior_node
from foamfit.data.toml_file import LONGEST
from foamfit.data.units import factor, is_unit

WEAK = 3  # rank of a header that may name the displacement


class Channel(NamedTuple):
    """SI unit of a channel, a usual unit for examples, and the words for it (best one first)."""

    si: str
    unit: str
    words: tuple[str, ...]


CHANNELS = {
    "time": Channel("s", "ms", ("time", "t")),
    "stress": Channel("Pa", "MPa", ("stress", "sigma")),
    "force": Channel("N", "N", ("force", "load", "f")),
    "displacement": Channel("m", "mm", ("displacement", "disp")),
    "strain": Channel("", "%", ("strain", "eps", "epsilon")),
    "acceleration": Channel("m/s**2", "m/s^2", ("acceleration", "accel", "deceleration")),
    "velocity": Channel("m/s", "m/s", ("velocity", "speed")),
    "cycle": Channel("", "", ()),  # the number of the cycle, where [columns] names such a column
}
_WORDS = {word for channel in CHANNELS.values() for word in channel.words}
# Words that name the displacement where nothing better does: a machine's travel, or a gap.
_MOTION = {"extension", "gap", "travel", "stroke", "deflection", "crosshead", "position"}
# With one of these beside it a channel's name means something else.
_OTHER = {"std", "sd", "dev", "error", "err", "noise", "uncertainty", "rate", "specific", "energy"}
# Units of mass that as those of a force mean a weight.
WEIGHTS = {"lb": "lbf", "lbs": "lbf", "kg": "kgf", "kgs": "kgf"}


@dataclass(frozen=True)
class Header:
    """One column's header: its text, the words of its name, its unit if it has one."""

    text: str
    words: tuple[str, ...] = ()
    unit: str | None = None

    def rank(self, channel: str) -> int | None:
        """How well it names a channel: 0 is best, None not at all."""
        words, node = channel_of(channel).words, interior_node(channel)
        numbers = [word for word in self.words if word.isdecimal()]
        if [int(number) for number in numbers] != ([] if node is None else [node]):
            return None  # displacement_1 is inside the specimen
        rest = [word for word in self.words if word not in numbers]
        if len(rest) == 1 and rest[0] in words:
            return 0 if rest[0] == words[0] else 1
        named = [w for w in rest if w in _WORDS and len(w) > 1]
        if _OTHER & set(rest) or not all(word in words for word in named):
            return None
        if named:
            return 2
        return WEAK if channel == "displacement" and _MOTION & set(rest) else None

    def is_named(self, name: str) -> bool:
        """Whether a column name in the TOML means it: with its unit or without."""
        bare = self.text.split("(")[0].split("[")[0]
        return name.casefold().split() in (t.casefold().split() for t in (self.text, bare))


def parse_header(text: str) -> Header:
    """Split a header into name and unit: stress (MPa), stress / MPa, stress_MPa or Time/ms."""
    text = text.strip()
    if len(text) > LONGEST:  # a title or a comment
        return Header(text)
    bracket = re.fullmatch(r"(.*)[(\[{]([^()\[\]{}]*)[)\]}]", text)
    bracket = bracket or re.fullmatch(r"(.+) / (\S+)", text)
    if bracket:
        return Header(text, _words(bracket[1]), bracket[2].strip())
    tokens = re.split(r"[\s_]+", text)
    for i in range(1, len(tokens)):
        rest = tokens[i:]
        if rest[0].lower() in _WORDS or rest[0].isdigit():
            continue
        unit = "/".join(token for token in rest if token.lower() != "per")  # m_s2, N_per_kg
        if is_unit(unit, any_case=True):
            return Header(text, _words(" ".join(tokens[:i])), unit)
    name, _, unit = (part.strip() for part in text.partition("/"))
    over = Header(text, _words(name), unit)
    if unit and any(over.rank(c) is not None and in_si(c, unit) is not None for c in CHANNELS):
        return over
    return Header(text, _words(text))


def _words(name: str) -> tuple[str, ...]:
    """Words of a name, in small letters: Force(Linear:Load) has three."""
    return tuple(word for word in re.split(r"[\s_:;()]+", name.lower()) if word)


def channel_of(name: str) -> Channel:
    """Return a channel by its name; displacement_1 of a mass inside is a displacement."""
    return CHANNELS["displacement" if interior_node(name) else name]


def example(name: str) -> str:
    """Return an example of a channel's header."""
    return f"{name} ({channel_of(name).unit})"


def in_si(channel: str, unit: str, times: str = "") -> float | None:
    """SI value of one `unit` · `times` of a channel; a mass or gram can only mean a weight or g."""
    if channel == "acceleration" and unit in {"g", "G"}:
        unit = "standard_gravity"
    if channel == "force":
        unit = WEIGHTS.get(unit.casefold(), unit)
    return factor(unit, channel_of(channel).si, times=times)
