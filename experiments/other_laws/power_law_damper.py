"""The paper's bistable spring parallel to a power-law damper: Σ = σ(ε) + c |dε/dt|^n sign(dε/dt).

σ is the law of Thevamaran, Fraternali & Daraio 2014 (J. Appl. Mech. 81, 121006, eqs. 2-5); the
damper is that of their reference 22. c (Pa) is the stress at a strain rate of 1 1/s; n = 1 is a
dashpot, n near 0 dry friction.

Carretero-González, Khatri, Porter, Kevrekidis & Daraio 2009, Phys. Rev. Lett. 102, 024102.
"""

from dataclasses import replace

import numpy as np

import foamfit as ff
from foamfit.springs import laws
from foamfit.springs.laws import followed

PAPER = laws.law("bistable")
PAPER_FUNCTIONS = PAPER.loaded_functions()
COLUMNS, STATES = followed.sizes_of(PAPER)
paper_fill = PAPER_FUNCTIONS.fill


def fill(values, row):
    """Fill in the row of the paper's spring, then the damper."""
    row[COLUMNS], row[COLUMNS + 1] = values[7], values[8]
    return paper_fill(values[:7], row[:COLUMNS]) and values[7] >= 0.0 and values[8] > 0.0


def viscous(row, state, rate, h):
    """Return the stress of the damper."""
    force = row[COLUMNS] * abs(rate) ** row[COLUMNS + 1]
    return force if rate > 0.0 else -force


def read_off(loop, marks, scales, way):
    """Read the spring off the loop; the damper bears up to a tenth of the stress."""
    spring, n = PAPER.read_off(loop, marks, scales, way), 0.1 * 10.0 ** marks[5]
    rate = max(scales.rate, 1e-6)
    c = 0.1 * scales.stress * 10.0 ** (-1.5 * marks[6]) / rate**n
    return np.array([*spring[:7], c, n, 0.0])


LAW = replace(
    PAPER,
    kind="bistable-power-damper",
    title="bistable spring beside a power-law damper",
    params=(
        *PAPER.params,
        ff.Param(
            "c", ("c", ""), "Pa", "damping stress at 1 1/s", (0.02, "stress"), (1e-8, 1e2), "stress"
        ),
        ff.Param("n", ("n", ""), "", "exponent of the damper", (0.5, "one"), (0.02, 2.0)),
    ),
    functions=PAPER_FUNCTIONS._replace(fill=fill, viscous=viscous),
    columns=COLUMNS + 2,
    states=STATES,
    spring=None,
    searched=(*PAPER.searched, "c", "n"),
    read_off=read_off,
    read_in_series=None,
    marks=7,
    neighbours=lambda values, top: iter(()),
    exchanged=None,
    points=(),
    compared=(),
    published=False,
)  # fmt: skip
