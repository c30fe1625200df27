"""Does the advised test determine what a first test left open?

Method and answer: README.md. Also written: foams.csv.gz, plan.csv and plan.png.

    python experiments/plan/plan.py                        # 40 foams of one spring, 20 of two
    python experiments/plan/plan.py --foams 4 --two 2 --out FOLDER
    python experiments/plan/plan.py --page                 # the page alone
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import foamfit as ff
from foamfit.errors import InputError, SimulationError

sys.path.insert(0, str(Path(__file__).parents[1]))
import studies
from rig import BENCH, MOST_STRAIN, TOWER, Impact, draw_bistable, recorded, work, write
from truth import Course, Rig

HERE = Path(__file__).parent
SECOND = ("advised", "strongest", "random", "ideal")
Foam = dict[str, Any]


def draw(seed: int, springs: int) -> Foam:
    """Draw a foam, a rig and a first velocity that does not close the loop."""
    rng = np.random.default_rng([seed, springs])
    while True:
        height, area, mass = BENCH if rng.random() < 0.5 else TOWER
        each = sorted((draw_bistable(rng) for _ in range(springs)), key=lambda s: s.onset)
        if springs == 2 and not 1.5 < each[1].onset / each[0].onset < 4.0:
            continue
        heights = (height / springs,) * springs
        top = max(spring.closing for spring in each)
        strains = [spring.strain(top) for spring in each]
        if max(strains) > 0.85:
            continue
        energy = sum(h * work(spring, top) for h, spring in zip(heights, each, strict=True)) * area
        closing = math.sqrt(2.0 * energy / mass)
        first = closing * math.sqrt(rng.uniform(0.35, 0.85))
        if springs == 1 and rng.random() < 0.5:
            eta = 10 ** rng.uniform(-2.5, -1.5) * top * height / closing
            each = [replace(each[0], eta=eta)]
        foam = {
            "springs": tuple(each), "heights": heights, "area": area, "mass": mass,
            "closing": closing, "first": first, "fastest": closing * rng.uniform(1.3, 2.5),
            "force": top * area * 10 ** rng.uniform(0.5, 1.3), "seed": seed,
        }  # fmt: skip
        random = np.exp(rng.uniform(math.log(0.5 * first), math.log(foam["fastest"])))
        foam["random"] = float(random), mass * float(rng.choice([1.0, 2.0]))
        hit = run(foam, first, mass)
        if hit is not None and hit[1] < 0.999 * top * area:
            return foam


def run(foam: Foam, velocity: float, mass: float) -> tuple[Course, float, float] | None:
    """Return the course of an impact, its largest force (N) and strain; None beyond the lock-up."""
    height = math.fsum(foam["heights"])
    rig = Rig(foam["springs"], foam["heights"], foam["area"], mass, velocity)
    try:
        course = rig.run(0.0, 100.0 * height / velocity)
    except RuntimeError:
        return None
    when = np.linspace(0.0, course.end, 2000)
    force = float(course.stress(when).max()) * foam["area"]
    return course, force, float(course.top(when, gauge=False).max()) / height


def judged(seed: int, springs: int) -> list[dict[str, Any]]:
    """Return one row for the first test and one for each second test and parameter."""
    foam, rows = draw(seed, springs), list[dict[str, Any]]()
    model = "+".join(["bistable"] * springs)
    about = {"foam": seed, "springs": springs}
    with studies.workplace() as folder:
        hit = run(foam, foam["first"], foam["mass"])
        assert hit is not None
        first = recorded(Impact(), hit[0], seed)
        step = float(np.median(np.diff(first.time)))
        ranges = {name: sigma / first.setup.noise for name, sigma in first.noise.items()}
        path = write(first, folder, "first")
        (folder / "rig.toml").write_text(rig_toml(foam, step, first.noise), encoding="utf-8")
        result, fitting = studies.timed(ff.fit, ff.read_test(path), model=model)
        plan, planning = studies.timed(ff.plan, result, rig=folder / "rig.toml")
        seconds = {"fit (s)": fitting, "plan (s)": planning}
        for name, one in result.parameters.items():
            if name in plan.now:
                rows.append(about | seconds | {"second": "none", **shown(name, one, None)})
        best = plan.advice.candidate if plan.advice else None
        tests = (  # as in SECOND
            (best.velocity, best.mass) if best else None,
            (foam["fastest"], 2.0 * foam["mass"]),
            foam["random"],
            (1.1 * foam["closing"], foam["mass"]),
        )
        for number, (kind, asked) in enumerate(zip(SECOND, tests, strict=True), start=1):
            row = about | {"second": kind}
            if asked is None:
                rows.append(row | {"error": "no test is advised"})
                continue
            row |= {"velocity over closing": asked[0] / foam["closing"], "mass": asked[1]}
            hit = run(foam, *asked)
            if hit is None or not (hit[1] <= foam["force"] and hit[2] <= MOST_STRAIN):
                rows.append(row | {"broke": True})
                continue
            second = recorded(Impact(), hit[0], 1000 * number + seed, ranges, step)
            write(second, folder, f"second-{kind}")
            expected = nearest(plan, *asked) if best else {}
            found = together(folder, kind, model, expected)
            rows += [row | {"broke": False} | one for one in found]
    return rows


def rig_toml(foam: Foam, step: float, noise: dict[str, float]) -> str:
    """Return RIG.toml."""
    stress = noise["force"] / foam["area"]
    return "\n".join([
        "[striker]",
        f'velocity = "{0.5 * foam["first"]} to {foam["fastest"]} m/s"',
        f'masses = ["{foam["mass"]} kg", "{2.0 * foam["mass"]} kg"]',
        "[limits]", f'force = "{foam["force"]} N"', f"strain = {MOST_STRAIN}",
        "[record]", f'rate = "{1.0 / step} Hz"',
        f'noise = {{ stress = "{stress} Pa", displacement = "{noise["displacement"]} m" }}',
    ]) + "\n"  # fmt: skip


def nearest(plan: ff.Plan, velocity: float, mass: float) -> dict[str, Any]:
    """Return what the plan expects of the candidate nearest to a test."""

    def far(one: Any) -> float:
        asked = one.candidate
        return abs(math.log(asked.velocity / velocity)) + 10 * abs(math.log(asked.mass / mass))

    return min(plan.outcomes, key=far).expected


def together(
    folder: Path, kind: str, model: str, expected: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Fit the first and a second test jointly; yield a row for each parameter."""
    study = studies.write_study(
        folder / f"{kind}.toml", ["first.csv", f"second-{kind}.csv"], model,
        dict.fromkeys(expected, "shared"), name=kind,
    )  # fmt: skip
    try:
        found, seconds = studies.timed(ff.joint, study)
    except (InputError, SimulationError) as error:
        yield {"error": str(error)}
        return
    for name in expected:
        yield {"joint (s)": seconds, **shown(name, found.parameters[name], expected[name])}


