"""Models, and the flat vector of their parameters.

A model names its springs from the base up, joined by "+": "bistable", "linear+bistable", … The flat
vector (SI) has the parameters of each spring (prefix s1_, s2_, …) with its relaxation terms, then
the heights of a chain, then `site_eta`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.options import FREED, MOST_TERMS
from foamfit.springs import laws
from foamfit.springs.chain import Chain
from foamfit.springs.compiled import compiled, fill_row
from foamfit.springs.laws.record import COMMON, Law, Param
from foamfit.springs.parameters import direction, family, names_of, split_name
from foamfit.springs.spring import Spring

if TYPE_CHECKING:
    from foamfit.springs.compiled.contract import Compiled

MOST_SPRINGS = 20  # no test can distinguish more


@dataclass(frozen=True)
class Model:
    """The springs of a model, from the base up, and the flat vector of their parameters.

    `kinds` names the law of each spring; `relaxation` is the number of relaxation terms of every
    hysteretic one.
    """

    kinds: tuple[str, ...]
    relaxation: int = 0

    @classmethod
    def parse(cls, name: str, relaxation: int = 0) -> Model:
        """Parse the name of a model, for example "linear+bistable".

        Raises
        ------
        InputError
            If a spring in it is unknown, there are too many of them or of relaxation terms, or no
            spring relaxes.
        """
        if type(relaxation) is not int or not 0 <= relaxation <= MOST_TERMS:
            raise InputError(
                f"relaxation = {relaxation!r} must be a whole number from 0 (none) to {MOST_TERMS}"
            )
        if not isinstance(name, str):
            raise InputError(f"model = {name!r} must be a text like 'linear+bistable'")
        kinds = tuple(part.strip() for part in name.split("+"))
        if len(kinds) > MOST_SPRINGS:
            raise InputError(
                f"a model of {len(kinds)} springs; it must have {MOST_SPRINGS} at most"
            )
        known = [law.kind for law in laws.records()]
        for kind in kinds:
            if kind not in known:
                raise InputError(
                    f"model '{name}': '{kind}' is not a spring; "
                    f"join {', '.join(laws.kinds())} by '+', from the base up"
                )
        if relaxation and not any(laws.law(kind).hysteretic for kind in kinds):
            raise InputError(
                f"model '{name}' has no hysteretic spring that could relax; leave relaxation out"
            )
        return cls(kinds, relaxation)

    @classmethod
    def of_result(cls, content: Mapping[str, Any]) -> Model:
        """Return the model of a result (fit.json, joint.json); InputError if it is unknown."""
        options = {name: content.get(name) is True for name in FREED}
        return cls.parse(with_options(content["model"], **options), content.get("relaxation", 0))

    @property
    def name(self) -> str:
        """The name of the model, springs from the base up, with the options of each."""
        return "+".join(self.kinds)

    @property
    def words(self) -> str:
        """The name of the model as `--model` takes it, without options."""
        return "+".join(law.word or law.kind for law in self.laws)

    @property
    def has_several(self) -> bool:
        """Whether it has more than one hysteretic spring."""
        return sum(law.hysteretic for law in self.laws) > 1

    @property
    def options(self) -> dict[str, bool]:
        """The options that free further parameters of some spring; see `foamfit.options`."""
        return {name: any(name in kind.split(", ") for kind in self.kinds) for name in FREED}

    @cached_property
    def laws(self) -> tuple[Law, ...]:
        """The law of each spring."""
        return tuple(laws.law(kind) for kind in self.kinds)

    def param(self, name: str) -> Param:
        """Return the record of a parameter."""
        spring, short = split_name(name)
        return COMMON.get(family(short)) or self.laws[spring].by_name[short]

    @cached_property
    def own_places(self) -> tuple[int, ...]:
        """Index of the first parameter of each spring in the flat vector."""
        return tuple(self.index[f"s{i}_{law.names[0]}"] for i, law in enumerate(self.laws, 1))

    def own(self, spring: int, values: Array) -> Array:
        """Return a view of the parameters and eta of a spring (0 = base) in a flat vector."""
        first = self.own_places[spring]
        return values[first : first + len(self.laws[spring].names)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the flat vector."""
        names = [
            f"s{i}_{short}"
            for i, law in enumerate(self.laws, start=1)
            for short in names_of(law, self.relaxation)
        ]
        if len(self.kinds) > 1:
            names += [f"s{i}_height" for i in range(1, len(self.kinds) + 1)]
        return (*names, "site_eta")

    @cached_property
    def index(self) -> dict[str, int]:
        """Index of each parameter in the flat vector."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def directions(self) -> NDArray[np.int64]:
        """Direction of the derivative by each parameter, (n, 2)."""
        terms = (self.relaxation,) * len(self.kinds)
        return np.array([direction(self.laws, name, terms) for name in self.names])

    def rows(self, values: Array) -> Array | None:
        """Return the rows for the solver, (n_springs, columns); None if not admissible."""
        made, width = self._compiled
        out = np.zeros((len(made), width))
        for row, (law, own, terms) in zip(out, made, strict=True):
            if not fill_row(law, values[own], values[terms], self.relaxation, row):
                return None
        return out

    @cached_property
    def _compiled(self) -> tuple[list[tuple[Compiled, slice, slice]], int]:
        """The compiled law of each spring, and the places of its parameters and its terms."""
        made = []
        for law, first in zip(self.laws, self.own_places, strict=True):
            end = first + len(law.names)
            last = end + 2 * self.relaxation * law.hysteretic
            made.append((compiled(law), slice(first, end), slice(end, last)))
        width = max(one.columns for one, *_ in made)
        return made, 1 + 2 * self.relaxation + width

    def heights(self, values: Array, total: float) -> Array:
        """Return the heights of the springs (m) in a specimen of height `total`."""
        count = len(self.kinds)
        return values[-1 - count : -1] if count > 1 else np.array([total])

    def springs(self, values: Array) -> tuple[Spring, ...]:
        """Return the springs of a flat vector; InputError if one is not admissible."""
        return tuple(
            law.make(values[own].tolist(), list(zip(*values[terms].reshape(-1, 2).T, strict=True)))
            for law, (_, own, terms) in zip(self.laws, self._compiled[0], strict=True)
        )

    def chain(self, values: Array, height: float, area: float) -> Chain:
        """Return the chain of a flat vector, without interior masses."""
        return Chain(
            self.springs(values),
            [float(h) for h in self.heights(values, height)],
            area,
            site_damping=float(values[-1]),
        )


def with_options(model: str, **options: bool) -> str:
    """Return the name of a model with options that free further parameters.

    `model` is the name without options, or "auto"; `options` are those of `FREED`. Raises
    InputError for an option that applies to no spring of the model.
    """
    if unknown := [name for name in options if name not in FREED]:
        raise TypeError(f"unexpected option {unknown[0]!r}; there are {', '.join(FREED)}")
    asked = tuple(name for name in FREED if options.get(name))
    if not asked:
        return model
    if model == "auto":
        raise InputError(f"{asked[0]} belongs to one model; name it instead of 'auto'")
    read = Model.parse(model)
    asked = tuple(name for name in FREED if name in asked or read.options[name])
    kinds = read.words.split("+")
    for name in asked:
        if not any(name in laws.options_of(kind) for kind in kinds):
            having = [kind for kind in laws.kinds() if name in laws.options_of(kind)]
            raise InputError(
                f"{name} needs a {' or '.join(having)} spring, and the model '{read.words}' has "
                f"none; take model {having[0]}, or leave {name} out"
            )
    return "+".join(laws.with_options(kind, asked) for kind in kinds)


def neighbours(model: Model, values: Array, top: float) -> Iterator[Array]:
    """Yield parameters with nearly the same loop up to the stress `top`, Pa (`Law.neighbours`)."""
    for spring, law in enumerate(model.laws):
        for near in law.neighbours(model.own(spring, values)[:-1], top):
            moved = values.copy()
            model.own(spring, moved)[:-1] = near
            yield moved


def exchanges(model: Model, values: Array) -> Iterator[Array]:
    """Yield chains in which two springs of one kind have exchanged some properties.

    The elongations of springs under a common stress add up. Properties are therefore exchanged as
    stresses and elongations (`Law.exchanged`): the springs snap at the same stresses, and the rest
    of the loop changes little. Nuisance parameters at the end of `values` (n,) do not change.
    """
    index, laws = model.index, model.laws
    for pair in combinations(range(len(laws)), 2):
        law, other = (laws[i] for i in pair)
        if law is not other or law.exchanged is None:
            continue
        to_stresses, from_stresses = law.exchanged
        names = [f"s{i + 1}_height" for i in pair]
        heights = [float(values[index[n]]) if n in index else 1.0 for n in names]
        own = [
            to_stresses(model.own(i, values)[:-1], height)
            for i, height in zip(pair, heights, strict=True)
        ]
        count = len(law.params)
        for bits in range(1, 2 ** (count - 1)):
            chosen = np.array([bool(bits >> k & 1) for k in range(count)])
            out = values.copy()
            for i, height, mine, their in zip(pair, heights, own, own[::-1], strict=True):
                mixed = np.where(chosen, their, mine)
                model.own(i, out)[:-1] = from_stresses(mixed, height)
            yield out
