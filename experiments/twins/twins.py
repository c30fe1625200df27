"""What does wear do to a running-shoe foam? Five specimens of a new heel against five of a worn.

Method. The measurements (arXiv:2602.12694, LivingMatterLab/CANN on GitHub; not part of this
repository) are compressions of ten specimens, six to seven cycles each. The study goes the way of a
user: a TOML beside each test, `foamfit.batch` over all tests and cycles, `foamfit.joint` of the new
and of the worn ones. Common values are compared by Welch's test of their logarithms, all
comparisons of a cycle counted together (Holm).

Answer. The worn heel dissipates less, but no parameter changes by more than the specimens of one
heel differ: see README.md, which this writes with batch.csv, wear.csv and a picture.

    FOAMFIT_DATA=path/to/data python experiments/twins/twins.py
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

import foamfit as ff
from foamfit.report.figures import BLUE, GREY, VERMILION
from foamfit.report.readable import readable_unit
from foamfit.springs.parameters import unit_of
from foamfit.text import listed, percent, significant

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import studies  # noqa: E402

SOURCE = "Measurements: arXiv:2602.12694, LivingMatterLab/CANN"
GROUPS, COLOURS = ("new", "worn"), {"new": BLUE, "worn": VERMILION}
FIRST, LATER = 1, 5  # cycles that the page has tables of
OWN = ["k0", "kc", "eps_star", "sigma_plus", "spread_plus", "sigma_minus", "spread_minus"]
LAW = [*OWN, "g1", "tau1"]
# No test tells kc from eps_star (r = 1.00), and all ten say that eps_star is one value by evidence:
# it is found from all of them and held in the fits of the groups, so that their kc compare.
HELD = "s1_eps_star"
SCATTERING = tuple(f"s1_{name}" for name in LAW if f"s1_{name}" != HELD)
ENERGY, PEAK = "dissipated energy", "peak stress"
UNITS = {ENERGY: (1e3, "kJ/m³"), PEAK: (1e3, "kPa")}
LEVEL = 0.05  # of what is said to stand out, all comparisons of a cycle together
POINTS = 200  # of a mean loop
# Measured strain and stress of each specimen by group; joint.json by cycle and group.
Loops = Mapping[str, Sequence[tuple[np.ndarray, np.ndarray]]]
Found = Mapping[int, Mapping[str, Mapping[str, Any]]]


# ------------------------------------------------------------------------------- fits


@dataclass(frozen=True)
class Made:
    """What is fitted, the batch and the joint fits by cycle, and the measured loops by cycle."""

    table: pd.DataFrame
    found: Found
    measured: Mapping[int, Loops]


def measure(data: Path, folder: Path) -> Made:
    """Make all fits: each cycle of each test, then each group together."""
    studies.place_twins(data, folder)
    found = ff.batch(
        folder, out=folder / "runs", model="microscale", relaxation=1, drive="displacement",
        cycle="all", intervals="local", report=False,
    )  # fmt: skip
    split = found["test"].str.extract(r"^(?P<specimen>.*)_raw(?:/cycle-(?P<cycle>\d+))?$")
    table = pd.concat([split, found.drop(columns=["test", "file"])], axis=1)
    print(f"batch: {len(table)} fits", flush=True)
    counts = table["cycle"].dropna().astype(int).value_counts()
    # A cycle that few records have is no group.
    full = sorted(n for n, count in counts.items() if count == table["specimen"].nunique())
    together = {n: fit_together(folder, n) for n in full}
    return Made(table, together, {n: loops(folder, n) for n in full})


def fit_together(folder: Path, cycle: int) -> dict[str, dict[str, Any]]:
    """Fit one cycle of all specimens, of the new and of the worn together; joint.json of each."""
    found = {"all": fit_study(folder, "*", cycle, "auto")}
    held = found["all"]["parameters"][HELD]
    if held["kind"] != "shared":
        sys.exit(f"cycle {cycle}: the evidence is for {HELD} {held['kind']}, not shared")
    for group in GROUPS:
        found[group] = fit_study(folder, group, cycle, held["value"])
    print(f"cycle {cycle} together", flush=True)
    return found


def fit_study(folder: Path, group: str, cycle: int, held: str | float) -> dict[str, Any]:
    """Fit one study; content of joint.json."""
    study = studies.write_study(
        folder / "study.toml", [f"{group}-heel-comp-*_raw.txt"], "microscale",
        dict.fromkeys(SCATTERING, "scatter") | {HELD: held}, relaxation=1, drive="displacement",
        cycle=cycle, name=f"shoe foam, {group} heel, cycle {cycle}",
    )  # fmt: skip
    return ff.joint(study).to_json_dict()


def loops(folder: Path, cycle: int) -> Loops:
    """Measured strain and stress of one cycle of each specimen, by group."""
    out = {}
    for group in GROUPS:
        tests = [ff.read_test(p, cycle=cycle) for p in sorted(folder.glob(f"{group}-*_raw.txt"))]
        out[group] = [(t.displacement / t.specimen.height, t.stress) for t in tests]
    return out


def mean_loop(group: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, ...]:
    """Mean strain, mean stress and its standard deviation, at equal shares of the largest strain.

    The first half is the loading, the second the unloading.
    """
    share = np.linspace(0.0, 1.0, POINTS)
    strains, stresses = [], []
    for strain, stress in group:
        turn, top = int(np.argmax(strain)), float(strain.max())
        up = np.interp(share, np.maximum.accumulate(strain[: turn + 1]) / top, stress[: turn + 1])
        back = np.maximum.accumulate(strain[turn:][::-1]) / top
        down = np.interp(share, back, stress[turn:][::-1])
        # Below where the unloading ends there is nothing to interpolate.
        down[share < back[0]] = np.nan
        strains.append(top * np.concatenate([share, share[::-1]]))
        stresses.append(np.concatenate([up, down[::-1]]))
    return np.mean(strains, axis=0), np.mean(stresses, axis=0), np.std(stresses, axis=0, ddof=1)


def lost(loop: tuple[np.ndarray, np.ndarray]) -> float:
    """Energy that a loop dissipates, J/m³."""
    return float(np.trapezoid(loop[1], loop[0]))


# ------------------------------------------------------------------------------- comparison


@dataclass(frozen=True)
class Group:
    """Values of one quantity in the specimens of a group, their common value and spread.

    `mean`, `stderr` and `spread` are of the logarithm. `ends` are the 95 % intervals of the single
    values, `sure` says whether each is determined.
    """

    values: tuple[float, ...]
    mean: float
    stderr: float
    spread: float
    ends: tuple[tuple[float, float] | None, ...] = ()
    sure: tuple[bool, ...] = ()

    @classmethod
    def of(cls, values: Sequence[float]) -> Group:
        """Measured values, whose errors are nothing beside their spread."""
        logs = np.log(values)
        spread = float(np.std(logs, ddof=1))
        return cls(tuple(values), float(np.mean(logs)), spread / math.sqrt(len(logs)), spread)

    @classmethod
    def of_joint(cls, item: Mapping[str, Any]) -> Group:
        """A scattering parameter of joint.json, its spread apart from errors of measurement."""
        tests = list(item["tests"].values())
        return cls(
            tuple(one["value"] for one in tests),
            math.log(item["value"]),
            item["stderr"] / item["value"],
            item["scatter"],
            tuple(one["ci95"] and tuple(one["ci95"]) for one in tests),
            tuple(one["state"] == "determined" for one in tests),
        )

    @property
    def common(self) -> float:
        """The common value: the median specimen's."""
        return math.exp(self.mean)

    @property
    def ci95(self) -> tuple[float, float]:
        """Its 95 % interval, with Student's t."""
        half = float(stats.t.ppf(0.975, len(self.values) - 1)) * self.stderr
        return math.exp(self.mean - half), math.exp(self.mean + half)

    @property
    def edges(self) -> tuple[float, float]:
        """One standard deviation between specimens to either side of the common value."""
        return math.exp(self.mean - self.spread), math.exp(self.mean + self.spread)


