"""How much time do unknown contact, zeros and motion noise cost in a fit?

Method. Each synthetic record (`experiments/recovery/rig.py`) is fitted twice, alternately: with
these unknowns, and with them taken as exact (contact time and zeros fixed; the motion as sampled).
The ratio of the times is the cost of the unknowns. The results of the second fit are wrong: only
its time is used.

Answer. The fit with unknowns takes 0.28 to 1.7 times as long: see unknowns.md.

    python experiments/error_vs_runtime/unknowns.py        # prints and writes unknowns.md
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "recovery"), str(HERE.parent)]

import rig  # noqa: E402

import foamfit as ff  # noqa: E402
import studies  # noqa: E402
from foamfit.data import motion  # noqa: E402
from foamfit.fitting import objective  # noqa: E402
from foamfit.fitting.problem import make_params  # noqa: E402
from foamfit.springs.parameters import NUISANCE  # noqa: E402

SEEDS = range(1, 9)
HEAD = """\
# Cost of unknown contact, zeros and motion noise

**Question.** How much time do unknown contact, zeros and motion noise cost in a fit?
**Method.** `python experiments/error_vs_runtime/unknowns.py` fits each synthetic record with these
unknowns, and with them taken as exact. **Answer.** The ratio of the times, in the last column."""
RECORDS: dict[str, rig.Impact | rig.Slow] = {
    "impact that begins at the contact": rig.Impact(samples=500, trimmed=True),
    "impact from before the contact, any zero": rig.Impact(samples=500),
    "slow test, microscale, exact motion": rig.Slow(rows=1000, exact=True),
    "slow test, microscale, 0.3 % noise": rig.Slow(rows=1000),
    "slow test, microscale with relaxation, 0.3 % noise": rig.Slow(relaxation=1, rows=1000),
}


def timed(fit: Callable[[], Any]) -> float:
    """Return the processor time (s) of a fit, including the smoothing of the motion."""
    motion._found.cache_clear()
    began = time.process_time()
    fit()
    return time.process_time() - began


def pair(setup: rig.Impact | rig.Slow, seed: int) -> tuple[float, float]:
    """Return the times of the fit of one record and of the fit that takes it as exact."""
    slow = isinstance(setup, rig.Slow)
    record = rig.slow(setup, seed) if slow else rig.impact(setup, seed)
    with tempfile.TemporaryDirectory() as folder:
        test = ff.read_test(rig.write(record, Path(folder)))
    drive = "displacement" if slow else "impact"
    held = make_params(test, record.model, drive, relaxation=setup.relaxation)
    for name in NUISANCE:
        if name in held:
            held[name].set(vary=False)
    keywords: dict[str, Any] = {"model": record.model, "relaxation": setup.relaxation}
    keywords["drive"] = drive
    ff.fit(test, starts=1, **keywords)  # compiles
    own = timed(lambda: ff.fit(test, **keywords))
    with patch.object(objective, "driving_motion", lambda *_, **__: None):  # motion as sampled
        return own, timed(lambda: ff.fit(test, params=held, **keywords))


def main() -> None:
    studies.arguments(__doc__).parse_args()
    rows = []
    for name, setup in RECORDS.items():
        times = [pair(setup, seed) for seed in SEEDS]
        own, exact = (statistics.median(column) for column in zip(*times, strict=True))
        ratio = statistics.median(a / b for a, b in times)
        rows.append((name, f"{own:.2f} s", f"{exact:.2f} s", f"{ratio:.2f}"))
        print(rows[-1], flush=True)
        note = f"Medians of {len(SEEDS)} records, processor time, alternating fits."
    table = studies.markdown("synthetic record | fit | taken as exact | ratio", rows)
    (HERE / "unknowns.md").write_text(f"{HEAD}\n\n{table}\n\n{note}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
