"""Photograph the page and its sliders: `python notebooks/make_pictures.py`.

A browser is needed. The test is a reconstruction, simulated from published parameters, not a
measurement.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PICTURES = HERE / "pictures"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Width and height of a window of which the upper part is seen.
WINDOW = {"width": 1200, "height": 850}


def tell(name: str) -> None:
    """Say that a picture is made."""
    path = PICTURES / f"{name}.png"
    print(f"{path.relative_to(HERE.parent)}  {path.stat().st_size / 1000:.0f} kB")


def photograph_page() -> None:
    """Fit a reconstruction on the page and take pictures of it, or say why there are none."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        print(f'no picture of the page is made ({error}); pip install ".[test]"')
        return
    chromium = next((path for path in map(shutil.which, CHROMIUM) if path), None)
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    command = [sys.executable, "-m", "foamfit", "page", "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parent) as served,
        sync_playwright() as playwright,
    ):
        try:
            options = ["--no-sandbox"] if root else []
            browser = playwright.chromium.launch(executable_path=chromium, args=options)
            window = browser.new_page(viewport=WINDOW)
            assert served.stdout is not None
            window.goto(served.stdout.readline().strip())
            window.get_by_role("button", name="Try an example").click(timeout=60_000)
            window.get_by_label("s1_k0", exact=True).wait_for(timeout=60_000)
            window.get_by_role("button", name="Fit", exact=True).click(timeout=60_000)
            window.get_by_role("button", name="Back to the fit").wait_for(timeout=120_000)
            window.evaluate("scrollTo(0, 0)")
            window.wait_for_timeout(1000)  # the curves of the fit are drawn
            window.screenshot(path=PICTURES / "page.png")
            tell("page")
            curves = window.locator("section").filter(has=window.locator("#h-curves"))
            curves.screenshot(path=PICTURES / "turn_the_parameters.png")
            tell("turn_the_parameters")
        except Error as error:
            print(f"no picture of the page is made: {error.message.splitlines()[0]}")
        finally:
            served.terminate()


if __name__ == "__main__":
    photograph_page()
