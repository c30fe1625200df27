"""What a law is: one record, by which everything else goes.

A law describes one kind of spring. Solver, search, statistics, report, page, scene file and options
ask its record and never which law it is: `Param` says all about a parameter, `Functions` follow the
spring along its strain, and the other fields of `Law` are optional.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.springs.loop import Loop

# The state of a spring along its strain begins with strain, stress (Pa) and the number of its
# branch; what else a law remembers follows.
EPS, SIGMA, BRANCH, OWN = 0, 1, 2, 3
LAST_STRAIN = 0.999

# What values of a parameter are admissible, in the words of a message.
ADMISSIBLE: dict[str, Callable[[float], bool]] = {
    "positive": lambda value: value > 0.0,
    "zero or positive": lambda value: value >= 0.0,
    "zero or negative": lambda value: value <= 0.0,
    "between 0 and 1": lambda value: 0.0 < value < 1.0,
    "at least 0 and less than 1": lambda value: 0.0 <= value < 1.0,
    "finite": math.isfinite,
}


class Between(NamedTuple):
    """Two ends that depend on other parameters: value = first + u (last - first).

    `of` names the others, `ends` gives (first, last) of their values, `slopes` the derivatives of
    both ends by each of them: ((dfirst, dlast), …).
    """

    of: tuple[str, ...]
    ends: Callable[..., tuple[float, float]]
    slopes: Callable[..., tuple[tuple[float, float], ...]]


@dataclass(frozen=True)
class Param:
    """One parameter of a law; "Your own law" in the documentation explains the fields.

    Numbers are multiples of a scale of the test: "one", "strain" (the largest), "stress" (the
    largest, Pa), "slope" (stress over strain, Pa), "damping" (Pa·s) or "duration" (s).
    """

    name: str  #: as in s1_<name>
    symbol: tuple[str, str] = ("", "")  #: letter and index, ("ε", "a")
    unit: str = ""  #: SI, "" for a pure number
    what: str = ""  #: what it is, in words for a table
    start: tuple[float, str] = (1.0, "one")  #: start value, where nothing is known, and its scale
    bounds: tuple[float, float] = (1e-3, 1e3)  #: limits of the search
    scale: str = "one"  #: the scale of `bounds`
    coordinate: str | Between = "logarithm"  #: what the search moves in; or "value", or Between
    box: tuple[float, float] | None = None  #: limits of the coordinate; by default `bounds`
    inner: tuple[float, float] | None = None  #: those of random start values; by default `box`
    least_size: float = 0.0  #: least share of its scale that its uncertainty is compared with
    admissible: str = "positive"  #: one of `ADMISSIBLE`
    neutral: float | None = None  #: the value at which the parameter has no effect
    branch: str = ""  #: the branch that a test must reach for the parameter to leave a trace
    example: str = ""  #: a value with its unit as a file states it

    @property
    def is_logarithmic(self) -> bool:
        """Whether the search moves in the logarithm."""
        return self.coordinate == "logarithm"

    @property
    def of(self) -> tuple[str, ...]:
        """Parameters that its coordinate is relative to."""
        return self.coordinate.of if isinstance(self.coordinate, Between) else ()

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest coordinate."""
        if self.box is not None:
            return self.box
        low, high = self.bounds
        return (math.log(low), math.log(high)) if self.is_logarithmic else (low, high)

    @cached_property
    def start_limits(self) -> tuple[float, float]:
        """Lowest and highest coordinate of random start values."""
        return self.limits if self.inner is None else self.inner

    @property
    def has_neutral(self) -> bool:
        """Whether the parameter may be zero, so that its interval tells whether it is there."""
        return self.neutral == 0.0


