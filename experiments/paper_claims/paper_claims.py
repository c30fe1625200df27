"""Are the claims of the paper correct that follow from its published numbers?

Method and answers: README.md, every number of which is computed here from the published parameters
(Thevamaran, Fraternali & Daraio 2014, Tables 1-3).

    python experiments/paper_claims/paper_claims.py
"""

import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import bisect

import foamfit as ff
from foamfit.springs import laws

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLUE, GREEN, GREY, ORANGE, SKY, Array

HERE = Path(__file__).parent
MODEL_1, MODEL_2, MODEL_3, FOAM_2 = "foam-1/model-1", "foam-1/model-2", "foam-1/model-3", "foam-2"
SETS = (MODEL_2, MODEL_3, FOAM_2)  # those with a damper
STRIKER = 7e-3  # kg
ETA = 1e4  # Pa·s, published for model-2 and foam-2
RTOL = 1e-9


def ratio_readings(name: str, eta: float | None = None) -> dict[str, float]:
    """Return ζ = η/(2 H √(ρ k)), ρ = m/(A H), of a published set by each reading."""
    item = ff.published[name]
    s, chain, own, eta = item.bistable, item.chain, item.specimen_mass, eta or item.eta or 0.0
    whole = chain.height
    other = ff.published[MODEL_1 if name == FOAM_2 else FOAM_2].chain.height

    def ratio(k: float = s.kc, mass: float = STRIKER, height: float = whole) -> float:
        return eta / (2.0 * height * math.sqrt(mass / (chain.area * height) * k))

    return {
        "the formula: k_c, H, ρ of the striker": ratio(),
        "ρ = bulk density of the foam": ratio(mass=own),
        "k₀ for k_c": ratio(s.k0),
        "k_h+ for k_c": ratio(s.kh_plus),
        "k_h− (branch e) for k_c": ratio(s.kh_minus),
        "tangent of branch c at C2 for k_c": ratio((s.kc + s.sigma_c) ** 2 / s.kc),
        "tangent of branch c at C1 for k_c": ratio((s.kc + s.sigma_hat_c) ** 2 / s.kc),
        "secant of branch c, C2 to C1, for k_c":
            ratio((s.sigma_hat_c - s.sigma_c) / (s.eps_hat_c - s.eps_c)),
        "secant from zero to C1 for k_c": ratio(s.sigma_hat_c / s.eps_hat_c),
        "height of the bistable spring for H": ratio(height=chain.heights[-1]),
        "height at C2, H(1 − ε_c)": ratio(height=whole * (1 - s.eps_c)),
        "height at A1, H(1 − ε_a)": ratio(height=whole * (1 - s.eps_a)),
        "height of the other specimen": ratio(height=other),
    }  # fmt: skip


def viscosity_wanted() -> float:
    """Return the viscosity (Pa·s) that would give the paper's ratio of model-2; ζ ~ η."""
    item = ff.published[MODEL_2]
    by_formula, printed = item.damping_ratio_by_formula(), item.damping_ratio
    assert by_formula is not None
    assert printed is not None
    return ETA * printed / by_formula


def impact_scene(name: str, interior: bool = True) -> ff.Chain:
    """Return the chain of a published set without its numerical damper."""
    chain = ff.published[name].chain
    return ff.Chain(chain.springs, chain.heights, chain.area, chain.masses if interior else None)


def struck(chain: ff.Chain, velocity: float, samples: int = 101) -> ff.Response:
    """Simulate an impact of the 7 g striker until after the end of contact."""
    time = np.linspace(0.0, 4.0 * chain.height / velocity, samples)
    got = ff.simulate(chain, ff.Impact(STRIKER, velocity), time, rtol=RTOL)
    assert got.contact_end is not None
    assert got.contact_end < time[-2]
    return got


def closing_velocity(name: str, interior: bool = True) -> float:
    """Return the least velocity (m/s) at which the impact reaches branch c."""
    chain, c = impact_scene(name, interior), [*laws.law("bistable").branches].index("c")

    def reaches(velocity: float) -> float:
        return 0.5 if np.any(struck(chain, velocity).switches[:, 3] == c) else -0.5

    return float(bisect(reaches, 1.0, 8.0, xtol=1e-6))