@dataclass(frozen=True)
class Change:
    """A quantity in the worn group over that in the new one, less one (Welch's test of logarithms).

    `size` is the change over the spread between specimens, both of the logarithm; `adjusted` is p
    with all comparisons of a cycle counted.
    """

    name: str
    new: Group
    worn: Group
    change: float
    ci95: tuple[float, float]
    p: float
    size: float
    adjusted: float = math.nan

    @property
    def stands_out(self) -> bool:
        """Whether there is a change in spite of the scatter, all comparisons counted."""
        return self.adjusted < LEVEL


def change_of(name: str, new: Group, worn: Group) -> Change:
    """Compare two groups."""
    difference, error = worn.mean - new.mean, math.hypot(new.stderr, worn.stderr)
    freedom = error**4 / sum(g.stderr**4 / (len(g.values) - 1) for g in (new, worn))
    half = float(stats.t.ppf(0.975, freedom)) * error
    p = 2.0 * float(stats.t.sf(abs(difference) / error, freedom))
    spread = math.hypot(new.spread, worn.spread) / math.sqrt(2.0)
    size = abs(difference) / spread if spread > 0.0 else math.inf
    ends = math.expm1(difference - half), math.expm1(difference + half)
    return Change(name, new, worn, math.expm1(difference), ends, p, size)


