"""Colours with a meaning are distinguishable with any colour vision, and in greyscale.

Colour vision without one type of cone is simulated with the matrices of Machado, Oliveira and
Fernandes (2009, IEEE Trans. Vis. Comput. Graph. 15, 1291) in linear RGB. Colour differences are
CIE76 distances in L*a*b* (D65).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from foamfit.report.figures import BLUE, FITTED, SEEN

EYES = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
    "grey": [[0.2126, 0.7152, 0.0722]] * 3,
}  # fmt: skip
# Smallest colour difference at which lines are distinguishable at a glance, in colour and in grey
# (where only lightness differs).
APART, APART_IN_GREY = 20.0, 12.0
XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]


def lab(colour: Any, eye: str) -> np.ndarray:
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eye]) @ linear, 0.0, 1.0)
    x, y, z = np.array(XYZ) @ seen / [0.9505, 1.0, 1.089]
    f = [t ** (1 / 3) if t > 0.008856 else 7.787 * t + 16 / 116 for t in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(one: Any, other: Any, eye: str) -> float:
    return float(np.linalg.norm(lab(one, eye) - lab(other, eye)))


def is_told(one: Any, other: Any) -> dict[str, float]:
    """Return the kinds of vision that do not distinguish two colours, with their difference."""
    found = {eye: apart(one, other, eye) for eye in EYES}
    return {
        eye: round(far, 1) for eye, far in found.items()
        if far < (APART_IN_GREY if eye == "grey" else APART)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (SEEN["color"], FITTED["color"]),
        (BLUE, "white"),  # hollow marks
    ],
)
def test_measured_and_simulated_are_told_apart(one: str, other: str) -> None:
    assert not is_told(one, other)
