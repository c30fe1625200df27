"""One spring under a known motion, by the functions of its law.

The strain is linear between samples, so the stress needs no integration. Relaxation terms z = q/g -
σ with dz/dt = -(z + σ)/τ are integrated exactly for the quartic through the stress at both ends and
the middle of a step and its slopes at the ends; what the middle adds to the cubic is the error
estimate. Derivatives follow from those of the stress at the same three points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from contract import (
    BY,
    BY_HELD,
    CHANGE,
    CHANGES,
    COLUMNS,
    EPS,
    HELD_NUMBERS,
    HIGH,
    LOW,
    MISS,
    OF_HELD,
    OF_LAW,
    OF_PARAMETER,
    OF_STRESS,
    OPTIONS,
    RELAX,
    RESULTS,
    SIGMA,
    SLOPE,
    TURNS,
    call_begin,
    call_evaluate,
    call_switch,
    inner,
    past,
    start,
)  # fmt: skip
from numba import njit

from stepper import BATCH, OWN_ETA, OWN_HEIGHT, RELAXING

MOMENTS, OF_STEP, TABLE = 0, 6, 8  # columns of the table of a relaxation term
NEAR = 1e-9  # relative correction of the stress that is the last
LEAST_STEP, FOLLOWED = 1e-9, 0.1  # share of an interval; error over what the middle adds


@inner
def settle(address, s, eps, x, implicit, want):
    """Bring a spring to a strain on its branch, from a guess x; return its stress."""
    s[EPS], s[SIGMA], out = eps, x, past(s, RESULTS)
    here, guess = past(s, EPS), past(s, SIGMA)
    if not implicit:
        call_evaluate(address, s, here, guess, 1, want, out)
        s[SIGMA] = out[OF_LAW]
        return s[SIGMA]
    for _ in range(60):
        s[SIGMA] = x
        call_evaluate(address, s, here, guess, 1, want, out)
        change = s[RESULTS + MISS] * s[RESULTS + SLOPE]
        if x != 0.0 and not abs(change) < 0.5 * abs(x):
            change = math.copysign(0.5 * abs(x), change)
        x -= change
        if abs(change) <= NEAR * abs(x):
            break
    s[SIGMA] = x
    return x


@inner
def derive(s, directions, p, held, seed, out):
    """Fill the derivatives of the stress now."""
    a, b, by_strain = s[RESULTS + BY_HELD], s[RESULTS + BY_HELD + 1], s[RESULTS + SLOPE] * s[EPS]
    for j in range(p):
        out[j] = a * held[j] + b * held[p + j] + by_strain * seed[j]
        if directions[j] < OWN_ETA:
            out[j] += s[RESULTS + BY + directions[j]]


@inner
def change_branch(address, s, up, directions, p, held, d_sigma):
    """Change the branch, and the derivatives of held numbers."""
    s[SIGMA] = call_switch(address, s, s[EPS], s[SIGMA], up, CHANGES)
    for j in range(p):
        first, second = held[j], held[p + j]
        for h in range(HELD_NUMBERS):
            by = past(s, CHANGES + h * CHANGE)
            held[h * p + j] = (
                by[OF_STRESS] * d_sigma[j] + by[OF_HELD] * first + by[OF_HELD + 1] * second
            )
            if directions[j] < OWN_ETA:
                held[h * p + j] += by[OF_PARAMETER + directions[j]]


@inner
def tabulate(x, h, table):
    """Fill the moments ∫₀¹ exp(-x (1-r)) r^m dr, m = 0 … 5, for steps of length h."""
    table[OF_STEP] = h
    if x > 1.0:
        table[0] = -math.expm1(-x) / x
        for m in range(1, 6):
            table[m] = (1.0 - m * table[m - 1]) / x
        return
    term = total = 1.0 / 6.0
    for k in range(1, 30):
        term *= -x / (6.0 + k)
        total += term
        if abs(term) < 1e-17:
            break
    table[5] = total
    for m in range(5, 0, -1):
        table[m - 1] = (1.0 - x * table[m]) / m


@inner
def relax(
    s, terms, h, tables, z, dz, first, low, high, bump, d_first, d_middle, d_last, directions, p
):
    """Advance the relaxation terms and their derivatives over a step.

    The stress is first + low r + … : slopes `low` and `high` at the ends, `bump` 16 r² (1-r)².
    """
    rise = s[SIGMA] - first
    square, cube = 3.0 * rise - 2.0 * low - high, low + high - 2.0 * rise
    square, cube, fourth = square + 16.0 * bump, cube - 32.0 * bump, 16.0 * bump
    for k in range(terms):
        tau, table = s[RELAX + 2 * k + 1], past(tables, k * TABLE)
        x = h / tau
        decay = math.exp(-x)
        total = (
            first * table[0]
            + low * table[1]
            + square * table[2]
            + cube * table[3]
            + fourth * table[4]
        )
        if p > 0:
            change = (
                first * (table[1] - table[0])
                + low * (table[2] - table[1])
                + square * (table[3] - table[2])
            )
            change += cube * (table[4] - table[3]) + fourth * (table[5] - table[4])
            by_tau = (decay * z[k] + total + x * change) * x / tau
            one, two = table[1], table[2]
            a, b, c = table[0] - 3.0 * one + 2.0 * two, 4.0 * (one - two), 2.0 * two - one
            for j in range(p):
                mine = decay * dz[k * p + j] - x * (
                    a * d_first[j] + b * d_middle[j] + c * d_last[j]
                )
                dz[k * p + j] = mine + (by_tau if directions[j] == RELAXING + 2 * k + 1 else 0.0)
        z[k] = decay * z[k] - x * total


@njit(**OPTIONS, no_cfunc_wrapper=True, _nrt=False)
def follow(springs, whole, work, eps, t, tol, out):
    """Follow a spring along strains from rest; `out` (1 + p, n) becomes stress and derivatives."""
    implicit, terms, p = whole[3] > 0, whole[4], whole[5]
    s, directions = start(springs), past(start(whole), 6)
    seed = start(work)
    held, z = past(seed, p), past(seed, 3 * p)
    dz, tables = past(z, terms), past(z, terms + terms * p)
    d_first = past(tables, terms * TABLE)
    d_middle, d_last = past(d_first, p), past(d_first, 2 * p)
    call_begin(whole[2], s)
    want, largest, bend, weight = int(p > 0), 0.0, 0.0, 0.0
    settle(whole[0], s, 0.0, 0.0, False, want)
    s[SIGMA] = 0.0
    if p > 0:
        derive(s, directions, p, held, seed, d_last)
    for k in range(terms):
        weight += s[RELAX + 2 * k] * min(1.0, (t[-1] - t[0]) / s[RELAX + 2 * k + 1])
    batch, ahead = past(d_last, p), 0
    for j in range(t.size):
        if j < ahead:
            continue
        if terms == 0 and not implicit and s[LOW] <= eps[j] <= s[HIGH]:
            # several samples on one branch of an explicit law
            ahead = j + 1
            while ahead < t.size and ahead - j < BATCH and s[LOW] <= eps[ahead] <= s[HIGH]:
                ahead += 1
            n, here = ahead - j, past(start(eps), j)
            call_evaluate(whole[0], s, here, here, n, want, batch)
            for k in range(n):
                out[0, j + k] = batch[OF_LAW * n + k]
            for c in range(p):
                own, slope = directions[c] < OWN_ETA, past(batch, SLOPE * n)
                by = past(batch, (BY + (directions[c] if own else 0)) * n)
                for k in range(n):
                    out[1 + c, j + k] = seed[c] * here[k] * slope[k] + (by[k] if own else 0.0)
            s[EPS], s[SIGMA] = here[n - 1], batch[OF_LAW * n + n - 1]
            s[RESULTS + SLOPE] = batch[SLOPE * n + n - 1]
            continue
        begun, left = s[EPS], 1.0
        between = t[j] - t[j - 1] if j > 0 else 0.0
        pace = 1.0
        while left > 0.0 or s[EPS] != eps[j]:
            up = eps[j] > s[EPS]
            if s[EPS] != eps[j] and s[TURNS] * (1.0 if up else -1.0) < 0.0:
                change_branch(whole[1], s, int(up), directions, p, held, d_last)
                settle(whole[0], s, s[EPS], s[SIGMA], implicit, want)
                derive(s, directions, p, held, seed, d_last)
                bend = 0.0
            goal, until, leaving = eps[j], 0.0, False
            if up and eps[j] > s[HIGH]:
                goal, leaving = s[HIGH], True
            elif not up and eps[j] < s[LOW]:
                goal, leaving = s[LOW], True
            if leaving:
                until = min(max((eps[j] - goal) / (eps[j] - begun), 0.0), left)
            share, part = left - until, goal
            if pace < share:
                share, leaving = pace, False
                part = (
                    eps[j] + (left - share) / left * (s[EPS] - eps[j])
                    if until == 0.0
                    else s[EPS] + share / (left - until) * (goal - s[EPS])
                )
            first, origin, slope = s[SIGMA], s[EPS], s[RESULTS + SLOPE]
            step, h = part - origin, share * between
            guess = first + step * (slope + 0.5 * bend * step)
            settle(whole[0], s, part, guess, implicit, want)
            last, last_slope = s[SIGMA], s[RESULTS + SLOPE]
            if terms > 0 and h > 0.0:
                low, high = slope * step, last_slope * step
                middle = 0.5 * (first + last) + 0.125 * (low - high)
                if p > 0:
                    for c in range(p):
                        d_first[c] = d_last[c]
                    derive(s, directions, p, held, seed, d_last)
                half = origin + 0.5 * step
                s[EPS], s[SIGMA] = half, middle
                call_evaluate(whole[0], s, past(s, EPS), past(s, SIGMA), 1, want, past(s, RESULTS))
                s[EPS], s[SIGMA], bump = part, last, s[RESULTS + OF_LAW] - middle
                if implicit:
                    bump = -s[RESULTS + MISS] * s[RESULTS + SLOPE]
                size = max(largest, abs(last))
                if FOLLOWED * weight * abs(bump) > tol * size and share > LEAST_STEP:
                    s[EPS], s[SIGMA], s[RESULTS + SLOPE] = origin, first, slope
                    for c in range(p):
                        d_last[c] = d_first[c]
                    pace = 0.5 * share
                    continue
                if p > 0:
                    s[EPS] = half
                    derive(s, directions, p, held, seed, d_middle)
                    s[EPS] = part
                s[RESULTS + SLOPE] = last_slope
                for k in range(terms):
                    if abs(h - tables[k * TABLE + OF_STEP]) > 1e-13 * h:
                        tabulate(h / s[RELAX + 2 * k + 1], h, past(tables, k * TABLE))
                relax(
                    s,
                    terms,
                    h,
                    tables,
                    z,
                    dz,
                    first,
                    low,
                    high,
                    bump,
                    d_first,
                    d_middle,
                    d_last,
                    directions,
                    p,
                )
            elif p > 0:
                derive(s, directions, p, held, seed, d_last)
            largest = max(largest, abs(last))
            bend = (last_slope - slope) / step if step != 0.0 else 0.0
            left = max(left - share, 0.0)
            pace = 2.0 * share if share < 1.0 else 1.0
            if leaving:
                change_branch(whole[1], s, int(up), directions, p, held, d_last)
                settle(whole[0], s, s[EPS], s[SIGMA], implicit, want)
                derive(s, directions, p, held, seed, d_last)
                bend = 0.0
        if j == 0:  # q = 0 at the first sample
            for k in range(terms):
                z[k] = -s[SIGMA]
                for c in range(p):
                    dz[k * p + c] = -d_last[c]
        total = s[SIGMA]
        for c in range(p):
            out[1 + c, j] = d_last[c]
        for k in range(terms):
            g = s[RELAX + 2 * k]
            total += g * (s[SIGMA] + z[k])
            for c in range(p):
                out[1 + c, j] += g * (d_last[c] + dz[k * p + c])
                if directions[c] == RELAXING + 2 * k:
                    out[1 + c, j] += s[SIGMA] + z[k]
        out[0, j] = total


class Prepared:
    """A spring under a known motion, laid out for repeated runs."""

    def __init__(self, law: Any, terms: int, directions: Any = (), height: float = 1.0) -> None:
        what, p = [int(own) for _, own in directions], len(directions)
        self.p = p
        self.whole = np.array([*law.addresses, law.implicit, terms, p, *what], np.int64)
        self.work = np.zeros(3 * p + terms * (1 + p) + terms * TABLE + 3 * p + COLUMNS * BATCH)
        self.work[:p] = [-1.0 / height if own == OWN_HEIGHT else 0.0 for own in what]

    def run(self, row, eps, t, tol):
        """Return stress and its derivatives, (1 + p, n)."""
        out = np.empty((1 + self.p, t.size))
        follow(row.copy(), self.whole, self.work.copy(), eps, t, tol, out)
        return out
