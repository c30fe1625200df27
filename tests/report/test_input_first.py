"""Warnings about the input of a fit come first and are never hidden."""

import json

from conftest import run, without_pictures

TIMES = [0.01 * i for i in range(241)]  # s
HEAD = "time (s),force (MN),strain (%),displacement (mm)\n"


def test_what_check_finds_wrong_stands_before_all_other_warnings(tmp_path, monkeypatch):
    without_pictures(monkeypatch)
    # Faulty input: force in meganewtons, strain for another height, a loop of simple power laws.
    rows = [(t, min(t, 2.4 - t) ** (1 if t < 1.2 else 2), min(t, 2.4 - t)) for t in TIMES]
    body = "".join(f"{t:.3f},{1e2 * f:.6f},{12 * w:.6f},{w:.6f}\n" for t, f, w in rows)
    (tmp_path / "test.csv").write_text(HEAD + body)
    (tmp_path / "test.toml").write_text(
        '[specimen]\nheight = "10 mm"\narea = "100 mm^2"\n'
        '[striker]\nmass = "1 kg"\nvelocity = "1 m/s"\n[noise]\nstress = "1 Pa"\n'
    )
    call = ["fit", str(tmp_path / "test.csv"), "--model", "linear", "--drive", "displacement"]
    out = run(*call, "--starts", "2", "--out", str(tmp_path / "out"))
    assert out.exit_code in (0, 2), out.output
    fit = json.loads((tmp_path / "out" / "fit.json").read_text())
    asked = [text.startswith("Check:") for text in fit["warnings"]]
    assert fit["status"] != "ok"
    assert sum(asked) > 3
    assert asked == sorted(asked, reverse=True)
    assert not all(asked)
    shown = " ".join(out.stdout.split())
    for warning, on_input in zip(fit["warnings"], asked, strict=True):
        assert not on_input or f"warning: {warning}"[:60] in shown
