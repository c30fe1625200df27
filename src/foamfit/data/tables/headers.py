"""Parse the header of a column: the channel it names and the unit of its numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from foamfit.data.measurement import interior_node
from foamfit.data.toml_file import LONGEST
from foamfit.data.units import factor, is_unit

WEAK = 3  # rank of a header that only suggests a displacement


class Channel(NamedTuple):
    """SI unit of a channel, a unit for examples, and its names in headers, the best one first."""

    si: str
    unit: str
    words: str


_MOVED = "displacement disp weg standardweg verschiebung stauchung compression"
CHANNELS = {
    "time": Channel("s", "ms", "time t zeit prüfzeit testzeit versuchszeit timestamp"),
    "stress": Channel("Pa", "MPa", "stress sigma σ druckspannung spannung"),
    "force": Channel("N", "N", "force load f kraft standardkraft prüfkraft druckkraft"),
    "displacement": Channel("m", "mm", _MOVED),
    "strain": Channel("", "%", "strain eps epsilon ε dehnung stauchung compression"),
    "acceleration": Channel("m/s**2", "m/s^2", "acceleration accel deceleration beschleunigung"),
    "velocity": Channel("m/s", "m/s", "velocity speed geschwindigkeit"),
    "cycle": Channel("", "", ""),  # assigned in [columns] only
}
_WORDS = {word for channel in CHANNELS.values() for word in channel.words.split()}
# Ambiguous words: the unit decides which quantity is meant.
_BY_UNIT = {"spannung", "stauchung", "compression"}
# Words for a displacement if no better name is present: travel of a machine, or a gap.
_MOTION = {"extension", "gap", "travel", "stroke", "deflection", "crosshead", "position"}
_MOTION |= {"deformation", "distance", "traversenweg", "kolbenweg"}
# Words that change the meaning of a channel's name.
_OTHER = {"std", "sd", "dev", "error", "err", "noise", "uncertainty", "rate", "specific", "energy"}
_OTHER |= {"transverse", "transversal", "lateral", "radial", "hoop", "circumferential", "poisson"}
_OTHER |= {"width", "diameter", "volumetric", "shear", "quer", "almansi", "kirchhoff"}
_OTHER |= {"setpoint", "command", "cmd", "target", "demand", "soll", "sollwert"}
# Words for strains and stresses other than engineering ones.
_LOGARITHMIC = {"true", "logarithmic", "log", "ln", "hencky", "wahre", "wahr", "logarithmische"}
_MEASURES = {
    "strain": {"logarithmic": _LOGARITHMIC | {"natural"}, "Green–Lagrange": {"green", "lagrange"}},
    "stress": {"true (Cauchy)": _LOGARITHMIC | {"cauchy"}},
}
# Words that add nothing to the name of a channel.
_PLAIN = {"engineering", "nominal", "compressive", "axial", "normal", "measured", "actual"}
_SIZES = {"height", "thickness", "length", "area"}  # words for the size of a specimen
# Words in brackets that are not units.
_ASIDE = _WORDS | _OTHER | _LOGARITHMIC | {"green", "lagrange", "cauchy", "natural"}
_TIMES = re.compile(r"[x×]\d+|\d+[x×]")  # force x10 (N): of what unit is unclear
# Units of mass that mean a weight if used for a force.
WEIGHTS = {"lb": "lbf", "lbs": "lbf", "kg": "kgf", "kgs": "kgf"}


@dataclass(frozen=True)
class Header:
    """Header of a column: text, words of the name, and unit if present."""

    text: str
    words: tuple[str, ...] = ()
    unit: str | None = None

    def measure(self, channel: str) -> str:
        """Return the measure of strain or stress named, "" for engineering measures."""
        named = _MEASURES.get(channel, {}).items()
        return next((measure for measure, words in named if words & set(self.words)), "")

    def qualifies(self, other: Header) -> bool:
        """Return whether the name is that of another column with more words."""
        return {*other.words} - _PLAIN < {*self.words} - _PLAIN

    @property
    def nameless(self) -> bool:
        """Whether the column may be any channel: its name says no channel and nothing else."""
        known = any(self.rank(channel) is not None for channel in CHANNELS)
        return bool(self.words) and not known and not {*self.words} & (_OTHER | _SIZES)

    def rank(self, channel: str) -> int | None:
        """Return how well the header names a channel: 0 is best, None not at all."""
        words, node = channel_of(channel).words.split(), interior_node(channel)
        poor = 4 if self.measure(channel) else 0
        numbers = [word for word in self.words if word.isdecimal()]
        if [int(number) for number in numbers] != ([] if node is None else [node]):
            return None  # displacement_1 is the channel of an interior mass
        rest = [word for word in self.words if word not in numbers]
        named = [w for w in rest if w in _WORDS and len(w) > 1]
        named = [w for w in named if w not in _BY_UNIT] or named
        if set(named) & _BY_UNIT and (self.unit is None or in_si(channel, self.unit) is None):
            return None
        if len(rest) == 1 and rest[0] in words:
            return poor + (rest[0] != words[0])
        if _OTHER & set(rest) or any(map(_TIMES.fullmatch, rest)):
            return None
        if not all(word in words for word in named):
            return None
        if named:
            return poor + 2
        return poor + WEAK if channel == "displacement" and _MOTION & set(rest) else None

    def is_named(self, name: str) -> bool:
        """Return whether a name in the TOML equals the header, with or without its unit."""
        bare = self.text.split("(")[0].split("[")[0]
        most = re.sub(r"[(\[][^(\[]*$", "", self.text)
        return name.casefold().split() in (t.casefold().split() for t in (self.text, bare, most))


def parse_header(text: str) -> Header:
    """Split a header into name and unit: stress (MPa), stress / MPa, stress_MPa or Time/ms."""
    text = text.strip()
    if len(text) > LONGEST:  # a title or a comment
        return Header(text)
    bracket = re.fullmatch(r"(.*)[(\[{]([^()\[\]{}]*)[)\]}]", text)
    bracket = bracket or re.fullmatch(r"(.+) (?:/|in) (\S+)", text)
    bracket = bracket or re.fullmatch(r"(.+?)\.\.(\S+)\.", text)  # Time..s., as R writes it
    bracket = bracket or re.fullmatch(r"(.+\w)(%)", text)
    if bracket:
        name, unit = bracket[1], bracket[2].strip()
        words = _words(f"{name} ({unit})")
        if not is_unit(unit, any_case=True):  # stress [MPa] (true), strain (Displacement)
            inner, aside = parse_header(name), {*_words(unit)}
            if inner.unit is not None or aside & _ASIDE:
                return Header(text, words, inner.unit)
        elif (other := parse_header(name).unit) and is_unit(other) and other != unit:
            unit = f"{other} or {unit}"  # force (N) (kN): which one is right is unknown
        return Header(text, _words(name), unit)
    tokens = re.split(r"[\s_]+", text.rstrip("_"))  # time_s_, as MATLAB writes time (s)
    for i in range(1, len(tokens)):
        rest = tokens[i:]
        if rest[0].lower() in _WORDS or rest[0].isdigit():
            continue
        unit = "/".join(token for token in rest if token.lower() != "per")  # m_s2, N_per_kg
        over = Header(text, _words(" ".join(tokens[:i])), unit)
        if is_unit(unit, any_case=True) and (len(unit) > 1 or unit == "V" or _fits(over)):
            return over  # but the A of "Channel A" is not ampere
    name, _, unit = (part.strip() for part in text.partition("/"))
    over = Header(text, _words(name), unit)
    return over if unit and _fits(over) else Header(text, _words(text))


def _fits(header: Header) -> bool:
    """Return whether the unit is valid for a channel named by the words."""
    unit = header.unit or ""
    return any(header.rank(c) is not None and in_si(c, unit) is not None for c in CHANNELS)


def _words(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case, without names of channels in brackets."""
    outside, inside = (re.split(r"[(\[{]([^()\[\]{}]*)[)\]}]", name)[i::2] for i in (0, 1))
    aside = [[word for word in _split(text) if word not in _WORDS] for text in [*inside, ""]]
    return tuple(w for text, more in zip(outside, aside, strict=True) for w in _split(text) + more)


def _split(name: str) -> list[str]:
    return [word for word in re.split(r"[\s_:;.,|#()\[\]{}\-–]+", name.lower()) if word]


def channel_of(name: str) -> Channel:
    """Return a channel by its name; "displacement_1" is a displacement."""
    return CHANNELS["displacement" if interior_node(name) else name]


def example(name: str) -> str:
    """Return an example of a channel's header."""
    return f"{name} ({channel_of(name).unit})"


def in_si(channel: str, unit: str, times: str = "") -> float | None:
    """Return the factor from `unit` · `times` to SI; a mass means its weight, g means gravity."""
    if channel == "acceleration" and unit in {"g", "G"}:
        unit = "standard_gravity"
    if channel == "force":
        unit = WEIGHTS.get(unit.casefold(), unit)
    if channel == "acceleration":  # mV/g
        times = re.sub(r"\bg\b", "standard_gravity", times)
    return factor(unit, channel_of(channel).si, times=times)
