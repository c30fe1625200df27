"""The parameters of a model: one flat vector, and how it becomes springs.

A model names its springs from the base up, joined by "+": "bistable", "linear+bistable", … Its
parameters are one flat vector in SI: for each spring its own (prefix s1_, s2_, …) with those of its
relaxation terms, then the heights of a chain, then `site_eta`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from foamfit.arrays import Array
from foamfit.errors import InputError
from foamfit.springs import laws
from foamfit.springs.chain import Chain, padded
from foamfit.springs.laws import followed
from foamfit.springs.laws.record import Law, Param
from foamfit.springs.parameters import direction, names_of, param_of
from foamfit.springs.spring import Spring

# Relaxation terms of a spring, and springs of a chain: no test tells so many apart.
MOST_TERMS, MOST_SPRINGS = 10, 20


@dataclass(frozen=True)
class Model:
    """Springs from the base up and the flat vector of their parameters.

    Parameters
    ----------
    kinds : tuple of str
        The law of each spring: "bistable", "microscale", "linear", "unilateral" (linear without
        tension), or one that is registered.
    relaxation : int
        Number of relaxation terms of every hysteretic spring.
    """

    kinds: tuple[str, ...]
    relaxation: int = 0

    @classmethod
    def parse(cls, name: str, relaxation: int = 0, options: tuple[str, ...] = ()) -> Model:
        """Read a model's name, for example "linear+bistable".

        `options` are those of the fit that free more parameters: see `laws.OPTIONS`.

        Raises
        ------
        InputError
            If a spring in it is unknown, there are too many of them or of relaxation terms, or no
            spring has the parameters of an option.
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
        known = laws.kinds()
        for kind in kinds:
            if kind not in known:
                raise InputError(
                    f"model '{name}': '{kind}' is not a spring; "
                    f"join {', '.join(known)} by '+', from the base up"
                )
        for option in options:
            having = [kind for kind in known if (option,) in laws.law(kind).options]
            if not set(having) & set(kinds):
                raise InputError(
                    f"--{option} needs a spring that has its parameters, and model '{name}' has "
                    f"none; take one with {' or '.join(having)}"
                )
        return cls(tuple(laws.with_options(kind, options) for kind in kinds), relaxation)

    @property
    def name(self) -> str:
        """The model's name, springs from the base up."""
        return "+".join(law.word or law.kind for law in self.laws)

    @cached_property
    def options(self) -> tuple[str, ...]:
        """Options that free the parameters of some springs; see `laws.OPTIONS`."""
        base = ((laws.law(law.word), law.kind) for law in self.laws if law.word)
        found = {o for one, kind in base for o, of in one.options.items() if of == kind}
        return max(found, key=len, default=())

    @cached_property
    def laws(self) -> tuple[Law, ...]:
        """The law of each spring."""
        return tuple(laws.law(kind) for kind in self.kinds)

    @cached_property
    def is_registered(self) -> bool:
        """Whether a spring follows a registered law, not one of the paper's."""
        return any(laws.is_registered(kind) for kind in self.kinds)

    def param(self, name: str) -> Param:
        """Record of a parameter of the model."""
        return param_of(self.kinds, name)

    @cached_property
    def own_places(self) -> tuple[int, ...]:
        """Place of the first own parameter of each spring in the flat vector."""
        return tuple(self.index[f"s{i}_{law.names[0]}"] for i, law in enumerate(self.laws, 1))

    def own(self, spring: int, values: Array) -> Array:
        """Own parameters and eta of a spring (0 at the base) in a flat vector, a view."""
        first = self.own_places[spring]
        return values[first : first + len(self.laws[spring].names)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters in the order of the flat vector."""
        names = [
            f"s{i}_{short}"
            for i, kind in enumerate(self.kinds, start=1)
            for short in names_of(kind, self.relaxation)
        ]
        if len(self.kinds) > 1:
            names += [f"s{i}_height" for i in range(1, len(self.kinds) + 1)]
        return (*names, "site_eta")

    @cached_property
    def index(self) -> dict[str, int]:
        """Place of each parameter in the flat vector."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def directions(self) -> NDArray[np.int64]:
        """Direction of the derivative by each parameter, (n, 2)."""
        terms = (self.relaxation,) * len(self.kinds)
        return np.array([direction(self.kinds, name, terms) for name in self.names])

    def rows(self, values: Array) -> Array | None:
        """Springs as the solver knows them, (n_springs, columns); None if one is not admissible."""
        rows = []
        for i, law in enumerate(self.laws):
            own = self.own(i, values)
            last = self.own_places[i] + own.size + 2 * self.relaxation * law.hysteretic
            terms = values[self.own_places[i] + own.size : last]
            if not self.is_registered:
                row = followed.solver_row(law, own, terms, self.relaxation)
            elif followed.row_of(law, own) is None or not own[-1] >= 0.0:
                row = None
            else:
                row = np.append(own, terms)
            if row is None:
                return None
            rows.append(row)
        return padded(rows)

    def heights(self, values: Array, total: float) -> Array:
        """Heights of the springs (m) in a specimen of height `total`."""
        count = len(self.kinds)
        return values[-1 - count : -1] if count > 1 else np.array([total])

    def springs(self, values: Array) -> tuple[Spring, ...]:
        """Springs of a flat vector of parameters.

        Raises
        ------
        ValueError
            If one is not admissible; the message names the parameter.
        """
        springs = []
        for i, law in enumerate(self.laws):
            own = self.own(i, values)
            first = self.own_places[i] + own.size
            pairs = values[first : first + 2 * self.relaxation * law.hysteretic].reshape(-1, 2)
            springs.append(law.make(own.tolist(), [(float(g), float(tau)) for g, tau in pairs]))
        return tuple(springs)

    def chain(self, values: Array, height: float, area: float) -> Chain:
        """Chain, massless inside, of a flat vector of parameters."""
        return Chain(
            self.springs(values),
            [float(h) for h in self.heights(values, height)],
            area,
            site_damping=float(values[-1]),
        )
