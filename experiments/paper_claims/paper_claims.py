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
from foamfit.springs.law import BRANCH_NAMES

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from studies import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION, Array

HERE = Path(__file__).parent


def mark(ax: Any, x: float, text: str, y: float = 0.03, dx: int = 3, **more: Any) -> None:
    """Draw a dotted line at an abscissa with a label."""
    ax.axvline(x, color=GREY, lw=0.8, ls=":")
    ax.annotate(
        text, (x, y), xycoords=("data", "axes fraction"), xytext=(dx, 0), color="0.35",
        textcoords="offset points", fontsize=7.5, **more,
    )  # fmt: skip


def draw_oscillation(drive: Drive, needed: float, path: Path) -> None:
    """Draw stress and displacement with the foam's mass, with and without damper; errors over η."""
    t = 1e3 * drive.time
    free, damped = claims.driven(drive, OWN_MASS, 0.0), claims.driven(drive, OWN_MASS, needed)
    with studies.sheet(path, 7.0, 4.9) as figure:
        axes = figure.subplots(2, 2).ravel()
        panels = (
            ("(a) stress", "spring stress (MPa)", lambda r: r.base_stress / 1e6,
             drive.stress / 1e6),
            ("(b) displacement", "displacement (mm)", lambda r: 1e3 * r.displacement[-1],
             1e3 * drive.displacement),
            ("(c) stress minus that of equilibrium", "difference (MPa)",
             lambda r: (r.base_stress - drive.stress) / 1e6, 0.0 * t),
        )  # fmt: skip
        for ax, (title, label, curve, exact) in zip(axes, panels, strict=False):
            ax.plot(t, curve(free), color=VERMILION, lw=0.9, label="5.56 mg, no damper")
            name = f"5.56 mg, damper of {needed:.2g} Pa·s"
            ax.plot(t, curve(damped), color=BLUE, lw=0.9, label=name)
            ax.plot(t, exact, color=BLACK, lw=0.8, ls="--", label="equilibrium")
            ax.set(xlabel="time (ms)", ylabel=label, title=title)
        axes[0].legend(loc="upper right")
        axes[0].set_ylim(top=1.75 * np.max(drive.stress) / 1e6)
        axes[2].set_ylim(bottom=-0.9)
        for at, source, target in free.switches[:3, [0, 2, 3]]:  # the last one is at the very end
            name = f"{BRANCH_NAMES[int(source)]}→{BRANCH_NAMES[int(target)]}"
            mark(axes[2], 1e3 * at, name, 0.02, 2)
        dampers = np.geomspace(1.0, ETA, 33)
        rows = [claims.oscillation(drive, OWN_MASS, damper) for damper in dampers]
        for key, style, name in (
            ("vibration", {"color": VERMILION, "marker": "o"}, "vibration (what the mass adds)"),
            ("lag", {"color": BLUE, "marker": "s"}, "lag (what the damper does)"),
        ):
            axes[3].loglog(dampers, [row[key] for row in rows], ms=3, lw=0.9, label=name, **style)
        mark(axes[3], needed, "no more\nturns")
        mark(axes[3], ETA, "published", 0.6, -3, ha="right")
        axes[3].set(xlabel="onsite damper η (Pa·s)", ylabel="RMS stress error (% of peak)")
        axes[3].set(title="(d) two errors of the damper")
        axes[3].set_ylim(top=1e3)
        axes[3].legend(loc="upper left")


