"""The main numbers of experiments/paper_claims, from the functions that write its page."""

from __future__ import annotations

import importlib.util
import math
import re
import sys

import numpy as np
import pytest

from conftest import EXPERIMENTS

FOLDER = EXPERIMENTS / "paper_claims"
_spec = importlib.util.spec_from_file_location("paper_claims", FOLDER / "paper_claims.py")
assert _spec is not None
assert _spec.loader is not None
claims = importlib.util.module_from_spec(_spec)
sys.modules["paper_claims"] = claims  # @dataclass looks up its module here
_spec.loader.exec_module(claims)

MODEL_1, MODEL_2, MODEL_3, FOAM_2 = claims.MODEL_1, claims.MODEL_2, claims.MODEL_3, claims.FOAM_2


@pytest.fixture(scope="module")
def drive() -> claims.Drive:
    return claims.drive_of_impact()


@pytest.fixture(scope="module")
def coarse() -> claims.Drive:
    """The same drive with fewer samples, for cases that need many steps between samples."""
    return claims.drive_of_impact(samples=101)


# ------------------------------------------------------------------------ 1: oscillation and damper


def test_foams_mass_oscillates_where_branches_change(drive: claims.Drive) -> None:
    free = claims.oscillation(drive, claims.OWN_MASS, 0.0)
    assert free["stress"] == pytest.approx(3.95, abs=0.1)
    assert free["displacement"] == pytest.approx(5.1, abs=0.2)
    assert free["turns"] > 20
    assert free["turns_w"] > 20
    by_branch = claims.vibration_by_branch(drive)
    assert by_branch["c"] == pytest.approx(11.7, abs=0.2)
    assert by_branch["c"] > 3 * max(by_branch[name] for name in "ade")


def test_without_mass_nothing_oscillates(drive: claims.Drive) -> None:
    still = claims.oscillation(drive, 0.0, 0.0)
    assert still["stress"] < 100.0 * 8 * np.finfo(float).eps  # %, of rounding
    assert still["displacement"] < 1e-6
    assert still["turns"] == still["turns_w"] == 0


def test_small_damper_removes_the_oscillation(drive: claims.Drive, coarse: claims.Drive) -> None:
    needed = claims.damper_needed(drive)
    assert needed == pytest.approx(8.1, abs=0.3)
    damped = claims.oscillation(drive, claims.OWN_MASS, needed)
    assert damped["stress"] < 0.5
    assert damped["turns"] == damped["turns_w"] == 0
    weaker = claims.oscillation(drive, claims.OWN_MASS, 0.9 * needed)
    assert weaker["turns"] + weaker["turns_w"] > 0
    given = [(drive, 1.5), (drive, 5.0), (drive, 50.0), (coarse, claims.ETA / needed)]
    for of, factor in given:  # a stronger damper must not bring the oscillation back
        stronger = claims.oscillation(of, claims.OWN_MASS, factor * needed)
        assert stronger["turns"] == stronger["turns_w"] == 0


def test_oscillation_has_the_free_period(drive: claims.Drive) -> None:
    """On branch c the slope rises with stress, so the period is a little below that of k_c."""
    got = claims.driven(drive, claims.OWN_MASS, 0.0)
    on_c = drive.spring.branches(got.strain) == "c"
    off = (got.base_stress - drive.stress)[on_c]
    crossings = np.flatnonzero(np.diff(np.sign(off)))
    period = 2 * np.mean(np.diff(drive.time[on_c][crossings]))
    longest = claims.free_period(drive, claims.OWN_MASS, drive.spring.kc)
    assert 0.93 * longest < period < longest


# ------------------------------------------------------------------------ 2: the literal reading


def test_literal_reading_fails_by_half(drive: claims.Drive) -> None:
    assert claims.displacement_error(drive, 0.0, 0.0) < 1e-6
    assert claims.displacement_error(drive, claims.STRIKER, 0.0) == pytest.approx(49.3, abs=0.3)
    assert claims.displacement_error(drive, claims.STRIKER, claims.ETA) == pytest.approx(
        54.5, abs=0.3
    )


@pytest.mark.parametrize(
    ("velocity", "undamped", "damped", "own"), [(1.75, 62.1, 58.0, 2.4), (2.3, 56.0, 54.2, 1.9)]
)
def test_literal_reading_with_other_drives(
    velocity: float, undamped: float, damped: float, own: float
) -> None:
    drive = claims.drive_of_impact(velocity=velocity)
    for mass, damper, error in (
        (claims.STRIKER, 0.0, undamped),
        (claims.STRIKER, claims.ETA, damped),
        (claims.OWN_MASS, 0.0, own),
    ):
        assert claims.displacement_error(drive, mass, damper) == pytest.approx(error, abs=0.3)


def test_vibration_closes_a_loop_that_the_drive_does_not() -> None:
    drive = claims.drive_of_impact(velocity=1.9)
    exact, vibration = (claims.driven(drive, mass, 0.0) for mass in (0.0, claims.OWN_MASS))
    on_c = claims.BRANCH_NAMES.index("c")
    assert on_c not in exact.switches[:, 3]
    assert on_c in vibration.switches[:, 3]


def test_slow_drive_brings_equilibrium(drive: claims.Drive, coarse: claims.Drive) -> None:
    assert claims.slowed(coarse, claims.ETA, 1000.0) == pytest.approx(0.81, abs=0.05)
    assert claims.slowed(drive, 0.0, 1000.0) < 0.3
    same = math.sqrt(claims.STRIKER / claims.OWN_MASS)
    own = claims.displacement_error(drive, claims.OWN_MASS, 0.0)
    assert claims.slowed(drive, 0.0, same) == pytest.approx(own, rel=1e-6)


