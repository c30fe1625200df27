"""What the page shows before a specimen is known: columns, curves, and remedies as buttons."""

import pytest

from foamfit.errors import InputError
from foamfit.page.desk import preview, remedies, with_column

ROWS = "\n".join(f"{0.01 * k},{k},{0.02 * k}" for k in range(60))


def write(tmp_path, head):
    path = tmp_path / "raw.csv"
    path.write_text(f"{head}\n{ROWS}\n", encoding="utf-8")
    return path


def test_a_file_is_drawn_without_its_specimen(tmp_path):
    found = preview(write(tmp_path, "time (s),force (N),displacement (mm)"), "")
    assert found.headers == ("time (s)", "force (N)", "displacement (mm)")
    assert found.picture.startswith(b"\x89PNG")


def test_a_file_with_unclear_columns_has_its_headers_and_is_drawn_with_them(tmp_path):
    path = write(tmp_path, "when,Load (kN),Crosshead")
    found = preview(path, "")
    assert found.headers == ("when", "Load (kN)", "Crosshead")
    assert found.picture is None
    assert "Use Crosshead in mm as displacement" in remedies(found.why)
    rest = with_column("", "displacement", {"column": "Crosshead", "unit": "mm"})
    rest = with_column(rest, "time", {"column": "when", "unit": "s"})
    assert preview(path, rest).picture is not None


def test_what_is_no_table_shows_nothing(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("hello\n", encoding="utf-8")
    assert preview(path, "") == preview(tmp_path / "missing.csv", "") == ((), None, "")


def test_the_entries_that_a_message_proposes_are_remedies():
    message = (
        "column 'Load' has no unit; write it in the header like 'force (kN)' or in [columns] like "
        'force = { column = "Load", unit = "kN" } or displacement = { column = "…", unit = "mm" }'
    )
    entry = {"column": "Load", "unit": "kN"}
    assert remedies(message) == {"Use Load in kN as force": ("force", entry)}


def test_an_entry_is_replaced_and_removed_and_the_rest_stays():
    rest = 'name = "a"\n[columns]\nforce = { column = "F" }\n'
    new = with_column(rest, "force", {"column": 2, "unit": "kN"})
    assert 'name = "a"' in new
    assert '"F"' not in new
    assert "columns" not in with_column(new, "force", {})
    with pytest.raises(InputError, match="not valid TOML"):
        with_column("[columns", "force", {"column": "F"})


def test_a_fit_offers_its_card_and_the_plan_of_the_next_test(tmp_path):
    import io
    import zipfile

    import foamfit as ff
    from conftest import RECONSTRUCTION
    from foamfit.page.desk import Desk

    class Fitted(Desk):
        fits = {0: tmp_path / "fit"}  # noqa: RUF012

    desk = Fitted(tmp_path / "window")
    test = ff.read_test(RECONSTRUCTION)
    ff.fit(test, starts=2, intervals="local").save(tmp_path / "fit", report=False)
    names = zipfile.ZipFile(io.BytesIO(desk.card(0))).namelist()
    assert {"foam.k", "foam.k.json"} <= set(names)
    assert b"which test next?" in desk.planned(0)
    desk.close()
