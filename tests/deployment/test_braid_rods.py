"""The braid of constant wires beside elastic rods, an independent model (``benchmarks/offline/braid_rods.py``)."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tubes import arc, line, tube

from vstent.deployment.deploy import deploy
from vstent.devices import design as device, formulas
from vstent.devices.stent import Landing

RODS = json.loads((Path(__file__).parents[1] / "helpers" / "data" / "braid_rods.json").read_text())
BRAID = device.Braid("reduced", "Reduced Silk", ((24, 50.0),), 1.152, (device.Size(4.0, 10.0, 4.2),))
BEFORE_MM = 14.0
"""Straight artery before the bend."""


@cache
def artery(name):
    """The artery of a case, the place on it that the rods call zero, and the rods' axes there (x, y, z)."""
    case = RODS[name]
    outer_mm = case["radius_mm"] + 0.05
    if case["bend_mm"]:
        turn = 2 * case["half_mm"] / case["bend_mm"]
        path, middle_mm = arc(case["bend_mm"], turn, BEFORE_MM), BEFORE_MM + case["half_mm"]
    else:
        path, middle_mm, turn = line(40), 20.0, 0.0
    anatomy = tube(path, outer_mm + case["slope"] * (np.linspace(0, 40, len(path[0])) - 20 if not turn else 0.0))
    cosine, sine = np.cos(turn / 2), np.sin(turn / 2)
    return anatomy, middle_mm, np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])


def compared(name):
    """Length (rods, ours) and the distance of every crossing from where the rods have it."""
    anatomy, middle_mm, axes = artery(name)
    stent = deploy(BRAID, anatomy, size=BRAID.sizes[0], landing=Landing(middle_mm)).stent
    shape, case = formulas.grid(BRAID, BRAID.sizes[0]), RODS[name]
    rods_mm = np.array(case["points_mm"]) @ axes + anatomy.parent.axis.at(np.array([middle_mm]))[0]
    lattice_mm = stent.nodes_mm[:: shape.row_split, :: shape.column_split]
    nearest_mm = []
    for turn in range(0, 24, 2) if not case["bend_mm"] else [0]:  # about a straight axis a braid may lie turned
        ours_mm = lattice_mm[case["row"], (np.array(case["column"]) + turn) % 24]
        nearest_mm.append(np.linalg.norm(ours_mm - _turned_back(rods_mm, ours_mm, case, anatomy), axis=1))
    return case["length_mm"], stent.deployed_length_mm, min(nearest_mm, key=np.mean)


def _turned_back(rods_mm, ours_mm, case, anatomy):
    """The rods turned about a straight axis by what is left of the angle."""
    if case["bend_mm"]:
        return rods_mm
    offset = anatomy.parent.axis.points_mm[0, :2]
    a, b = ((p[:, :2] - offset) @ np.array([1, 1j]) for p in (rods_mm, ours_mm))
    away = a * np.exp(1j * np.angle((b * a.conj()).sum()))
    return np.stack([away.real + offset[0], away.imag + offset[1], rods_mm[:, 2]], axis=1)


@pytest.mark.parametrize("name", ["tube", "taper", "bend"])
def test_elastic_rods_come_to_lie_where_the_braid_is_drawn(name):
    rods_mm, ours_mm, apart_mm = compared(name)
    assert ours_mm == pytest.approx(rods_mm, rel=0.01)
    assert apart_mm.mean() < 0.06
    assert apart_mm.max() < 0.15


def test_rows_that_keep_their_straight_spacing_in_the_bend_are_not_what_rods_do():
    free_mm = formulas.deployed_length_mm(BRAID, BRAID.sizes[0], 3.7)
    assert RODS["tube"]["length_mm"] == pytest.approx(free_mm, rel=1e-3)
    assert RODS["bend"]["length_mm"] < 0.97 * free_mm