def work_to_c1(name: str) -> float:
    """Return the work per cross-section (J/m²) to load massless springs to C1, closed form."""
    item, total = ff.published[name], 0.0
    top = item.bistable.sigma_hat_c
    for s, h in zip(item.chain.springs, item.chain.heights, strict=True):
        if isinstance(s, ff.LinearSpring):
            total += h * top**2 / (2.0 * s.k0)
        else:
            on_a = s.k0 * (-math.log1p(-s.eps_a) - s.eps_a)
            total += h * (on_a + 0.5 * (s.sigma_a + top) * (s.eps_hat_c - s.eps_a))
    return total


def closing_velocity_by_energy(name: str) -> float:
    """Return the velocity (m/s) whose kinetic energy is the work to C1."""
    return math.sqrt(2.0 * ff.published[name].chain.area * work_to_c1(name) / STRIKER)


def loop_area(name: str) -> float:
    """Return the area (J/m²) of the smallest closed loop, to C1 and back to σ = 0."""
    item = ff.published[name]
    top = item.bistable.eps_hat_c
    strain = np.concatenate([np.linspace(0, top, 20001), np.linspace(top * (1 + 1e-12), 0, 20001)])
    stress = np.maximum(item.bistable.stress(strain), 0.0)
    return float(item.chain.heights[-1] * np.trapezoid(stress, strain))


def rebound(got: ff.Response) -> float:
    """Return the velocity (m/s) of the striker after contact."""
    return -float(np.diff(got.displacement[-1])[-1] / np.diff(got.time)[-1])


def energy_row(name: str, interior: bool = True) -> dict[str, float]:
    """Compare the simulated published impact of one set with its loop; SI."""
    item, chain = ff.published[name], impact_scene(name, interior)
    velocity, needed = item.striker_velocity, closing_velocity(name, interior)
    got = struck(chain, velocity, 4001)
    return {
        "velocity": velocity, "strain": float(np.max(got.strain[-1])),
        "c1": item.bistable.eps_hat_c, "peak": float(np.max(got.base_stress)),
        "rebound": rebound(got), "needed": needed,
        "needed_energy": closing_velocity_by_energy(name),
        "excess": 100.0 * ((needed / velocity) ** 2 - 1.0),
    }  # fmt: skip


def lost_share(chain: ff.Chain, velocity: float) -> float:
    """Return the share (%) of the striker's energy that is lost."""
    return 100.0 * (1.0 - (rebound(struck(chain, velocity)) / velocity) ** 2)


def draw_energy(path: Path) -> None:
    """Draw the energy that the striker loses over its velocity."""
    factors = np.linspace(0.9, 1.25, 141)
    with studies.sheet(path, 4.4, 2.9) as figure:
        ax = figure.add_subplot()
        for name, colour, style in (
            (MODEL_1, SKY, "-"), (MODEL_2, BLUE, "--"), (MODEL_3, ORANGE, "-"),
            (FOAM_2, GREEN, "-"),
        ):  # fmt: skip
            chain, velocity = impact_scene(name), ff.published[name].striker_velocity
            lost = [lost_share(chain, velocity * f) for f in factors]
            ax.plot(factors, lost, color=colour, ls=style, label=name)
        ax.axvline(1.0, color=GREY, lw=0.8, ls=":")
        ax.set(xlabel="velocity over the published one (–)", ylabel="energy lost (% of striker's)")
        ax.legend()


def of_ratios() -> dict[str, Any]:
    """Numbers and table of the third claim."""
    each = {name: ratio_readings(name) for name in SETS}
    readings = {label: {name: each[name][label] for name in SETS} for label in each[MODEL_2]}
    printed = {name: ff.published[name].damping_ratio or math.nan for name in SETS}
    formula = next(iter(readings))
    off = {name: 100 * abs(readings[formula][name] / printed[name] - 1) for name in SETS}
    nearest = min(readings, key=lambda label: abs(readings[label][MODEL_2] - printed[MODEL_2]))
    return {
        "ratio": readings[formula], "readings": len(readings), "nearest": nearest,
        "nearest_value": readings[nearest][MODEL_2], "spread": max(off[MODEL_3], off[FOAM_2]),
        "short": off[MODEL_2], "wanted": viscosity_wanted(),
        "table_ratios": studies.lines(
            (label, f"{row[MODEL_2]:.3f}", f"{row[MODEL_3]:.4f}", f"{row[FOAM_2]:.3f}")
            for label, row in readings.items()
        ),
    }  # fmt: skip


