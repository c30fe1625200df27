"""The TOML that `foamfit init` drafts: it proposes a column only if no other can be meant."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from conftest import DATA, needs_data, run, run_refused, write_lines

T = np.linspace(0.0, 2.0, 201)
W = 4.0 * np.sin(0.5 * np.pi * T)
F = 50.0 * W
VOLTS = F / 100.0
COUNTS = np.arange(201.0)


def drafted(folder: Path, *head: str, columns: tuple[np.ndarray, ...] = (T, F, W)) -> list[str]:
    """Return the lines of [columns] that init writes for a table."""
    rows = [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
    return initialised(write_lines(folder, [*head, *rows], toml=None))


def initialised(path: Path) -> list[str]:
    run("init", str(path))
    text = path.with_suffix(".toml").read_text(encoding="utf-8")
    tomllib.loads(text)
    lines = text.partition("[columns]\n")[2].partition("\n\n")[0].splitlines()
    for line in lines:
        if " = {" in line:
            tomllib.loads(line.removeprefix("# "))  # every question is an entry
    return lines


@pytest.mark.parametrize(
    ("others", "wanted"),
    [
        (["reference stress (MPa)", "engineering stress (MPa)"], "engineering stress (MPa)"),
        (["engineering stress (MPa)", "filtered engineering stress (MPa)"],
         "engineering stress (MPa)"),
        (["stress (MPa)", "engineering stress (MPa)"], "stress (MPa)"),
        (["true stress (MPa)", "nominal stress (MPa)"], "nominal stress (MPa)"),
        (["command stress (MPa)", "measured stress (MPa)"], "measured stress (MPa)"),
    ],
)  # fmt: skip
def test_a_plain_name_goes_before_a_qualified_one(
    tmp_path: Path, others: list[str], wanted: str
) -> None:
    head = ",".join(["time (s)", *others, "displacement (mm)"])
    lines = drafted(tmp_path, head, columns=(T, F, F / 2, W))
    assert f'stress = {{ column = "{wanted}" }}' in lines


def test_of_equals_the_user_chooses_and_the_rest_is_known(tmp_path: Path) -> None:
    head = "time (s),left force (N),right force (N),displacement (mm)"
    lines = drafted(tmp_path, head, columns=(T, F, F, W))
    assert lines == [
        'time = { column = "time (s)" }',
        'displacement = { column = "displacement (mm)" }',
        "# force = { column = \"left force (N)\" }  # needed: which of 'left force (N)' and "
        "'right force (N)' is it?",
    ]


@pytest.mark.parametrize(
    ("head", "columns", "proposed"),
    [
        ("time (s),stress_std (MPa),displacement_std (mm)", (T, F, W), ["…", "…"]),
        ("time (s),stress error (MPa),height (mm)", (T, F, W), ["…", "…"]),
        ("time (s),x,y", (T, F, W), ["…", "…"]),
        ("time (s),LVDT A (mm),LVDT B (mm)", (T, W, W), ["…", "…"]),
        ("time (s),Marker,Step", (T, COUNTS, COUNTS // 50), ["…", "…"]),
        ("time (s),Channel A (V),Channel B (V)", (T, VOLTS, W), ["…", "…"]),
        ("time (s),Channel A (V),LVDT (mm)", (T, VOLTS, W), ["Channel A (V)", "LVDT (mm)"]),
        ("time (s),load cell (N),Way,Step", (T, F, W, COUNTS), ["load cell (N)", "Way"]),
    ],
)
def test_what_no_header_says_is_proposed_only_without_an_alternative(
    tmp_path: Path, head: str, columns: tuple[np.ndarray, ...], proposed: list[str]
) -> None:
    lines = drafted(tmp_path, head, columns=columns)
    asked = [line for line in lines if line.startswith("# ") and "needed" in line]
    loads = [line for line in lines if "force =" in line or "stress =" in line]
    ways = [line for line in lines if "displacement =" in line]
    for (line,), name in zip((loads, ways), proposed, strict=True):
        assert f'column = "{name}"' in line
    if "load cell (N)" not in proposed:
        assert len(asked) == 2
    if "Channel A (V)" in proposed:
        scaled = 'scale = "100 N/V" }  # needed: a force (N) or a stress (MPa), with the scale'
        assert scaled in loads[0]


@pytest.mark.parametrize(
    "content", ["time (s),force (N)\n", "<html>1</html>", "%PDF-1.4\n1 0 obj\n"]
)
def test_init_writes_nothing_for_a_file_without_a_table(tmp_path: Path, content: str) -> None:
    path = tmp_path / "test.csv"
    path.write_text(content)
    assert run_refused("init", path).startswith(f"foamfit: {path}: ")
    assert not path.with_suffix(".toml").exists()


@needs_data
@pytest.mark.parametrize(
    ("name", "entries", "never"),
    [
        (
            "aluminium-foam/stress_strain_rate.csv",
            ['time = { column = "time_s" }', 'stress = { column = "engineering_stress_MPa" }',
             'strain = { column = "engineering_strain" }'],
            "column = \"reference",
        ),
        (
            "lattice-impact/Hex_Diamond_contact.csv",
            ['displacement = { column = "displacement_m" }', "or else the [striker] mass"],
            "column = \"displacement_std",
        ),
        ("cartilage-impact/test_1_raw.txt", ['# time = { column = "X_Value"'], 'column = "Comm'),
        ("shoe-foam-twins/specimens.csv", ['# displacement = { column = "…"'], "column = \"dia"),
    ],
)  # fmt: skip
def test_drafts_for_measured_records(
    tmp_path: Path, name: str, entries: list[str], never: str
) -> None:
    path = tmp_path / Path(name).name
    path.symlink_to(DATA / name)
    text = "\n".join(initialised(path))
    for entry in entries:
        assert entry in text
    assert never not in text
