"""Are the claims of the paper correct that can be tested without its data?

Method and answers: README.md, every number of which is computed by `claims` from the published
parameters (Thevamaran, Fraternali & Daraio 2014, Tables 1-3).

    python experiments/paper_claims/paper_claims.py
"""

import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

import claims
import foamfit as ff
from claims import ETA, FOAM_2, MODEL_1, MODEL_2, MODEL_3, OWN_MASS, SETS, STRIKER, Drive

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION, Array

HERE = Path(__file__).parent


def draw_oscillation(drive: Drive, needed: float, path: Path) -> None:
    """Draw stress and its error with the foam's mass, with and without damper; errors over η."""
    t = 1e3 * drive.time
    runs = {
        "5.56 mg, no damper": (claims.driven(drive, OWN_MASS, 0.0), VERMILION),
        f"5.56 mg, damper of {needed:.2g} Pa·s": (claims.driven(drive, OWN_MASS, needed), BLUE),
    }
    dampers = np.geomspace(1.0, ETA, 33)
    rows = [claims.oscillation(drive, OWN_MASS, damper) for damper in dampers]
    with studies.sheet(path, 7.0, 2.6) as figure:
        axes = figure.subplots(1, 3)
        for label, (run, colour) in runs.items():
            axes[0].plot(t, run.base_stress / 1e6, color=colour, lw=0.9, label=label)
            axes[1].plot(t, (run.base_stress - drive.stress) / 1e6, color=colour, lw=0.9)
        axes[0].plot(t, drive.stress / 1e6, color=BLACK, lw=0.8, ls="--", label="equilibrium")
        axes[0].set(ylabel="spring stress (MPa)", title="(a) stress")
        axes[0].set_ylim(top=1.75 * np.max(drive.stress) / 1e6)
        axes[1].set(ylabel="difference (MPa)", title="(b) minus that of equilibrium")
        for ax in axes[:2]:
            ax.set_xlabel("time (ms)")
        for key, colour in (("vibration", VERMILION), ("lag", BLUE)):
            axes[2].loglog(dampers, [row[key] for row in rows], color=colour, label=key)
        for at in (needed, ETA):
            axes[2].axvline(at, color=GREY, lw=0.8, ls=":")
        axes[2].set(xlabel="onsite damper η (Pa·s)", ylabel="RMS stress error (% of peak)")
        axes[2].set_title("(c) two errors of the damper")
        axes[0].legend(loc="upper right", fontsize=6.5)
        axes[2].legend()


def draw_energy(path: Path) -> None:
    """Draw the energy that the striker loses over its velocity."""
    factors = np.linspace(0.9, 1.25, 141)
    with studies.sheet(path, 4.4, 2.9) as figure:
        ax = figure.add_subplot()
        for name, colour, style in (
            (MODEL_1, SKY, "-"), (MODEL_2, BLUE, "--"), (MODEL_3, ORANGE, "-"),
            (FOAM_2, GREEN, "-"),
        ):  # fmt: skip
            chain, velocity = claims.impact_scene(name), ff.published[name].striker_velocity
            lost = [claims.lost_share(chain, velocity * f) for f in factors]
            ax.plot(factors, lost, color=colour, ls=style, label=name)
        ax.axvline(1.0, color=GREY, lw=0.8, ls=":")
        ax.set(xlabel="velocity over the published one (–)", ylabel="energy lost (% of striker's)")
        ax.legend()


def main() -> None:
    out = studies.arguments(__doc__, HERE).parse_args().out
    drive = claims.drive_of_impact()
    draw_oscillation(drive, claims.damper_needed(drive), out / "oscillation.png")
    draw_energy(out / "energy.png")
    values = of_oscillation() | of_literal() | of_ratios() | of_energy() | of_microscale()
    page = studies.write_page(HERE, out, **values)
    page = re.sub(r"(?<=[kε\u0302])_(h[+−]|[ac*])", r"<sub>\1</sub>", page)  # k_c, ε_a, …
    (out / "README.md").write_text(page, encoding="utf-8")


