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
from foamfit.springs import kernels, microscale_kernels
from foamfit.springs.chain import Chain
from foamfit.springs.parameters import HYSTERETIC, KINDS, direction, names_of
from foamfit.springs.spring import BistableSpring, LinearSpring, MicroscaleSpring, Spring

# Relaxation terms of a spring, and springs of a chain: no test tells so many apart.
MOST_TERMS, MOST_SPRINGS = 10, 20


@dataclass(frozen=True)
class Model:
    """Springs from the base up and the flat vector of their parameters.

    Parameters
    ----------
    kinds : tuple of str
        "bistable", "microscale", "linear" or "unilateral" (linear without tension) for each spring.
    relaxation : int
        Number of relaxation terms of every hysteretic (bistable or microscale) spring.
    """

    kinds: tuple[str, ...]
    relaxation: int = 0

    @classmethod
    def parse(cls, name: str, relaxation: int = 0) -> Model:
        """Read a model's name, for example "linear+bistable".

        Raises
        ------
        InputError
            If a spring in it is unknown, or there are too many of them or of relaxation terms.
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
        for kind in kinds:
            if kind not in KINDS:
                raise InputError(
                    f"model '{name}': '{kind}' is not a spring; "
                    f"join {', '.join(KINDS)} by '+', from the base up"
                )
        return cls(kinds, relaxation)

    @property
    def name(self) -> str:
        """The model's name, springs from the base up."""
        return "+".join(self.kinds)

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

    @cached_property
    def _codes(self) -> NDArray[np.int64]:
        return np.array([KINDS.index(kind) for kind in self.kinds])

    def rows(self, values: Array) -> Array | None:
        """Springs as the kernels know them, (n_springs, columns); None if one is not admissible."""
        rows = np.zeros((len(self.kinds), kernels.N_COLUMNS + 2 * self.relaxation))
        plain = self.relaxation == 0 and "microscale" not in self.kinds
        fill = kernels.fill_rows if plain else microscale_kernels.fill_rows
        return rows if fill(self._codes, values, rows) else None

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
        springs: list[Spring] = []
        at = 0
        for kind in self.kinds:
            if kind in HYSTERETIC:
                make = BistableSpring if kind == "bistable" else MicroscaleSpring
                own, more = map(float, values[at : at + 8]), values[at + 8 :]
                terms = [
                    (float(more[2 * k]), float(more[2 * k + 1])) for k in range(self.relaxation)
                ]
                springs.append(make(*own, relaxation=terms))
                at += 8 + 2 * self.relaxation
            else:
                k0, eta = map(float, values[at : at + 2])
                springs.append(LinearSpring(k0, eta, kind == "unilateral"))
                at += 2
        return tuple(springs)

    def chain(self, values: Array, height: float, area: float) -> Chain:
        """Chain, massless inside, of a flat vector of parameters."""
        return Chain(
            self.springs(values),
            [float(h) for h in self.heights(values, height)],
            area,
            site_damping=float(values[-1]),
        )
