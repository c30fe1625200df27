"""A fabricated fit: the spring law along a half-sine motion, with a little noise."""

from dataclasses import replace
from typing import Any

import lmfit
import numpy as np
from matplotlib.figure import Figure

from foamfit.api import FitResult
from foamfit.data.measurement import Measurement, Specimen, Striker
from foamfit.parts import ParameterEstimate
from foamfit.results import SOURCES, Budget, Curves, Switch
from foamfit.springs.chain import Chain
from foamfit.springs.laws import BistableSpring, LinearSpring, MicroscaleSpring
from foamfit.text import ASKED
from foamfit.trust.checklist import input_first

HEIGHT, AREA = 1.19e-3, 1.9635e-5
SPRING = BistableSpring(
    k0=5.5e6, kc=82.5e6, dsigma=-0.17907e6, eps_a=0.14, eps_c=0.31, kh_plus=14.3e6, kh_minus=2.3e6
)
MICRO = MicroscaleSpring(
    k0=4.4e5, kc=4.9e5, eps_star=0.29, sigma_plus=1.06e5, spread_plus=0.44, sigma_minus=7.9e4,
    spread_minus=0.7, relaxation=[(0.5, 0.25)],
)  # fmt: skip
UNITS = dict.fromkeys(("eps_a", "eps_c", "eps_star", "spread_plus", "spread_minus", "g1"), "")
UNITS |= {"tau1": "s", "height": "m", "eta": "Pa·s", "site_eta": "Pa·s"}
FILES = {  # of the folder of a fit with its report
    "fit.json", "parameters.csv", "curves.csv", "report.html", "fit.png", "fit.pdf", "table.tex",
}  # fmt: skip


def half_sine() -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[Switch, ...]]:
    """Return time (s), strain, stress (Pa) and switches of one loading to 35 % and unloading."""
    time = np.linspace(0.0, 0.9e-3, 601)
    strain = 0.35 * np.sin(np.pi * time / time[-1])
    stress, back = np.asarray(SPRING.stress(strain)), time > time[300]
    begins = {
        ("a", "d"): strain > SPRING.eps_a,
        ("d", "c"): strain > SPRING.eps_hat_c,
        ("c", "e"): back & (strain <= SPRING.eps_c),
        ("e", "a"): back & (strain < SPRING.eps_hat_a),
    }
    places = {branches: int(np.argmax(found)) for branches, found in begins.items()}
    switches = tuple(
        Switch(1, *branches, time[i], strain[i] * HEIGHT, stress[i])
        for branches, i in places.items()
    )
    return time, strain, stress, switches


def estimate(name: str, value: float, **changed: Any) -> ParameterEstimate:
    stderr = 0.012 * abs(value)
    given: dict[str, Any] = {
        "value": value,
        "stderr": stderr,
        "ci95": (value - 1.96 * stderr, value + 1.96 * stderr),
        "unit": UNITS.get(name.split("_", 1)[-1], UNITS.get(name, "Pa")),
        "vary": True,
        "state": "determined",
        "why": "the test reaches its branch",
    }
    return ParameterEstimate(**(given | changed))


def parameters() -> dict[str, ParameterEstimate]:
    values = {
        f"s1_{name}": getattr(SPRING, name)
        for name in ("k0", "kc", "dsigma", "eps_a", "eps_c", "kh_plus", "kh_minus", "eta")
    }
    made = {name: estimate(name, value) for name, value in values.items()}
    made["s1_kc"] = estimate(
        "s1_kc", SPRING.kc, state="weak", why="its interval is wider than half of its value"
    )
    made["s1_dsigma"] = estimate("s1_dsigma", SPRING.dsigma, stderr=21.5e3, ci95=(-221e3, -137e3))
    made["s1_kh_minus"] = estimate(
        "s1_kh_minus", SPRING.kh_minus, stderr=None, ci95=None, state="not determined",
        why="branch e was never reached",
    )  # fmt: skip
    made["s1_eta"] = estimate(
        "s1_eta", 0.0, stderr=None, ci95=None, vary=False, state="fixed", why="fixed by the model"
    )
    return made