# ------------------------------------------------------------------------ 3: damping ratios


def test_two_of_three_damping_ratios_follow_from_the_tables() -> None:
    formula = next(iter(claims.ratio_readings().values()))
    assert f"{formula[MODEL_3]:.4f}" == "0.0297"
    assert f"{formula[FOAM_2]:.3f}" == "0.525"
    assert f"{formula[MODEL_2]:.3f}" == "0.845"
    for name, value in formula.items():  # the package agrees
        assert claims.ff.published[name].damping_ratio_by_formula() == pytest.approx(value)


def test_no_reading_gives_the_third() -> None:
    readings = claims.ratio_readings()
    assert len(readings) >= 15
    assert not [label for label, row in readings.items() if f"{row[MODEL_2]:.3f}" == "0.894"]


def test_what_would_give_the_third() -> None:
    wanted, q = claims.ratio_wanted(), claims.quantities(claims.ff.published[MODEL_2])
    area = math.pi / 4 * wanted["diameter"] ** 2
    for changed in (
        claims.ratio(q | {"eta": wanted["eta"]}, q["kc"]),
        claims.ratio(q, wanted["kc_over_k0"] * q["k0"]),
        claims.ratio(q, q["kc"], mass=wanted["mass"]),
        claims.ratio(q, q["kc"], height=wanted["height"]),
        claims.ratio(q | {"A": area}, q["kc"]),
    ):
        assert changed == pytest.approx(0.894, rel=1e-12)
    assert wanted["eta"] == pytest.approx(1.058e4, rel=1e-3)


# ------------------------------------------------------------------------ 4: energy


@pytest.mark.parametrize(
    ("name", "interior", "needed"),
    [
        (MODEL_1, False, 1.9107),
        (MODEL_2, False, 1.9107),
        (MODEL_3, False, 1.9227),
        (MODEL_3, True, 1.9214),
        (FOAM_2, False, 4.3933),
        (FOAM_2, True, 4.3924),
    ],
)
def test_velocity_that_closes_the_loop(name: str, interior: bool, needed: float) -> None:
    assert claims.closing_velocity(name, interior) == pytest.approx(needed, abs=1e-4)
    if not interior:
        assert claims.closing_velocity_by_energy(name) == pytest.approx(needed, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "strain"), [(MODEL_1, 0.3218), (MODEL_2, 0.3218), (MODEL_3, 0.7045)]
)
def test_foam_1_lacks_a_fifth_of_the_energy(name: str, strain: float) -> None:
    row = claims.energy_row(name)
    assert row["strain"] == pytest.approx(strain, abs=2e-4)
    assert row["strain"] < row["c1"]
    assert row["rebound"] == pytest.approx(1.75, rel=1e-4)
    assert 19.0 < row["excess"] < 21.0
    assert row["brought"] < row["work"]


def test_foam_2_just_closes_its_loop() -> None:
    row = claims.energy_row(FOAM_2)
    assert row["strain"] == pytest.approx(0.767, abs=5e-4)
    assert row["peak"] / 1e6 == pytest.approx(17.4, abs=0.05)
    assert row["rebound"] == pytest.approx(2.17, abs=0.005)
    assert row["excess"] == pytest.approx(-2.1, abs=0.1)


def test_massless_chain_loses_the_loop_area() -> None:
    """Just past C1 the striker loses the area of the smallest closed loop."""
    chain, velocity = claims.impact_scene(MODEL_2), 1.9108
    brought = 0.5 * claims.STRIKER * velocity**2 / chain.area
    lost = claims.lost_share(chain, velocity) / 100 * brought
    assert lost == pytest.approx(claims.loop_area(MODEL_2), rel=1e-3)


def test_published_damping_is_no_viscosity() -> None:
    eta = claims.published_viscosity()
    assert eta["stress"] / 1e6 == pytest.approx(14.7, abs=0.05)
    assert eta["first"] == pytest.approx(eta["stress"], rel=1e-9)
    assert eta["stress"] > 3.5 * eta["c1"]
    assert eta["strain"] == pytest.approx(0.058, abs=1e-3)


# ------------------------------------------------------------------------ the page


def test_page_is_the_filled_template() -> None:
    """README.md is the filled template; its numbers and tables are not compared."""
    template = claims.subscripts((FOLDER / "page.template.md").read_text(encoding="utf-8"))
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    for text in re.split(r"{[^}]+}", template):
        assert text in page
    assert "{" not in page
    for figure in re.findall(r"]\((\w+\.png)\)", page):
        assert (FOLDER / figure).is_file()
    assert claims.subscripts(claims.of_ratios()["table_ratios"]) in page
    assert claims.of_energy()["table_energy"] in page


# -------------------------------------------------------------------------- 5: the microscale


@pytest.mark.parametrize(
    ("name", "slope", "bound"),
    [(MODEL_1, 14.3, 7.4), (MODEL_2, 14.3, 7.4), (MODEL_3, 6.8, 4.7), (FOAM_2, 34.5, 16.0)],
)
def test_no_published_branch_d_is_made_by_snapping(name: str, slope: float, bound: float) -> None:
    row = claims.microscale_row(name)
    assert row["d"] == pytest.approx(slope, abs=0.05)
    assert row["a"] == pytest.approx(bound, abs=0.05)
    assert row["least"] < -1e-3
    assert row["falls"] == 0.0
