"""The page in a real browser: clicking, dropping files and moving sliders."""

import json
import os
import re
import shutil
import tomllib
import zipfile
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import foamfit as ff
from conftest import EXPERIMENTS, needs_panel
from cycled import write_record
from serving import served

api = pytest.importorskip(
    "playwright.sync_api", reason='no browser is driven without: pip install "foamfit[test]"'
)
pytestmark = needs_panel
__all__ = ["served"]

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
TEST = EXPERIMENTS / "foam-1" / "model-2-2.0mps-reconstruction.csv"
HEAD = "time (ms),force (N),displacement (mm)"
SOON, LATER = 40_000, 120_000  # ms

# Return the first slider.
SLIDER = """() => {
  const inputs = (at) => [...at.querySelectorAll('*')].flatMap((e) => [
    ...(e.matches('input[type=range]') ? [e] : []), ...(e.shadowRoot ? inputs(e.shadowRoot) : []),
  ]);
  return inputs(document)[0];
}"""
# Move the first slider by several steps at once, and count in `drawn` how often the curve changes.
MOVE = f"""(steps) => {{
  const source = [...Bokeh.documents[0]._all_models.values()].find((m) => m.data?.stress_time_y);
  const slider = ({SLIDER})();
  if (window.drawn === undefined)
    source.properties.data.change.connect(() => {{ window.drawn += 1; }});
  window.drawn = 0;
  for (const step of steps) {{
    slider.value = step;
    slider.dispatchEvent(new Event('input'));
  }}
}}"""
# Store in `seen` whether the sliders ever took no input.
WATCH = f"""() => {{
  window.seen = false;
  setInterval(() => {{ window.seen ||= ({SLIDER})()?.closest('.list').inert; }}, 2);
}}"""
# Send the events of dropping external files to an element.
DROP = """(beneath, files) => {
  const carried = new DataTransfer();
  for (const [name, text] of files)
    carried.items.add(new File([Uint8Array.from(text, (c) => c.charCodeAt(0))], name));
  const place = beneath.getBoundingClientRect();
  return ['dragenter', 'dragover', 'drop'].map((kind) => {
    const event = new DragEvent(kind, {
      dataTransfer: carried, bubbles: true, cancelable: true, composed: true,
      clientX: place.x + 5, clientY: place.y + 5,
    });
    beneath.dispatchEvent(event);
    return event.defaultPrevented;
  });
}"""
FOCUSED = """() => {
  let at = document.activeElement;
  while (at.shadowRoot?.activeElement) at = at.shadowRoot.activeElement;
  return at.labels?.[0]?.textContent || at.ariaLabel || at.textContent;
}"""
CURVE = """() => Array.from([...Bokeh.documents[0]._all_models.values()]
  .find((m) => m.data?.stress_time_y).data.stress_time_y).join()"""


def rows(change=lambda i, row: row):
    """Return a valid table except for the changes that `change` makes."""
    return "\n".join([HEAD, *(change(i, f"{i},{0.1 * i},{0.01 * i}") for i in range(40))])


# Text of each invalid file, and words of the error message.
BAD = {
    "word.csv": (rows(lambda i, r: "9,oops,1" if i == 9 else r), "row 11"),
    "no-unit.csv": (rows().replace("force (N)", "force"), "'force'"),
    "picture.png": ("\x89PNG", "picture.png is not a table"),
}


@pytest.fixture(scope="module")
def playwright():
    with api.sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def chromium(playwright):
    """Start a Chromium that is installed, or else the one of Playwright."""
    found = next((path for path in map(shutil.which, CHROMIUM) if path), None)
    if found is None and not Path(playwright.chromium.executable_path).exists():
        pytest.skip(f"no Chromium is here: neither {', '.join(CHROMIUM)} nor Playwright's own")
    options = [] if not hasattr(os, "geteuid") or os.geteuid() else ["--no-sandbox"]
    browser = playwright.chromium.launch(executable_path=found, args=options)
    yield browser
    browser.close()


