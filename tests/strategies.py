"""Springs by the ratios of the paper, and random springs and histories for property tests."""

import numpy as np
from hypothesis import strategies as st

import foamfit as ff
from reference import law


def with_ratios(
    k0: float, ratio: float, eps_a: float, eps_c: float, plus: float, minus: float, kc: float
) -> ff.BistableSpring:
    """Return a spring; `ratio` is Δσ/σ_a, and the three others are stiffnesses over k0."""
    dsigma = ratio * k0 * eps_a / (1 - eps_a)
    return ff.BistableSpring(k0, kc * k0, dsigma, eps_a, eps_c, plus * k0, minus * k0)


@st.composite
def admissible_parameters(draw: st.DrawFn, least: float = 0.0) -> dict[str, float]:
    """Draw seven parameters of an admissible spring in SI units, with k_h± ≥ `least` times k0."""
    k0 = 10.0 ** draw(st.floats(5.0, 9.0))
    eps_a = draw(st.floats(0.02, 0.5))
    eps_c = draw(st.floats(eps_a + 0.02, 0.9))
    sigma_a = k0 * eps_a / (1 - eps_a)
    dsigma = sigma_a * draw(st.floats(-0.95, 0.0, exclude_min=True))
    sigma_c = sigma_a + dsigma
    return {
        "k0": k0,
        "kc": k0 * draw(st.floats(1.0, 100.0)),
        "dsigma": dsigma,
        "eps_a": eps_a,
        "eps_c": eps_c,
        "kh_plus": k0 * draw(st.floats(least, 10.0)),
        "kh_minus": k0 * least + sigma_c / eps_c * draw(st.floats(0.0, 3.0)),
    }


@st.composite
def admissible_springs(draw: st.DrawFn, sloped: bool = False) -> ff.BistableSpring:
    """Draw an admissible spring; if `sloped`, no branch is flat, so stress determines strain."""
    return ff.BistableSpring(**draw(admissible_parameters(2e-3 if sloped else 0.0)))


def strain_history(
    spring: ff.BistableSpring, seed: int, turns: int = 12, fine: int = 7
) -> np.ndarray:
    """Return a random strain history with reversals, beyond C1, with `fine` samples per stroke."""
    rng = np.random.default_rng(seed)
    points = law(spring)
    top = points.eps_hat_c + 0.5 * (points.limit - points.eps_hat_c)
    ends = rng.uniform(0.0, top, turns)
    ends[rng.integers(turns)] = top  # so that both flags occur
    corners = np.concatenate([[0.0], ends])
    at = np.linspace(0.0, turns, fine * turns + 1)
    return np.interp(at, np.arange(turns + 1), corners)
