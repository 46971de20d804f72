"""A vessel after the treatment: moved, bent by a known map, with noise, and with the wires in a scan."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tubes import line, tube, with_neck

from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.cli.console import followup_table
from vstent.deployment.deploy import deploy
from vstent.deployment.straightening import measured, straighten
from vstent.devices.stent import Landing
from vstent.geometry.image import Image
from vstent.geometry.registration import registered
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.io.dicom_writer import write_dicom
from vstent.io.writers import write_stl
from vstent.kernels.curves import resample
from vstent.phantoms import demo_phantom, phantom_surface
from vstent.reporting.followup import draw_followup
from vstent.study.followup import compare_followup

TURN, SHIFT_MM = Rotation.from_rotvec([0.9, -0.5, 0.7]).as_matrix(), np.array([20.0, -11.0, 6.0])


@pytest.fixture(scope="module")
def plan():
    anatomy = restore(trim(trace(Vessel(phantom_surface(demo_phantom(), edge_mm=0.3)))))
    return anatomy, deploy("enterprise", anatomy)


def after(vessel, rng):
    """A vessel in another frame, with noise on its wall."""
    noise_mm = 0.03 * rng.normal(size=vessel.lumen.vertices_mm.shape)
    return Surface(vessel.lumen.vertices_mm @ TURN.T + SHIFT_MM + noise_mm, vessel.lumen.faces)


def test_a_motion_is_found_from_any_direction(plan):
    anatomy, _ = plan
    points_mm = anatomy.vessel.lumen.vertices_mm
    pose = registered(points_mm, after(anatomy.vessel, np.random.default_rng(0)))
    assert np.linalg.norm(pose.of(points_mm) - points_mm @ TURN.T - SHIFT_MM, axis=1).max() < 0.05
    assert pose.residual_mm < 0.03


@pytest.mark.parametrize("degrees", [0, 12])
def test_the_map_of_a_moved_and_bent_vessel_is_found(degrees, plan, tmp_path):
    anatomy, deployed = plan
    bent = straighten(anatomy, [deployed], f"{degrees}deg")
    write_stl(tmp_path / "after.stl", after(bent.anatomy.vessel, np.random.default_rng(1)).closed)
    found = compare_followup(anatomy, deployed.stent, tmp_path / "after.stl")
    own = Rotation.from_matrix(found.pose.turn @ TURN.T).magnitude()
    assert np.degrees(own) < 2.0
    truth_mm = bent.anatomy.parent.axis.points_mm @ TURN.T + SHIFT_MM
    away_mm = found.anatomy.parent.axis.nearest_abscissa_mm(truth_mm)
    inner = (away_mm > 3) & (away_mm < found.anatomy.parent.axis.length_mm - 3)
    off_mm = np.linalg.norm(found.anatomy.parent.axis.at(away_mm) - truth_mm, axis=1)[inner]
    assert np.quantile(off_mm, 0.95) < 0.3
    ends_mm = deployed.stent.proximal_abscissa_mm, deployed.stent.distal_abscissa_mm
    axes = anatomy.parent.axis, bent.anatomy.parent.axis
    places_mm = tuple(np.interp(ends_mm, axes[0].abscissa_mm, axes[1].abscissa_mm))
    true_rad, true_mm = measured(resample(axes[1].points_mm, 0.5), places_mm)
    assert np.degrees(found.real["arms_angle_rad"]) == pytest.approx(np.degrees(true_rad), abs=2.0)
    assert found.real["bend_radius_mm"] == pytest.approx(true_mm, abs=0.3)
    assert np.degrees(true_rad - found.planned["arms_angle_rad"]) == pytest.approx(degrees, abs=2.0)
    draw_followup(tmp_path / "followup.png", anatomy, found)
    assert (tmp_path / "followup.png").read_bytes()[1:4] == b"PNG"
    assert followup_table(found).columns[0]._cells == [
        "Angle of the arms",
        "Radius of the sharpest bend",
        "Straightening",
    ]
    assert found.metrics()["registration"]["residual_mm"] < 0.1


def test_wires_in_a_scan_show_where_the_device_lies(plan, tmp_path):
    """The planned wires, shifted by 2 mm along the artery, as bright voxels beside blood."""
    anatomy, deployed = plan
    real = deploy(
        deployed.stent.design,
        anatomy,
        size=deployed.stent.size,
        landing=Landing(deployed.stent.middle_abscissa_mm + 2.0),
    )
    points_mm = anatomy.vessel.closed.vertices_mm
    low_mm, size = points_mm.min(axis=0) - 2.0, 0.25
    shape = np.ceil((np.ptp(points_mm, axis=0) + 4.0) / size).astype(int)
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = low_mm
    grid_mm = low_mm + size * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    voxels = np.where(anatomy.vessel.closed.signed_distance(grid_mm) < 0, 1000.0, 0.0).reshape(shape)
    wires = np.rint((real.stent.wire_points_mm - low_mm) / size).astype(int)
    voxels[tuple(wires.T)] = 3000.0
    write_dicom(Image(voxels.astype(np.int16), affine, "CT"), tmp_path / "after")
    found = compare_followup(anatomy, deployed.stent, tmp_path / "after", metal=2500.0)
    middle_mm = np.mean(anatomy.parent.span_mm(anatomy.aneurysms[0]))
    ends_mm = real.stent.proximal_abscissa_mm - middle_mm, real.stent.distal_abscissa_mm - middle_mm
    for end, true_mm in zip(("proximal", "distal"), ends_mm, strict=True):
        assert found.real[f"{end}_end_to_neck_middle_mm"] == pytest.approx(true_mm, abs=1.2)
    assert found.real["mean_diameter_mm"] == pytest.approx(found.planned["mean_diameter_mm"], abs=0.3)


def test_straight_arms_and_a_sac_that_is_gone(tmp_path):
    """A straight artery whose sac is occluded: its arms stay straight, wherever along it the device lies."""
    artery = tube(line(36.0), 1.9)
    anatomy = with_neck(artery, 16.0, 20.0)
    stent = deploy("enterprise", anatomy, landing=Landing(18.0)).stent
    write_stl(tmp_path / "after.stl", after(artery.vessel, np.random.default_rng(3)))
    found = compare_followup(anatomy, stent, tmp_path / "after.stl")
    assert not found.anatomy.aneurysms
    assert np.degrees(found.real["arms_angle_rad"]) == pytest.approx(180.0, abs=2.0)
    assert np.degrees(found.real["straightened_rad"]) == pytest.approx(0.0, abs=2.0)
    assert found.real["bend_radius_mm"] > 50
    way = found.pose.turn @ np.array([0.0, 0.0, 1.0])
    assert abs(way @ TURN @ np.array([0.0, 0.0, 1.0])) > np.cos(np.radians(2.0))
