"""Shared synthetic tests: simulated impacts and loops with stated noise."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
from foamfit.data.measurement import Measurement, Noise, Specimen, Striker
from foamfit.report import folder as result_folder
from foamfit.solve import cache, precompile

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
DATA = Path(os.environ.get("FOAMFIT_DATA", ROOT.parent / "shared" / "data"))

HEIGHT, AREA = 1.19e-3, 1.9635e-5

needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measurements of others are not beside this checkout"
)


STIFF = """
import foamfit as ff
chain = ff.Chain([ff.LinearSpring(5e6, eta=1e8)], [1e-3], 2e-5)
assert ff.simulate(chain, ff.Impact(7e-3, 2.0), [0.0, 1e-3]).method == "Radau IIA"
"""


@pytest.fixture(scope="session", autouse=True)
def compiled() -> Iterator[None]:
    """Compile once, in two processes, what most tests need; no command then says that it does.

    The loops of implicit steps are compiled beside the first tests.
    """
    if cache.compiled():
        yield
        return
    with precompile.side_by_side() as compile_rest:
        compile_rest()
    with subprocess.Popen([sys.executable, "-c", STIFF]):
        yield


def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a result folder be written with pictures of a few bytes and an empty page."""
    monkeypatch.setattr(result_folder, "plot_fit", lambda _: None)
    monkeypatch.setattr(result_folder, "laid_out", lambda _: nullcontext())
    monkeypatch.setattr(result_folder, "image", lambda *_: b"\x89PNG" + bytes(20))
    monkeypatch.setattr(result_folder, "render_report", lambda *_, **__: "")


@functools.cache
def synthetic_impact(
    velocity: float = 2.0, noise: float = 0.01, seed: int = 0, eta: float = 0.0, samples: int = 401
) -> tuple[ff.BistableSpring, Measurement]:
    """A simulated impact on a spring with the published parameters of foam-1, time zero known."""
    spring = ff.published["foam-1/model-1"].bistable
    spring = ff.BistableSpring(*spring.seven, eta=eta)
    chain = ff.Chain([spring], [HEIGHT], AREA)
    time = np.linspace(0.0, 0.75e-3, samples)
    response = ff.simulate(chain, ff.Impact(7e-3, velocity), time)
    rng = np.random.default_rng(seed)
    stress, motion = response.base_stress, response.displacement[-1]
    spread = [noise * np.ptp(stress), noise * np.ptp(motion)]
    measurement = Measurement(
        name="synthetic impact",
        path=None,
        data_sha256="0" * 64,
        time=time,
        stress=stress + spread[0] * rng.standard_normal(samples),
        displacement=motion + spread[1] * rng.standard_normal(samples),
        specimen=Specimen(HEIGHT, AREA),
        striker=Striker(7e-3, velocity),
        noise=Noise(*spread) if noise else Noise(),
        motion="measured",
    )
    return spring, measurement


@functools.cache
def synthetic_loop(noise: float = 0.005) -> tuple[ff.BistableSpring, Measurement]:
    """A quasi-static loop without time and without striker."""
    spring = ff.published["foam-1/model-1"].bistable
    strain = np.concatenate([np.linspace(0, 0.38, 200), np.linspace(0.38, 0.02, 200)[1:]])
    stress = spring.stress(strain)
    rng = np.random.default_rng(1)
    measurement = Measurement(
        name="synthetic loop",
        path=None,
        data_sha256="",
        time=None,
        stress=stress + noise * np.ptp(stress) * rng.standard_normal(stress.size),
        displacement=strain * HEIGHT,
        specimen=Specimen(HEIGHT, AREA),
        motion="measured",
    )
    return spring, measurement
