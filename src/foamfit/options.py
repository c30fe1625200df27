"""The options of a fit: the table of their names, types, units, defaults and admissible values.

The command line, `foamfit.fit`, batches, study files and the page are made from it. It imports
nothing of the package but errors, so every room may use it.
"""

from __future__ import annotations

import difflib
import inspect
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Any, Self, TypedDict, TypeVar

from foamfit.errors import InputError

# Called with the `Problem` and the best point, an array, many times a second, so it must be quick.
Watch = Callable[[Any, Any], None]
F = TypeVar("F", bound=Callable[..., Any])

DRIVES = ("impact", "stress", "displacement")
METHODS = ("auto", "local", "profile", "mcmc")  # of the intervals
# Links of a parameter between several tests; see `fitting.together`.
LOG_RATE, POWER_RATE = "log rate", "power rate"
RATES = (LOG_RATE, POWER_RATE)
KINDS = ("shared", "own", "scatter", *RATES)
# Start points per spring, per spring if several are hysteretic, and the largest number in all.
STARTS, STARTS_IN_SERIES, MOST_STARTS = 16, 24, 100_000
MOST_TERMS = 10  # relaxation terms
DRAWS, LEAST_DRAWS, MOST_DRAWS = 2000, 100, 100_000  # steps of a Markov chain


