"""A material card: its curves, unloading, text as read by the solver, and loss of accuracy."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fabricated
import foamfit as ff
from conftest import DATA, needs_data, run, run_refused, specimen_toml, thinned
from foamfit.cards import loading
from foamfit.cards.card import FORMATS, UNITS
from foamfit.data.measurement import Specimen
from foamfit.results import Curves

HEIGHT, AREA, MASS = 10e-3, 5e-5, 1.1e-4  # 220 kg/m³
LAW: dict[str, float] = {
    "k0": 4.4e5, "kc": 4.9e5, "eps_star": 0.29, "sigma_plus": 1.06e5, "spread_plus": 0.44,
    "sigma_minus": 7.9e4, "spread_minus": 0.7, "eta": 20.0, "g1": 0.3, "tau1": 0.25,
}  # fmt: skip
TOP, NOISE = 0.6, 300.0
# One unit of stress, strain rate and density in Pa, 1/s and kg/m³.
SI = {"kg-mm-ms": (1e9, 1e3, 1e9), "t-mm-s": (1e6, 1.0, 1e12), "SI": (1.0, 1.0, 1.0)}


def write_fit(
    folder: Path, rate: float, b: float = 0.0, top: float = TOP, **changed: Any
) -> ff.FitResult:
    """Write the folder of a fit to a triangular test simulated by the law, with added noise.

    The snap stresses are proportional to the strain rate to the power b.
    """
    values = LAW | {name: LAW[name] * rate**b for name in ("sigma_plus", "sigma_minus")}
    *own, g, tau = values.values()
    chain = ff.Chain([ff.MicroscaleSpring(*own, relaxation=[(g, tau)])], [HEIGHT], AREA)
    time = np.linspace(0.0, 2.0 * top / rate, 401)
    moved = rate * np.minimum(time, time[-1] - time) * HEIGHT
    fitted = ff.simulate(chain, ff.DisplacementDrive(moved), time).base_stress
    measured = fitted + NOISE * np.random.default_rng(0).standard_normal(time.size)
    base = fabricated.microscale_result()
    given: dict[str, Any] = {
        "measurement": replace(
            base.measurement, name="a foam", time=time, stress=measured, displacement=moved,
            specimen=Specimen(HEIGHT, AREA, MASS),
        ),
        "chain": chain,
        "misfit": {"stress_strain": float(np.std(fitted - measured) / np.ptp(measured))},
        "curves": Curves(time, measured, moved, fitted, None, fitted),
        "parameters": {
            f"s1_{n}": fabricated.estimate(n, v, stderr=None, ci95=None) for n, v in values.items()
        },
        "switches": (),
    }  # fmt: skip
    found = replace(base, **(given | changed))
    found.save(folder, report=False)
    return found


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fits") / "foam"
    write_fit(folder, 0.25)
    return folder


@pytest.fixture(scope="module")
def joint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a joint fit of three tests whose snap stresses follow a rate law."""
    folder, b = tmp_path_factory.mktemp("joint") / "study", 0.08
    rates = {"slow": 0.01, "middle": 1.0, "fast": 100.0}
    tests = {name: write_fit(folder / name, rate, b) for name, rate in rates.items()}
    parameters = {
        f"s1_{name}": {"value": value, "unit": ""}
        | ({"kind": "power rate", "b": b} if name.startswith("sigma") else {"kind": "shared"})
        for name, value in LAW.items()
    }
    content = {
        "schema": 1, "foamfit": "", "name": "rates", "model": "microscale", "relaxation": 1,
        "drive": "displacement", "status": "ok", "warnings": [], "sentences": [], "rate0": 1.0,
        "parameters": parameters,
        "tests": {
            name: {"rate": rate, "drive": "displacement", "misfit": tests[name].misfit}
            for name, rate in rates.items()
        },
    }  # fmt: skip
    (folder / "joint.json").write_text(json.dumps(content))
    return folder


# ------------------------------------------------------------------------------- curves


