"""The state of a microscale spring, and the normal distribution of its ranks.

Its memory is the rank w up to which micro-springs have snapped, in standard normal scores: the
snapped fraction is p = Φ(w).
"""

# mypy: disallow-untyped-decorators=False, warn-return-any=False
from __future__ import annotations

import math

from foamfit.springs.kernels import inner

# Strain, stress, branch, rank, p, 1 - p, the strains and stresses at which the branch ends, and
# dε/dσ, d²ε/dσ² where the stress was last sought. Then what stays: strain and stress where
# snap-through and snap-back meet, where the first micro-spring snaps, and where the last one has
# snapped back. Of a spring that remembers also the rank W up to which micro-springs have ever
# snapped, 1 - P = Φ(-W), and the strain below which none is taken to snap.
EPS, SIGMA, BRANCH, RANK, SNAPPED, REST, LOW, HIGH, SIGMA_LOW, SIGMA_HIGH = range(10)
FLEXIBILITY, CURVATURE, MEET, SIGMA_MEET, FIRST, SIGMA_FIRST, LAST, SIGMA_LAST = range(10, 18)
EVER, NEVER, LEAST_AT, STATE = range(18, 22)
# Derivatives that are carried: by k0 … spread_minus, by (the logarithm of) the strain itself, and,
# of a spring that remembers, by stiffening, softening, weakening.
OF_STRAIN, OF_STIFFENING, OF_SOFTENING, OF_WEAKENING, CARRIED = 7, 8, 9, 10, 11
# So many of them where it does not.
PLAIN_CARRIED = 8
# A step of Halley's method so small, in widths over which the law bends, is the last: what it
# leaves is about its cube.
NEAR = 3e-6
# The least stress that is sought: the least normal number.
LEAST = 2.0**-1022
_ROOT_HALF, _ROOT_TURN = math.sqrt(0.5), 1.0 / math.sqrt(2.0 * math.pi)


@inner
def share(rank: float) -> float:
    """Φ, the share of all ranks that lies below one."""
    return 0.5 * math.erfc(-_ROOT_HALF * rank)


@inner
def density(rank: float) -> float:
    """Φ', the density of ranks."""
    return _ROOT_TURN * math.exp(-0.5 * rank * rank)
