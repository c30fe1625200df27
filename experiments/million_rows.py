"""How long does the command take for a million rows, and how much memory?

Method. A synthetic impact (published foam-1/model-1 at 2 m/s, 1 % white noise) is fitted twice.

Answer. 6.2 s once compiled, 384 MiB.

    python experiments/million_rows.py            # --rows 600 for a small one
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import foamfit as ff
import studies

TOML = """\
name = "synthetic impact, {rows} rows"
[specimen]
height = "1.19 mm"
diameter = "5 mm"
[striker]
mass = "7 g"
velocity = "2 m/s"
"""


def write(folder: Path, rows: int) -> Path:
    """Write the synthetic test: published foam-1/model-1 at 2 m/s, 1 % white noise."""
    item = ff.published["foam-1/model-1"]
    chain = ff.Chain(item.chain.springs, item.chain.heights, item.chain.area)
    t = np.linspace(-0.1e-3, 0.8e-3, rows)
    response = ff.simulate(chain, ff.Impact(7e-3, 2.0), t)
    rng = np.random.default_rng(0)
    force = response.base_stress * chain.area + 1.0 * rng.standard_normal(rows)
    motion = response.displacement[-1] + 4e-6 * rng.standard_normal(rows)
    path = folder / "synthetic.csv"
    table = np.column_stack(((t - t[0]) * 1e3, force, motion * 1e3))
    header = "time (ms),force (N),displacement (mm)"
    np.savetxt(path, table, fmt="%.7f,%.4f,%.6f", header=header, comments="")
    path.with_suffix(".toml").write_text(TOML.format(rows=rows))
    return path


def main() -> None:
    options = studies.arguments(__doc__, rows=1_000_000).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), options.rows)
        command = [sys.executable, "-m", "foamfit", "fit", str(path), "--out", f"{folder}/result"]
        for run in ("first", "second"):
            began = time.perf_counter()
            subprocess.run([*command, "--quiet"], check=True)
            print(f"{run} run: {time.perf_counter() - began:.1f} s from command to report")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"peak memory {peak:.0f} MiB")


if __name__ == "__main__":
    main()