def test_loading_curves_are_those_of_the_law_and_fit_for_a_solver(joint: Path) -> None:
    card = ff.card(joint, format="csv", rates=(0.001, 0.01, 1, 10, 100, 1e4))
    curves = card.curves
    assert curves.measured_to == pytest.approx(TOP)
    assert np.all(curves.stress[:, 0] == 0.0)
    assert curves.strain[0] == 0.0
    assert np.all(np.diff(curves.strain) > 0.0)
    assert np.all(np.diff(curves.stress) > 0.0)
    assert np.all(np.diff(curves.stress, axis=0) >= 0.0)  # curves do not cross
    assert curves.strain[-1] > 0.85
    np.testing.assert_array_equal(curves.stress[0], curves.stress[1])  # clamped
    np.testing.assert_array_equal(curves.stress[-1], curves.stress[-2])
    assert sum("outside the fitted rates" in one for one in card.warnings) == 2
    # Between the fitted rates, the interpolated card must agree with a simulation.
    sigma = [LAW[name] * 10.0**0.08 for name in ("sigma_plus", "sigma_minus")]
    values = LAW | dict(zip(("sigma_plus", "sigma_minus"), sigma, strict=True))
    *own, g, tau = values.values()
    chain = ff.Chain([ff.MicroscaleSpring(*own, relaxation=[(g, tau)])], [1.0], 1.0)
    strain = np.linspace(0.0, 0.85, 3001)
    law = ff.simulate(chain, ff.DisplacementDrive(strain), strain / 10.0).base_stress
    read = np.interp(strain, curves.strain, curves.stress[3])
    beyond = strain > 0.01  # below, the card smooths the initial jump of the dashpot
    assert np.abs(read - law)[beyond].max() < 2e-3 * curves.stress[3].max()


def test_curves_end_where_a_bistable_law_ends() -> None:
    base, soft = fabricated.result(), {"s1_kc": 1e6, "s1_dsigma": -1e5}  # eps_star = -0.13
    made = {name: fabricated.estimate(name, value) for name, value in soft.items()}
    card = ff.card(replace(base, parameters=base.parameters | made), format="csv")
    assert 0.8 < card.curves.strain[-1] < 0.87


def test_nearly_equal_rates_share_a_curve() -> None:
    rates = SimpleNamespace(rates=(0.24, 0.234, 2.4))
    assert loading.fitted_rates(rates) == [0.234, 2.4]


# ------------------------------------------------------------------------------- unloading


def replayed(style: str, strain: np.ndarray, unloading: loading.Unloading) -> np.ndarray:
    """Return the stress of a card with one curve, σ = ε² MPa, for strain samples 1 s apart."""
    x = np.linspace(0.0, 1.0, 4001)
    curves = loading.Curves(np.array([1e-3]), x, 1e6 * x[None] ** 2, 1.0)
    first = strain >= np.maximum.accumulate(strain)
    motion = loading.Motion(strain, np.gradient(strain), first)
    return loading.REPLAYS[style](curves, motion)(unloading)


def test_unloading_follows_the_formula_of_the_solvers() -> None:
    hu, shape, expon = unloading = loading.Unloading(0.1, 1.7, 0.6)
    down, up = np.linspace(0.8, 0.2, 61), np.linspace(0.2, 0.9, 71)[1:]
    strain = np.concatenate([np.linspace(0.0, 0.8, 81), down[1:], up])
    # W is proportional to ε³.
    share = 1.0 - (1.0 - hu) * (1.0 - (down / 0.8) ** (3.0 * shape)) ** expon
    dyna = replayed("mat083", strain, unloading)
    np.testing.assert_allclose(dyna[80:141], 1e6 * share * down**2, rtol=1e-4)
    np.testing.assert_allclose(dyna[141:200], dyna[139:80:-1], rtol=1e-6)  # the same on reloading
    np.testing.assert_allclose(dyna[201:], 1e6 * strain[201:] ** 2, rtol=1e-4)
    radioss = replayed("law90", strain, unloading)
    np.testing.assert_allclose(radioss[81:140], dyna[81:140], rtol=2e-3)
    np.testing.assert_allclose(radioss[142:], 1e6 * strain[142:] ** 2, rtol=1e-4)  # jumps back


@pytest.mark.parametrize("style", FORMATS)
def test_the_unloading_of_a_card_is_found_again(style: str) -> None:
    strain = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)[1:]])
    true = loading.Unloading(0.15, 2.3, 1.0 if style == "mat057" else 0.7)
    target = replayed(style, strain, true)
    found = loading.fit_unloading(
        [lambda one: replayed(style, strain, one)], [target], expon=style != "mat057"
    )
    np.testing.assert_allclose(found, true, rtol=1e-3)


