"""What a device straightens: the beam in its bed, the fitted factor, the vessel that follows, agreement of both."""

import re
import runpy
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from tubes import arc, tube

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment import straightening
from vstent.deployment.beam import Beam
from vstent.deployment.deploy import deploy
from vstent.deployment.motion import Motion, Skin, moved
from vstent.deployment.straightening import SETTINGS, read_straightening, settled, straighten
from vstent.devices.catalogue import find_design
from vstent.devices.stent import Landing
from vstent.errors import InputError, LandingError
from vstent.geometry.vessel import Vessel
from vstent.kernels import curves
from vstent.phantoms import demo_phantom, phantom_surface

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "straightening.py"
FITTED = "immediate, mean radius", "immediate, sharpest radius", "six months"
BEND_MM, WALL, DEVICE, BED, SPRING, STRETCH = 7.0, 18.0, 9.0, 0.02, 0.05, 50.0


def arc_beam(n, device=DEVICE):
    """A 90-degree arc in n nodes."""
    angle = np.linspace(0, np.pi / 2, n)
    nodes = BEND_MM * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    hold = np.full(n, BED * BEND_MM * np.pi / 2 / (n - 1))
    hold[[0, -1]] = 0.5 * hold[0] + SPRING
    return Beam(nodes, np.full(n, WALL), np.full(n, device), np.full(n - 1, STRETCH), hold)


def test_an_arc_settles_as_the_differential_equation_of_the_beam():
    """x, y, direction, moment and force along the arc: M = (wall + device) theta' - wall / R."""
    length, force = BEND_MM * np.pi / 2, (WALL + DEVICE, WALL / BEND_MM)

    def rest(s):
        return BEND_MM * np.sin(s / BEND_MM), BEND_MM * (1 - np.cos(s / BEND_MM))

    def slopes(s, state):
        x, y, theta, moment, a, b = state
        longer = 1 + (a * np.cos(theta) + b * np.sin(theta)) / STRETCH
        aside = longer * (a * np.sin(theta) - b * np.cos(theta))
        way = longer * np.cos(theta), longer * np.sin(theta), (moment + force[1]) / force[0], aside
        return np.stack([*way, BED * (x - rest(s)[0]), BED * (y - rest(s)[1])])

    def ends(first, last):
        x, y = rest(length)
        held = first[4] - SPRING * first[0], first[5] - SPRING * first[1]
        return np.array([first[3], last[3], *held, last[4] + SPRING * (last[0] - x), last[5] + SPRING * (last[1] - y)])

    s = np.linspace(0, length, 200)
    start = np.stack([*rest(s), s / BEND_MM, 0 * s, 0 * s, 0 * s])
    exact = solve_bvp(slopes, ends, s, start, tol=1e-8)
    beam = arc_beam(25)
    nodes = beam.settled_mm(beam.rest_mm)
    true = exact.sol(np.linspace(0, length, 25))[:2].T
    ways = np.linalg.norm(true - beam.rest_mm[:, :2], axis=1)
    assert ways.max() > 0.35
    assert np.abs(nodes[:, :2] - true).max() < 0.02 * ways.max()
    assert not nodes[:, 2].any()
    assert curves.arc_length(nodes)[-1] == pytest.approx(length, rel=0.01)


def test_forces_are_the_slopes_of_the_energy():
    beam, rng = arc_beam(20), np.random.default_rng(1)
    x, way = beam.rest_mm + 0.05 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    slope = (beam.energy(x + 1e-6 * way)[0] - beam.energy(x - 1e-6 * way)[0]) / 2e-6
    assert (beam.energy(x)[1] * way).sum() == pytest.approx(slope, rel=1e-6)


def test_a_turned_beam_settles_turned():
    beam, turn = arc_beam(25), np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    plain = beam.settled_mm(beam.rest_mm)
    turned = beam._replace(rest_mm=beam.rest_mm @ turn)
    np.testing.assert_allclose(turned.settled_mm(turned.rest_mm), plain @ turn, atol=1e-7)
    straight = arc_beam(25, device=1e4)
    assert np.linalg.norm(np.diff(straight.settled_mm(straight.rest_mm)[[0, -1]], axis=0)) > 0.97 * 7 * np.pi / 2


