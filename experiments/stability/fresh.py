"""Is any result of the solver wrong? Random scenes and judges that share no code with it.

Method, families of scenes and answer: README.md. Also written: fresh.csv, a row per scene and
rtol.

    python experiments/stability/fresh.py                       # --page: from the table alone
    python experiments/stability/fresh.py --family gap --out scenes.csv
"""

import contextlib
import json
import math
import sys
import time
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))
import foamfit as ff
import roots
import studies
from families import FAMILIES, MEMORY, REMEMBERING, SEED, spec_of
from independent import LOOSE, Array, Truth, follow, judge, over_range
from scenes import Scene, Spec, scene_from

HERE = Path(__file__).parent
KEPT = HERE / "fresh.csv"
RTOLS = (1e-4, 1e-6, 1e-8)
MOST = {"base": 10_000_000, "long": 20_000_000}  # limit of the judge: steps times springs
USUAL_MOST = 4_000_000
BAD, POOR = 3.0, 1.0  # error over rtol
SLOPE_BAR = 1e-3  # allowed error of a derivative over its range, for rtol up to 1e-5


def moved(spec: Spec, name: str, factor: float) -> tuple[Spec, float]:
    """Multiply a parameter; return the scene and the original value."""
    other: Spec = json.loads(json.dumps(spec))
    prefix, _, short = name.partition("_")
    i = int(prefix[1:]) - 1
    place = other["heights"] if short == "height" else other["springs"][i]
    key: Any = i if short == "height" else short
    if short[:-1] in ("g", "tau"):
        place, key = place["relaxation"][int(short[-1]) - 1], int(short.startswith("tau"))
    value = float(place[key])
    place[key] = value * factor
    return other, value


STEPS = (1e-4, 1e-5)  # of the finite differences, relative to the parameter
LEAST_SLOPE = 1e-3  # smallest range of a judged derivative, over curve range per parameter


def slopes_of(spec: Spec, name: str, most: int) -> tuple[Array, Array, NDArray[np.bool_]] | None:
    """Return derivatives of base stress and displacements by differences of judge runs.

    The shape is (curves, n_t). Also return the range of each and the valid samples: not those
    between two ends of contact, or where two step lengths disagree. Return None if there is no
    judgement.
    """
    found, ends = [], []
    span = np.zeros(0)
    for step in STEPS:
        sides = []
        for sign in (1.0, -1.0):
            other, value = moved(spec, name, 1.0 + sign * step)
            try:
                scene = scene_from(other)
            except ValueError:  # the scene is at the limit of admissible parameters
                return None
            rooted = spec.get("judge") == "roots"
            truth = roots.follow(*scene) if rooted else follow(*scene, LOOSE, most)
            if truth.why:
                return None
            sides.append(np.vstack((truth.base_stress, truth.displacement)))
            ends.append(math.nan if truth.contact_end is None else truth.contact_end)
        found.append((sides[0] - sides[1]) / (2.0 * step * value))
        reach = np.abs(sides[0]).max(axis=1) * LEAST_SLOPE / value
        span = np.maximum(np.abs(found[-1]).max(axis=1), reach)
        span[1:] = span[1:].max()  # displacements share one range
    grid = scene_from(spec)[2]
    counts = np.ones(grid.size, bool)
    if not np.isnan(ends).all():
        counts = (grid < np.nanmin(ends)) | (grid > np.nanmax(ends))
    span = np.where(span > 0.0, span, 1.0)
    counts &= (np.abs(found[0] - found[1]) <= 0.1 * SLOPE_BAR * span[:, None]).all(axis=0)
    return found[1], span, counts


def slope_bar(rtol: float) -> float:
    """Return the error of a derivative over its range beyond which it is wrong."""
    return max(SLOPE_BAR, 100.0 * rtol)


def slope_error(spec: Spec, scene: Scene, rtol: float, most: int, known: dict[str, Any]) -> float:
    """Return the largest error of the solver's derivatives over their range; NaN if unjudged."""
    names, worst = spec.get("sensitivities", []), math.nan
    if not names:
        return worst
    answer = ff.simulate(*scene, rtol=rtol, sensitivities=names)
    for name in names:
        if name not in known:
            known[name] = slopes_of(spec, name, most)
        if known[name] is None or known[name][2].sum() < 0.5 * scene[2].size:
            continue
        want, span, counts = known[name]
        got = answer.sensitivities[name]
        mine = np.vstack((got.base_stress, got.displacement))
        miss = np.abs(mine - want)[:, counts].max(axis=1) / span
        worst = np.nanmax([worst, miss.max() if np.isfinite(miss).all() else math.inf])
    return float(worst)


# Rounding error of the logarithm of a stress after a few switches; over the spread of the snap
# stresses it is the smallest strain error that brute force can resolve.
OF_STRESSES = 1e-14


