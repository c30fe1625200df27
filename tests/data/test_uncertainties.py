"""Standard deviations in the TOML: how they are written, stored, shown and rejected."""

import math

import numpy as np
import pytest

from conftest import refused, write_csv
from foamfit.data.csv_file import read_test
from foamfit.data.energy import audit
from foamfit.errors import InputError
from foamfit.report.summary import describe

LOOP = np.sin(np.linspace(0.0, np.pi, 41))
TIME = np.arange(41) * 1e-3


def written(folder, toml, **columns):
    """Write a test with these columns, by default time, stress and displacement of a loop."""
    given = columns or {
        "time (s)": TIME, "stress (MPa)": 2.0 * LOOP, "displacement (mm)": 4.0 * LOOP,
    }  # fmt: skip
    return write_csv(folder / "test.csv", ",".join(given), *given.values(), toml=toml)


def specimen(height='"10 mm"', area='area = "100 mm^2"'):
    return f"[specimen]\nheight = {height}\n{area}\n"


@pytest.mark.parametrize(
    ("text", "sigma"),
    [
        ("10 ± 0.05 mm", 5e-5),
        ("10 mm ± 0.05 mm", 5e-5),
        ("10 mm ± 50 um", 5e-5),
        ("10 mm +/- 50 um", 5e-5),
        ("1 cm ± 5e-2 mm", 5e-5),
        ("10.0±.05 mm", 5e-5),
        ("(10 ± 0.05) mm", 5e-5),
        ("10 mm ± 0.5 %", 5e-5),
        ("10 mm ± 0.5%", 5e-5),
    ],
)
def test_ways_to_write_a_standard_deviation(tmp_path, text, sigma):
    test = read_test(written(tmp_path, specimen(f'"{text}"')))
    assert test.specimen.height == pytest.approx(0.01)
    assert test.uncertainties == {"height": pytest.approx(sigma)}


EVERYTHING = """
[specimen]
height = "10 mm ± 50 um"
diameter = "5 ± 0.02 mm"
mass = "60 mg ± 1 mg"
heights = ["6 ± 0.1 mm", "4 mm"]
[striker]
mass = "7 g +/- 0.02 g"
velocity = "1.75 ± 0.01 m/s"
[columns]
force = { column = "Load", unit = "V", scale = "-10 ± 0.05 N/V" }
displacement = { column = "x", unit = "mm", scale = "1.00 ± 0.01" }
"""


def test_every_quantity_keeps_its_own_and_check_shows_it(tmp_path):
    columns = {"time (s)": TIME, "Load": -2.0 * LOOP, "x": 4.0 * LOOP}
    path = written(tmp_path, EVERYTHING, **columns)
    test = read_test(path)
    area = math.pi / 4 * 0.005**2
    assert test.specimen.area == pytest.approx(area)
    assert test.specimen.heights == pytest.approx((6e-3, 4e-3))
    assert test.stress.max() == pytest.approx(20.0 / area)
    assert test.uncertainties == pytest.approx(
        {
            "height": 5e-5, "height_1": 1e-4, "area": 2 * 0.02 / 5 * area, "specimen_mass": 1e-6,
            "striker_mass": 2e-5, "velocity": 0.01, "stress_scale": 0.005,
            "displacement_scale": 0.01,
        }
    )  # fmt: skip
    told = " ".join(describe(test, audit(test)).split())
    for part in (
        "height 10.000 ± 0.050 mm, area 19.63 ± 0.16 mm², mass 60.0 ± 1.0 mg",
        "springs from the base 6.00 ± 0.10 mm + 4 mm",
        "7.000 ± 0.020 g, 1.75 ± 0.01 m/s",
        "force from 'Load' in V times -10 N/V ± 0.5 %",
        "displacement from 'x' in mm times 1 ± 1 %",
    ):
        assert part in told


BAD = [
    ("10 ± -1 mm", "must not be negative"),
    ("10 ± 10 mm", "must be less than the value"),
    ("10 mm ± 1e999 mm", "must be between 1e-30 and 1e+30"),
    ("0 ± 1 mm", "must be less than the value"),
    ("10 mm ± 1 kg", "the ± has the wrong dimension"),
    ("10 mm ± 1 furlings", "the ± has an unknown unit"),
    ("10 mm ± small", "the ± is not a quantity"),
    ("10 mm ±", "the ± is not a quantity"),
    ("10 mm ± 0,1 mm", "decimal point"),
    ("± 1 mm", "is not a quantity"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_a_wrong_standard_deviation_is_refused(tmp_path, text, words):
    path = written(tmp_path, specimen(f'"{text}"'))
    told = refused(path, text, words)
    assert told.startswith(f"{path.with_suffix('.toml')}: [specimen] height = ")
    assert told.count(". ") == 0  # a single sentence


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ('[noise]\nstress = "20 ± 1 kPa"\n', "[noise] stress"),
        ('[window]\nstart = "1 ± 0.1 ms"\n', "[window] start"),
        ('[columns]\ntime = { column = 1, scale = "1 ± 0.01" }\n', "[columns] time: scale"),
    ],
)
def test_where_none_has_a_meaning_it_is_refused(tmp_path, toml, words):
    path = written(tmp_path, specimen() + toml)
    refused(path, words, "has a ±, which has no meaning here")


@pytest.mark.parametrize("scale", ["2 ± 2 N/V", "2 N/V ± 1 N", "2 ± x N/V", "2 ± -0.1 N/V"])
def test_a_wrong_scale_is_refused(tmp_path, scale):
    columns = {"time (s)": TIME, "Load": LOOP, "displacement (mm)": 4.0 * LOOP}
    entry = f'[columns]\nforce = {{ column = "Load", unit = "V", scale = "{scale}" }}\n'
    with pytest.raises(InputError, match=r"\[columns\] force: scale = .*: the ± "):
        read_test(written(tmp_path, specimen() + entry, **columns))