def test_what_the_card_loses_is_said(fit: Path, joint: Path) -> None:
    """The fit reaches the noise; the card loses less with three unloading parameters than two."""
    losses = {}
    for style in FORMATS:
        card = ff.card(fit, format=style)
        assert card.misfit["fit"] == pytest.approx(NOISE / np.ptp(card.records[0].stress), rel=0.1)
        assert 0.0 < card.unloading.HU <= 1.0
        losses[style] = card.misfit["card"]
        one = card.records[0]
        rms = np.sqrt(np.mean((one.card - one.stress) ** 2)) / np.ptp(one.stress)
        assert losses[style] == pytest.approx(rms)
    assert card.misfit["fit"] < losses["mat083"] < losses["mat057"] < 0.05
    assert ff.card(fit, format="mat057").unloading.EXPON == 1.0
    many = {style: ff.card(joint, format=style) for style in FORMATS}
    assert many["mat083"].misfit["card"] < 0.04
    assert len(many["mat057"].curves.rates) == 1
    assert any("no strain rate" in one for one in many["mat057"].warnings)


@needs_data
def test_scale_and_delay_of_a_record_are_no_misfit_of_the_card(tmp_path: Path) -> None:
    plain, late, scale = write_fit(tmp_path / "plain", 0.25), 0.02, 1.08
    c = plain.curves
    read = replace(
        c,
        measured_stress=c.measured_stress / scale,
        stress_along=c.stress_along / scale,
        measured_displacement=np.interp(c.time - late, c.time, c.measured_displacement),
    )
    values = {"force_scale": scale, "time_shift": late}
    more = {name: fabricated.estimate(name, value) for name, value in values.items()}
    other = replace(plain, curves=read, parameters=plain.parameters | more)
    first, second = (ff.card(one, format="mat083").misfit["card"] for one in (plain, other))
    assert second == pytest.approx(first, rel=0.1)


def test_on_real_foam_three_parameters_lose_little_and_two_more(tmp_path: Path) -> None:
    file = thinned(DATA / "shoe-foam" / "turbo-comp-1_cycle1.csv", tmp_path, 4)
    test = ff.read_test(file, specimen_toml(tmp_path, 10.53, 7.63))
    law = {"model": "microscale", "relaxation": 1}
    fit = ff.fit(test, **law, starts=3, intervals="local")
    three, two = (ff.card(fit, format=style) for style in ("mat083", "mat057"))
    assert fit.misfit["stress_strain"] < 0.007
    assert three.misfit["card"] < 0.012
    assert 1.2 * three.misfit["card"] < two.misfit["card"] < 0.02
    # The loss is largest at the strain reversal, where the foam relaxes but a card does not.
    one = three.records[0]
    off = (one.card - one.stress)[one.strain < one.strain.max() - 0.01]
    assert np.sqrt(np.mean(off**2)) / np.ptp(one.stress) < 0.009


# ------------------------------------------------------------------------------- texts


def fixed(line: str, width: int = 10) -> list[str]:
    return [line[i : i + width].strip() for i in range(0, len(line), width)]


