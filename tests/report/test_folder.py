import csv
import json
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest

import fabricated
import foamfit as ff
import foamfit.report.folder
from conftest import small_pictures
from foamfit.errors import InputError
from foamfit.report.figures import write_both
from foamfit.report.folder import load_result, save_whole

KEYS = {
    "schema", "foamfit", "test", "data_sha256", "model", "drive", "interior_mass", "seed", "status",
    "warnings", "notes", "checklist", "data", "parameters", "relaxation", "stiffening", "mullins",
    "derived", "visited", "misfit", "weights", "specimen", "statistics", "energy", "runtime_s",
    "stopped", "noise", "outliers", "load",
}  # fmt: skip


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fabricated.result().save(tmp_path_factory.mktemp("fits") / "foam" / "bistable")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def strict(text: str) -> dict:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_folder_is_complete_and_nothing_is_beside_it(saved: Path) -> None:
    assert {path.name for path in saved.iterdir()} == fabricated.FILES
    assert [path.name for path in saved.parent.iterdir()] == ["bistable"]
    assert (saved / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert (saved / "fit.pdf").read_bytes().startswith(b"%PDF")


def test_json_keeps_the_contract(saved: Path) -> None:
    content = strict((saved / "fit.json").read_text(encoding="utf-8"))
    assert set(content) == KEYS
    assert content["schema"] == 1
    assert content["parameters"]["s1_k0"] == {
        "value": 5.5e6, "stderr": 66000.0, "ci95": [5370640.0, 5629360.0], "unit": "Pa",
        "vary": True, "state": "determined", "why": "the test reaches its branch",
        "ci95_method": None, "range": None, "systematic": 0.0,
    }  # fmt: skip
    assert content["visited"] == {"s1": ["a", "d", "c", "e"]}
    assert content["misfit"]["stress_strain"] is None
    assert content["weights"] == {"stress": 0.5, "displacement": 0.5}
    assert content["energy"]["absorbed_J"] == 0.0095
    assert content["derived"]["s1"]["sigma_a"] == pytest.approx(0.895349e6, rel=1e-6)
    assert content["derived"]["s1"]["eps_hat_c"] == pytest.approx(0.345858, abs=1e-6)


def test_no_number_in_the_json_is_other_than_finite() -> None:
    odd = fabricated.estimate("s1_kc", 1.0, stderr=np.nan, ci95=(-np.inf, np.inf))
    result = fabricated.result(
        parameters={"s1_kc": odd},
        statistics={"redchi": np.float64("inf"), "n_data": np.int64(3)},
        energy={"lost_J": np.array([1.0, np.nan])},
    )
    content = strict(json.dumps(result.to_json_dict(), allow_nan=False))
    assert content["parameters"]["s1_kc"]["stderr"] is None
    assert content["parameters"]["s1_kc"]["ci95"] == [None, None]
    assert content["statistics"] == {"redchi": None, "n_data": 3}
    assert content["energy"] == {"lost_J": [1.0, None]}


def test_parameters_csv(saved: Path) -> None:
    table = {row["name"]: row for row in rows(saved / "parameters.csv")}
    assert float(table["s1_k0"]["ci95_lo"]) == 5370640.0
    assert table["s1_kh_minus"]["stderr"] == table["s1_kh_minus"]["ci95_hi"] == ""
    assert table["s1_kh_minus"]["state"] == "not determined"


def test_curves_csv_gives_the_curves_back(saved: Path) -> None:
    table = rows(saved / "curves.csv")
    curves = fabricated.result().curves
    assert list(table[0]) == [
        "time (s)", "measured stress (Pa)", "fitted stress (Pa)", "measured displacement (m)",
        "fitted displacement (m)", "stress along measured displacement (Pa)",
    ]  # fmt: skip
    assert [float(row["measured stress (Pa)"]) for row in table] == list(curves.measured_stress)


def test_masses_inside_have_their_columns(tmp_path: Path) -> None:
    result = fabricated.result()
    inside = 0.4 * result.curves.displacement
    curves = replace(result.curves, interior={1: (inside + 1e-6, inside)})
    folder = replace(result, curves=curves).save(tmp_path / "r", report=False)
    table = rows(folder / "curves.csv")
    names = ["measured displacement_1 (m)", "fitted displacement_1 (m)"]
    assert list(table[0])[-2:] == names
    assert [float(row[names[1]]) for row in table] == inside.tolist()
    assert float(table[0][names[0]]) == 1e-6


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_failing_midway_leaves_the_older_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: type[BaseException]
) -> None:
    small_pictures(monkeypatch)
    folder = fabricated.result(seed=1).save(tmp_path / "r")

    def fail(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr(foamfit.report.folder, "render_report", fail)
    with pytest.raises(failure):
        fabricated.result(seed=2).save(folder)
    with pytest.raises(failure):
        fabricated.result(seed=2).save(tmp_path / "new" / "deep")
    assert load_result(folder)["seed"] == 1
    assert {path.name for path in folder.iterdir()} == fabricated.FILES
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


def test_another_kind_of_result_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "joint.json").write_text('{"schema": 1, "foamfit": "", "tests": {"slow": {}}}')
    fabricated.result().save(tmp_path / "slow", report=False)
    with pytest.raises(ff.InputError, match=r"joint\.json, which does not belong to a fit"):
        fabricated.result().save(tmp_path, report=False)
    assert (tmp_path / "slow" / "fit.json").is_file()
    fabricated.result().save(tmp_path, report=False, force=True)
    assert not (tmp_path / "slow").exists()


def test_the_same_result_gives_the_same_files(saved: Path, tmp_path: Path) -> None:
    again = fabricated.result().save(tmp_path / "again")
    assert all(
        (again / name).read_bytes() == (saved / name).read_bytes() for name in fabricated.FILES
    )


def test_derived_numbers_of_a_microscale_spring() -> None:
    result = fabricated.microscale_result()
    derived = result.to_json_dict()["derived"]["s1"]
    peak = float(fabricated.MICRO.stress([0.0, 0.6])[-1])
    most = NormalDist(np.log(1.06e5), 0.44).cdf(np.log(peak))
    assert derived["p_max"] == pytest.approx(most, rel=1e-9)
    assert derived["p_max_stress"] == pytest.approx(peak, rel=1e-9)
    assert derived["p_max_strain"] == pytest.approx(0.6)
    on_a, on_c = 1.06e5 / (4.4e5 + 1.06e5), 0.29 + 1.06e5 / (4.9e5 + 1.06e5)
    assert derived["snap_strain"] == pytest.approx(on_c - on_a)


def test_a_figure_that_cannot_be_written_names_the_folder_of_the_result(tmp_path: Path) -> None:
    figure = fabricated.no_figures()["fit"]
    with pytest.raises(InputError) as refused:
        save_whole(tmp_path / "out", lambda fresh: write_both(figure, fresh / "none" / "joint"))
    reason = "No such file or directory; choose another folder"
    assert str(refused.value) == f"the result cannot be written to {tmp_path / 'out'}: {reason}"
