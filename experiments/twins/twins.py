"""How does wear change a running-shoe foam? Five specimens each of a new and a worn heel.

Method and answer: README.md. Also written: wear.csv and a figure.

    FOAMFIT_DATA=… python experiments/twins/twins.py    # --page: from the table alone
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.report.readable import readable_unit
from foamfit.springs.parameters import unit_of
from foamfit.text import percent, significant

sys.path.insert(0, str(Path(__file__).parents[1]))
import records
import studies
from studies import BLUE, GREY, VERMILION

HERE = Path(__file__).parent
SOURCE = "Measurements: arXiv:2602.12694, LivingMatterLab/CANN"
GROUPS, COLOURS = ("new", "worn"), {"new": BLUE, "worn": VERMILION}
CYCLES = range(1, 7)
FIRST, LATER = 1, 5  # cycles with tables on the page
# A single test cannot separate kc and eps_star (r = 1.00), but the evidence of all ten favours one
# common eps_star. It is fitted to all tests and fixed in the groups, so that kc can be compared.
HELD = "s1_eps_star"
SCATTERING = [f"s1_{name}" for name in (*studies.MICROSCALE, "g1", "tau1")]
SCATTERING.remove(HELD)
ENERGY, PEAK = "dissipated energy", "peak stress"
UNITS = {ENERGY: (1e3, "kJ/m³"), PEAK: (1e3, "kPa")}
LEVEL = 0.05  # significance level, for all comparisons of a cycle together
POINTS = 200  # of a mean loop
# Measured strain and stress of each specimen by group.
Loops = Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]]


def measure(folder: Path) -> None:
    """Fit each group jointly in each cycle; write wear.csv."""
    frames = {n: wear(fit_together(folder, n), loops(folder, n)) for n in CYCLES}
    rows = pd.concat(frames, names=["cycle", "row"]).reset_index("cycle")
    studies.write_csv(rows, HERE / "wear.csv")


def fit_together(folder: Path, cycle: int) -> dict[str, dict[str, Any]]:
    """Fit one cycle of all, then of new and of worn specimens jointly; return their joint.json."""
    held = fit_study(folder, "*", cycle, "auto")["parameters"][HELD]
    if held["kind"] != "shared":
        sys.exit(f"cycle {cycle}: the evidence is for {HELD} {held['kind']}, not shared")
    print(f"cycle {cycle} together", flush=True)
    return {group: fit_study(folder, group, cycle, held["value"]) for group in GROUPS}


def fit_study(folder: Path, group: str, cycle: int, held: str | float) -> dict[str, Any]:
    """Fit one study; return the content of joint.json."""
    study = studies.write_study(
        folder / "study.toml", [f"{group}-heel-comp-*_raw.txt"], "microscale",
        dict.fromkeys(SCATTERING, "scatter") | {HELD: held}, relaxation=1, drive="displacement",
        cycle=cycle, name=f"shoe foam, {group} heel, cycle {cycle}",
    )  # fmt: skip
    return ff.joint(study).to_json_dict()


def loops(folder: Path, cycle: int) -> Loops:
    """Return measured strain and stress of one cycle of each specimen, by group."""
    out = {}
    for group in GROUPS:
        tests = [ff.read_test(p, cycle=cycle) for p in sorted(folder.glob(f"{group}-*_raw.txt"))]
        out[group] = [(t.displacement / t.specimen.height, t.stress) for t in tests]
    return out


def mean_loop(group: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    """Return mean strain, mean stress and its standard deviation at equal relative strains.

    The first half is the loading, the second the unloading.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    strains = [one.max() * np.concatenate([share, share[::-1]]) for one, _ in group]
    stresses = [studies.at_shares(*one, share, share[::-1]) for one in group]
    return np.mean(strains, axis=0), np.mean(stresses, axis=0), np.std(stresses, axis=0, ddof=1)