def counted_together(changes: Sequence[Change]) -> list[Change]:
    """The changes by their size, largest first, with p adjusted for their number (Holm 1979)."""
    out, least = list[Change](), 0.0
    for i, one in enumerate(sorted(changes, key=lambda one: one.p)):
        least = max(least, min((len(changes) - i) * one.p, 1.0))
        out.append(replace(one, adjusted=least))
    return sorted(out, key=lambda one: -one.size)


def wear(found: Mapping[str, Mapping[str, Any]], measured: Loops) -> list[Change]:
    """What differs between the joint fits of two groups, and what their loops say without a law."""
    out = [
        change_of(name, *(Group.of([one(loop) for loop in measured[g]]) for g in GROUPS))
        for name, one in ((ENERGY, lost), (PEAK, lambda loop: float(loop[1].max())))
    ]
    for name in SCATTERING:
        new, worn = (Group.of_joint(found[group]["parameters"][name]) for group in GROUPS)
        out.append(change_of(name, new, worn))
    return counted_together(out)


# ------------------------------------------------------------------------------- in words


def shown_change(one: Change) -> str:
    """Write a change with its 95 % interval."""
    value, low, high = (f"{100 * end:+.0f}".replace("-", "−") for end in (one.change, *one.ci95))
    return f"{value} % ({low} to {high} %)"


def verdict(one: Change) -> str:
    """Whether a change stands out of the scatter between specimens."""
    if one.stands_out:
        return "stands out"
    return f"a hint, p = {significant(one.p, 1)}" if one.p < LEVEL else "within scatter"


def headline(changes: Sequence[Change]) -> str:
    """Name what stands out."""
    there = [one.name.removeprefix("s1_") for one in changes if one.stands_out]
    if not there:
        return "no change stands out of the scatter between specimens"
    return f"{listed(there)} {'stands' if len(there) == 1 else 'stand'} out of the scatter"


def unit_for(one: Change) -> tuple[float, str]:
    """Factor and name of the unit in which a quantity reads well."""
    return UNITS.get(one.name) or readable_unit(one.new.common, unit_of(one.name))


def title(one: Change) -> str:
    unit = unit_for(one)[1]
    return f"{one.name.removeprefix('s1_')}{f' ({unit})' if unit else ''}"