def draw_energy(path: Path) -> None:
    """Draw published loops with the published impact, and energy lost over velocity."""
    with studies.sheet(path, 7.0, 2.9) as figure:
        axes = figure.subplots(1, 3)
        for ax, name, title in (
            (axes[0], MODEL_2, "(a) foam-1 model-2, 1.75 m/s"),
            (axes[1], FOAM_2, "(b) foam-2, S2, 4.44 m/s"),
        ):
            item, chain = ff.published[name], claims.impact_scene(name)
            s, got = item.bistable, claims.struck(chain, item.striker_velocity, 4001)
            c1 = s.eps_hat_c, s.sigma_hat_c / 1e6
            loop = np.append(np.linspace(0, c1[0], 800), np.linspace(c1[0] * (1 + 1e-9), 0, 800))
            stress = s.stress(loop)
            there = stress >= 0
            ax.plot(loop[there], stress[there] / 1e6, color=GREY, lw=2.6, alpha=0.6, label="loop")
            strain = claims.spring_strain(chain, got)[got.time <= (got.contact_end or math.inf)]
            ax.plot(strain, s.stress(strain) / 1e6, color=VERMILION, lw=1.1, label="impact")
            ax.plot(*c1, "o", color=BLACK, ms=3.5)
            ax.annotate("C1", c1, xytext=(-6, 3), ha="right", textcoords="offset points")
            ax.set(xlabel="strain of the spring (–)", ylabel="spring stress (MPa)", title=title)
            ax.legend(loc="upper left")
            ax.margins(y=0.12)
        ax, factors = axes[2], np.linspace(0.9, 1.25, 141)
        for name, colour, style in (
            (MODEL_1, SKY, "-"), (MODEL_2, BLUE, "--"), (MODEL_3, ORANGE, "-"),
            (FOAM_2, GREEN, "-"),
        ):  # fmt: skip
            chain, velocity = claims.impact_scene(name), ff.published[name].striker_velocity
            lost = [claims.lost_share(chain, velocity * f) for f in factors]
            ax.plot(factors, lost, color=colour, ls=style, label=name)
        mark(ax, 1.0, "published", 0.12, rotation=90)
        ax.set(xlabel="velocity over the published one (–)", ylabel="energy lost (% of striker's)")
        ax.set(ylim=(-4, 132), title="(c) energy lost", yticks=[0, 25, 50, 75, 100])
        ax.legend(loc="upper left", ncols=2, columnspacing=0.8, handlelength=1.2, fontsize=6.5)


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
    drive, first = claims.drive_of_impact(MODEL_2), claims.drive_of_impact(MODEL_1)
    needed = claims.damper_needed(drive)
    free, damped = (claims.oscillation(drive, OWN_MASS, eta) for eta in (0.0, needed))
    coarse = claims.drive_of_impact(samples=1001)
    fewer = claims.driven(coarse, OWN_MASS, 0.0, rtol=1e-6).base_stress
    undamped, exact = claims.driven(drive, OWN_MASS, 0.0), claims.driven(drive, 0.0, 0.0)
    dampers = np.geomspace(0.3, 300.0, 61)
    errors = [claims.displacement_error(drive, OWN_MASS, damper) for damper in dampers]
    best = float(dampers[np.argmin(errors)])
    cells = "{stress:.2f} | {displacement:.2f} | {vibration:.3f} | {lag:.2f} | {turns} | {turns_w}"
    rows = []
    for label, given, damper in (
        ("model-1, no damper", first, 0.0),
        ("model-2, no damper", drive, 0.0),
        ("model-2, damper nearest to equilibrium", drive, best),
        ("model-2, least damper without turns", drive, needed),
        ("model-2, published damper of model-3", drive, 3e2),
        ("model-2, its published damper", drive, ETA),
    ):
        row = cells.format(**claims.oscillation(given, OWN_MASS, damper))
        rows.append((label, f"{float(f'{damper:.3g}'):g}", row))
    slopes, branches = (
        {"": drive.spring.k0, "_c": drive.spring.kc},
        claims.vibration_by_branch(drive),
    )
    return {
        "velocity": claims.DRIVE_VELOCITY, "samples": claims.SAMPLES,
        "contact": 1e3 * drive.time[-1],
        "turn": 100 * claims.TURN, "turn_kpa": 1e-3 * claims.TURN * float(np.ptp(drive.stress)),
        "needed": needed, "needed_1": claims.damper_needed(first),
        "needed_175": claims.damper_needed(claims.drive_of_impact(MODEL_2, 1.75)),
        "needed_coarse": claims.damper_needed(drive, share=0.01),
        "needed_ratio": claims.ratio_readings(MODEL_2, needed)["ρ = bulk density of the foam"],
        "free": free, "damped": damped, "quieter": free["vibration"] / damped["vibration"],
        "by_branch": ", ".join(f"{k} {v:.1f} %" for k, v in branches.items()),
        "early": 1e6 * (exact.switches[:2, 0] - undamped.switches[:2, 0]),
        "moved": float(100 * np.max(abs(undamped.base_stress[::4] - fewer)) / drive.stress.max()),
        "eta_over_needed": round(ETA / needed, -2),
        "published_own": claims.displacement_error(drive, OWN_MASS, ETA),
        "best": best, "at_best": min(errors), "table_oscillation": studies.lines(rows),
    } | {
        f"period_{name}{suffix}": scale * claims.free_period(drive, mass, slope)
        for suffix, slope in slopes.items()
        for name, mass, scale in (("own", OWN_MASS, 1e6), ("striker", STRIKER, 1e3))
    }  # fmt: skip