class Group(NamedTuple):
    """Logarithm of a quantity of a group: mean, standard error, spread between specimens."""

    mean: float
    stderr: float
    spread: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Make a group from measured values, whose errors are negligible against their spread."""
        logs = np.log(values)
        spread = float(np.std(logs, ddof=1))
        return cls(float(np.mean(logs)), spread / math.sqrt(len(logs)), spread, len(logs))

    @classmethod
    def of_joint(cls, item: Mapping[str, Any]) -> Self:
        """Make a group from a scattering parameter of joint.json, without measurement error."""
        value, error = item["value"], item["stderr"]
        return cls(math.log(value), error / value, item["scatter"], len(item["tests"]))

    def row(self, name: str) -> dict[str, float]:
        """Return the common (median) value, its 95 % interval (Student's t) and the spread."""
        half = float(stats.t.ppf(0.975, self.count - 1)) * self.stderr
        logs = {"": self.mean, "_lo": self.mean - half, "_hi": self.mean + half}
        ends = {f"{name}{end}": math.exp(log) for end, log in logs.items()}
        return ends | {f"{name}_spread": self.spread}


def change_of(quantity: str, new: Group, worn: Group) -> dict[str, Any]:
    """Compare two groups by Welch's test of the logarithms; the change is worn over new minus 1."""
    difference, error = worn.mean - new.mean, math.hypot(new.stderr, worn.stderr)
    freedom = error**4 / sum(g.stderr**4 / (g.count - 1) for g in (new, worn))
    half = float(stats.t.ppf(0.975, freedom)) * error
    spread = math.hypot(new.spread, worn.spread) / math.sqrt(2.0)
    return {
        "quantity": quantity, **new.row("new"), **worn.row("worn"),
        "change": math.expm1(difference), "change_lo": math.expm1(difference - half),
        "change_hi": math.expm1(difference + half),
        "change_over_spread": abs(difference) / spread if spread > 0.0 else math.inf,
        "p": 2.0 * float(stats.t.sf(abs(difference) / error, freedom)),
    }  # fmt: skip


def counted_together(changes: pd.DataFrame) -> pd.DataFrame:
    """Sort the changes by size, largest first, and adjust p for their number (Holm 1979)."""
    found = changes.sort_values("p", kind="stable")
    left = len(found) - np.arange(len(found))
    found["p_adjusted"] = np.maximum.accumulate(np.minimum(left * found["p"], 1.0))
    return found.sort_values("change_over_spread", ascending=False, ignore_index=True)


def wear(found: Mapping[str, Mapping[str, Any]], measured: Loops) -> pd.DataFrame:
    """Compare the joint fits of two groups, and their measured loops."""
    pairs = {
        ENERGY: [Group.of([np.trapezoid(s, e) for e, s in measured[g]]) for g in GROUPS],
        PEAK: [Group.of([stress.max() for _, stress in measured[g]]) for g in GROUPS],
    }
    pairs |= {n: [Group.of_joint(found[g]["parameters"][n]) for g in GROUPS] for n in SCATTERING}
    return counted_together(pd.DataFrame([change_of(n, *pair) for n, pair in pairs.items()]))


def draw(changes: pd.DataFrame, measured: Loops, path: Path) -> None:
    """Draw the mean loops of the first cycle and the change of each quantity in two cycles."""
    with studies.sheet(path, 7.4, 3.4) as figure:
        left, right = figure.subplots(1, 2)
        for group, colour in COLOURS.items():
            strain, *stresses = mean_loop(measured[group])
            stress, spread = (one / 1e3 for one in stresses)
            for part in (slice(None, POINTS), slice(POINTS, None)):
                ends = (stress - spread)[part], (stress + spread)[part]
                left.fill_between(strain[part], *ends, color=colour, alpha=0.15, linewidth=0)
            left.plot(strain, stress, color=colour, linewidth=1.2, label=group)
        left.set(xlabel="strain (–)", ylabel="stress (kPa)", title="mean loops ± deviation")
        left.legend(loc="upper left")
        order = list(changes[changes["cycle"] == FIRST]["quantity"])[::-1]
        for cycle, off, colour in ((FIRST, 0.12, studies.BLACK), (LATER, -0.12, GREY)):
            own = changes[changes["cycle"] == cycle].set_index("quantity").loc[order]
            value, low, high = (100.0 * own[f"change{end}"] for end in ("", "_lo", "_hi"))
            right.errorbar(
                value, np.arange(len(order)) + off, xerr=[value - low, high - value], fmt="o",
                color=colour, markersize=3.5, linewidth=0.9, label=f"cycle {cycle}",
            )  # fmt: skip
        right.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
        right.set_yticks(range(len(order)), [name.removeprefix("s1_") for name in order])
        right.set(xlabel="worn over new, less one (%)", title="changes with 95 % intervals")
        right.legend(loc="upper right")
        title = f"Running-shoe foam, new heel against worn. {SOURCE}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=8)


def change_rows(changes: pd.DataFrame) -> str:
    """Return the rows of the table of changes."""

    def cells(one: Any) -> Iterator[str]:
        factor, unit = UNITS.get(one.quantity) or readable_unit(one.new, unit_of(one.quantity))
        yield one.quantity.removeprefix("s1_") + (f" ({unit})" if unit else "")
        for group in GROUPS:
            ends = (getattr(one, group + end) for end in ("", "_lo", "_hi"))
            value, low, high = (significant(end / factor, 3) for end in ends)
            yield f"{value} ({low} to {high})"
            yield percent(getattr(one, f"{group}_spread"))
        ends = 100.0 * one.change, 100.0 * one.change_lo, 100.0 * one.change_hi
        yield "{:+.0f} % ({:+.0f} to {:+.0f} %)".format(*ends).replace("-", "−")
        yield from (significant(x, 2) for x in (one.change_over_spread, one.p, one.p_adjusted))
        hint = f"a hint, p = {significant(one.p, 1)}" if one.p < LEVEL else "within scatter"
        yield "significant" if one.p_adjusted < LEVEL else hint

    return studies.lines(cells(one) for one in changes.itertuples())


def write(measured: Loops) -> None:
    """Write figure and page from the table."""
    changes = pd.read_csv(HERE / "wear.csv")
    draw(changes, measured, HERE / "new_against_worn.png")
    everywhere = (changes["p_adjusted"] < LEVEL).groupby(changes["quantity"]).all()
    studies.write_page(
        HERE, first=FIRST, later=LATER, last=changes["cycle"].max(),
        everywhere=", ".join(everywhere.index[everywhere]) or "nothing",
        wear_first=change_rows(changes[changes["cycle"] == FIRST]),
        wear_later=change_rows(changes[changes["cycle"] == LATER]),
    )  # fmt: skip


def main() -> None:
    options = studies.arguments(__doc__, page=True).parse_args()
    studies.measurements("shoe-foam-twins")
    with records.placed(*records.HEELS) as folder:
        if not options.page:
            measure(folder)
        write(loops(folder, FIRST))


if __name__ == "__main__":
    main()
