"""The record of a law, which describes one kind of spring.

Solver, search, statistics, report, page, scene file and options use only this record and never
depend on a particular law. `Param` describes a parameter, `Functions` follow the spring along its
strain, and all other fields of `Law` are optional.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from foamfit.arrays import Array, Mask
from foamfit.errors import InputError

LAST_STRAIN = 0.999
CORNERS = 8  # corners of a polygon along loading, and along unloading
# What the scales of a test are without one: 1 MPa at a strain of 0.5 within 1 ms.
SCALES = {"one": 1.0, "strain": 0.5, "stress": 1e6, "slope": 2e6, "damping": 1e3, "duration": 1e-3}
# Directions of derivatives, beside the places of parameters in their law: dashpot, height, onsite
# damper, and from OWN_RELAXATION on g and τ of each relaxation term. The others are those of a
# drive: a shift of the prescribed motion of all samples in contact; of an impact its time of
# contact, velocity, and areal mass of the striker, kg/m².
OWN_ETA, OWN_HEIGHT, DRAG, OWN_RELAXATION = range(1_000_000, 1_000_004)
MOVED, BEGUN, STRUCK, HEAVIER = range(-4, 0)
# Conditions on the value of a parameter, by their wording in messages.
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

    `of` names these parameters, `ends` returns (first, last) for their values, and `slopes` the
    derivatives of both ends by each of them: ((dfirst, dlast), …).
    """

    of: tuple[str, ...]
    ends: Callable[..., tuple[float, float]]
    slopes: Callable[..., tuple[tuple[float, float], ...]]


