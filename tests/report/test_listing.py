"""The list of results: a line each, one page, and the refusals."""

import json
import re

import pytest

from conftest import ROOT, run, run_refused
from foamfit.errors import InputError
from foamfit.report.listing import results_in, write_index

FITS = ROOT / "fits"


@pytest.fixture
def folder(tmp_path):
    """A folder with two results, one with its curves, and a damaged one."""
    for name in ("model-1/impact", "model-3/stress"):
        place = tmp_path / "runs" / name
        place.mkdir(parents=True)
        place.joinpath("fit.json").write_bytes((FITS / "foam-1" / name / "fit.json").read_bytes())
    head = "measured stress (Pa),measured displacement (m),stress along measured displacement (Pa)"
    rows = "\n".join(f"{k * 1e3},{k * 1e-6},{k * 1.1e3}" for k in range(100))
    (tmp_path / "runs/model-1/impact/curves.csv").write_text(f"{head}\n{rows}\n")
    (tmp_path / "runs/model-3/stress/curves.csv").write_text(f"{head}\n1.0,2")  # cut short
    (tmp_path / "runs/model-1/impact/report.html").write_text("report")
    (tmp_path / "runs/bad").mkdir()
    (tmp_path / "runs/bad/fit.json").write_text('{"schema": 1, "foamfit": "0"}')
    return tmp_path / "runs"


def test_every_result_is_one_line(folder):
    ran = run("list", str(folder))
    head, *lines = ran.output.split("\n\n")[0].splitlines()
    columns = ["test", "model", "status", "options", "misfit", "determined", "when", "folder"]
    assert head.split() == columns
    assert sorted(line.split()[-1] for line in lines) == ["bad", "model-1/impact", "model-3/stress"]
    assert len(lines) == 3
    content = json.loads((folder / "model-1/impact/fit.json").read_text(encoding="utf-8"))
    line = next(line for line in lines if "model-1" in line)
    own = [
        p for n, p in content["parameters"].items() if n.startswith(("s1_", "site_")) and p["vary"]
    ]
    number = sum(p["state"] == "determined" for p in own)
    assert re.search(rf"bistable\s+ok\s.*{number} of {len(own)}\s", line)
    assert "damaged" in next(line for line in lines if line.startswith("bad"))
    (folder / "bad/fit.json").write_text(json.dumps(content | {"misfit": 3}))
    assert "fit.json is damaged" in run("list", str(folder)).output


def test_the_page_links_to_the_reports_and_draws_the_loops(folder):
    page = write_index(folder, results_in(folder)).read_text(encoding="utf-8")
    assert '<a href="model-1/impact/report.html">' in page
    assert page.count("<polyline") == 2
    assert page.count('type="checkbox"') == 3


def test_only_results_that_compare_takes_can_be_ticked(folder):
    whole = {"schema": 1, "foamfit": "0", "name": "family", "model": "bistable", "relaxation": 0}
    whole |= {"status": "ok", "parameters": {}, "tests": {}}
    (folder / "family").mkdir()
    (folder / "family/joint.json").write_text(json.dumps(whole))
    page = write_index(folder, results_in(folder)).read_text(encoding="utf-8")
    boxes = dict(re.findall(r'type="checkbox" value="(.*?)" aria-label=".*?"( disabled)?>', page))
    assert [at for at, off in boxes.items() if not off] == ["model-1/impact", "model-3/stress"]
    assert boxes["family"]


def test_the_page_is_written_again_and_no_other_page_is_replaced(folder):
    found = results_in(folder)
    path = write_index(folder, found)
    write_index(folder, found[:1])
    assert path.read_text(encoding="utf-8").count('type="checkbox"') == 1
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="was not written by foamfit"):
        write_index(folder, found)
    assert path.read_text(encoding="utf-8") == "mine"


def test_a_result_folder_itself_stays_as_it_is(folder):
    place = folder / "model-1/impact"
    assert write_index(place, results_in(place)) is None
    assert not (place / "index.html").exists()


def test_a_folder_without_results_is_refused(tmp_path):
    for name in ("missing", "."):
        assert "foamfit fit TEST.csv writes" in run_refused("list", tmp_path / name)