def shown(name: str, one: Any, expected: Any) -> dict[str, Any]:
    """Return state and width of a parameter, and what was expected."""
    width = math.nan if one.ci95 is None else one.ci95[1] - one.ci95[0]
    row = {"parameter": name, "value": one.value, "state": one.state, "width": width}
    if expected is None:
        return row
    return row | {"expected state": expected.state, "expected width": expected.ci95_width}


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Return, for each kind of second test, parameters determined and agreement of widths."""
    out = list[dict[str, Any]]()
    rows = rows.assign(**{name: rows.get(name) for name in ("broke", "expected width")})
    for springs, part in rows.groupby("springs"):
        good = part[part.state == "determined"].groupby(["foam", "second"]).parameter.agg(set)
        foams = sorted(part.foam.unique())
        after = {  # the second test; the first alone, if the second was not made
            kind: {f: good.get((f, kind), good.get((f, "none"), set())) for f in foams}
            for kind in ("none", *SECOND)
        }
        could = {f: set().union(*(after[kind][f] for kind in SECOND)) for f in foams}
        total = sum(map(len, could.values()))
        for kind, own in after.items():
            mine = part[part.second == kind]
            sure = mine[(mine["expected width"] > 0.0) & (mine.width > 0.0)]
            ratio = sure.width / sure["expected width"]
            out.append({
                "springs": springs, "second test": kind, "foams": len(foams),
                "determined": sum(len(own[f] & could[f]) for f in foams), "could be": total,
                "broke the rig": int(mine.drop_duplicates("foam").broke.eq(True).sum()),
                "fewer than random": sum(len(own[f]) < len(after["random"][f]) for f in foams),
                "velocity over closing": mine["velocity over closing"].median(),
                "width over expected": ratio.median(),
                "within 1.5 (%)": 100.0 * float(((ratio < 1.5) & (ratio > 1 / 1.5)).mean()),
            })  # fmt: skip
    return pd.DataFrame(out)


def draw_figure(rows: pd.DataFrame, found: pd.DataFrame, path: Path) -> None:
    """Draw parameters determined after each second test, and obtained against expected widths."""
    with studies.sheet(path, 7.0, 2.8) as figure:
        left, right = figure.subplots(1, 2)
        for at, (springs, part) in enumerate(found.groupby("springs")):
            x = np.arange(len(part)) + 0.4 * (at - 0.5)
            share = 100.0 * part["determined"] / part["could be"]
            colour, name = (studies.BLUE, "one spring") if at == 0 else (studies.ORANGE, "two")
            left.bar(x, share, 0.38, color=colour, label=f"{name} ({int(part.foams.max())} foams)")
            mine = rows[(rows.springs == springs) & (rows.second == "advised")]
            right.plot(mine["expected width"] / mine.value.abs(), mine.width / mine.value.abs(),
                       ".", color=colour, markersize=3)  # fmt: skip
        left.axhline(90.0, color="black", linewidth=0.6, linestyle=":")
        left.set_xticks(range(5), ["first test\nalone", *SECOND], fontsize=6.5)
        left.set_ylabel("parameters determined (%)")
        left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=6.5)
        ends = np.array([1e-3, 3.0])
        for factor, dashes in ((1.0, "-"), (1.5, ":"), (1 / 1.5, ":")):
            right.plot(ends, factor * ends, color="black", linewidth=0.5, linestyle=dashes)
        right.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
        right.set(xlabel="expected width over value", ylabel="obtained width over value")


def write_page(out: Path) -> None:
    """Write README.md and plan.png from foams.csv.gz, plan.csv and real.csv."""
    names = ("foams.csv.gz", "plan.csv", "real.csv")
    rows, found, real = (pd.read_csv(out / name) for name in names)
    draw_figure(rows, found, out / "plan.png")
    values = {"table": studies.shown(found), "real": studies.shown(real)}
    for name, springs in (("one", 1), ("two", 2)):
        row = found[(found.springs == springs) & (found["second test"] == "advised")].iloc[0]
        values |= {
            f"share_{name}": f"{100.0 * row['determined'] / row['could be']:.1f} %",
            f"fewer_{name}": row["fewer than random"], f"foams_{name}": row["foams"],
            f"within_{name}": f"{row['within 1.5 (%)']:.1f} %",
            f"broke_{name}": f"{row['broke the rig']} of {row['foams']}",
        }  # fmt: skip
    studies.write_page(HERE, out, **values)


def main() -> None:
    """Run the study, and write its page."""
    counts: dict[str, Any] = {"foams": (40, "foams of one spring"), "two": (20, "of two springs")}
    asked = studies.arguments(__doc__, HERE, page=True, **counts).parse_args()
    if not asked.page:
        counted = ((1, asked.foams), (2, asked.two))
        jobs = [(seed + 1, springs) for springs, foams in counted for seed in range(foams)]
        rows = list[dict[str, Any]]()
        for made in studies.in_order(judged, jobs, 2):
            rows += made
            print({key: made[0][key] for key in ("foam", "springs", "plan (s)")}, flush=True)
        table = pd.DataFrame(rows)
        studies.write_csv(table, asked.out / "foams.csv.gz")
        studies.write_csv(summary(table), asked.out / "plan.csv")
    if asked.page or asked.out == HERE:  # real.py has written real.csv there
        write_page(asked.out)


if __name__ == "__main__":
    main()