@dataclass(frozen=True)
class Param:
    """One parameter of a law; "Your own law" in the documentation explains the fields.

    Numbers are multiples of a scale of the test: "one", "strain" (largest strain), "stress"
    (largest stress, Pa), "slope" (their ratio, Pa), "damping" (Pa·s) or "duration" (s).
    """

    name: str  #: as in s1_<name>
    symbol: tuple[str, str] = ("", "")  #: letter and index, ("ε", "a")
    unit: str = ""  #: SI, "" if dimensionless
    what: str = ""  #: description for tables
    start: tuple[float, str] = (1.0, "one")  #: default start value, and its scale
    bounds: tuple[float, float] = (1e-3, 1e3)  #: limits of the search
    scale: str = "one"  #: the scale of `bounds`
    coordinate: str | Between = "logarithm"  #: of the search: "logarithm", "value" or Between
    box: tuple[float, float] | None = None  #: limits of the coordinate; by default `bounds`
    inner: tuple[float, float] | None = None  #: limits of random start values; by default `box`
    least_size: float = 0.0  #: least size, relative to the scale, to judge uncertainty
    admissible: str = "positive"  #: one of `ADMISSIBLE`
    neutral: float | None = None  #: value at which the parameter has no effect
    branch: str = ""  #: branch that a test must reach to determine the parameter
    moves: str = ""  #: another branch, which it moves together with other parameters
    example: str = ""  #: a value with its unit, as in a file

    @property
    def label(self) -> str:
        """The symbol in plain text: k0, k_c, σ₊."""
        letter, index = self.symbol
        if index.strip("0+−"):
            return f"{letter}_{index}"
        return letter + index.translate(str.maketrans("+−", "₊₋")) or self.name

    @property
    def is_logarithmic(self) -> bool:
        """Whether the coordinate of the search is the logarithm."""
        return self.coordinate == "logarithm"

    @property
    def of(self) -> tuple[str, ...]:
        """Parameters on which its coordinate depends."""
        return self.coordinate.of if isinstance(self.coordinate, Between) else ()

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Limits of the coordinate."""
        if self.box is not None:
            return self.box
        low, high = self.bounds
        return (math.log(low), math.log(high)) if self.is_logarithmic else (low, high)

    @cached_property
    def start_limits(self) -> tuple[float, float]:
        """Limits of the coordinate of random start values."""
        return self.limits if self.inner is None else self.inner


class Functions(NamedTuple):
    """The formulas of a registered law; "Your own law" in the documentation specifies them.

    p is the tuple of the parameters, x the array of the internal variables, `strain` and `rate` are
    numbers, all complex; `branch` is the number of the branch.
    """

    stress: Callable[..., Any]  #: stress(p, x, strain, branch) -> σ, Pa
    along: Callable[..., None] | None = None  #: along(p, x, strain, branch, out): fill dx/dε
    decay: Callable[..., None] | None = None  #: decay(p, x, strain, branch, out): fill dx/dt, 1/s
    #: ends(p, x, strain, branch, out): fill strains at the lower and upper end of the branch, and
    #: 1 (-1) if it ends where the strain stops rising (falling)
    ends: Callable[..., None] | None = None
    #: switch(p, x, strain, branch, up) -> next branch; it may change x
    switch: Callable[..., int] | None = None
    #: viscous(p, x, strain, rate, branch): a stress (Pa) that depends on the strain rate (1/s)
    viscous: Callable[..., Any] | None = None
    admissible: Callable[[Array], bool] | None = None  #: admissible(p) -> bool, of real numbers


@dataclass(frozen=True, eq=False)
class Loop:
    """Loading and unloading stress (Pa) of a measured loop, from which laws read start values."""

    strain: Array
    stress: Array

    @cached_property
    def kinks(self) -> tuple[Array, Array, Array, Array]:
        """Return candidates for A1, C1, C2 and A2: strain and stress (k, 2) of bends of the loop.

        On loading the slope falls at A1 and rises at C1 (or the loop turns there). On unloading it
        falls at C2 and rises at A2 (or the loop ends).
        """
        peak = int(np.argmax(self.strain))
        ways = slice(peak + 1), slice(peak, None)
        up, down = (corners(self.strain[w], self.stress[w], CORNERS) for w in ways)
        out = []
        for line in (up, down[::-1]):
            steps = np.diff(line, axis=0)
            slopes = np.arctan2(
                steps[:, 1] / np.ptp(self.stress), steps[:, 0] / np.ptp(self.strain)
            )
            falls = np.append(False, np.append(np.diff(slopes) < 0.0, False))
            out.append((line[falls], line[1:-1][~falls[1:-1]]))
        (a1, c1), (a2, c2) = out
        a1 = a1 if len(a1) else up[1:2]
        return a1, np.vstack([c1, up[-1]]), np.vstack([c2, down[0]]), np.vstack([a2, down[-1]])

    def at(self, strain: float, *, loading: bool) -> float:
        """Return the stress (Pa) on loading up to the largest strain, or on unloading."""
        peak = int(np.argmax(self.strain))
        way = slice(peak + 1) if loading else slice(None, peak - 1 if peak else None, -1)
        return float(np.interp(strain, np.maximum.accumulate(self.strain[way]), self.stress[way]))


def corners(strain: Array, stress: Array, count: int) -> Array:
    """Return the corners of a polygon that approximates a curve, (count, 2), with its ends."""
    x, y = strain / (np.ptp(strain) or 1.0), stress / (np.ptp(stress) or 1.0)
    chosen = [0, x.size - 1]
    # Each is the sample farthest from the polygon so far, relative to the ranges of the curve.
    for _ in range(min(count, x.size) - 2):
        parts = np.clip(np.searchsorted(chosen, np.arange(x.size)), 1, len(chosen) - 1)
        low, high = np.array(chosen)[parts - 1], np.array(chosen)[parts]
        dx, dy = x[high] - x[low], y[high] - y[low]
        off = np.abs((x - x[low]) * dy - (y - y[low]) * dx) / np.maximum(np.hypot(dx, dy), 1e-12)
        chosen = sorted({*chosen, int(np.argmax(off))})
    return np.column_stack([strain, stress])[chosen]


class PointOf(NamedTuple):
    """A derived number that the report lists."""

    attribute: str  # of the spring
    symbol: tuple[str, str]
    what: str
    unit: str


class Compared(NamedTuple):
    """A row of the comparison with published parameters: a function of the parameters."""

    label: str
    unit: str
    of: tuple[str, ...]
    formula: Callable[..., Any]  # must accept complex numbers, for its derivatives


def _no_neighbours(values: Array, top: float) -> Iterator[Array]:
    return iter(())


@dataclass(frozen=True, eq=False)
class Law:
    """A kind of spring."""

    kind: str  #: name in models: "bistable", "linear+bistable"
    #: parameters, without dashpot, relaxation terms and height
    params: tuple[Param, ...]
    functions: Functions | Any  #: or the name of a built-in law, or compiled functions
    internal: int = 0  #: number of internal variables
    #: branches in the order of their numbers, the first at rest: name and description
    branches: Mapping[str, str] = field(default_factory=lambda: {"line": "the law"})
    title: str = ""  #: name in words, "bistable spring"
    hysteretic: bool = True  #: whether it has a loop and may relax
    #: makes a spring from the parameters, eta and relaxation=; `register` sets a default
    spring: Callable[..., Any] | None = None
    #: order of the coordinates of the search; by default dependent ones last
    searched: tuple[str, ...] = ()
    #: read_off(loop, marks, scales, way): parameters and eta read off a measured loop at places
    #: given by `marks` (n,) in [0, 1]; without it, start values are random
    read_off: Callable[[Loop, Array, Any, int], Array] | None = None
    #: the same for one of several springs: (loop, marks, fraction of the height)
    read_in_series: Callable[[Loop, Array, float], Array] | None = None
    #: likely(values, seen, marks): parameters of a foam like those published, about the `seen` ones
    #: of `values`, for branches that no test has reached; marks (n_params,) are in [0, 1]
    likely: Callable[[Array, Mask, Array], Array] | None = None
    #: fewer(values, largest stress): parameters of springs that stay on their first branches
    fewer: Callable[[Array, float], Iterator[Array]] = _no_neighbours
    marks: int = 5  #: number of marks
    ways: int = 1  #: number of ways to read a loop
    #: stress of the first snap as a function of the parameters, by which interchangeable springs
    #: are sorted; by default the first parameter
    onset: Callable[..., float] | None = None
    #: neighbours(values, largest stress): parameters of springs with nearly the same loop, which
    #: the search tries as further start points
    neighbours: Callable[[Array, float], Iterator[Array]] = _no_neighbours
    #: (values, height) to the stresses and elongations that springs exchange, and back
    exchanged: tuple[Callable[[Array, float], Array], Callable[[Array, float], Array]] | None = None
    points: tuple[PointOf, ...] = ()  #: derived numbers in the report
    #: rows of a comparison, or names of parameters; by default all parameters
    compared: tuple[Compared | str, ...] = ()
    note: str = ""  #: sentence of the report on the marks of the figure
    #: whether its state is more than its branch, so that partial unloading leaves the branch
    remembers: bool = True
    word: str = ""  #: name in models, if it is not `kind`
    #: indices of derivatives by parameters, if not in the order of `params`
    places: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def own(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(param.name for param in self.params)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters and of the dashpot."""
        return (*self.own, ETA.name)

    @cached_property
    def by_name(self) -> dict[str, Param]:
        """The parameters and the dashpot by their names."""
        return {param.name: param for param in (*self.params, ETA)}

    @property
    def wanted_marks(self) -> int:
        """Number of marks for start values; without `read_off`, one per parameter."""
        return self.marks if self.read_off is not None else len(self.params)

    @cached_property
    def search_order(self) -> tuple[str, ...]:
        """The parameters in an order in which each follows those that it depends on."""
        if self.searched:
            return self.searched
        return tuple(param.name for param in sorted(self.params, key=lambda param: len(param.of)))

    @cached_property
    def needed(self) -> tuple[str, ...]:
        """Branches that a test must reach to determine some parameter."""
        shown = {param.branch for param in self.params}
        return tuple(branch for branch in self.branches if branch in shown)

    def make(self, values: Sequence[float], relaxation: Sequence[tuple[float, float]]) -> Any:
        """Return a spring of these parameters and eta; InputError if they are not admissible."""
        if self.spring is None:
            raise InputError(f"law '{self.kind}' is not known yet: register it first")
        return self.spring(*values, **({"relaxation": relaxation} if self.hysteretic else {}))

    @property
    def is_viscous(self) -> bool:
        """Whether the stress depends on time."""
        given = self.functions
        return isinstance(given, Functions) and bool(given.viscous or given.decay)

    def assembled(self, chosen: Callable[[Param], float]) -> Array:
        """Return parameters from a choice for each: its position between its ends, or its value."""
        values: dict[str, float] = {}
        for name in self.search_order:
            param = self.by_name[name]
            values[name] = chosen(param)
            if isinstance(param.coordinate, Between):
                first, last = param.coordinate.ends(*(values[other] for other in param.of))
                values[name] = first + values[name] * (last - first)
        return np.array([values[name] for name in self.own])

    def any_spring(self, terms: int = 0) -> Any:
        """Return a spring with the start values of the parameters, and relaxation terms."""
        return self.make([*self.start_values, 0.0], ((0.0, 1.0),) * terms)

    @property
    def start_values(self) -> Array:
        """The start values of the parameters where no test gives a scale, see `SCALES`."""
        return self.assembled(lambda p: 0.5 if p.of else p.start[0] * SCALES[p.start[1]])

    def named_branch(self, number: int) -> str:
        """Return the name of a branch by its number."""
        return tuple(self.branches)[number]