def code(name: str) -> str:
    """Write the name of a parameter as such."""
    return name if name in UNITS else f"`{name.removeprefix('s1_')}`"


# ------------------------------------------------------------------------------- pictures


def draw_wear(changes: Sequence[Change], measured: Loops, cycle: int, path: Path) -> None:
    """The mean loops, and each quantity new against worn."""
    with studies.sheet(path, 7.6, 6.4) as figure:
        grid = figure.add_gridspec(3, 4)
        ax = figure.add_subplot(grid[0, :2])
        for group, colour in COLOURS.items():
            strain, stress, spread = mean_loop(measured[group])
            for part in (slice(None, POINTS), slice(POINTS, None)):
                low, high = ((stress + sign * spread)[part] / 1e3 for sign in (-1.0, 1.0))
                ax.fill_between(strain[part], low, high, color=colour, alpha=0.15, linewidth=0)
            ax.plot(strain, stress / 1e3, color=colour, linewidth=1.2, label=group)
        ax.set(xlabel="strain", ylabel="stress (kPa)", title="mean loops ± standard deviation")
        ax.legend(loc="upper left")
        places = [grid[0, 2], grid[0, 3], *(grid[r, c] for r in (1, 2) for c in range(4))]
        for place, one in zip(places, changes, strict=True):
            draw_change(figure.add_subplot(place), one)
        figure.suptitle(
            f"Running-shoe foam, cycle {cycle}, new heel against worn: {headline(changes)}; "
            "largest change over spread first\n"
            "points: specimens with 95 % intervals, hollow if not well determined; line and band: "
            "common value and its 95 % interval;\n"
            f"dashed: spread between specimens. {SOURCE}",
            x=0.01, ha="left", fontsize=7.5,
        )  # fmt: skip


def draw_change(ax: Any, one: Change) -> None:
    """One quantity: specimens, common value and spread of both groups."""
    factor, _ = unit_for(one)
    for x, (name, group) in enumerate((("new", one.new), ("worn", one.worn))):
        colour, span = COLOURS[name], [x - 0.36, x + 0.36]
        low, high = (end / factor for end in group.ci95)
        ax.fill_between(span, low, high, color=colour, alpha=0.18, linewidth=0, zorder=0)
        ax.plot(span, [group.common / factor] * 2, color=colour, linewidth=1.6, zorder=1)
        for edge in group.edges:
            ax.plot(span, [edge / factor] * 2, "--", color=colour, linewidth=0.7, zorder=1)
        at, count = x + np.linspace(-0.24, 0.24, len(group.values)), len(group.values)
        given = zip(
            at, group.values, group.ends or [None] * count, group.sure or [True] * count,
            strict=True,
        )  # fmt: skip
        for here, value, ends, sure in given:
            if ends is not None:
                ax.plot([here] * 2, [end / factor for end in ends], color=GREY, linewidth=0.8)
            fill = colour if sure else "white"
            ax.plot(here, value / factor, "o", color=colour, markersize=3.4, mfc=fill, mew=0.8)
    ax.set_xlim(-0.55, 1.55)
    ax.set_xticks([0, 1], GROUPS)
    ax.set_title(
        f"{title(one)}\n{shown_change(one)}\n{one.size:.1f} spreads: {verdict(one)}",
        fontsize=7, fontweight="bold" if one.stands_out else "normal",
    )  # fmt: skip
    ax.locator_params(axis="y", nbins=5)


# ------------------------------------------------------------------------------- the page


def change_rows(changes: Sequence[Change]) -> str:
    """Rows of the page's table of changes."""
    rows = []
    for one in changes:
        factor, cells = unit_for(one)[0], []
        for group in (one.new, one.worn):
            told = [significant(v / factor, 3) for v in (group.common, *group.ci95)]
            cells += [f"{told[0]} ({told[1]} to {told[2]})", percent(group.spread)]
        sizes = (significant(number, 2) for number in (one.size, one.p, one.adjusted))
        rows.append([title(one), *cells, shown_change(one), *sizes, verdict(one)])
    return studies.lines(rows)