def lines_of(
    task: tuple[str, int, tuple[float, ...]], most: int | None = None
) -> list[dict[str, Any]]:
    """Solve and judge a scene at each rtol; `most` limits the judge's steps times springs."""
    family, number, rtols = task
    spec, most = spec_of(family, number), most or MOST.get(family, USUAL_MOST)
    scene, known = scene_from(spec), dict[str, Any]()
    truth = roots.follow(*scene) if spec.get("judge") == "roots" else judge(*scene, most)
    about = {"scene": f"{family}:{number}", "family": family}
    lines = [
        about | {"rtol": rtol} | judged(spec, scene, truth, rtol, most, known) for rtol in rtols
    ]
    for line in lines:  # the others can be redrawn from name and seed
        kept = line["outcome"] != "answer" or line["error"] > POOR
        line["parameters"] = json.dumps(spec) if kept else ""
    return lines


def judged(
    spec: Spec, scene: Scene, truth: Truth, rtol: float, most: int, known: dict[str, Any]
) -> dict[str, Any]:
    """Compare the solver's result for a scene with the true solution: errors over rtol."""
    springs, rooted = spec.get("springs", []), spec.get("judge") == "roots"
    spreads = [s.get(f"spread_{side}", 1.0) for s in springs for side in ("plus", "minus")]
    finest = 0.0 if rooted else OF_STRESSES / min(spreads, default=1.0)
    sure = not truth.why and max(truth.unsure, finest) <= 0.1 * rtol
    found: dict[str, Any] = {
        "judge": truth.why or ("judged" if sure else "chaotic"), "unsure": truth.unsure,
        "outcome": "answer", "reason": "", "error": math.nan, "slope": math.nan,
    }  # fmt: skip
    began = time.perf_counter()
    try:
        answer = ff.simulate(*scene, rtol=rtol)
    except ff.SimulationError as refusal:
        return found | {"outcome": "refused", "reason": str(refusal)}
    except Exception as wrong:  # reported; a run of hundreds of scenes continues
        return found | {"outcome": "failure", "reason": f"{type(wrong).__name__}: {wrong}"}
    found["seconds"] = time.perf_counter() - began
    if not sure:
        return found
    found["error"] = max(
        over_range(answer.displacement, truth.displacement) / rtol,
        over_range(answer.base_stress, truth.base_stress) / rtol,
    )
    try:
        found["slope"] = slope_error(spec, scene, rtol, most, known)
    except ff.SimulationError:
        found["reason"] = "derivatives refused"
    if not found["error"] <= BAD:
        found["outcome"] = "failure"
    elif found["slope"] > slope_bar(rtol):
        found["outcome"] = "wrong derivative"
    return found


def summary(lines: pd.DataFrame) -> pd.DataFrame:
    """Return counts per family and rtol."""
    by, known = [lines.family, lines.rtol], lines.judge == "judged"
    refused, error = known & (lines.outcome == "refused"), lines.error.where(known)
    counts = pd.DataFrame({
        "scenes": True, "judged": known, "chaotic": lines.judge == "chaotic",
        "answers": known & ~refused, "refused": refused, "over 1 rtol": error > POOR,
        "over 3 rtol": error > BAD, "derivatives": known & lines.slope.notna(),
        "refused derivatives": known & (lines.reason == "derivatives refused"),
        "wrong derivatives": known & (lines.slope > lines.rtol.map(slope_bar)),
    })  # fmt: skip
    largest = {"largest / rtol": error, "longest s": lines.seconds}
    table = counts.groupby(by, sort=False).sum()
    return table.assign(**{k: v.groupby(by).max() for k, v in largest.items()}).reset_index()


def write_page() -> None:
    """Write README.md from the stored scenes."""
    lines = pd.read_csv(KEPT)
    table, plain = summary(lines), set(FAMILIES) - {*MEMORY, *REMEMBERING}
    parts = {"fresh": plain, "memory": MEMORY, "worn": REMEMBERING}
    tables = {n: studies.shown(table[table.family.isin(own)], 2) for n, own in parts.items()}
    worn = lines[lines.family.isin(REMEMBERING)]
    studies.write_page(
        HERE, **tables, fresh_scenes=lines.scene.nunique(), fresh_seed=SEED,
        fresh_judged=lines[lines.judge == "judged"].scene.nunique(),
        worn_scenes=worn.scene.nunique(),
        fresh_each=int(lines.groupby("family").scene.nunique().max()),
    )  # fmt: skip


def main() -> None:
    """Run the command line."""
    warnings.simplefilter("ignore")
    ask = studies.arguments(__doc__, KEPT, page=True, scenes=(134, "per family"))
    ask.add_argument("--family", action="append", choices=FAMILIES)
    given = ask.parse_args()
    if given.page:
        write_page()
        return
    families, lines = given.family or FAMILIES, list[dict[str, Any]]()
    for family, number in product(families, range(6)):  # no timed scene must compile
        with contextlib.suppress(ff.SimulationError):
            ff.simulate(*scene_from(spec_of(family, number)))
    tasks = [((family, n, RTOLS),) for family in families for n in range(given.scenes)]
    for found in studies.in_order(lines_of, tasks, 2):
        lines += found
        if len(lines) % 150 == 0:
            print(f"{len(lines) // 3} scenes", file=sys.stderr, flush=True)
    table = pd.DataFrame(lines)
    studies.write_csv(table, given.out, 6)
    print(summary(table).to_string(index=False))
    wrong = table[(table.error > POOR) | (table.slope > table.rtol.map(slope_bar))]
    print(wrong[["scene", "rtol", "error", "slope"]].to_string(index=False))


if __name__ == "__main__":
    main()
