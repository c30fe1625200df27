"""What does the solver do with stiff and extreme scenes? A study of more than two thousand of them.

Method. Each scene of scenes.py (all are synthetic) must end with an answer inside its tolerance or
with a `SimulationError` that says why. The judges are shorter steps and the other method of the
solver (judges.py), and brute force (independent.py). fresh.py draws other scenes at random and
judges them by brute force alone; its table is on the page, too.

Answer. 1,911 answers inside tolerance, 109 refused with a reason, none wrong: see README.md.

One command runs fresh scenes, and one the study, which writes scenes.csv (a line per scene) and
README.md; the last only writes README.md again from scenes.csv and fresh.csv:

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
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import fresh  # noqa: E402
from independent import judge, over_range  # noqa: E402
from judges import explicit_fits, refined  # noqa: E402
from scenes import Point, designed, scene_of, swept  # noqa: E402

import foamfit as ff  # noqa: E402
import studies  # noqa: E402
from foamfit.solve.plan import MOST_WORK  # noqa: E402

RTOL, DESIGNED, SEED = 1e-6, 1550, 4
JUDGES = ("refinement", "other method", "independent")
LONGEST = 300  # s; a scene that takes longer ends the study
BRUTE = 3_000_000  # steps times springs up to which brute force judges
CHEAP = 50_000  # steps times springs up to which the other method is tried too


def judged(point: Point) -> dict[str, Any]:
    """Simulate one scene and judge what comes of it: a line of the study."""
    scene, began = scene_of(point), time.perf_counter()
    found: dict[str, Any] = {"outcome": "refused", "reason": "", "method": "", "steps": 0}
    found |= {"seconds": 0.0, **dict.fromkeys((*JUDGES, "error"), math.nan)}
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
    implicit, most = answer.method == "Radau IIA", 10 * work + CHEAP
    found["refinement"] = 0.0
    if answer.steps:
        found["refinement"] = refined(scene, answer, RTOL, implicit=implicit, most=most)
        if found["refinement"] is None:
            found["refinement"] = refined(scene, answer, RTOL, implicit=not implicit, most=most)
    if answer.steps and work < CHEAP and len(scene[2]) < 20_000 and explicit_fits(scene):
        other = refined(scene, answer, RTOL, implicit=not implicit, most=CHEAP // 3)
        found["other method"] = math.nan if other is None else other
    truth = judge(*scene, BRUTE)
    if not truth.why and truth.unsure <= 0.1 * RTOL:
        found["independent"] = max(
            over_range(answer.displacement, truth.displacement),
            over_range(answer.base_stress, truth.base_stress),
        )
    errors = {name: math.inf if found[name] is None else found[name] for name in JUDGES}
    found["error"] = np.nanmax(list(errors.values()))
    bad = [name for name, error in errors.items() if error > RTOL]
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


def study_table(lines: pd.DataFrame) -> str:
    """Count the scenes of the study by drive and method."""
    head = "drive | scenes | answers | refused | failures | median error | largest error | "
    head += "by brute force: judged, largest | closed form / Taylor / Radau | longest s"
    rows = []
    for drive, group in [*lines.groupby("drive"), ("all", lines)]:
        answers, gone = group[group.outcome == "answer"], group[group.outcome == "refused"]
        methods = answers.method.value_counts()
        told = [str(methods.get(m, 0)) for m in ("closed form", "Taylor series", "Radau IIA")]
        rows.append(
            [drive, len(group), len(answers), f"{len(gone)} ({fresh.reasons(gone)})",
             int((group.outcome == "failure").sum()), _number(answers.error.median()),
             _number(answers.error.max()),
             f"{answers.independent.notna().sum()}, {_number(answers.independent.max())}",
             " / ".join(told), f"{group.seconds.max():.2g}"]
        )  # fmt: skip
    return studies.markdown(head, rows)


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
    head += "1 rtol | over 3 rtol | largest error / rtol | derivatives judged | refused | "
    head += "wrong, largest | longest s"
    rows, lines = [], lines[lines.family.isin(families)]
    for _, r in fresh.summary(lines).iterrows():
        own = lines[(lines.family == r.family) & (lines.rtol == r.rtol)]
        beyond = int(((own.outcome == "refused") & (own.judge != "judged")).sum())
        rows.append(
            [r.family, f"{r.rtol:g}", r.scenes, r.judged, r.answers, refused(r), beyond,
             r["over 1 rtol"], r["over 3 rtol"], _number(r.largest, ".2g"), r.derivatives,
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


def page(lines: pd.DataFrame, drawn: pd.DataFrame) -> None:
    """Write the README of the study."""
    worn = drawn[drawn.family.isin(fresh.REMEMBERING)]
    studies.write_page(
        HERE, study=study_table(lines), other=int(lines["other method"].notna().sum()),
        fresh=fresh_table(drawn[~drawn.family.isin(fresh.MEMORY + fresh.REMEMBERING)]),
        memory=memory_table(drawn, fresh.MEMORY), worn=memory_table(drawn, fresh.REMEMBERING),
        memory_wrong=memory_wrong(drawn, fresh.MEMORY),
        worn_wrong=memory_wrong(drawn, fresh.REMEMBERING), worn_scenes=worn.scene.nunique(),
        fresh_scenes=drawn.scene.nunique(),
        fresh_judged=drawn[drawn.judge == "judged"].scene.nunique(), fresh_seed=fresh.SEED,
        scenes=len(lines), design=int((lines.axis == "design").sum()), rtol=f"{RTOL:g}",
        median=1e3 * lines.seconds.median(), work=MOST_WORK, machine=platform.machine(),
        python=platform.python_version(), numpy=np.__version__,
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
    if not options.page:
        floats = {"seconds": 4, "error": 12}
        studies.write_csv(lines.round(floats), HERE / "scenes.csv", 6)
    page(lines, drawn)
    print(study_table(lines))
    print(fresh.summary(drawn).to_string(index=False))
    if (lines.outcome == "failure").any() or (drawn.outcome == "failure").any():
        sys.exit("some scenes ended with a wrong answer: see scenes.csv and fresh.csv")


if __name__ == "__main__":
    studies.run(main, HERE)