def of_literal() -> dict[str, Any]:
    """Numbers and tables of the second claim."""
    cases = ((0.0, 0.0), (STRIKER, 0.0), (STRIKER, ETA), (OWN_MASS, 0.0))
    drives = {v: claims.drive_of_impact(MODEL_2, v) for v in claims.OTHER_VELOCITIES}
    errors = {v: [claims.displacement_error(d, *case) for case in cases] for v, d in drives.items()}
    closed = {v: np.max(d.displacement) / d.height > d.spring.eps_hat_c for v, d in drives.items()}
    rows = (
        (f"{v:.2f}", "yes" if closed[v] else "no", *(f"{error:.1f}" for error in own))
        for v, own in errors.items()
    )
    drive = drives[claims.DRIVE_VELOCITY]
    slow = {s: [claims.slowed(drive, eta, s) for eta in (0.0, ETA)] for s in (1, 10, 100, 1000)}
    _, undamped, damped, _ = zip(*errors.values(), strict=True)
    own = [row[3] for v, row in errors.items() if v != 1.9]
    return {
        "literal": errors[claims.DRIVE_VELOCITY][1],
        "literal_low": min(undamped), "literal_high": max(undamped),
        "literal_damped_low": min(damped), "literal_damped_high": max(damped),
        "literal_eta_only": claims.displacement_error(drive, 0.0, ETA),
        "own_low": min(own), "own_high": max(own), "own_jump": errors[1.9][3],
        "slowing": math.sqrt(STRIKER / OWN_MASS), "slow": slow[1000][1],
        "table_literal": studies.lines(rows),
        "table_slow": studies.lines((s, f"{a:.2f}", f"{b:.2f}") for s, (a, b) in slow.items()),
    }  # fmt: skip


def of_ratios() -> dict[str, Any]:
    """Numbers and table of the third claim."""
    each, wanted = {name: claims.ratio_readings(name) for name in SETS}, claims.ratio_wanted()
    readings = {label: {name: each[name][label] for name in SETS} for label in each[MODEL_2]}
    printed = {name: ff.published[name].damping_ratio or math.nan for name in SETS}
    off = {
        label: {name: 100 * (row[name] / printed[name] - 1) for name in SETS}
        for label, row in readings.items()
    }
    formula = next(iter(readings))
    nearest = min(off, key=lambda label: abs(off[label][MODEL_2]))
    return {
        "ratio": readings[formula], "readings": len(readings), "nearest": nearest,
        "nearest_value": readings[nearest][MODEL_2],
        "spread": max(abs(off[formula][name]) for name in (MODEL_3, FOAM_2)),
        "short": -off[formula][MODEL_2], "wanted": wanted,
        **{f"wanted_{name}": 1e3 * wanted[name] for name in ("mass", "height", "diameter")},
        "table_ratios": studies.lines(
            (label, f"{row[MODEL_2]:.3f}", f"{row[MODEL_3]:.4f}", f"{row[FOAM_2]:.3f}")
            for label, row in readings.items()
        ),
    }  # fmt: skip


def of_energy() -> dict[str, Any]:
    """Numbers and tables of the fourth claim."""
    rows = {
        "foam-1 model-1": claims.energy_row(MODEL_1),
        "foam-1 model-2": claims.energy_row(MODEL_2),
        "foam-1 model-3, S2, 5.56 mg between": claims.energy_row(MODEL_3),
        "foam-1 model-3, S2, massless": claims.energy_row(MODEL_3, interior=False),
        "foam-2, S2, 5.05 mg between": claims.energy_row(FOAM_2),
        "foam-2, S2, massless": claims.energy_row(FOAM_2, interior=False),
    }
    massless = {label: row for label, row in rows.items() if "between" not in label}
    m2, m3, f2 = (list(rows.values())[i] for i in (1, 3, 4))
    eta = claims.published_viscosity()
    cells = "{velocity:.2f} | {strain:.4f} | {c1:.4f} | {mpa:.2f} | {rebound:.3f} | {needed:.4f}"
    works = "{brought:.0f} | {work:.0f} | {loop:.0f}"
    return {
        "m2": m2, "m3": m3, "f2": f2, "f2_left": f2["left"], "f2_spare": -f2["excess"],
        "f2_peak": 1e-6 * f2["peak"],
        "f2_lost": 100 * (1 - (f2["rebound"] / f2["velocity"]) ** 2),
        "m2_mass": 1e3 * STRIKER * (1 + m2["excess"] / 100),
        "eta_mpa": 1e-6 * eta["stress"], "eta_first": 1e-6 * eta["first"],
        "eta_strain": eta["strain"], "eta_times": eta["stress"] / eta["c1"],
        "eta_foam_2": 1e-6 * eta["foam_2"],
        "check_energy": max(abs(r["needed"] / r["needed_energy"] - 1) for r in massless.values()),
        "table_energy": studies.lines(
            (label, cells.format(mpa=1e-6 * row["peak"], **row), f"{row['excess']:+.1f}")
            for label, row in rows.items()
        ).replace("| -", "| −"),
        "table_work": studies.lines(
            (label.removesuffix(", S2, massless"), works.format(**row))
            for label, row in massless.items()
        ),
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
