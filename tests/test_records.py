"""What a record can be, and what becomes of each row of it."""

import itertools

import numpy as np
import pytest
from click.testing import CliRunner

import fabricated
from foamfit.audit import audit, describe
from foamfit.cli import main
from foamfit.errors import InputError
from foamfit.reading import read_test
from foamfit.report import render_report, summary_text

SPECIMEN = '[specimen]\nheight = "10 mm"\narea = "100 mm^2"\n'
STRIKER = '[striker]\nmass = "1 kg"\nvelocity = "1 m/s"\n'
HEADER = "time (ms),stress (MPa),displacement (mm)"


def write(folder, lines, toml=SPECIMEN):
    path = folder / "test.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    path.with_suffix(".toml").write_text(toml, encoding="utf-8")
    return path


def table(*columns, header=HEADER):
    rows = zip(*columns, strict=True)
    return [header, *(",".join(f"{value:.9g}" for value in row) for row in rows)]


def loop(n=101, top=4.0):
    """Time (ms), stress (MPa) and displacement (mm) of one loading and unloading."""
    shape = np.sin(np.linspace(0.0, np.pi, n))
    return np.arange(float(n)), 0.5 * top * shape, top * shape


def refused(path, *words):
    with pytest.raises(InputError) as caught:
        read_test(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def accounted(test):
    """Every row of the file is used or counted with its reason."""
    count = test.rows
    assert count.rows == count.used + sum(item.rows for item in count.dropped)
    for item in count.dropped:
        assert item.rows <= item.last - item.first + 1
        assert item.why
    return count


# ---------------------------------------------------------------------------------- every row


def test_all_rows_are_used_where_nothing_is_wrong(tmp_path):
    count = accounted(read_test(write(tmp_path, table(*loop()))))
    assert (count.rows, count.used, count.dropped) == (101, 101, ())


@pytest.mark.parametrize("at", [60, 800])  # within the lines that are searched for a header or not
def test_a_repeated_header_is_refused_with_both_rows(tmp_path, at):
    lines = table(*loop(1284))
    lines.insert(at, HEADER.replace(",", ", "))
    refused(write(tmp_path, lines), f"row {at + 1} repeats the header of row 1")


def test_two_tables_in_a_file_are_refused(tmp_path):
    lines = [*table(*loop()[:2], header="time (ms),stress (MPa)"), *table(*loop())]
    refused(write(tmp_path, lines), "rows 2 to 102 hold numbers above the header in row 103")


def test_duplicate_time_stamps_are_averaged_and_counted(tmp_path):
    time, stress, displacement = loop()
    for values in (time, stress, displacement):
        values[[31, 41, 42]] = values[[30, 40, 40]]
    stress[[41, 42]] += 0.001, 0.002
    lines = table(time, stress, displacement)
    test = read_test(write(tmp_path, lines))
    count = accounted(test)
    assert (count.rows, count.used) == (101, 98)
    (item,) = count.dropped
    assert (item.rows, item.first, item.last) == (3, 33, 44)
    assert "time stamp of the row before" in item.why
    assert test.time.size == 98
    assert test.stress[40 - 1] == pytest.approx(1e6 * stress[40:43].mean())
    refused(
        write(tmp_path, lines, SPECIMEN + '[data]\nduplicates = "refuse"\n'), "row 33", "repeats"
    )
    refused(write(tmp_path, lines, SPECIMEN + "[data]\nduplicates = 3\n"), "average, refuse")


def test_rows_without_a_cell_are_counted(tmp_path):
    lines = [*table(*loop()), ",,", " , , "]
    lines.insert(50, ",,")
    count = accounted(read_test(write(tmp_path, lines)))
    assert (count.rows, count.used) == (104, 101)
    assert (count.dropped[0].first, count.dropped[0].last) == (51, 105)


def test_row_numbers_are_lines_of_the_file(tmp_path):
    time, stress, displacement = loop()
    for values in (time, stress, displacement):
        values[7] = values[6]
    lines = ["A title", "", *table(time, stress, displacement)]
    lines[5:5] = ["", ""]
    (item,) = accounted(read_test(write(tmp_path, lines))).dropped
    assert lines[item.first - 1].startswith("6,")
    assert lines[item.first - 2].startswith("6,")


def triangles(tops, n=80, low=0.02):
    """Displacement (mm) of triangles to the given tops, with a rest at both ends."""
    corners = [0.0, *(level for top in tops for level in (top, low * max(tops)))]
    parts = [np.linspace(a, b, n, endpoint=False) for a, b in itertools.pairwise(corners)]
    return np.concatenate([*parts, [corners[-1]]])


def record(kind):
    """Time (ms), stress (MPa) and displacement (mm) of a record with something to leave out."""
    rng = np.random.default_rng(0)
    time, stress, displacement = loop(601)
    if kind in ("impact", "window"):
        stress = np.concatenate([np.zeros(200), stress, np.zeros(300)])
        displacement = np.concatenate([np.zeros(200), displacement, np.zeros(300)])
        stress += 0.002 * rng.standard_normal(stress.size)
    elif kind == "cycles":
        displacement = triangles([4.0, 4.0, 4.0])
        stress = 0.5 * displacement
    elif kind == "spikes":
        stress += 0.002 * rng.standard_normal(stress.size)
        stress[[150, 400]] += 1.0
        displacement[400] = 0.0
    elif kind == "many":
        time, stress, displacement = loop(20_000)
        stress[5000:5400] += 0.0
        stress[7000] = 9.0
    time = np.arange(float(stress.size))
    return table(time, stress, displacement)


@pytest.mark.parametrize(
    ("kind", "toml", "why"),
    [
        ("impact", STRIKER, {"before contact starts", "after contact ends"}),
        ("window", '[window]\nend = "0.9 s"\n', {"outside [window] start and end"}),
        ("cycles", "[window]\ncycle = 2\n", {"before cycle 2", "after cycle 2"}),
        ("spikes", "", {"a spike or gap of the stress, bridged by a straight line"}),
        ("many", "", {"a spike or gap of the stress, bridged by a straight line"}),
    ],
)
def test_every_row_that_is_not_used_has_its_reason(tmp_path, kind, toml, why):
    lines = record(kind)
    test = read_test(write(tmp_path, lines, SPECIMEN + toml))
    count = accounted(test)
    assert count.rows == len(lines) - 1
    assert why <= {item.why for item in count.dropped}
    if kind != "many":  # these are averaged in blocks
        left_out = np.any([found.left_out for found in test.outliers.values()], axis=0)
        assert count.used == test.stress.size - np.count_nonzero(left_out)
    told = describe(test, audit(test))
    assert f"{count.rows} in the file, {count.used} used" in told
    assert all(f"Not used: {str(item)[:20]}" in told for item in count.dropped)


def test_the_rows_stand_in_the_terminal_and_in_the_result(tmp_path):
    time, stress, displacement = loop()
    for values in (time, stress, displacement):
        values[7] = values[6]
    path = write(tmp_path, table(time, stress, displacement))
    assert "101 in the file, 100 used." in CliRunner().invoke(main, ["check", str(path)]).stdout
    result = fabricated.result(measurement=read_test(path))
    told = summary_text(result)
    assert "rows: 101 in the file, 100 used." in told
    assert "rows: Not used: row 9: the time stamp of the row before" in told
    assert "data: Check: 1 of 101 rows" in told
    data = result.to_json_dict()["data"]
    assert (data["rows"], data["used"]) == (101, 100)
    (item,) = data["dropped"]
    assert item == {"rows": 1, "first": 9, "last": 9, "why": item["why"]}
    assert "101 in the file" in render_report(result, fit_png=b"\x89PNG" + bytes(20))


def test_a_test_that_is_not_read_from_a_file_uses_all_samples():
    data = fabricated.result().to_json_dict()["data"]
    assert (data["rows"], data["used"], data["dropped"]) == (601, 601, [])