@contextmanager
def opened(browser, served):
    """Open a window and check at the end that its console shows no errors."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    page, wrong, hosts = context.new_page(), [], set()
    page.set_default_timeout(SOON)
    api.expect.set_options(timeout=SOON)  # the default of 5 s is too short
    page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "request",
        lambda request: hosts.update(re.findall(r"^(?:http|ws)s?://([^/]*)", request.url)),
    )
    page.goto(served.address)
    page.get_by_text("Drop a CSV").wait_for()
    yield page
    assert wrong == []
    assert hosts == {f"127.0.0.1:{served.port}"}
    context.close()


@pytest.fixture(scope="module")
def window(chromium, served):
    with opened(chromium, served) as page:
        yield page


def drop(page, *files):
    """Drop files as a file manager would."""
    given = [[name, text.encode().decode("latin-1")] for name, text in files]
    field, beside = page.get_by_text("Drag & Drop"), page.get_by_role("heading", name="Curves")
    assert beside.evaluate(DROP, given)[1:] == [True, True]  # else the browser opens the file
    field.evaluate(DROP, given)


def choose(page, *files):
    """Select files as with the browser's file dialog."""
    given = [
        {"name": name, "mimeType": "text/csv", "buffer": text.encode("latin-1")}
        for name, text in files
    ]
    page.locator("input[type=file]").set_input_files(given)


def press(button):
    """Scroll, wait and click; an immediate click would hit the report that was there before."""
    button.scroll_into_view_if_needed()
    button.page.wait_for_timeout(300)
    button.click()


def load(page):
    toml = TEST.with_suffix(".toml").read_text()
    choose(page, (TEST.name, TEST.read_text()), ("any.toml", toml))
    # An earlier test stays on the page until the files have arrived.
    page.get_by_text(tomllib.loads(toml)["name"]).first.wait_for(state="attached")
    page.get_by_label("s1_k0", exact=True).wait_for()
    api.expect(page.get_by_role("button", name="Fit", exact=True)).to_be_enabled()
    api.expect(page.get_by_text("Preparing the curves")).to_have_count(0)


def test_load_drop_fit_stop_turn_and_save(window, tmp_path):
    page = window
    # Errors in a file are shown immediately.
    for name, (text, told) in BAD.items():
        drop(page, (name, text), ("t.toml", TEST.with_suffix(".toml").read_text()))
        api.expect(page.get_by_text(told, exact=False).first).to_be_visible()
        api.expect(page.get_by_role("button", name="Fit", exact=True)).to_be_disabled()
        api.expect(page.get_by_text("Save the result folder")).to_be_hidden()
    # Markup in a name is shown as plain text.
    name = "<img src=x onerror=document.title='hit'>"
    toml = TEST.with_suffix(".toml").read_text()
    toml = re.sub(r'name = ".*"', f"name = {json.dumps(name)}", toml)
    drop(page, (TEST.name, TEST.read_text()), ("t.toml", toml))
    page.get_by_text("What is understood").click()
    api.expect(page.get_by_text(name).first).to_be_visible()
    assert page.title() == "foamfit"
    page.get_by_text("What is understood").click()  # folds the section again
    # With a valid test, a quantity of the wrong dimension is marked.
    load(page)
    height = page.get_by_label("Specimen height")
    api.expect(height).to_have_value("1.19 mm")
    height.fill("5 kg")
    height.press("Tab")
    api.expect(page.get_by_text("has the wrong dimension").first).to_be_visible()
    api.expect(page.get_by_label("s1_k0", exact=True)).to_have_count(0)
    height.fill("1.19 mm")
    height.press("Tab")
    page.get_by_label("s1_k0", exact=True).wait_for()
    # A slider works with the keyboard alone, and the curve follows.
    slider, before = page.get_by_label("s1_k0", exact=True), page.evaluate(CURVE)
    slider.focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    page.wait_for_function(f"({CURVE})() !== '{before}'")
    page.get_by_label("s1_eps_c as a number").fill("0.01")
    page.get_by_label("s1_eps_c as a number").press("Enter")
    api.expect(page.get_by_text("is not admissible").first).to_be_visible()
    # A stopped fit keeps the best point.
    page.get_by_text("More options").click()
    page.get_by_label("Starts:").fill("100000")
    page.get_by_role("button", name="Fit", exact=True).click()
    api.expect(page.get_by_text("best misfit").first).to_be_visible(timeout=LATER)
    api.expect(height).to_be_disabled()
    choose(page, ("other.csv", rows()))  # is refused until the fit has ended
    refused = page.get_by_text("A fit is running; stop it")
    api.expect(refused).to_be_visible()
    page.get_by_role("button", name="Stop").click()
    report = page.frame_locator("iframe")
    api.expect(report.get_by_text("stopped by Ctrl-C").first).to_be_visible(timeout=LATER)
    api.expect(refused).to_have_count(0)
    # A complete fit with a fixed parameter.
    page.get_by_label("s1_eta as a number").fill("3")
    page.get_by_label("s1_eta fixed in the fit").check()
    page.get_by_label("Starts:").fill("2")
    page.get_by_role("button", name="Fit", exact=True).click()
    api.expect(page.get_by_text("A fit is running.")).to_be_visible()
    api.expect(report.get_by_text("s1_kc").first).to_be_visible(timeout=LATER)
    # The saved archive contains the files that the command writes.
    with page.expect_download() as saved:
        press(page.get_by_text("Save the result folder"))
    archive = zipfile.ZipFile(saved.value.path())
    assert {"fit.json", "report.html", "fit.png", "curves.csv", "test.toml"} <= {
        *archive.namelist()
    }
    fit = json.loads(archive.read("fit.json"))
    k0 = float(page.get_by_label("s1_k0 as a number").input_value())
    assert k0 == pytest.approx(fit["parameters"]["s1_k0"]["value"] / 1e6, rel=1e-4)
    assert (fit["parameters"]["s1_eta"]["value"], fit["parameters"]["s1_eta"]["vary"]) == (3, False)
    archive.close()