def dyna_blocks(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the keywords of an LS-DYNA deck with their data lines."""
    lines = [line for line in text.splitlines() if not line.startswith("$")]
    starts = [i for i, line in enumerate(lines) if line.startswith("*")]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        yield lines[start], lines[start + 1 : end]


def points(lines: list[str]) -> np.ndarray:
    return np.array([[float(cell) for cell in fixed(line, 20)] for line in lines]).T


@pytest.mark.parametrize("units", UNITS)
def test_ls_dyna_reads_the_card(joint: Path, units: str) -> None:
    card = ff.card(joint, format="mat083", units=units, rates=(0.02, 3, 80))
    pa, per_second, dense = SI[units]
    assert all(len(line) <= 80 for line in card.text.splitlines())
    assert card.text.isascii()
    assert "\n\n" not in card.text
    blocks = list(dyna_blocks(card.text))
    names = [name for name, _ in blocks]
    assert names == ["*KEYWORD", "*MAT_083", "*DEFINE_TABLE", *["*DEFINE_CURVE"] * 3, "*END"]
    first, second, third, fourth, fifth = map(fixed, blocks[1][1])
    mid, ro, e, kcon, tc, _, _, tbid = first  # MID RO E KCON TC FAIL DAMP TBID
    assert (int(mid), float(tc)) == (1, 1e20)
    assert float(ro) * dense == pytest.approx(MASS / (AREA * HEIGHT), rel=1e-3)
    slopes = np.diff(card.curves.stress) / np.diff(card.curves.strain)
    assert float(e) * pa == pytest.approx(slopes[:, : card.curves.measured - 1].max(), rel=1e-3)
    assert float(kcon) * pa == pytest.approx(slopes.max(), rel=1e-3)
    # BVFLAG SFLAG RFLAG TFLAG PVID SRAF REF HU; …; C3 … MAXR SHAPE; EXPON RIULD
    assert [float(cell) for cell in second[:7]] == [0, 1, 0, 0, 0, 0, 0]
    read = [float(cell) for cell in (second[7], fourth[7], fifth[0])]
    np.testing.assert_allclose(read, card.unloading, rtol=1e-5)
    assert not any(float(cell) for cell in (*third, *fourth[:7], fifth[1]))
    table, *rates = blocks[2][1]
    assert fixed(table)[0] == tbid
    np.testing.assert_allclose([float(one) * per_second for one in rates], [0.02, 3, 80], rtol=1e-6)
    ids = set()
    for (_, (head, *lines)), stress in zip(blocks[3:6], card.curves.stress, strict=True):
        ids.add(fixed(head)[0])
        strain, read_stress = points(lines)
        np.testing.assert_allclose(strain, card.curves.strain, rtol=1e-6)
        np.testing.assert_allclose(read_stress * pa, stress, rtol=1e-6)
    assert len({tbid, *ids}) == 4
    assert card.text.count("extrapolated from here on") == 3


def test_the_other_solvers_read_their_cards(joint: Path) -> None:
    rates = (0.02, 3, 80)
    single = ff.card(joint, format="mat057", rates=rates)
    blocks = list(dyna_blocks(single.text))
    first, second = map(fixed, blocks[1][1])  # MID RO E LCID TC HU BETA DAMP; SHAPE … KCON REF
    assert (blocks[1][0], first[3], first[6]) == ("*MAT_057", "1001", "0.0")
    read = [float(first[5]), float(second[0])]
    np.testing.assert_allclose(read, single.unloading[:2], rtol=1e-5)
    np.testing.assert_allclose(
        points(blocks[2][1][1:])[1] * 1e9, single.curves.stress[0], rtol=1e-6
    )

    card = ff.card(joint, format="law90", rates=rates, units="t-mm-s")
    lines = [line for line in card.text.splitlines() if not line.startswith("#")]
    assert lines[2].split() == ["Mg", "mm", "s"]
    at = lines.index("/MAT/LAW90/1/1")
    head = lines[at + 4]  # NL Ismooth Fcut Shape Hys Alpha
    assert fixed(head[:20]) == ["4", "1"]
    _, shape, hu, alpha = (float(cell) for cell in fixed(head[20:], 20))
    np.testing.assert_allclose([hu, shape, alpha], card.unloading, rtol=1e-6)
    rows = [(int(row[:10]), float(row[10:30])) for row in lines[at + 5 : at + 9]]
    assert [row[0] for row in rows] == [1001, 1002, 1003, 1003]  # constant above the highest rate
    assert rows[3][1] > 1e3 * rows[2][1]
    functions = [i for i, line in enumerate(lines) if line.startswith("/FUNCT/")]
    stress = points(lines[functions[1] + 2 : functions[2]])[1]
    np.testing.assert_allclose(stress * 1e6, card.curves.stress[1], rtol=1e-6)

    card = ff.card(joint, format="abaqus", rates=(0.02, 3, 100, 1e4), units="SI")
    body = card.text.partition("DIRECTION=COMPRESSION\n")[2].splitlines()
    data = np.array([[float(x) for x in row.split(",")] for row in body if row[:2] != "**"])
    stress, _, rate = data.T
    assert np.all(np.diff(rate) >= 0.0)
    assert list(np.unique(rate)) == [-0.02, 0.02, 3.0, 100.0]  # 1e4 is beyond the fitted rates
    parts = [data[rate == one] for one in np.unique(rate)]
    for part in parts:
        assert np.all(np.diff(part[:, :2], axis=0) > 0.0)
    for below, above in pairwise(parts):
        assert np.all(below[1:, 0] < above[1:, 0])  # curves do not touch
    np.testing.assert_allclose(parts[1][:, 0], card.curves.stress[0], rtol=1e-6)


def test_an_unknown_density_is_no_number(tmp_path: Path, fit: Path) -> None:
    known = ff.load(fit)
    test = replace(known.measurement, specimen=Specimen(HEIGHT, AREA))
    replace(known, measurement=test).save(tmp_path / "foam", report=False)
    for style in ("mat083", "mat057", "law90", "abaqus"):
        card = ff.card(tmp_path / "foam", format=style)
        assert any("density" in one for one in card.warnings)
        assert "DENSITY MISSING" in card.text
        assert FORMATS[style][2] in card.text


# ------------------------------------------------------------------------------- files, refusals


@pytest.mark.usefixtures("here")
def test_the_command_writes_card_numbers_and_picture(fit: Path) -> None:
    done = run("card", fit, "--format", "mat083", "--rates", "0.25,10")
    card = f"{fit.parent.name}-foam-mat083.k"
    assert f"cards/{card}" in done.output
    names = [card, *(f"{card}.{one}" for one in ("json", "pdf", "png"))]
    assert sorted(path.name for path in Path("cards").iterdir()) == names
    told = json.loads(Path("cards", names[1]).read_text())
    assert list(told) == ["format", "misfit", "parameters", "curves", "warnings"]
    assert list(told["parameters"]) == ["HU", "SHAPE", "EXPON"]
    assert list(told["curves"][0]) == ["rate", "strain", "stress", "measured_to"]
    assert "10 1/s lies outside the fitted rates" in told["warnings"][0]
    assert f"{100 * told['misfit']['card']:.2g} %" in done.output
    rows = np.genfromtxt(
        ff.card(fit, format="csv", units="SI").text.splitlines()[1:], delimiter=","
    )
    np.testing.assert_allclose(rows[:, 2], told["curves"][0]["stress"])
    assert np.all(rows[:, 3] == (rows[:, 1] > TOP))
    Path("mine.k").write_text("mine")
    assert "is not a card" in run_refused("card", fit, "--format", "csv", "--out", "mine.k")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--format", "mat084"], "format = 'mat084' is unknown"),
        (["--format", "mat083", "--units", "inch"], "units = 'inch' is unknown"),
        (["--format", "mat083", "--rates", "1,-2"], "rates = 1,-2 must be positive"),
        (["--format", "csv", "--out", "no/such/card.csv"], "there is no folder"),
        (["--format", "csv", "--out", "."], ". is a folder; name a file"),
        ([], "--format"),
    ],
)
def test_a_wrong_call_is_one_sentence_and_writes_nothing(
    fit: Path, here: Path, given: list[str], words: str
) -> None:
    assert words in run_refused("card", fit, *given)
    assert not list(here.iterdir())


def test_a_result_without_a_card_is_refused(tmp_path: Path, fit: Path, joint: Path) -> None:
    linear = {"s1_k0": fabricated.estimate("s1_k0", 1e6)}
    write_fit(tmp_path / "linear", 0.25, model="linear", relaxation=0, parameters=linear)
    shutil.copytree(fit, tmp_path / "older")
    older = json.loads((fit / "fit.json").read_text())
    del older["load"]
    (tmp_path / "older" / "fit.json").write_text(json.dumps(older))
    shutil.copytree(joint, tmp_path / "apart")
    together = json.loads((joint / "joint.json").read_text())
    together["parameters"]["s1_kc"]["value"] = 4e9  # eps_star is too small for it
    (tmp_path / "apart" / "joint.json").write_text(json.dumps(together))
    for result, words in (
        (tmp_path / "apart", "the common values of its tests are not a spring"),
        (tmp_path / "linear", "has no hysteretic spring"),
        (tmp_path / "older", "fit the test again"),
        (tmp_path / "nothing", "is not a result folder"),
    ):
        told = run_refused("card", result, "--format", "mat083", "--out", tmp_path / "card.k")
        assert words in told
    told = run_refused("card", fit, "--format", "csv", "--out", fit / "card.csv")
    assert "lies in a result" in told
    assert not list(tmp_path.glob("card*"))
    with pytest.raises(ff.InputError, match="rates"):
        ff.card(fit, format="csv", rates=0.0)


def test_a_result_in_memory_gives_the_card_of_its_folder(tmp_path: Path, joint: Path) -> None:
    made = fabricated.microscale_result()
    made.save(tmp_path / "fit", report=False)
    for one, folder in ((made, tmp_path / "fit"), (ff.load(joint), joint)):
        first, second = (ff.card(given, format="mat083") for given in (one, folder))
        assert first.text == second.text
        assert first.to_json_dict() == second.to_json_dict()
