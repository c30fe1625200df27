"""The two inputs that the page's library has not: files that are dropped, and rows of sliders.

Both are plain inputs of the browser, with labels and keys; what they do stands in `templates`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import param
from panel.custom import JSComponent

TEMPLATES = Path(__file__).with_name("templates")
INPUTS = """
  .error { color: #85280a; }
  :host { display: block; width: 100%; font-size: .92rem; color: #1d2327; }
  input:focus-visible { outline: 3px solid #0072B2; outline-offset: 2px; }
  input[type=number] { font: inherit; padding: .15rem .3rem; border: 1px solid #6f7a81;
    border-radius: .25rem; min-width: 0; width: 100%; }
"""
ZONE = """
  .zone { border: 2px dashed #6f7a81; border-radius: .4rem; padding: .7rem;
    display: grid; gap: .4rem; }
  .zone.over { background: #e4f1f9; border-color: #0072B2; }
  .zone input { font: inherit; color: transparent; width: 8.5rem; }
  .zone p { margin: 0; overflow-wrap: anywhere; } .zone p:empty { display: none; }
"""
ROWS = """
  .told { margin: 0 0 .5rem; min-height: 1.5em; }
  .list { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr));
    gap: .25rem 1.6rem; }
  .row { display: grid; grid-template-columns: 7.9rem minmax(4rem, 1fr) 6rem 2.6rem; gap: .5rem;
    align-items: center; }
  .ticks .row { grid-template-columns: 7.9rem minmax(3rem, 1fr) 5.2rem 2.3rem auto;
    gap: .3rem; }
  .held { display: none; gap: .2rem; align-items: center; font-size: .8rem; }
  .ticks .row .held { display: flex; font-family: inherit; font-size: .82rem; }
  .held input { width: 1.1rem; height: 1.1rem; margin: 0; accent-color: #005a8f; }
  .row label { font-family: ui-monospace, Menlo, Consolas, monospace; font-size: .86rem; }
  .row input[type=range] { min-width: 0; width: 100%; min-height: 1.6rem;
    accent-color: #0072B2; }
  @media (max-width: 30rem) {
    .row { grid-template-columns: minmax(7.9rem, 1fr) 5.2rem 2.6rem; }
    .ticks .row { grid-template-columns: minmax(7.9rem, 1fr) 5.2rem 2.3rem auto; }
    .row input[type=range] { grid-column: 1 / -1; grid-row: 2; } }
"""


class Upload(JSComponent):
    """A place to drop files on; what the server says of each is shown beneath."""

    address = param.String()
    limit = param.Integer()

    _esm = TEMPLATES / "upload.js"
    _stylesheets: ClassVar[list[str]] = [INPUTS, ZONE]


class Sliders(JSComponent):
    """A slider and a number for each parameter; a message names those moved or ticked."""

    rows = param.List()
    ticks = param.Boolean(doc="Whether each has a tick for a fit to hold it.")
    told = param.String()
    wrong = param.Boolean()

    _esm = TEMPLATES / "sliders.js"
    _stylesheets: ClassVar[list[str]] = [INPUTS, ROWS]

    def show(self, values: Mapping[str, float]) -> None:
        """Put the sliders elsewhere, in the units of their rows; nothing is drawn by that."""
        self._send_msg({"values": dict(values)})

    def tell(self, sentence: str, wrong: bool = False) -> None:
        """Write a sentence above the sliders."""
        self.param.update(told=sentence, wrong=wrong)

    def drawn(self) -> None:
        """Say that the last move is drawn, and the next may come."""
        self._send_msg({"drawn": True})


def message(event: Any) -> dict[str, Any]:
    """Return what a browser has sent, which may be anything, as a dictionary."""
    return event.data if isinstance(event.data, dict) else {}