def test_several_cycles_are_turned(window, tmp_path):
    record, page = write_record(tmp_path), window
    toml = record.with_suffix(".toml")
    choose(page, (record.name, record.read_text()), ("any.toml", toml.read_text()))
    page.get_by_label("Cycles (FIRST-LAST)").fill("1-3")
    page.get_by_label("Cycles (FIRST-LAST)").press("Tab")
    api.expect(page.get_by_text("cycles 1 to 3: misfit")).to_be_visible()
    page.get_by_label("Model:").select_option("microscale")
    more = page.get_by_text("More options")
    if not page.get_by_label("Mullins:").is_visible():
        more.click()
    for option in ("Stiffening:", "Mullins:"):
        page.get_by_label(option).check()
    for name in ("stiffening", "softening", "weakening"):
        page.get_by_label(f"s1_{name}", exact=True).wait_for()
    api.expect(page.get_by_text("cycles 1 to 3: misfit")).to_be_visible()
    for option in ("Stiffening:", "Mullins:"):
        page.get_by_label(option).uncheck()
    page.get_by_label("Model:").select_option("bistable")
    more.click()


def test_another_file_keeps_nothing_of_the_one_before(window):
    """The specimen comes from the new file's TOML or must be entered by the user."""
    page = window
    height, rest = page.get_by_label("Specimen height"), page.get_by_label("Further TOML")
    load(page)
    api.expect(height).to_have_value("1.19 mm")
    choose(page, ("other.csv", TEST.read_text()))
    api.expect(height).to_have_value("")
    api.expect(rest).to_have_value("")
    api.expect(page.get_by_text("height", exact=False).first).to_be_visible()
    api.expect(page.get_by_role("button", name="Fit", exact=True)).to_be_disabled()


def test_two_windows_do_not_mix(window, served):
    other = window.context.new_page()
    other.goto(served.address)
    load(window)
    other.get_by_text("Drop a CSV").wait_for()
    for page in (window, other):
        page.get_by_text("What is understood").click()  # unfolds the section
    api.expect(other.get_by_text("There is no test yet.")).to_be_visible()
    api.expect(other.get_by_label("Specimen height")).to_have_value("")
    other.get_by_role("button", name="Try an example").click()
    api.expect(other.get_by_text("VACNT foam-1/model-1").first).to_be_visible()
    api.expect(window.get_by_text("VACNT foam-1/model-2").first).to_be_visible()
    api.expect(window.get_by_text("VACNT foam-1/model-1")).to_have_count(0)
    # Closing a window while it waits for curves causes no traceback; `served` checks this.
    other.get_by_label("s1_k0", exact=True).focus()
    for _ in range(8):
        other.keyboard.press("ArrowRight")
    other.close()  # windows in the background are drawn only once per second


