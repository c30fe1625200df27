"""The ways in which foamfit says no, each in one sentence that says what would be right."""


class InputError(ValueError):
    """A file, key, column or option is wrong; the message names it and says what would be right."""


class SimulationError(RuntimeError):
    """A simulation cannot go on; the message says why. A simulation never returns NaN instead."""


def printable(text: str) -> str:
    """Return a text without control characters, for a terminal; names and paths may hold some."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)