def of_oscillation() -> dict[str, Any]:
    """Return numbers and table of the first claim."""
    drive = claims.drive_of_impact()
    needed = claims.damper_needed(drive)
    cases = {"no damper": 0.0, "least damper without turns": needed, "published damper": ETA}
    found = {label: claims.oscillation(drive, OWN_MASS, eta) for label, eta in cases.items()}
    free, damped, published = found.values()
    coarse = claims.drive_of_impact(samples=1001)
    fewer = claims.driven(coarse, OWN_MASS, 0.0, rtol=1e-6).base_stress
    moved = claims.driven(drive, OWN_MASS, 0.0).base_stress[::4] - fewer
    cells = "{stress:.2f} | {displacement:.2f} | {vibration:.3f} | {lag:.2f} | {turns} | {turns_w}"
    return {
        "velocity": claims.DRIVE_VELOCITY, "samples": claims.SAMPLES,
        "contact": 1e3 * drive.time[-1], "turn": 100 * claims.TURN, "needed": needed,
        "free": free, "damped": damped, "quieter": free["vibration"] / damped["vibration"],
        "moved": float(100 * np.max(abs(moved)) / drive.stress.max()),
        "eta_over_needed": round(ETA / needed, -2), "published_own": published["displacement"],
        "period_own": 1e6 * claims.free_period(drive, OWN_MASS, drive.spring.k0),
        "period_striker": 1e3 * claims.free_period(drive, STRIKER, drive.spring.k0),
        "table_oscillation": studies.lines(
            (label, f"{float(f'{cases[label]:.3g}'):g}", cells.format(**row))
            for label, row in found.items()
        ),
    }  # fmt: skip


def of_literal() -> dict[str, Any]:
    """Numbers and table of the second claim."""
    cases = ((0.0, 0.0), (STRIKER, 0.0), (STRIKER, ETA), (OWN_MASS, 0.0))
    drives = {v: claims.drive_of_impact(MODEL_2, v) for v in claims.OTHER_VELOCITIES}
    errors = {v: [claims.displacement_error(d, *case) for case in cases] for v, d in drives.items()}
    _, undamped, damped, _ = zip(*errors.values(), strict=True)
    own = [row[3] for v, row in errors.items() if v != 1.9]
    return {
        "literal": errors[claims.DRIVE_VELOCITY][1],
        "literal_low": min(undamped), "literal_high": max(undamped),
        "literal_damped_low": min(damped), "literal_damped_high": max(damped),
        "own_low": min(own), "own_high": max(own), "own_jump": errors[1.9][3],
        "slowing": math.sqrt(STRIKER / OWN_MASS),
        "slow": claims.slowed(drives[claims.DRIVE_VELOCITY], ETA, 1000.0),
        "table_literal": studies.lines(
            (f"{v:.2f}", *(f"{error:.1f}" for error in row)) for v, row in errors.items()
        ),
    }  # fmt: skip


def of_ratios() -> dict[str, Any]:
    """Numbers and table of the third claim."""
    each = {name: claims.ratio_readings(name) for name in SETS}
    readings = {label: {name: each[name][label] for name in SETS} for label in each[MODEL_2]}
    printed = {name: ff.published[name].damping_ratio or math.nan for name in SETS}
    formula = next(iter(readings))
    off = {name: 100 * abs(readings[formula][name] / printed[name] - 1) for name in SETS}
    nearest = min(readings, key=lambda label: abs(readings[label][MODEL_2] - printed[MODEL_2]))
    return {
        "ratio": readings[formula], "readings": len(readings), "nearest": nearest,
        "nearest_value": readings[nearest][MODEL_2], "spread": max(off[MODEL_3], off[FOAM_2]),
        "short": off[MODEL_2], "wanted": claims.viscosity_wanted(),
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
    rows = {label: claims.energy_row(*case) for label, case in cases.items()}
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


if __name__ == "__main__":
    main()
