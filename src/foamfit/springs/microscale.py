"""The micro-springs underneath: any monotone laws of snapping, those of the bistable law included.

In series all micro-springs carry one stress σ. P₊(σ) of them have snapped on first loading, P₋(σ)
are left on unloading; along a history the fraction that has snapped is p ← min(max(p, P₊), P₋).
`MicroscaleSpring` has log-normal laws, compiled; here they are functions that the caller gives.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foamfit.errors import InputError
from foamfit.springs.spring import BistableSpring, as_samples

Array = NDArray[np.float64]
Fraction = Callable[[Array], ArrayLike]

# Stresses at which laws of snapping are tried for being monotone.
_TRIED = 2001


def follow_fractions(stress: ArrayLike, plus: Fraction, minus: Fraction) -> Array:
    """Fraction of micro-springs that has snapped along a stress history, from none.

    Parameters
    ----------
    stress : (n,) array
        Stress history, Pa.
    plus, minus : callable
        P₊ and P₋: the fractions, between 0 and 1, at an array of stresses. Both must not fall with
        the stress; where P₋ is less than P₊, it counts as P₊ (snapping is reversible there).

    Returns
    -------
    (n,) array

    Raises
    ------
    InputError
        If a law falls, or gives what is no fraction, on the stresses of the history; the message
        names it and the stress.
    """
    history = np.atleast_1d(as_samples(stress, "stress"))
    order = np.argsort(history)
    laws = []
    for name, law in (("plus", plus), ("minus", minus)):
        fraction = np.asarray(law(history), dtype=float)
        rising = fraction[order]
        wrong = ~((rising >= 0.0) & (rising <= 1.0))
        wrong[1:] |= np.diff(rising) < -1e-12
        if wrong.any():
            at = history[order][np.argmax(wrong)]
            raise InputError(
                f"{name} is no law of snapping: at {at:g} Pa it falls, or is not from 0 to 1"
            )
        laws.append(fraction)
    out, snapped = np.empty(history.size), 0.0
    for j, (least, most) in enumerate(zip(*laws, strict=True)):
        snapped = min(max(snapped, least), max(least, most))
        out[j] = snapped
    return out


def follow_strain(
    stress: ArrayLike, k0: float, kc: float, eps_star: float, plus: Fraction, minus: Fraction
) -> Array:
    """Strain of micro-springs in series along a stress history (n,); see `follow_fractions`.

    Their branches a and c are those of the bistable law: σ/(k0+σ) and ε_* + σ/(kc+σ).
    """
    history = np.atleast_1d(as_samples(stress, "stress"))
    snapped = follow_fractions(history, plus, minus)
    on_a, on_c = history / (k0 + history), eps_star + history / (kc + history)
    return (1.0 - snapped) * on_a + snapped * on_c


def fractions_of(spring: BistableSpring) -> tuple[Fraction, Fraction]:
    """P₊ and P₋ of the micro-springs whose full loop is that of a bistable spring.

    Branch d is where P₊ of them have snapped, between A1 and C1; branch e where P₋ are left,
    between C2 and A2 (or a stress of -k0/2, where e never meets a).

    Raises
    ------
    InputError
        If one of them falls with the stress: then branch d or e is stiffer than micro-springs that
        only snap can make it, and there are none. The message names the slope.
    """
    k0, kc, eps_star = spring.k0, spring.kc, spring.eps_star
    low = spring.sigma_hat_a
    ends = {
        "kh_plus": (spring.sigma_a, spring.sigma_hat_c, spring.sigma_a, spring.eps_a),
        "kh_minus": (-k0 / 2 if low is None else low, spring.sigma_c, spring.sigma_c, spring.eps_c),
    }

    def law(name: str) -> Fraction:
        first, last, sigma, eps = ends[name]
        slope = getattr(spring, name)

        def inside(stress: Array) -> Array:
            on_a, on_c = stress / (k0 + stress), eps_star + stress / (kc + stress)
            on_line = eps + (stress - sigma) / slope if slope > 0.0 else on_a
            return (on_line - on_a) / (on_c - on_a)

        def fraction(stress: Array) -> Array:
            share = np.clip(inside(np.clip(stress, first, last)), 0.0, 1.0)
            return np.where(stress < first, 0.0, np.where(stress >= last, 1.0, share))

        if np.any(np.diff(inside(np.linspace(first, last, _TRIED))) < -1e-12):
            raise InputError(
                f"{name} = {slope:g} Pa is too stiff a branch for micro-springs that snap: the "
                "fraction that has snapped would fall with the stress"
            )
        return fraction

    return law("kh_plus"), law("kh_minus")
