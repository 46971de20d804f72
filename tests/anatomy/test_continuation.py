"""An artery cut near the neck is continued: exactly straight, of the end's area, and it counts in no measure."""

from dataclasses import replace

import numpy as np
import pytest
from tubes import on_parent

import vstent
from vstent import phantoms
from vstent.anatomy.continuation import ENOUGH_MM, RELAXING_DIAMETERS, continued
from vstent.anatomy.landing_zones import neck_span_mm
from vstent.anatomy.morphology import morphology
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.measure import measure
from vstent.deployment.sizing import propose_size
from vstent.geometry.vessel import Anatomy, Vessel


@pytest.fixture(scope="module")
def whole() -> Anatomy:
    """A straight artery of 4 mm along z, 60 mm long, with a sac in its middle."""
    phantom = phantoms.with_sac(phantoms.tube(length_mm=60.0), abscissa_mm=30.0, width_mm=5.0, neck_mm=4.0)
    return restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))


def cut(whole: Anatomy, mm: float) -> Anatomy:
    """Return the anatomy with so much artery on either side of the neck."""
    first_mm, last_mm = neck_span_mm(whole)
    beside_mm = mm + 0.5 * (last_mm - first_mm)
    return restore(trim(whole.vessel, upstream_mm=beside_mm, downstream_mm=beside_mm))


def test_a_long_artery_stays_as_it_is(whole: Anatomy) -> None:
    assert whole.parent.continued_mm == (0.0, 0.0)
    assert continued(whole) is whole
    assert not whole.parent.is_continued.any()
    healthy = replace(whole, aneurysms=())
    assert continued(healthy) is healthy


def test_a_short_artery_without_a_sac_is_continued_about_its_middle() -> None:
    short = restore(trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=12.0), edge_mm=0.3))))
    assert not short.aneurysms
    np.testing.assert_allclose(short.parent.continued_mm, ENOUGH_MM - 6.0, atol=0.3)
    assert short.parent.axis.length_mm == pytest.approx(2 * ENOUGH_MM, abs=0.01)


def test_a_straight_artery_is_continued_along_itself(whole: Anatomy) -> None:
    short = cut(whole, 6.0)
    first_mm, last_mm = neck_span_mm(short)
    assert first_mm == pytest.approx(ENOUGH_MM)
    assert short.parent.axis.length_mm - last_mm == pytest.approx(ENOUGH_MM)
    np.testing.assert_allclose(short.parent.continued_mm, ENOUGH_MM - 6.0, atol=0.6)
    points_mm = short.parent.axis.points_mm
    assert np.linalg.norm(points_mm[:, :2], axis=1).max() < 0.1
    steps_mm = np.linalg.norm(np.diff(points_mm, axis=0), axis=1)
    assert steps_mm.max() / steps_mm.min() < 1.3
    new = short.parent.axis.abscissa_mm < short.parent.own_mm[0] - 1e-6
    np.testing.assert_allclose(short.parent.section_radius_mm[new], 2.0, atol=0.04)


def test_an_oval_section_relaxes_to_the_circle_of_its_area(whole: Anatomy) -> None:
    """After RELAXING_DIAMETERS diameters 1/e of the difference from the circle is left."""
    rings_mm = whole.parent.landing_surface.vertices_mm.copy() * [1.15, 1 / 1.15, 1.0]
    surface = replace(whole.parent.landing_surface, vertices_mm=rings_mm)
    points_mm = whole.parent.axis.at(np.linspace(4.0, neck_span_mm(whole)[1], 9))
    sac = replace(whole.aneurysms[0], neck_mm=points_mm)
    oval = continued(replace(on_parent(whole, landing_surface=surface), aneurysms=(sac,)))
    added_mm = oval.parent.continued_mm[0]
    assert added_mm == pytest.approx(ENOUGH_MM - 4.0)
    rings = oval.parent.landing_surface.vertices_mm.reshape(len(oval.parent.axis.points_mm), -1, 3)
    rho_mm = np.linalg.norm(rings - oval.parent.axis.points_mm[:, None], axis=2)
    new = np.flatnonzero(oval.parent.axis.abscissa_mm < added_mm - 1e-6)
    at_end = rho_mm[new[-1] + 1]
    radius_mm = np.sqrt((at_end**2).mean())
    from_end_mm = added_mm - oval.parent.axis.abscissa_mm[new]
    expected = radius_mm + np.exp(-from_end_mm / (2 * radius_mm * RELAXING_DIAMETERS))[:, None] * (at_end - radius_mm)
    np.testing.assert_allclose(rho_mm[new], expected, rtol=1e-6)


def test_what_lies_in_the_continuation_counts_in_no_measure_of_the_wall(whole: Anatomy) -> None:
    short = cut(whole, 4.0)
    z_mm = short.parent.landing_surface.corners_mm.mean(axis=1)[:, 2]
    own = (z_mm > short.vessel.lumen.vertices_mm[:, 2].min()) & (z_mm < short.vessel.lumen.vertices_mm[:, 2].max())
    assert not short.parent.is_patient_face[~own].any()
    silk = vstent.find_design("silk")
    deployment = vstent.deploy(silk, short, size=propose_size(silk, whole))
    apart = on_parent(short, landing_surface=replace(short.parent.landing_surface))  # same wall; gaps are kept by node
    gap_mm = deployment.wall_gap_mm.copy()
    rows_mm = deployment.stent.nodes_mm[..., 2].mean(axis=1)
    first_mm, last_mm = short.vessel.lumen.vertices_mm[:, 2].min(), short.vessel.lumen.vertices_mm[:, 2].max()
    gap_mm[(rows_mm < first_mm - 0.5) | (rows_mm > last_mm + 0.5)] = 9.0
    assert (gap_mm == 9.0).any()
    told = measure(apart, replace(deployment, wall_gap_mm=gap_mm))
    assert told["max_wall_gap_mm"] < 1.0
    assert "leaves the patient's artery by" in deployment.advice
    ours, theirs = morphology(short), morphology(whole)
    for key in ("parent_proximal_diameter_mm", "parent_distal_diameter_mm", "sac_volume_mm3"):
        assert ours[key] == pytest.approx(theirs[key], rel=0.02)


@pytest.mark.parametrize("kept_mm", [12.0, 9.0, 6.0, 4.0])
def test_a_device_in_a_cut_artery_is_as_long_as_in_the_whole_one(whole: Anatomy, kept_mm: float) -> None:
    silk = vstent.find_design("silk")
    short = cut(whole, kept_mm)
    size = propose_size(silk, short)
    assert size == propose_size(silk, whole)
    ours, theirs = (measure(one, vstent.deploy(silk, one, size=size)) for one in (short, whole))
    assert ours["deployed_length_mm"] == pytest.approx(theirs["deployed_length_mm"], rel=0.02)
    key = "neck_metal_coverage_fraction"
    assert ours[key] == pytest.approx(theirs[key], abs=0.01)