def result(**changed: Any) -> FitResult:
    """Return the complete result of a one-spring impact fit; any field can be replaced."""
    time, strain, stress, switches = half_sine()
    random = np.random.default_rng(0)
    measured_stress = stress + 0.03e6 * random.standard_normal(time.size)
    measured_displacement = 1.01 * strain * HEIGHT
    given: dict[str, Any] = {
        "measurement": Measurement(
            "VACNT foam-1, reconstruction", None,
            "5d41402abc4b2a76b9719d911017c592ae1f0f0e4d1e7e5f8a3b2c1d0e9f8a7b",
            time, measured_stress, measured_displacement,
            Specimen(height=HEIGHT, area=AREA, mass=5.56e-6),
            Striker(mass=7e-3, velocity=1.75), motion="measured",
            notes=("The force was divided by the area 19.6 mm².", "Time zero was set at contact."),
        ),
        "model": "bistable",
        "drive": "impact",
        "seed": 3,
        "status": "warnings",
        "warnings": ("s1_kh_minus is not determined: branch e was never reached.",),
        "chain": Chain(springs=[SPRING], heights=[HEIGHT], area=AREA),
        "params": lmfit.Parameters(),
        "parameters": parameters(),
        "visited": {"s1": ("a", "d", "c", "e")},
        "misfit": {"stress_time": 0.012, "displacement_time": 0.004, "stress_strain": None},
        "weights": {"stress": 0.5, "displacement": 0.5},
        "statistics": {
            "n_data": 1202, "n_vary": 7, "redchi": 1.02, "aic": -301.2, "aicc": -301.0,
            "bic": -265.3, "nfev": 4210, "n_starts": 16,
        },
        "energy": {
            "striker_kinetic_J": 0.01072, "absorbed_J": np.float64(0.0095), "closes": False,
            "peak_MPa": None, "sentences": ["The striker brings 0.0107 J.", "The loop takes less."],
        },
        "runtime_s": 21.4,
        "curves": Curves(
            time, measured_stress, measured_displacement, stress, strain * HEIGHT, stress * 1.01
        ),
        "switches": switches,
    }  # fmt: skip
    given |= changed
    asked = [note for note in given["measurement"].notes if note.startswith(ASKED)]
    given["warnings"] = input_first((*given["warnings"], *asked))
    return FitResult(**given)


def budget(**shares: float) -> Budget:
    """Return an uncertainty budget of two parameters; sources are given relative to the value."""
    given = {"noise": 0.01} | {name.replace("_", " "): share for name, share in shares.items()}
    row = dict.fromkeys(SOURCES, 0.0) | given
    values = {"s1_k0": SPRING.k0, "s1_eps_a": SPRING.eps_a}
    return Budget(
        {name: {k: share * value for k, share in row.items()} for name, value in values.items()},
        values,
    )


def chain_result() -> FitResult:
    """Return a result of linear+bistable, whose parameter names must not be confused."""
    one = result()
    springs = [LinearSpring(k0=60e6), SPRING]
    switches = tuple(
        Switch(2, s.source, s.target, s.time, s.displacement, s.stress) for s in one.switches
    )
    renamed = {name.replace("s1_", "s2_"): p for name, p in one.parameters.items()}
    return result(
        model="linear+bistable",
        chain=Chain(springs=springs, heights=[0.7e-3, 0.49e-3], area=AREA),
        parameters={"s1_k0": estimate("s1_k0", 60e6), **renamed},
        visited={"s1": (), "s2": ("a", "d", "c", "e")},
        switches=switches,
    )


def microscale_result(**changed: Any) -> FitResult:
    """Return a result of a relaxing microscale spring under a slow triangular strain up to 60 %."""
    time = np.linspace(0.0, 5.0, 401)
    strain = 0.6 * (1.0 - np.abs(time / 2.5 - 1.0))
    stress = np.asarray(MICRO.stress(strain))
    measured = stress + 1e3 * np.random.default_rng(0).standard_normal(time.size)

    def at(place: int, source: str, target: str) -> Switch:
        return Switch(1, source, target, time[place], strain[place] * HEIGHT, stress[place])

    back = 214  # sample at which unloading reaches the first snap-back
    switches = (
        at(3, "a", "snap-through"), at(50, "snap-through", "held"), at(51, "held", "snap-through"),
        at(200, "snap-through", "held"), at(back, "held", "snap-back"),
    )  # fmt: skip
    values = dict(zip(MICRO.law.names, MICRO.values, strict=True))
    values |= {"g1": 0.5, "tau1": 0.25}
    made = {f"s1_{name}": estimate(f"s1_{name}", value) for name, value in values.items()}
    made["s1_eta"] = result().parameters["s1_eta"]
    base = result()
    given: dict[str, Any] = {
        "measurement": replace(
            base.measurement, name="shoe foam", time=time, stress=measured,
            displacement=strain * HEIGHT, striker=None,
        ),
        "model": "microscale",
        "relaxation": 1,
        "drive": "displacement",
        "status": "ok",
        "warnings": (),
        "chain": Chain(springs=[MICRO], heights=[HEIGHT], area=AREA),
        "parameters": made,
        "visited": {"s1": ("a", "snap-through", "held", "snap-back")},
        "misfit": {"stress_time": 0.006, "displacement_time": None, "stress_strain": 0.006},
        "curves": Curves(time, measured, strain * HEIGHT, stress, None, stress),
        "switches": switches,
    }  # fmt: skip
    return result(**(given | changed))


def no_figures() -> dict[str, Figure]:
    """Return an empty figure for a report, because drawing takes most of the time."""
    return {"fit": Figure(figsize=(1.0, 1.0))}
