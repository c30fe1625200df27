"""What does the solver do with stiff and extreme scenes? A study of more than two thousand of them.

Method. Each scene of scenes.py (all are synthetic) must end with an answer inside its tolerance or
with a `SimulationError` that says why. The judges are shorter steps, the other method of the solver
and the balance of energy (judges.py), and brute force (independent.py). fresh.py draws other scenes
at random and judges them by brute force alone; its table is on the page, too.

Answer. 1,911 answers inside tolerance, 109 refused with a reason, none wrong: see README.md.

One command runs fresh scenes, and one the study, which writes scenes.csv (a line per scene),
table.csv, stability.png and README.md; the last only writes these again from scenes.csv and
fresh.csv:

    python experiments/stability/fresh.py
    python experiments/stability/stability.py
    python experiments/stability/stability.py --page
"""

from __future__ import annotations

import faulthandler
import math
import platform
import sys
import time
import warnings
from collections.abc import Iterable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.colors import BoundaryNorm, ListedColormap

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import fresh  # noqa: E402
from independent import judge, over_range  # noqa: E402
from judges import balance_of, explicit_fits, refined, ripple_of  # noqa: E402
from scenes import SWEEPS, Point, designed, scene_of, swept  # noqa: E402

import foamfit as ff  # noqa: E402
import studies  # noqa: E402
from foamfit.solve.plan import MOST_WORK  # noqa: E402

RTOL, DESIGNED, SEED = 1e-6, 1550, 4
ENERGY_BAR = 10.0 * RTOL  # the energy is made of both displacement and stress, over a whole history
BARS = {
    "refinement": RTOL, "other method": RTOL, "energy": ENERGY_BAR, "impulse": ENERGY_BAR,
    "ripple": RTOL, "independent": RTOL,
}  # fmt: skip
LONGEST = 300  # s; a scene that takes longer ends the study
BRUTE = 3_000_000  # steps times springs up to which brute force judges
CHEAP = 50_000  # steps times springs up to which the other method is tried too


