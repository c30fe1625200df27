"""Synthetic tests of springs drawn at random, and what a linear problem makes of their noise.

A problem that is linear about the truth, and whose noise is known, has intervals that hold in
exactly 95 % of cases: what its count is off with the same draws is the luck of the draws, and what
a fit's count is off beyond that is the doing of the fit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

import foamfit as ff
from foamfit.data.measurement import Measurement, Specimen, Striker
from foamfit.trust.best_point import BestPoint
from foamfit.trust.residuals.noise_process import NoiseProcess, parts

Array = np.ndarray
NOISE = 0.01
HEIGHT, AREA, MASS = 1.2e-3, 1.9635e-5, 7e-3
BEYOND = 1.05  # a record's length over that of contact


def white(rng: np.random.Generator, samples: int) -> Array:
    """White noise of unit variance."""
    return rng.standard_normal(samples)


def autoregressive(rho: float, noise: Array) -> Array:
    """Noise of unit variance and of an autocorrelation, from white noise 500 samples longer."""
    return np.asarray(lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], noise)[..., 500:])


def random_case(
    rng: np.random.Generator,
    samples: int = 501,
    noise: Callable[[np.random.Generator, int], Array] = white,
) -> tuple[ff.BistableSpring, Measurement]:
    """A random spring and its synthetic impact, struck hard enough to use branch c."""
    k0 = 10 ** rng.uniform(6, 7.5)
    eps_a = rng.uniform(0.05, 0.35)
    sigma_a = k0 * eps_a / (1 - eps_a)
    eps_c = eps_a + rng.uniform(0.1, 0.45)
    drop = rng.uniform(0.05, 0.8)
    kh_plus = k0 * rng.uniform(0.1, 3)
    kc = k0 * 10 ** rng.uniform(0.7, 1.7)
    kh_minus = sigma_a * (1 - drop) / eps_c * rng.uniform(0.5, 1.1)
    spring = ff.BistableSpring(k0, kc, -drop * sigma_a, eps_a, eps_c, kh_plus, kh_minus)
    # work to C1, and a third to a factor of two more than that
    strain = np.linspace(0, spring.eps_hat_c, 2000)
    work = np.trapezoid(spring.stress(strain), strain) * AREA * HEIGHT
    velocity = float(np.sqrt(2 * work * rng.uniform(1.3, 2.0) / MASS))
    if rng.random() < 0.5:
        eta = 10 ** rng.uniform(-2.5, -1) * spring.sigma_hat_c * HEIGHT / velocity
        spring = ff.BistableSpring(*spring.seven, eta=eta)
    chain, drive = ff.Chain([spring], [HEIGHT], AREA), ff.Impact(MASS, velocity)
    long = ff.simulate(chain, drive, np.linspace(0, 20 * HEIGHT / velocity, 4001))
    time = np.linspace(0, BEYOND * (long.contact_end or long.time[-1]), samples)
    response = ff.simulate(chain, drive, time)
    curves = response.base_stress, response.displacement[-1]
    noisy = [x + NOISE * np.ptp(x) * noise(rng, x.size) for x in curves]
    measurement = Measurement(
        "synthetic impact", None, "", time=time, stress=noisy[0], displacement=noisy[1],
        specimen=Specimen(HEIGHT, AREA), striker=Striker(MASS, velocity), motion="measured",
    )  # fmt: skip
    return spring, measurement


def toml_of(specimen: Specimen, striker: Striker | None = None) -> str:
    """Write what a user would say of a specimen and of a striker."""
    text = f'[specimen]\nheight = "{specimen.height} m"\narea = "{specimen.area} m^2"\n'
    if striker is not None:
        text += f'[striker]\nmass = "{striker.mass} kg"\nvelocity = "{striker.velocity} m/s"\n'
    return text


def linear(around: BestPoint, levels: dict[str, float], rho: float = 0.0) -> tuple[Array, Array]:
    """Change of the scaled parameters by each residual, and its standard deviation, to first order.

    `levels` are those of the noise in the residuals of each curve, `rho` its autocorrelation.
    """
    pull = np.linalg.pinv(around.jacobian * around.sizes)
    variance, objective = np.zeros(len(pull)), around.problem.objective
    for part, curve in zip(parts(objective.sizes), objective.counted, strict=True):
        process = NoiseProcess(np.array([rho] if rho else []), levels[curve] ** 2)
        variance += process.forms(pull[:, part].T)
    return pull, np.sqrt(variance)
