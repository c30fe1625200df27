"""Errors raised by foamfit."""


class InputError(ValueError):
    """A file, key, column, option or argument is wrong; the message says what would be right.

    Any other ValueError, as numpy's LinAlgError is one, is a defect of foamfit.
    """


class SimulationError(RuntimeError):
    """A simulation cannot go on; the message says why. A simulation never returns NaN instead."""