# Parameters of springs of all laws.
ETA = Param(
    "eta", ("η", ""), "Pa s", "dashpot in parallel", (0.0, "damping"), (0.0, 10.0), "damping",
    "value", inner=(0.0, 0.3), least_size=0.1, admissible="zero or positive", neutral=0.0,
    example="100 Pa*s",
)  # fmt: skip
STRENGTH = Param(
    "g", ("g", ""), "", "strength of a relaxation term", (0.2, "one"), (0.0, 10.0), "one",
    "value", inner=(0.0, 1.0), least_size=0.1, admissible="zero or positive", example="0.5",
)  # fmt: skip
# The least time is about the interval of a record with 1500 samples: faster relaxation acts as a
# dashpot, and explicit steps would have to resolve it.
RELAXATION_TIME = Param(
    "tau", ("τ", ""), "s", "time of a relaxation term", (0.05, "duration"), (1e-3, 30.0),
    "duration", inner=(math.log(0.002), math.log(1.0)), example="0.2 s",
)  # fmt: skip
HEIGHT = Param(
    "height", ("h", ""), "m", "height of the spring", (1.0, "height"), (0.02, 0.98), "height",
    "value", example="1 mm",
)  # fmt: skip
COMMON = {param.name: param for param in (ETA, STRENGTH, RELAXATION_TIME, HEIGHT)}
