"""The linear spring as a law of the stepper."""

import math

import numpy as np
from contract import (
    BY,
    HIGH,
    LOW,
    MISS,
    OF_LAW,
    SLOPE,
    TURNS,
    Law,
    beginning,
    evaluating,
    switching,
)


def fill(k0):
    """Return the row."""
    return np.array([k0])


@evaluating
def evaluate(row, memory, eps, x, count, want, out):
    for k in range(count):
        out[OF_LAW * count + k], out[SLOPE * count + k] = row[0] * eps[k], row[0]
        out[MISS * count + k], out[BY * count + k] = 0.0, eps[k]
    return 0.0


@switching
def switch(row, memory, eps, x, up, out):
    return x


@beginning
def begin(row, memory):
    memory[LOW], memory[HIGH], memory[TURNS] = -math.inf, math.inf, 0.0
    return 0.0


LAW = Law(fill, ("k0",), False, (evaluate.address, switch.address, begin.address))