def test_everyone_can_use_it_at_once(window):
    """Check for accessibility, no cut-off content and keyboard access."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is missing")
    load(window)
    for width, colours in product((390, 1280), ("dark", "light")):  # widths of a phone and a laptop
        window.emulate_media(color_scheme=colours)
        window.set_viewport_size({"width": width, "height": 900})
        window.wait_for_function(f"document.documentElement.scrollWidth <= {width}")
        found = axe.Axe().run(window).response
        serious = [v["id"] for v in found["violations"] if v["impact"] in ("serious", "critical")]
        assert serious == []
        assert {"label", "color-contrast", "button-name"} <= {one["id"] for one in found["passes"]}
    reached = set()
    wanted = {"Specimen height", "Check the test", "Fit", "s1_k0", "s1_eta"}
    for press in range(300):
        if press % 75 == 0:  # from the first field again: sliders that are made anew lose the focus
            window.locator("input[type=file]").focus()
        window.keyboard.press("Tab")
        reached.add(window.evaluate(FOCUSED))
        if wanted <= reached:
            break
    assert wanted <= reached


def test_quick_moves_of_a_slider_are_drawn_by_the_last(chromium, served):
    # In a new window: without the quantities of an earlier test there are no sliders until both
    # files are read, so none is replaced after the first move.
    with opened(chromium, served) as window:
        load(window)

        def move(*steps, until):
            window.evaluate(MOVE, steps)
            window.wait_for_function(f"({CURVE})() {until}")

        def settled():  # curves of a file may still arrive after its sliders
            before, now = None, window.evaluate(CURVE)
            while now != before:
                window.wait_for_timeout(1000)
                before, now = now, window.evaluate(CURVE)
            return now

        move(350, until=f"!== '{settled()}'")
        wanted = settled()
        move(150, until=f"!== '{wanted}'")
        move(*range(151, 351), until=f"=== '{wanted}'")
        assert window.evaluate("window.drawn") <= 4  # of 200 moves


def test_sliders_about_to_be_replaced_cannot_be_moved(window):
    load(window)
    window.evaluate(WATCH)
    window.get_by_label("Model:").select_option("bistable+bistable")
    window.get_by_label("s2_k0", exact=True).wait_for()
    window.wait_for_function(f"({SLIDER})()?.closest('.list').inert === false")
    assert window.evaluate("window.seen")


def test_a_raw_file_is_drawn_and_offers_its_columns(chromium, served, tmp_path):
    """A rheometer's export on a phone: no TOML, and a gap without a unit that counts down."""
    loop = np.sin(np.linspace(0.0, np.pi, 200))
    rows = [f"{0.005 * i:.3f},{2 * y:.4f},{10 - 4 * y:.5f}" for i, y in enumerate(loop)]
    raw = tmp_path / "raw.csv"
    raw.write_text("\n".join(["time (s),Normal force (N),Gap", *rows]), encoding="utf-8")
    with opened(chromium, served) as page:
        page.set_viewport_size({"width": 390, "height": 800})
        page.locator("input[type=file]").set_input_files(raw)
        api.expect(page.get_by_text("fill in the specimen height")).to_be_visible()
        api.expect(page.locator("p[role=alert]")).to_have_count(0)
        page.get_by_role("button", name="Use Gap in mm as displacement").click()
        page.get_by_alt_text("Force of the file").wait_for()
        for label, value in (("Specimen height", "10 mm"), ("Specimen diameter", "8 mm")):
            page.get_by_label(label).fill(value)
            page.keyboard.press("Tab")
        page.get_by_label("s1_k0", exact=True).wait_for()
        api.expect(page.locator("p[role=alert]")).to_have_count(0)
        page.get_by_text("What is understood").click()
        api.expect(page.get_by_text("counts down in compression").first).to_be_visible()
        for width in (390, 1280):
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_function(f"document.documentElement.scrollWidth <= {width}")


def test_ticked_tests_of_a_joint_report_are_compared(chromium, tmp_path):
    """Its table of tests is not the first of the report."""
    for stiff, name in enumerate("ab", start=1):
        table = "\n".join([HEAD, *(f"{i},{stiff * i},{0.1 * i}" for i in range(30))])
        (tmp_path / f"{name}.csv").write_text(table)
        (tmp_path / f"{name}.toml").write_text('specimen = {height = "10 mm", diameter = "8 mm"}')
    study = tmp_path / "two.toml"
    study.write_text('tests = ["*.csv"]\nmodel = "linear"\ndrive = "displacement"\n')
    ff.joint(study).save(tmp_path / "joint")
    page = chromium.new_page()
    page.goto((tmp_path / "joint" / "joint.html").as_uri())
    for box in page.locator("input[type=checkbox]").all():
        box.check()
    line = f'foamfit compare "{tmp_path}/joint/a" "{tmp_path}/joint/b"'
    api.expect(page.locator("#line")).to_have_text(line)


def test_the_page_says_that_its_program_has_ended(chromium, served):
    """The last test of this file, as it ends the program."""
    with opened(chromium, served) as page:
        api.expect(page.get_by_text("has ended")).to_be_hidden()
        page.wait_for_function("Bokeh.documents[0].is_idle")
        served.process.terminate()
        served.process.wait(timeout=120)
        api.expect(page.get_by_text("has ended")).to_be_visible()
