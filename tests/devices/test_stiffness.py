"""Bending stiffness of devices beside frames of elastic beams."""

import numpy as np
import pytest
from frames import bending_stiffness, lattice

from vstent.devices import design as device
from vstent.devices.catalogue import find_design
from vstent.devices.stiffness import MODULUS_N_MM2, POISSON, bending_stiffness_N_mm2

MODULUS, SHEAR = MODULUS_N_MM2[0], MODULUS_N_MM2[0] / 2 / (1 + POISSON)


@pytest.mark.parametrize("degrees", [45, 60, 72])
def test_a_braid_bends_as_its_helices(degrees):
    """A helix of 6 turns of straight beams, over 4 phases about the axis."""
    um, angle = 40.0, np.radians(degrees)
    size = device.Size(4.0, 20.0, 4.0)
    braid = device.Braid("b", "B", ((24, um),), angle, (size,))
    turn = np.linspace(0, 12 * np.pi, 241)
    bars = np.stack([np.arange(240), np.arange(1, 241)], axis=1)
    inertia = np.pi / 64 * (um * 1e-3) ** 4
    stiffness = {"across": MODULUS * inertia, "along": MODULUS * inertia, "twist": SHEAR * 2 * inertia}
    phases = []
    for phase in np.arange(4) * np.pi / 4:
        nodes = np.stack([2 * np.cos(turn + phase), 2 * np.sin(turn + phase), 2 * turn / np.tan(angle)], axis=1)
        outward = np.tile([0.0, 0.0, 1.0], (240, 1))
        phases.append(bending_stiffness(nodes, bars, ([0], [240]), outward, stretch=MODULUS * 1e-3, **stiffness))
    found = bending_stiffness_N_mm2(braid, size, np.array([4.0]))[:, 0]
    assert found[0] == pytest.approx(24 * np.mean(phases), rel=0.005)
    assert found[1] == pytest.approx(found[0] * 2 / 3)  # no range of its wires, a modulus of 40 to 240 kN/mm2, friction
    assert found[2] == pytest.approx(found[0] * 40)


@pytest.mark.parametrize("name", ["enterprise", "neuroform_atlas"])
@pytest.mark.parametrize("diameter_mm", [2.8, 3.8])
def test_a_laser_cut_stent_bends_as_a_frame_of_its_struts(name, diameter_mm):
    design = find_design(name)
    size = design.sizes[-1]
    nodes, bars, ends = lattice(design, size, diameter_mm, 33)
    width_mm, thickness_mm = design.strut_width_um * 1e-3, design.strut_thickness_um * 1e-3
    outward = nodes[bars].mean(axis=1) * [1, 1, 0]
    stiffness = {
        "stretch": MODULUS * width_mm * thickness_mm,
        "across": MODULUS * width_mm * thickness_mm**3 / 12,
        "along": MODULUS * thickness_mm * width_mm**3 / 12,
        "twist": SHEAR * 0.141 * width_mm**4,
    }
    low, high = sorted(bending_stiffness_N_mm2(design, size, np.array([diameter_mm]))[1:, 0])
    found = bending_stiffness_N_mm2(design, size, np.array([diameter_mm]))[0, 0]
    assert found == pytest.approx(bending_stiffness(nodes, bars, ends, outward, **stiffness), rel=0.2)
    assert low < 0.7 * found < 1.5 * found < high


def test_devices_in_sacs_have_no_stiffness():
    for name in ("web_sl", "coils"):
        design = find_design(name)
        assert not bending_stiffness_N_mm2(design, design.sizes[0], np.ones(2)).any()


def test_an_enterprise_is_stiffer_than_an_open_cell_and_a_braid():
    """The order of Krischek et al. 2011 but for Leo, whose highest value is above that of Neuroform."""
    found = {}
    for name in ("enterprise", "neuroform_atlas", "leo", "silk"):
        design = find_design(name)
        found[name] = bending_stiffness_N_mm2(design, design.sizes[-1], np.array([3.5]))[:, 0]
    assert found["enterprise"][0] > found["neuroform_atlas"][0] > found["silk"][2] > found["silk"][0]
    assert found["leo"][2] > found["neuroform_atlas"][0] > found["leo"][0]