def judged(point: Point) -> dict[str, Any]:
    """Simulate one scene and judge what comes of it: a line of the study."""
    scene, began = scene_of(point), time.perf_counter()
    found: dict[str, Any] = {"outcome": "refused", "reason": "", "method": "", "steps": 0}
    found |= {"seconds": 0.0, **dict.fromkeys((*BARS, "error"), math.nan)}
    try:
        answer = ff.simulate(*scene, rtol=RTOL)
    except ff.SimulationError as refusal:
        reason = fresh.reason_of(refusal)
        return found | {"seconds": time.perf_counter() - began, "reason": reason}
    found["seconds"] = time.perf_counter() - began
    found |= {"method": answer.method, "steps": answer.steps}
    finite = np.isfinite(answer.displacement).all() and np.isfinite(answer.base_stress).all()
    if not finite:
        return found | {"outcome": "failure", "reason": "not a number"}
    work = answer.steps * len(scene[0].springs)
    balance = balance_of(scene, answer, RTOL) if work < CHEAP else None
    implicit, most = answer.method == "Radau IIA", 10 * work + CHEAP
    found["refinement"] = 0.0
    if answer.steps:
        found["refinement"] = refined(scene, answer, RTOL, implicit=implicit, most=most)
        if found["refinement"] is None:
            found["refinement"] = refined(scene, answer, RTOL, implicit=not implicit, most=most)
    if answer.steps and work < CHEAP and len(scene[2]) < 20_000 and explicit_fits(scene):
        other = refined(scene, answer, RTOL, implicit=not implicit, most=CHEAP // 3)
        found["other method"] = math.nan if other is None else other
    if balance is not None:
        found |= {"energy": balance.energy, "impulse": balance.impulse}
    ripple = ripple_of(scene, answer, RTOL)
    found["ripple"] = math.nan if ripple is None else ripple
    truth = judge(*scene, BRUTE)
    if not truth.why and truth.unsure <= 0.1 * RTOL:
        found["independent"] = max(
            over_range(answer.displacement, truth.displacement),
            over_range(answer.base_stress, truth.base_stress),
        )
    errors = [found["refinement"], found["other method"], found["independent"]]
    found["error"] = np.nanmax([math.inf if e is None else e for e in errors])
    bad = [name for name, bar in BARS.items() if found[name] is None or found[name] > bar]
    return found | {"outcome": "failure" if bad else "answer", "reason": ", ".join(bad)}


def study(designed_scenes: int) -> pd.DataFrame:
    """Judge every scene; one line each."""
    scenes = [*swept(), *(("design", point) for point in designed(designed_scenes, SEED))]
    lines: list[dict[str, Any]] = []
    try:
        for number, (axis, point) in enumerate(scenes):
            faulthandler.dump_traceback_later(LONGEST, exit=True)
            lines.append({"axis": axis, **asdict(point), **judged(point)})
            faulthandler.cancel_dump_traceback_later()
            if lines[-1]["outcome"] == "failure" or number % 100 == 0:
                print(number, lines[-1], file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print(f"stopped after {len(lines)} of {len(scenes)} scenes", file=sys.stderr)
    return pd.DataFrame(lines)


# --------------------------------------------------------------------------------------- the table

EDGES: dict[str, list[float]] = {
    "kc_ratio": [1, 10, 1e2, 1e3, 1e4, 1e5],
    "dsigma_ratio": [-0.99, -0.9, -0.5, -0.1, -1e-12, 0],
    "kh_plus_ratio": [0, 1e-9, 0.01, 0.1, 1, 10, 100],
    "kh_minus_ratio": [0, 1e-9, 0.01, 0.1, 1, 10, 100],
    "mass": [0, 1e-13, 1e-10, 1e-8, 1e-6, 1e-4, 7e-3],
    "top_mass": [0, 1e-13, 1e-10, 1e-8, 1e-6, 1e-4, 7e-3],
    "eta": [0, 1e-9, 1e-3, 1, 1e3, 1e6, 1e8],
    "site_eta": [0, 1e-9, 1e-3, 1, 1e3, 1e6, 1e8],
    "velocity": [1e-3, 1e-2, 0.1, 1, 10, 100],
    "height": [1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1],
    "springs": [1, 2, 4, 11, 101, 1001],
    "samples": [5, 20, 100, 1000, 10_000, 100_000, 1_000_001],
}
TITLES = {
    "kc_ratio": "k_c/k0", "dsigma_ratio": "Δσ/σ_a", "kh_plus_ratio": "k_h+/k0",
    "kh_minus_ratio": "k_h−/k0", "mass": "interior mass (kg)",
    "top_mass": "top mass, stress drive (kg)", "eta": "η of the springs (Pa·s)",
    "site_eta": "η onsite (Pa·s)", "velocity": "velocity (m/s)", "height": "height (m)",
    "springs": "springs", "samples": "samples", "drive": "drive", "history": "history",
    "kinds": "springs from the base",
}  # fmt: skip


def parts(axis: str, lines: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Split the scenes to which an axis means something into its ranges."""
    if axis == "velocity":
        lines = lines[lines.drive == "impact"]
    elif axis == "top_mass":
        lines = lines[lines.drive == "stress"]
    elif axis == "mass":
        lines = lines[lines.springs > 1]
    elif axis == "history":
        lines = lines[lines.drive != "impact"]
    if axis not in EDGES:
        return [(str(value), group) for value, group in lines.groupby(axis)]
    edges, found = EDGES[axis], []
    for low, high in pairwise(edges):
        zero = low == 0 and 0 < high <= 1e-9
        last = high == edges[-1]
        inside = lines[axis].between(low, high, inclusive="both" if last else "left")
        label = "0" if zero or (last and low == -1e-12) else f"{low:g} … {high:g}"
        if axis == "springs":
            label = f"{low:g} … {high - 1:g}" if high - low > 1 else f"{low:g}"
        found.append((label, lines[inside]))
    return found


def table(lines: pd.DataFrame) -> pd.DataFrame:
    """Count outcomes, errors, methods and seconds per axis and range."""
    rows = []
    for axis in ("all", *TITLES):
        for label, group in [("", lines)] if axis == "all" else parts(axis, lines):
            answers = group[group.outcome == "answer"]
            methods = answers.method.value_counts()
            rows.append(
                {
                    "axis": TITLES.get(axis, "all scenes"), "range": label, "scenes": len(group),
                    "answers": len(answers), "refused": int((group.outcome == "refused").sum()),
                    "reasons": fresh.reasons(group[group.outcome == "refused"]),
                    "failures": int((group.outcome == "failure").sum()),
                    "median error": answers.error.median(), "largest error": answers.error.max(),
                    "largest energy residual": answers.energy.max(),
                    "judged by brute force": int(answers.independent.notna().sum()),
                    "largest by brute force": answers.independent.max(),
                    "closed form": int(methods.get("closed form", 0)),
                    "Taylor": int(methods.get("Taylor series", 0)),
                    "Radau": int(methods.get("Radau IIA", 0)),
                    "median s": group.seconds.median(), "longest s": group.seconds.max(),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


# -------------------------------------------------------------------------------------- the picture


def heat_map(rows: pd.DataFrame, path: Path) -> None:
    """Per axis and range: the share of answers, and the largest error of those answers."""
    axes = [title for key, title in TITLES.items() if key in EDGES]
    steps = np.arange(-16, -5)
    colours = matplotlib.colormaps["viridis_r"](np.linspace(0.0, 0.85, len(steps) - 1))
    looks: list[tuple[str, str, dict[str, Any]]] = [
        ("Scenes that end with an answer", "answers (%)",
         {"vmin": 50, "vmax": 100, "cmap": "RdYlGn"}),
        (f"Largest error of an answer, over the range (wanted: {RTOL:g})",
         "log10 of the largest error",
         {"norm": BoundaryNorm(steps, len(steps) - 1), "cmap": ListedColormap(colours)}),
    ]  # fmt: skip
    with studies.sheet(path, 13.0, 5.8, 150) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        values = np.full((2, len(axes), max(map(len, EDGES.values())) - 1), np.nan)
        for i, title in enumerate(axes):
            for j, (_, row) in enumerate(rows[rows.axis == title].iterrows()):
                largest = row["largest error"]
                texts = f"{row.answers} of {row.scenes}", f"{largest:.0e}" if largest else "0"
                if row.scenes:
                    values[0, i, j] = 100.0 * row.answers / row.scenes
                if row.answers:
                    values[1, i, j] = math.log10(max(largest, 1e-16))
                for panel, text in zip(panels, texts, strict=True):
                    panel.text(j, i + 0.3, row["range"], ha="center", va="center", fontsize=5.5)
                    if row.answers or panel is panels[0]:
                        panel.text(j, i - 0.12, text, ha="center", va="center", fontsize=7)
        for panel, shown, (title, label, look) in zip(panels, values, looks, strict=True):
            shades = panel.imshow(shown, alpha=0.65, aspect="auto", **look)
            figure.colorbar(shades, ax=panel, label=label, shrink=0.6)
            panel.set_title(title)
            panel.set_yticks(range(len(axes)), axes)
            panel.set_xticks([])
            panel.tick_params(length=0)
            panel.spines[:].set_visible(False)


# ----------------------------------------------------------------------------------------- the page


def _number(value: float, form: str = ".0e") -> str:
    return "–" if not math.isfinite(value) else "0" if value == 0.0 else format(value, form)


def named_once(rows: Iterable[list[Any]]) -> list[list[Any]]:
    """Leave out the first cell of a row where it is that of the row before."""
    given = list(rows)
    return [
        [row[0] if row[0] != last[0] else "", *row[1:]]
        for last, row in zip([[None], *given], given, strict=False)
    ]


def refused(row: Any) -> str:
    return f"{row.refused} ({row.reasons})" if row.refused else "0"


def fresh_table(lines: pd.DataFrame) -> str:
    """Count the fresh scenes per family and rtol, as a table of the page."""
    head = "family | rtol | scenes | judged | answers | refused | over 1 rtol | over 3 rtol | "
    head += "largest error / rtol | derivatives judged | wrong | longest s"
    rows = (
        [r.family, f"{r.rtol:g}", r.scenes, r.judged, r.answers, refused(r), r["over 1 rtol"],
         r["over 3 rtol"], _number(r.largest, ".2g"), r.derivatives, r["wrong derivatives"],
         f"{r['longest s']:.2g}"]
        for _, r in fresh.summary(lines).iterrows()
    )  # fmt: skip
    return studies.markdown(head, named_once(rows))


def memory_table(lines: pd.DataFrame, families: tuple[str, ...]) -> str:
    """Count the fresh scenes of springs with memory per family and rtol."""
    head = "family | rtol | scenes | judged | answers | refused | refused, beyond the judge | over "
    head += "1 rtol | over 3 rtol | largest error / rtol | by energy: impacts, largest / rtol | "
    head += "derivatives judged | refused | wrong, largest | longest s"
    rows, lines = [], lines[lines.family.isin(families)]
    for _, r in fresh.summary(lines).iterrows():
        own = lines[(lines.family == r.family) & (lines.rtol == r.rtol)]
        beyond = int(((own.outcome == "refused") & (own.judge != "judged")).sum())
        rows.append(
            [r.family, f"{r.rtol:g}", r.scenes, r.judged, r.answers, refused(r), beyond,
             r["over 1 rtol"], r["over 3 rtol"], _number(r.largest, ".2g"),
             f"{own.energy.notna().sum()}, {_number(r['largest energy'], '.1g')}", r.derivatives,
             r["refused derivatives"], f"{r['wrong derivatives']}, {_number(own.slope.max())}",
             f"{r['longest s']:.2g}"]
        )  # fmt: skip
    return studies.markdown(head, named_once(rows))


def memory_wrong(lines: pd.DataFrame, families: tuple[str, ...]) -> str:
    """Name the fresh scenes of springs with memory that are wrong, or refused though judged."""
    known = lines[lines.family.isin(families) & (lines.judge == "judged")]
    groups = {
        f"over {fresh.BAD:g} rtol at one rtol at least": known[known.outcome == "failure"],
        "with a wrong derivative": known[known.outcome == "wrong derivative"],
        "refused at one rtol at least": known[known.outcome == "refused"],
        "derivatives refused at one rtol at least": known[known.reason == "derivatives refused"],
    }
    named = [
        f"- {what} ({group.scene.nunique()}): {', '.join(group.scene.unique())}"
        for what, group in groups.items()
        if len(group)
    ]
    return "\n".join(named) or "None is wrong, and none that is judged is refused."


def page(lines: pd.DataFrame, rows: pd.DataFrame, drawn: pd.DataFrame) -> None:
    """Write the README of the study."""
    answers = lines[lines.outcome == "answer"]
    head = "axis | range | scenes | answers | refused | failures | median error | largest error | "
    head += "by brute force: judged / largest | closed form / Taylor / Radau | median s | longest s"
    cells = (
        [r.axis, r["range"], r.scenes, r.answers, refused(r), r.failures,
         _number(r["median error"]), _number(r["largest error"]),
         f"{r['judged by brute force']} / {_number(r['largest by brute force'])}",
         f"{r['closed form']} / {r.Taylor} / {r.Radau}", _number(r["median s"], ".2g"),
         _number(r["longest s"], ".2g")]
        for _, r in rows.iterrows()
    )  # fmt: skip
    studies.write_page(
        HERE, scenes=len(lines), answers=len(answers),
        refused=int((lines.outcome == "refused").sum()),
        failures=int((lines.outcome == "failure").sum()), energy=int(answers.energy.notna().sum()),
        largest_energy=_number(answers.energy.max()), ripples=int(answers.ripple.notna().sum()),
        largest_ripple=_number(answers.ripple.max()),
        other=int(answers["other method"].notna().sum()),
        independent=int(answers.independent.notna().sum()),
        largest_independent=_number(answers.independent.max()),
        fresh=fresh_table(drawn[~drawn.family.isin(fresh.MEMORY + fresh.REMEMBERING)]),
        memory=memory_table(drawn, fresh.MEMORY), worn=memory_table(drawn, fresh.REMEMBERING),
        memory_wrong=memory_wrong(drawn, fresh.MEMORY),
        worn_wrong=memory_wrong(drawn, fresh.REMEMBERING),
        worn_scenes=f"{drawn[drawn.family.isin(fresh.REMEMBERING)].scene.nunique():,}",
        fresh_scenes=f"{drawn.scene.nunique():,}",
        fresh_judged=f"{drawn[drawn.judge == 'judged'].scene.nunique():,}", fresh_seed=fresh.SEED,
        design=int((lines.axis == "design").sum()), largest=_number(answers.error.max()),
        longest=format(lines.seconds.max(), ".0f"),
        median=format(lines.seconds.median() * 1e3, ".1f"), rtol=f"{RTOL:g}",
        bar=f"{ENERGY_BAR:g}", work=f"{MOST_WORK:,}",
        sweeps=", ".join(TITLES[key] for key in SWEEPS),
        machine=f"{platform.machine()}, two shared cores, Python {platform.python_version()}, "
        f"NumPy {np.__version__}",
        table=studies.markdown(head, named_once(cells)),
    )  # fmt: skip


def main() -> None:
    """Run the study and write its files."""
    parser = studies.arguments(__doc__, scenes=(DESIGNED, "of the design"))
    parser.add_argument("--page", action="store_true", help="write the page of what was run")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if not (HERE / "fresh.csv").exists():
        sys.exit("fresh.csv is missing: make it first with python experiments/stability/fresh.py")
    drawn = pd.concat([pd.read_csv(HERE / name) for name in ("fresh.csv", "worn.csv")])
    lines = pd.read_csv(HERE / "scenes.csv") if options.page else study(options.scenes)
    lines["reason"] = lines.reason.fillna("")
    rows = table(lines)
    if not options.page:
        floats = {"seconds": 4, "error": 12}
        studies.write_csv(lines.round(floats), HERE / "scenes.csv", 6)
    studies.write_csv(rows, HERE / "table.csv")
    heat_map(rows, HERE / "stability.png")
    page(lines, rows, drawn)
    print(rows.iloc[0].to_string())
    print(fresh.summary(drawn).to_string(index=False))
    if (lines.outcome == "failure").any() or (drawn.outcome == "failure").any():
        sys.exit("some scenes ended with a wrong answer: see scenes.csv and fresh.csv")


if __name__ == "__main__":
    studies.run(main, HERE)