class Functions(NamedTuple):
    """How a spring is followed along its strain: functions that Numba compiles.

    "Your own law" in the documentation says what each must do.
    """

    fill: Callable[..., bool]  #: fill(values, row): write own parameters; False if not admissible
    begin: Callable[..., None]  #: begin(row, state): set the state of a spring at rest
    leaves: Callable[..., bool]  #: leaves(row, state, strain): whether the branch ends before it
    switch: Callable[..., None]  #: switch(row, state, up): to the end of the branch, and the next
    settle: Callable[..., None]  #: settle(row, state, strain): to a strain on the branch
    #: viscous(row, state, rate, h): stress (Pa) that depends on time, for the strain rate (1/s) and
    #: length (s) of the last step
    viscous: Callable[..., float] | None = None


class PointOf(NamedTuple):
    """A number that follows from the parameters, as the report lists it."""

    attribute: str  # of the spring
    symbol: tuple[str, str]
    what: str
    unit: str


class Compared(NamedTuple):
    """A row of the comparison with published parameters: a formula of parameters."""

    label: str
    unit: str
    of: tuple[str, ...]
    formula: Callable[..., Any]  # also of complex numbers, for its derivatives


def _no_neighbours(values: Array, top: float) -> Iterator[Array]:
    return iter(())