@dataclass(frozen=True)
class Option:
    """One option: `name` is the keyword of `foamfit.fit` and the key in TOML and fit.json."""

    name: str
    kind: str  # int, float, bool, str, mapping, sequence of str, callable
    told: str  # what it is, in sentences
    default: Any = None
    usual: str = ""  # what a default of None means
    unit: str = ""
    choices: tuple[str, ...] = ()
    least: int = 0  # smallest whole number; any other must be greater than zero
    most: int | None = None
    metavar: str = ""  # of the value on the command line
    like: str = ""  # an example of a mapping
    python_only: bool = False
    frees: tuple[str, ...] = ()  # parameters of some springs that it frees

    @property
    def flag(self) -> str:
        """The option of the command."""
        return f"--{self.name.replace('_', '-')}"

    @property
    def text(self) -> str:
        """What it is, and its default where that needs words."""
        return f"{self.told} Default: {self.usual}." if self.usual else self.told

    @property
    def right(self) -> str:
        """Admissible values, in words; "" if they are not those of a number or a list."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        if self.kind == "int":
            end = "up" if self.most is None else f"to {self.most}"
            return f"a whole number from {self.least} {end}"
        if self.kind == "float":
            return f"positive, in {self.unit}"
        return f"a mapping like {self.like}" if self.kind == "mapping" else ""

    def admits(self, value: Any) -> bool:
        """Return whether a value is admissible; None is the default."""
        if (value is None and self.default is None) or not self.right:
            return True
        if self.choices:
            return value in self.choices
        if self.kind == "int":
            most = math.inf if self.most is None else self.most
            return isinstance(value, Integral) and self.least <= int(value) <= most
        if self.kind == "float":
            return isinstance(value, Real) and float(value) > 0
        return isinstance(value, Mapping)


def option(told: str, default: Any = None, **more: Any) -> Any:
    """Declare a field of `Given`; `more` are attributes of `Option`."""
    return field(default=default, metadata={"told": told, **more})


@dataclass(frozen=True)
class Given:
    """The options of a fit. Raises InputError if a value is not admissible."""

    drive: str | None = option(
        "Quantity that moves the chain.",
        choices=DRIVES,
        usual="impact if striker and time are known and the record does not contradict them, else "
        "displacement",
    )
    seed: int = option("The same test and seed give the same numbers.", 0)
    starts: int | None = option(
        "Start points of the search.",
        least=1,
        most=MOST_STARTS,
        usual=f"{STARTS} per spring, {STARTS_IN_SERIES} if several are hysteretic",
    )
    max_time: float | None = option(
        "Time limit; the best point so far is returned.", unit="s", metavar="SECONDS"
    )
    fix: Mapping[str, float] | None = option(
        "Fix a parameter (SI).", metavar="NAME=VALUE", unit="SI", like="{'s1_eta': 0}"
    )
    vary: Sequence[str] = option("Vary a parameter that is fixed by default.", (), metavar="NAME")
    interior_mass: bool = option(
        "Distribute the specimen's mass equally between the springs instead of neglecting it.",
        False,
    )
    time_shift: bool = option(
        "Fit the delay of the motion relative to the force (time_shift).", False
    )
    relaxation: int = option(
        "Number of relaxation terms of every hysteretic spring (s1_g1, s1_tau1); auto tries one by "
        "itself.",
        0,
        most=MOST_TERMS,
        metavar="N",
    )
    stiffening: bool = option(
        "Fit the stiffening of branch a of microscale springs.", False, frees=("stiffening",)
    )
    mullins: bool = option(
        "Fit softening and weakening after the first snap of microscale springs.",
        False,
        frees=("softening", "weakening"),
    )
    intervals: str = option(
        "Method of the 95 % intervals: auto is the local covariance, and profiles of the "
        "parameters along which the cost is not parabolic, unless the law errs.",
        "auto",
        choices=METHODS,
        python_only=True,
    )
    draws: int | None = option(
        "Number of steps of the Markov chain.",
        least=LEAST_DRAWS,
        most=MOST_DRAWS,
        usual=str(DRAWS),
        python_only=True,
    )
    weights: Mapping[str, float] | None = option(
        "Weight of each curve, by its name in `FitResult.misfit`.",
        like="{'stress_time': 1}",
        python_only=True,
    )
    priors: Mapping[str, str | tuple[float, float]] | None = option(
        "Normal prior distributions of spring parameters as mean and standard deviation: (5.5e6, "
        '1e5) in SI units, or "5.5 ± 0.1 MPa". Each counts as one residual. They are added to '
        "[priors] of the TOML.",
        like="{'s1_k0': '5.5 ± 0.1 MPa'}",
        unit="SI",
        python_only=True,
    )
    watch: Watch | None = option(  # noqa: RUF009  (a field)
        "Called with the problem and the best parameters whenever these improve; it must return "
        "quickly.",
        python_only=True,
    )

    @classmethod
    def of(cls, function: str, given: Mapping[str, Any]) -> Self:
        """Make options from the keyword arguments of `function`; TypeError for an unknown one."""
        for name in given.keys() - cls.__dataclass_fields__.keys():
            near = difflib.get_close_matches(name, cls.__dataclass_fields__, 1)
            meant = f"; did you mean {near[0]!r}?" if near else ""
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}{meant}")
        return cls(**given)

    def __post_init__(self) -> None:
        """Reject inadmissible values."""
        for name, one in OF_FIT.items():
            if not one.admits(value := getattr(self, name)):
                raise InputError(f"{name} = {value!r} is not admissible; it must be {one.right}")


class Keywords(TypedDict, total=False):
    """The fields of `Given` as keyword arguments, for type checkers and editors."""

    drive: str | None
    seed: int
    starts: int | None
    max_time: float | None
    fix: Mapping[str, float] | None
    vary: Sequence[str]
    interior_mass: bool
    time_shift: bool
    relaxation: int
    stiffening: bool
    mullins: bool
    intervals: str
    draws: int | None
    weights: Mapping[str, float] | None
    priors: Mapping[str, str | tuple[float, float]] | None
    watch: Watch | None


_KINDS = {"Mapping": "mapping", "Sequence": "sequence of str", "Watch": "callable"}
OF_FIT = {
    one.name: Option(
        one.name,
        _KINDS.get(found := re.findall(r"\w+", str(one.type))[0], found),
        default=one.default,
        **one.metadata,
    )
    for one in fields(Given)
}
_BEFORE = (  # which test and which model
    Option(
        "specimen",
        "str",
        "TOML of specimen, striker, columns, noise, window, data.",
        usual="TEST.toml beside the CSV",
        metavar="FILE.toml",
    ),
    Option(
        "cycle",
        "int",
        "Cycle of a slow record: a number, several as 1,2,10, or all.",
        least=1,
        usual="the first",
        metavar="N|all",
    ),
    Option(
        "cycles",
        "sequence of int",
        "Fit several cycles of a slow record as one history, with one set of parameters.",
        metavar="FIRST-LAST",
    ),
    Option(
        "model",
        "str",
        "Springs from the base up, joined by +; auto selects the simplest model that describes the "
        "curves.",
        "bistable",
    ),
)
_AFTER = (  # what the command calls two of the intervals
    Option("profile", "bool", "95 % intervals by profile likelihood."),
    Option(
        "mcmc",
        "int",
        "95 % intervals by N steps of emcee.",
        least=LEAST_DRAWS,
        most=MOST_DRAWS,
        metavar="N",
    ),
)
OPTIONS = {one.name: one for one in (*_BEFORE, *OF_FIT.values(), *_AFTER)}
FREED = {name: one.frees for name, one in OF_FIT.items() if one.frees}


def documented(function: F) -> F:
    """Replace the entry `**options` in the docstring of a function by one entry per option."""
    entries = []
    for name, one in OF_FIT.items():
        kind = one.kind if one.default is not None else f"{one.kind}, optional"
        default = "" if one.default is None else f"Default: {one.default!r}."
        right = f"{one.right[:1].upper()}{one.right[1:]}." if one.right else ""
        freed = f"Parameters: {', '.join(f's1_{free}' for free in one.frees)}." if one.frees else ""
        unit = f"Unit: {one.unit}." if one.unit and one.unit not in one.text else ""
        words = filter(None, (one.text, default, right, freed, unit))
        text = textwrap.fill(" ".join(words), 92, initial_indent="    ", subsequent_indent="    ")
        entries.append(f"{name} : {kind}\n{text}")
    text = inspect.getdoc(function) or ""
    function.__doc__ = re.sub(
        r"^\*\*options\n(    .*\n)+", lambda _: "\n".join(entries) + "\n", text, flags=re.MULTILINE
    )
    return function