def of_energy() -> dict[str, Any]:
    """Numbers and table of the fourth claim."""
    cases = {
        "foam-1 model-1": (MODEL_1, True), "foam-1 model-2": (MODEL_2, True),
        "foam-1 model-3, S2, 5.56 mg between": (MODEL_3, True),
        "foam-1 model-3, S2, massless": (MODEL_3, False),
        "foam-2, S2, 5.05 mg between": (FOAM_2, True), "foam-2, S2, massless": (FOAM_2, False),
    }  # fmt: skip
    rows = {label: energy_row(*case) for label, case in cases.items()}
    m2, m3, f2 = (list(rows.values())[i] for i in (1, 3, 4))
    massless = (row for label, row in rows.items() if "between" not in label)
    model = ff.published[MODEL_2]
    viscous = ETA * m2["velocity"] / model.chain.height  # stress of the dashpot at first contact
    cells = "{velocity:.2f} | {strain:.4f} | {c1:.4f} | {mpa:.2f} | {rebound:.3f} | {needed:.4f}"
    return {
        "m2": m2, "m3": m3, "f2": f2, "f2_spare": -f2["excess"], "f2_peak": 1e-6 * f2["peak"],
        "f2_lost": 100 * (1 - (f2["rebound"] / f2["velocity"]) ** 2),
        "m2_mass": 1e3 * STRIKER * (1 + m2["excess"] / 100),
        "eta_mpa": 1e-6 * viscous, "eta_times": viscous / model.bistable.sigma_hat_c,
        "check_energy": max(abs(r["needed"] / r["needed_energy"] - 1) for r in massless),
        "table_energy": studies.lines(
            (label, cells.format(mpa=1e-6 * row["peak"], **row), f"{row['excess']:+.1f}")
            for label, row in rows.items()
        ).replace("| -", "| −"),
    }  # fmt: skip


def of_microscale() -> dict[str, Any]:
    """Numbers and table of the fifth claim.

    How far are the branches of a published spring from what snapping micro-springs make? Slopes are
    those at A1 (MPa); p is the fraction of snapped micro-springs that a branch stands for.
    """
    rows, too_stiff = [], []
    for name in (MODEL_1, MODEL_2, MODEL_3, FOAM_2):
        s = ff.published[name].bistable
        d, a = s.kh_plus / 1e6, s.k0 / (1 - s.eps_a) ** 2 / 1e6

        def p(stress: Array, strain: Array, s: ff.BistableSpring = s) -> Array:
            on_a, on_c = stress / (s.k0 + stress), s.eps_star + stress / (s.kc + stress)
            return (strain - on_a) / (on_c - on_a)

        up = np.linspace(s.sigma_a, s.sigma_hat_c, 20001)
        down = np.linspace(s.sigma_hat_a or 0.0, s.sigma_c, 20001)
        least = 100 * np.min(p(up, s.eps_a + (up - s.sigma_a) / s.kh_plus))
        rises = np.all(np.diff(p(down, s.eps_c + (down - s.sigma_c) / s.kh_minus)) >= 0.0)
        rows.append((name, f"{d:.1f}", f"{a:.1f}", f"{least:.1f}", "yes" if rises else "no"))
        too_stiff.append(d / a)
    return {
        "too_stiff_least": min(too_stiff), "too_stiff_most": max(too_stiff),
        "table_microscale": studies.lines(rows).replace("| -", "| −"),
    }  # fmt: skip


def main() -> None:
    out = studies.arguments(__doc__, HERE).parse_args().out
    draw_energy(out / "energy.png")
    page = studies.write_page(HERE, out, **of_ratios(), **of_energy(), **of_microscale())
    page = re.sub(r"(?<=[kε\u0302])_(h[+−]|[ac*])", r"<sub>\1</sub>", page)  # k_c, ε_a, …
    (out / "README.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