@dataclass(frozen=True, eq=False)
class Law:
    """A kind of spring."""

    kind: str  #: the word of a model's name: "bistable", "linear+bistable"
    #: its own parameters, in the order of `Functions.fill`; dashpot, relaxation terms and height
    #: come by themselves
    params: tuple[Param, ...]
    functions: Functions | Callable[[], Functions]  #: how it is followed, or a callable for these
    columns: int = 0  #: length of a row; by default one number per parameter
    states: int = OWN  #: length of a state; by default strain, stress and branch
    #: branches by their number, the first at rest: name and what the spring does on it
    branches: Mapping[str, str] = field(default_factory=lambda: {"line": "the law"})
    title: str = ""  #: the spring in words, "bistable spring"
    hysteretic: bool = True  #: whether it has a loop, and may relax
    #: makes the spring of own parameters, eta, and relaxation=; by default `register` gives one
    spring: Callable[..., Any] | None = None
    #: order of the coordinates of the search; by default those last that are relative to others
    searched: tuple[str, ...] = ()
    #: read_off(loop, marks, scales, way): own parameters and eta, read off a measured loop where
    #: `marks` (n,) in [0, 1] place them; without one, start values are random
    read_off: Callable[[Loop, Array, Any, int], Array] | None = None
    #: the same for one of several springs: (loop, marks, share of the height)
    read_in_series: Callable[[Loop, Array, float], Array] | None = None
    marks: int = 5  #: number of marks
    ways: int = 1  #: number of ways to read a loop
    #: stress at which the spring starts to snap, of its own parameters, by which exchangeable
    #: springs are ordered; by default the first parameter
    onset: Callable[..., float] | None = None
    scanned: str = ""  #: a parameter along which the cost may have several minima
    strata: str = ""  #: one over whose range the points from which the search descends are spread
    #: neighbours(values, largest stress): own parameters of springs with nearly the same loop, from
    #: which the search begins again
    neighbours: Callable[[Array, float], Iterator[Array]] = _no_neighbours
    #: (values, height) to stresses and elongations, and back: what springs in series exchange
    exchanged: tuple[Callable[[Array, float], Array], Callable[[Array, float], Array]] | None = None
    points: tuple[PointOf, ...] = ()  #: what the report lists beside the parameters
    compared: tuple[Compared, ...] = ()  #: what a comparison shows
    note: str = ""  #: what the report says about the marks of the figure
    inner_loops: bool = True  #: whether partial unloading leaves the branch
    remembers: bool = True  #: whether the spring remembers more than its branch
    published: bool = False  #: whether the paper publishes parameters of it
    numbered: tuple[str, ...] = ()  #: names of branches by numbers, if not those of `branches`
    #: options of a fit that free more parameters: the law with them
    options: Mapping[tuple[str, ...], str] = field(default_factory=dict)
    word: str = ""  #: the word of a model's name, where it is not `kind`
    #: places of derivatives by parameters, where these are not in the order of `params`
    places: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def own(self) -> tuple[str, ...]:
        """Names of its own parameters."""
        return tuple(param.name for param in self.params)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of its own parameters and of its dashpot."""
        return (*self.own, ETA.name)

    @cached_property
    def by_name(self) -> dict[str, Param]:
        """Its own parameters and the dashpot by their names."""
        return {param.name: param for param in (*self.params, ETA)}

    @property
    def wanted_marks(self) -> int:
        """Number of marks that start values are made of: of a law that reads none, all of them."""
        return self.marks if self.read_off is not None else len(self.params)

    @cached_property
    def search_order(self) -> tuple[str, ...]:
        """Its own parameters in an order in which each follows those that it is relative to."""
        if self.searched:
            return self.searched
        return tuple(param.name for param in sorted(self.params, key=lambda param: len(param.of)))

    @cached_property
    def needed(self) -> tuple[str, ...]:
        """Branches that some parameter needs a test to reach."""
        shown = {param.branch for param in self.params}
        return tuple(branch for branch in self.branches if branch in shown)

    def make(self, values: Sequence[float], relaxation: Sequence[tuple[float, float]]) -> Any:
        """Make the spring of its own parameters and eta; refuses what is not admissible."""
        if self.spring is None:
            raise InputError(f"law '{self.kind}' is not known yet: register it first")
        return self.spring(*values, **({"relaxation": relaxation} if self.hysteretic else {}))

    def loaded_functions(self) -> Functions:
        """Functions of the law, loaded where they are not given at once."""
        return self.functions if isinstance(self.functions, Functions) else self.functions()

    @cached_property
    def is_viscous(self) -> bool:
        """Whether its stress depends on time."""
        return self.loaded_functions().viscous is not None

    def assembled(self, chosen: Callable[[Param], float]) -> Array:
        """Own parameters from a choice for each: its place between its ends, or else its value."""
        values: dict[str, float] = {}
        for name in self.search_order:
            param = self.by_name[name]
            values[name] = chosen(param)
            if isinstance(param.coordinate, Between):
                first, last = param.coordinate.ends(*(values[other] for other in param.of))
                values[name] = first + values[name] * (last - first)
        return np.array([values[name] for name in self.own])

    def any_spring(self) -> Any:
        """Make some spring of the law, whatever its numbers: of it only the law counts."""
        own = self.assembled(lambda param: 0.2 if param.of else abs(param.start[0]) or 1.0)
        return self.make([*own, 0.0], ())

    def derivative(self, short: str) -> int:
        """Place of the derivative by one of its own parameters."""
        return self.places.get(short, self.own.index(short))

    def named_branch(self, number: int) -> str:
        """Name of a branch by its number."""
        return (self.numbered or tuple(self.branches))[number]


# Parameters that a spring has whatever its law.
ETA = Param(
    "eta", ("η", ""), "Pa s", "dashpot in parallel", (0.0, "damping"), (0.0, 10.0), "damping",
    "value", inner=(0.0, 0.3), least_size=0.1, admissible="zero or positive", neutral=0.0,
    example="100 Pa*s",
)  # fmt: skip
STRENGTH = Param(
    "g", ("g", ""), "", "strength of a relaxation term", (0.2, "one"), (0.0, 10.0), "one",
    "value", inner=(0.0, 1.0), least_size=0.1, admissible="zero or positive", example="0.5",
)  # fmt: skip
# The least time is about that of a sample, of which a record has 1500 at most: what relaxes faster
# acts as a dashpot, and explicit steps would have to follow it.
RELAXATION_TIME = Param(
    "tau", ("τ", ""), "s", "time of a relaxation term", (0.05, "duration"), (1e-3, 30.0),
    "duration", inner=(math.log(0.002), math.log(1.0)), example="0.2 s",
)  # fmt: skip
HEIGHT = Param(
    "height", ("h", ""), "m", "height of the spring", (1.0, "height"), (0.02, 0.98), "height",
    "value", example="1 mm",
)  # fmt: skip
COMMON = {param.name: param for param in (ETA, STRENGTH, RELAXATION_TIME, HEIGHT)}
