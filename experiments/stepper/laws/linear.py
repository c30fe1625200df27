"""The linear spring as a law of the stepper."""

import math

import numpy as np
from contract import BY, HIGH, LOW, MISS, SLOPE, TURNS, Law, beginning, evaluating, switching


def fill(k0):
    """Return the row."""
    return np.array([k0])


@evaluating
def evaluate(row, memory, eps, x, want, out):
    out[SLOPE], out[MISS], out[BY] = row[0], 0.0, eps
    return row[0] * eps


@switching
def switch(row, memory, eps, x, up, out):
    return x


@beginning
def begin(row, memory):
    memory[LOW], memory[HIGH], memory[TURNS] = -math.inf, math.inf, 0.0
    return 0.0


LAW = Law(fill, ("k0",), False, (evaluate.address, switch.address, begin.address))