def batch_rows(table: pd.DataFrame) -> str:
    """By group and cycle: fits, misfits, states that are determined."""
    rows = []
    groups = table.groupby([table["specimen"].str.split("-").str[0], "cycle"], dropna=False)
    for (group, cycle), part in groups:
        off = part["misfit_stress_strain"].dropna()
        told = f"{percent(off.min())} to {percent(off.max())}" if len(off) else "–"
        acceptable = part["status"].isin(["ok", "warnings"]).sum()
        states = (part[f"s1_{name}_state"].eq("determined").sum() for name in LAW)
        rows.append([group, cycle, f"{acceptable} of {len(part)}", told, *states])
    return studies.lines(rows)


def told(changes: Sequence[Change]) -> str:
    """Name what stands out, what may, and what does not."""
    parts = {
        "Stands out of the scatter between specimens": [o for o in changes if o.stands_out],
        f"A hint (p below {LEVEL} on its own)": [
            o for o in changes if o.p < LEVEL and not o.stands_out
        ],
        "Within the scatter": [o for o in changes if o.p >= LEVEL],
    }
    return "\n".join(
        f"- {words}: {'; '.join(f'{code(o.name)} {shown_change(o)}' for o in ones) or 'nothing'}."
        for words, ones in parts.items()
    )


def write_tables(table: pd.DataFrame, changes: Mapping[int, Sequence[Change]]) -> None:
    """Write batch.csv and wear.csv."""
    errors = [name for name in table if name.endswith("_stderr")]
    studies.write_csv(table.drop(columns=errors), HERE / "batch.csv", 5)
    rows = []
    for cycle, ones in changes.items():
        for one in ones:
            row: dict[str, Any] = {"cycle": cycle, "quantity": one.name}
            for name, group in (("new", one.new), ("worn", one.worn)):
                low, high = group.ci95
                row |= {name: group.common, f"{name}_lo": low, f"{name}_hi": high}
                row[f"{name}_spread"] = group.spread
            row |= {"change": one.change, "change_lo": one.ci95[0], "change_hi": one.ci95[1]}
            row |= {"change_over_spread": one.size, "p": one.p, "p_adjusted": one.adjusted}
            rows.append(row)
    studies.write_csv(rows, HERE / "wear.csv")


def write(made: Made) -> None:
    """Write tables, picture and page of what was found."""
    changes = {n: wear(made.found[n], made.measured[n]) for n in made.found}
    draw_wear(changes[FIRST], made.measured[FIRST], FIRST, HERE / "new_against_worn.png")
    write_tables(made.table, changes)
    table, off = made.table, made.table["misfit_stress_strain"]
    everywhere = [
        code(name)
        for name in (ENERGY, PEAK, *SCATTERING)
        if all(one.stands_out for ones in changes.values() for one in ones if one.name == name)
    ]
    studies.write_page(
        HERE, first=FIRST, later=LATER, last=max(changes), fits=len(table),
        fitted=int(table["status"].isin(["ok", "warnings"]).sum()),
        misfit_low=percent(off.min()), misfit_high=percent(off.max()),
        misfit_median=percent(off.median()), batch=batch_rows(table),
        names=" | ".join(f"`{name}`" for name in LAW), dashes=" | ".join("---" for _ in LAW),
        told_first=told(changes[FIRST]), told_later=told(changes[LATER]),
        everywhere=", ".join(everywhere) or "nothing", wear_first=change_rows(changes[FIRST]),
        wear_later=change_rows(changes[LATER]),
    )  # fmt: skip


def main() -> None:
    studies.arguments(__doc__).parse_args()
    data = studies.measurements("shoe-foam-twins") / "shoe-foam-twins"
    with tempfile.TemporaryDirectory() as folder:
        made = measure(data, Path(folder))
    write(made)


if __name__ == "__main__":
    studies.run(main, HERE)