@pytest.mark.validation
def test_the_factors_are_fitted_to_what_was_published(shared_data, capsys):
    """In seven siphons; both ways to read a published radius give the same factor within a fifth."""
    runpy.run_path(str(BENCHMARK))["fit"]()
    found = dict(line.split(": ") for line in capsys.readouterr().out.splitlines())
    mean, sharpest, angle = ([float(one) for one in found[title].split(", ")] for title in FITTED)
    assert list(SETTINGS["immediate"]) == pytest.approx(mean, rel=0.01)
    assert sharpest == pytest.approx(mean[:2], rel=0.2)
    assert [SETTINGS["six_months"][0], SETTINGS["six_months"][2]] == pytest.approx(angle, rel=0.01)
    predicted, spread = map(float, re.findall(r"[\d.]+", found["opened with immediate"]))
    assert 12.9 - predicted == pytest.approx(2.0, abs=0.5)  # the factor of the radius foretells the angle
    assert spread == pytest.approx(6.7, abs=0.3)


def test_the_range_of_six_months_begins_without_straightening():
    """12.9 - 13.1 degrees is none."""
    for likely, low, high in SETTINGS.values():
        assert low < likely < high
    assert SETTINGS["six_months"][1] == 0.0


@pytest.fixture(scope="module")
def bend():
    """An artery with a bend of 90 degrees and 7 mm, and an Enterprise in it."""
    anatomy = tube(arc(7.0, np.pi / 2, straight_mm=16.0), 1.6, around=48)
    middle_mm = 0.5 * anatomy.parent.axis.length_mm
    return anatomy, deploy("enterprise", anatomy, landing=Landing(middle_mm), size=find_design("enterprise").sizes[0])


def test_the_vessel_follows_without_folds(bend):
    anatomy, deployed = bend
    began = time.process_time()
    found = straighten(anatomy, [deployed])
    assert time.process_time() - began < 8.0  # with the device, which is deployed again every time
    assert 0.02 < found.metrics()["straightened_rad"] < 0.35
    assert abs(found.axis_length_change_fraction) < 0.01
    before, after = anatomy.vessel.lumen, found.anatomy.vessel.lumen
    assert np.einsum("ij,ij->i", before.normals, after.normals).min() > 0.7
    ring = after.vertices_mm.reshape(-1, 48, 3)
    radius_mm = np.linalg.norm(ring - ring.mean(axis=1, keepdims=True), axis=2)
    np.testing.assert_allclose(radius_mm, 1.6, rtol=0.01)  # sections are rigid
    np.testing.assert_allclose(ring.mean(axis=1), found.anatomy.parent.axis.points_mm, atol=0.01)
    wall = found.anatomy.parent.landing_surface
    assert wall.closest(found.deployed[0].stent.nodes_mm.reshape(-1, 3))[1].max() < 0.6
    low, high = found.angle_rad[2:]
    assert low < found.angle_rad[1] < high


def test_device_and_artery_agree(bend):
    """The beam with the device as deployed in the artery that has yielded is that artery."""
    anatomy, deployed = bend
    found = straighten(anatomy, [deployed])
    rest = straightening.artery_beam(anatomy)
    stent = straightening._on(found.deployed[0].stent, anatomy, found.anatomy)
    device = SETTINGS["immediate"][0] * straightening._device(rest, [stent])[0]
    nodes = settled(rest, device, rest.rest_mm)
    assert found.anatomy.parent.axis.nearest_abscissa_mm(nodes).size == len(nodes)
    assert curves.project(found.anatomy.parent.axis.points_mm, nodes)[1].max() < 0.1


def test_without_stiffness_nothing_changes_in_the_last_bit(bend, monkeypatch):
    anatomy, deployed = bend
    for setting in ("off", "0deg"):
        found = straighten(anatomy, [deployed], setting)
        assert found.anatomy is anatomy
        assert found.deployed == (deployed,)
        assert found.metrics()["straightened_rad"] == found.displacement_mm == 0.0
    monkeypatch.setattr(straightening, "bending_stiffness_N_mm2", lambda *_: np.zeros((3, 1)))
    assert straighten(anatomy, [deployed]).anatomy is anatomy


