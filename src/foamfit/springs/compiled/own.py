"""A registered law, compiled to the contract of the solvers.

Its functions are plain formulas, compiled for complex numbers. Every derivative is the imaginary
part of the formula with an imaginary step in one of its arguments, exact to rounding (Squire &
Trapp 1998).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import cfunc, njit, types

from foamfit.springs.compiled.contract import (
    BRANCH,
    BY,
    BY_HELD,
    EPS,
    HIGH,
    INTERNAL,
    LOW,
    MISS,
    OF_LAW,
    RATE,
    SLOPE,
    TURNS,
    Compiled,
    X,
    past,
)

if TYPE_CHECKING:
    from foamfit.springs.laws.record import Law

STEP = 1e-40  # imaginary step
_F, _I, _P = types.float64, types.int64, types.CPointer(types.float64)
_PLAIN = {"error_model": "numpy"}


@njit(**_PLAIN)
def _no_rates(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    """Leave all rates at zero."""


@njit(**_PLAIN)
def _no_ends(p, x, strain, branch, out):  # type: ignore[no-untyped-def]
    """Leave the only branch without ends."""


@njit(**_PLAIN)
def _same(p, x, strain, branch, up):  # type: ignore[no-untyped-def]
    """Stay on the branch."""
    return branch


@njit(**_PLAIN)
def _no_stress(p, x, strain, rate, branch):  # type: ignore[no-untyped-def]
    return 0.0 * strain


def _ready(function: Any, otherwise: Any) -> Any:
    """Return a compiled function."""
    if function is None:
        return otherwise
    return function if hasattr(function, "py_func") else njit(**_PLAIN)(function)


def compile_law(law: Law) -> Compiled:
    """Compile a registered law."""
    given: Any = law.functions
    count, inside = len(law.params), law.internal
    stress, along, decay = (
        _ready(given.stress, None), _ready(given.along, _no_rates), _ready(given.decay, _no_rates)
    )  # fmt: skip
    ends, change = _ready(given.ends, _no_ends), _ready(given.switch, _same)
    viscous = _ready(given.viscous, _no_stress)
    admissible = given.admissible or (lambda p: True)
    values_of = 2 + 2 * inside

    def fill(values: Any, row: Any) -> bool:
        row[:count] = values
        fine: bool = bool(np.isfinite(values).all()) and bool(admissible(values))
        return fine

    @njit(**_PLAIN)
    def load(row, x, n, j, p, inner):  # type: ignore[no-untyped-def]
        """Copy parameters and internal variables of a point."""
        for c in range(count):
            p[c] = complex(row[c], 0.0)
        for k in range(inside):
            inner[k] = complex(x[k * n + j], 0.0)

    @njit(**_PLAIN)
    def all_of(p, inner, eps, rate, branch, out, one, two):  # type: ignore[no-untyped-def]
        """Fill σ, V, and the rates of the internal variables."""
        out[0] = stress(p, inner, eps, branch)
        out[1] = viscous(p, inner, eps, rate, branch)
        for k in range(inside):
            one[k] = two[k] = 0j
        along(p, inner, eps, branch, one)
        decay(p, inner, eps, branch, two)
        for k in range(inside):
            out[2 + k], out[2 + inside + k] = one[k], two[k]

    @cfunc(_F(_P, _P, _P, _P, _I, _I, _P), **_PLAIN)
    def evaluate(row, s, eps, x, n, want, out):  # type: ignore[no-untyped-def]
        p, inner = np.empty(count, np.complex128), np.empty(inside, np.complex128)
        found = np.empty(values_of, np.complex128)
        one, two = np.empty(inside, np.complex128), np.empty(inside, np.complex128)
        branch, step = int(s[BRANCH]), complex(0.0, STEP)
        for j in range(n):
            load(row, x, n, j, p, inner)
            strain, rate = complex(eps[j], 0.0), complex(s[RATE], 0.0)
            all_of(p, inner, strain, rate, branch, found, one, two)
            out[OF_LAW * n + j], out[MISS * n + j] = found[0].real, 0.0
            out[BY_HELD * n + j] = out[(BY_HELD + 1) * n + j] = 0.0
            at = BY + count
            for f in range(values_of):
                out[(at + f) * n + j] = found[f].real
            at += values_of
            for q in range(2 + inside + count):
                if (want == 0 and q > 0) or (want == 2 and not (q == 0 or 2 <= q < 2 + inside)):
                    continue
                if q == 0:
                    strain += step
                elif q == 1:
                    rate += step
                elif q < 2 + inside:
                    inner[q - 2] += step
                else:
                    p[q - 2 - inside] += step
                all_of(p, inner, strain, rate, branch, found, one, two)
                for f in range(values_of):
                    out[(at + q * values_of + f) * n + j] = found[f].imag / STEP
                load(row, x, n, j, p, inner)
                strain, rate = complex(eps[j], 0.0), complex(s[RATE], 0.0)
            out[SLOPE * n + j] = out[at * n + j]
            for c in range(count if want == 1 else 0):
                out[(BY + c) * n + j] = out[(at + (2 + inside + c) * values_of) * n + j]
        return 0.0

    @njit(**_PLAIN)
    def bound(row, s, p, inner):  # type: ignore[no-untyped-def]
        """Set the ends of the branch."""
        three = np.array([-math.inf, math.inf, 0.0])
        ends(p, inner, complex(s[EPS], 0.0), int(s[BRANCH]), three)
        s[LOW], s[HIGH], s[TURNS] = three[0], three[1], three[2]

    @cfunc(_F(_P, _P, _I, _P), **_PLAIN)
    def switch(row, s, up, out):  # type: ignore[no-untyped-def]
        p, inner = np.empty(count, np.complex128), np.empty(inside, np.complex128)
        turns, branch, x = s[TURNS] * (1.0 if up else -1.0) < 0.0, int(s[BRANCH]), past(s, X)
        if not turns:
            s[EPS] = s[HIGH] if up else s[LOW]
        wide = 1 + inside + count
        for q in range(wide):
            load(row, x, 1, 0, p, inner)
            strain = complex(s[EPS], 0.0)
            if q == 0:
                strain += complex(0.0, STEP)
            elif q <= inside:
                inner[q - 1] += complex(0.0, STEP)
            else:
                p[q - 1 - inside] += complex(0.0, STEP)
            change(p, inner, strain, branch, up > 0)
            for k in range(inside):
                out[k * wide + q] = inner[k].imag / STEP
        load(row, x, 1, 0, p, inner)
        s[BRANCH] = change(p, inner, complex(s[EPS], 0.0), branch, up > 0)
        for k in range(inside):
            x[k] = inner[k].real
        bound(row, s, p, inner)
        return 0.0

    @cfunc(_F(_P, _P), **_PLAIN)
    def begin(row, s):  # type: ignore[no-untyped-def]
        p, inner = np.empty(count, np.complex128), np.empty(inside, np.complex128)
        s[EPS], s[BRANCH] = 0.0, 0.0
        for k in range(inside):
            s[X + k] = 0.0
        load(row, past(s, X), 1, 0, p, inner)
        bound(row, s, p, inner)
        return 0.0

    @cfunc(_F(_P, _P, _F), **_PLAIN)
    def none(row, s, number):  # type: ignore[no-untyped-def]
        s[EPS] = number
        return 0.0

    made = (begin, evaluate, switch, none, none)
    kept.append(made)  # addresses stay valid
    return Compiled(fill, INTERNAL, count, count, inside, tuple(one.address for one in made))  # type: ignore[arg-type]


kept: list[Any] = []