def test_a_measured_angle_or_radius_is_met(bend):
    anatomy, deployed = bend
    found = straighten(anatomy, [deployed], "4deg")
    assert np.degrees(found.metrics()["straightened_rad"]) == pytest.approx(4.0, abs=0.6)
    assert np.ptp(found.angle_rad[1:]) == 0.0
    found = straighten(anatomy, [deployed], "9mm")
    assert found.metrics()["bend_radius_after_mm"] == pytest.approx(9.0, rel=0.03)
    with pytest.raises(InputError, match="opens this artery by at most"):
        straighten(anatomy, [deployed], "170deg")
    with pytest.raises(InputError, match=r"The sharpest bend has a radius of 6\.\d mm, and of at most"):
        straighten(anatomy, [deployed], "500mm")
    for text in ("12", "deg", "soft", "-3deg"):
        with pytest.raises(InputError, match="is not off, immediate, six_months, an angle"):
            read_straightening(text)


def test_a_braid_straightens_less_than_a_laser_cut_stent(bend):
    anatomy, deployed = bend
    silk = deploy("silk", anatomy, landing=Landing(0.5 * anatomy.parent.axis.length_mm))
    assert 0 < straighten(anatomy, [silk]).displacement_mm < 0.1 * straighten(anatomy, [deployed]).displacement_mm


def test_devices_at_a_fork_and_in_sacs_are_refused(bend):
    anatomy, deployed = bend
    other = replace(deployed, stent=replace(deployed.stent, path="outlet_1"))
    with pytest.raises(LandingError, match="for devices on one path"):
        straighten(anatomy, [deployed, other])
    with pytest.raises(LandingError, match="Nothing straightens the artery"):
        straighten(anatomy, [])


def test_a_sac_keeps_its_volume_and_no_triangle_turns_over():
    anatomy = restore(trim(trace(Vessel(phantom_surface(demo_phantom(), edge_mm=0.3)))))
    deployed = deploy("enterprise", anatomy)
    found = straighten(anatomy, [deployed], "12deg")
    before, after = anatomy.aneurysms[0], found.anatomy.aneurysms[0]
    assert after.sac.volume_mm3 == pytest.approx(before.sac.volume_mm3, rel=0.01)
    assert np.linalg.norm(after.sac.vertices_mm - before.sac.vertices_mm, axis=1).max() > 0.3
    for one, other in ((anatomy.vessel.lumen, found.anatomy.vessel.lumen), (before.sac, after.sac)):
        assert np.einsum("ij,ij->i", one.normals, other.normals).min() > 0.8
    on_wall = anatomy.vessel.lumen.closest(before.sac.vertices_mm)[1] < 1e-6
    assert found.anatomy.vessel.lumen.closest(after.sac.vertices_mm[on_wall])[1].max() < 1e-6
    began = time.process_time()
    beam = straightening.artery_beam(anatomy)
    settled(beam, 0.3 * straightening._device(beam, [deployed.stent])[0], beam.rest_mm)
    assert time.process_time() - began < 1.0


@pytest.mark.parametrize("file", ["aneurisk_C0038.vtp", "aneurisk/C0016.vtp"])
def test_no_triangle_of_a_patient_turns_over(file, shared_data):
    """Their sacs lose 13 and 7 % where the neck narrows; the sac of C0038 is cut off a branch 5 mm from the neck."""
    anatomy = restore(trim(trace(read_vessel(shared_data / file))))
    deployed = deploy("enterprise", anatomy)
    found = straighten(anatomy, [deployed], "six_months", place=1.0)
    assert np.degrees(found.metrics()["straightened_rad"]) > 15
    before, after = anatomy.vessel.lumen, found.anatomy.vessel.lumen
    assert np.einsum("ij,ij->i", before.normals, after.normals).min() > 0.3
    (sac,), (other,) = anatomy.aneurysms, found.anatomy.aneurysms
    assert other.sac.volume_mm3 == pytest.approx(sac.sac.volume_mm3, rel=0.01)
    rest = straightening.artery_beam(anatomy)
    device = straightening._device(rest, [deployed.stent])[0]
    skin, moved_mm = Skin(anatomy, rest.rest_mm), settled(rest, 0.5 * device, rest.rest_mm)
    began = time.process_time()
    moved(Motion.of(skin, moved_mm))
    assert time.process_time() - began < 2.0
    began = time.process_time()
    Motion.of(skin, moved_mm)  # as the page redraws it
    assert time.process_time() - began < 0.5
