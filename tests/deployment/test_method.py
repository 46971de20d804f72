"""The paper's method beside the default one; devices pushed, one in another, and in a branch."""

from functools import cache

import numpy as np
import pytest
from tubes import arc, line, on_parent, tube

from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.active_contour import ActiveContour
from vstent.deployment.braid import ConstantWire
from vstent.deployment.contour import perimeters
from vstent.deployment.deploy import deploy
from vstent.deployment.measure import measure, wire_stretches
from vstent.deployment.method import Zhong2016
from vstent.deployment.wall import inner_nodes_mm
from vstent.devices import catalogue, design as device, formulas
from vstent.devices.stent import Landing
from vstent.errors import DeviceError, InputError, LandingError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel
from vstent.io.images import read_image
from vstent.io.surfaces import read_surface

SILK, ENTERPRISE = catalogue.find_design("silk"), catalogue.find_design("enterprise")
SIZE = catalogue.find_size(SILK, diameter_mm=4, length_mm=15)
DD_MM = 0.05


@cache
def straight(radius_mm=1.9):
    return tube(line(40), radius_mm)


@cache
def wavy():
    """An artery whose sections are no circles: the contour needs several iterations."""
    artery = tube(arc(7.0, 1.2, 12), 1.9)
    vertices_mm, surface = artery.parent.landing_surface.vertices_mm, artery.parent.landing_surface
    middle_mm = np.repeat(artery.parent.axis.points_mm, 160, axis=0)
    angle = np.tile(2 * np.pi * np.arange(160) / 160, len(artery.parent.axis.points_mm))
    growth = 1 + 0.12 * (1 + np.cos(3 * angle))
    grown_mm = middle_mm + growth[:, None] * (vertices_mm - middle_mm)
    return on_parent(artery, landing_surface=Surface(grown_mm, surface.faces))


SLOW = ActiveContour(k1=0.3)
METHODS = {
    "constant_wire": ConstantWire(),
    "zhong2016": Zhong2016(),
    "slow constant_wire": ConstantWire(SLOW),
    "slow zhong2016": Zhong2016(SLOW),
}


@cache
def deployed(method, artery):
    return deploy(SILK, artery(), size=SIZE, landing=Landing(18.0), method=METHODS[method])


def test_the_papers_device_is_as_long_as_its_label_with_evenly_spaced_rows_on_the_wall():
    done = deployed("zhong2016", straight)
    assert done.stent.deployed_length_mm == pytest.approx(15.0, abs=1e-9)
    assert np.diff(done.stent.row_abscissa_mm) == pytest.approx(15.0 / (len(done.stent.nodes_mm) - 1), rel=1e-9)
    assert np.linalg.norm(done.stent.nodes_mm[..., :2], axis=2) == pytest.approx(1.9 - DD_MM, abs=0.002)


def test_the_papers_device_knows_no_free_diameter():
    done = deploy(SILK, straight(2.6), size=SIZE, method="zhong2016")
    assert np.linalg.norm(done.stent.nodes_mm[..., :2], axis=2) == pytest.approx(2.6 - DD_MM, abs=0.002)
    assert wire_stretches(done.stent).mean() > 0.15


@pytest.mark.parametrize("method", ["slow constant_wire", "slow zhong2016"])
def test_every_iteration_is_kept(method):
    done = deployed(method, wavy)
    iterations = len(done.terminated_fraction)
    assert iterations >= 3
    assert done.history_mm.shape == (iterations + 1, *done.stent.nodes_mm.shape)
    assert done.energy_mm2.shape == (iterations + 1,)
    assert np.all(np.diff(done.terminated_fraction) >= 0)
    assert done.terminated_fraction[-1] >= 0.99 > done.terminated_fraction[-2]
    assert np.array_equal(done.history_mm[-1], done.stent.nodes_mm)


def test_the_energy_is_equation_1():
    method = Zhong2016()
    weights = method.contour
    done = deployed("zhong2016", wavy)
    v = done.history_mm[0]
    v_s, v_r = np.diff(v, axis=0), np.roll(v, -1, axis=1) - v
    terms = (
        (weights.a1, v_s),
        (weights.a2, np.diff(v, n=2, axis=0)),
        (weights.a3, v_r),
        (weights.a4, np.roll(v, -1, axis=1) - 2 * v + np.roll(v, 1, axis=1)),
        (2 * weights.a5, np.roll(v_s, -1, axis=1) - v_s),
    )
    distance_mm = wavy().parent.landing_surface.closest(v.reshape(-1, 3))[1]
    outer = (weights.k1 * distance_mm**2 + 2 * weights.k2 * distance_mm).sum()
    assert done.energy_mm2[0] == pytest.approx(sum(a * (d**2).sum() for a, d in terms) + outer, rel=1e-9)
    assert done.energy_mm2[-1] < 0.5 * done.energy_mm2[0]


def test_both_methods_lie_on_the_same_wall_and_differ_in_length_and_coverage():
    paper, ours = deployed("zhong2016", wavy), deployed("constant_wire", wavy)
    a, b = measure(wavy(), paper), measure(wavy(), ours)
    inner = paper.stent.contour
    reach = (ours.stent.row_abscissa_mm > 11.0) & (ours.stent.row_abscissa_mm < 25.0)
    assert inner.closest(ours.stent.nodes_mm[reach].reshape(-1, 3))[1].max() < 0.06
    assert a["deployed_length_mm"] == pytest.approx(15.0)
    assert b["deployed_length_mm"] == pytest.approx(12.3, abs=0.1)
    assert abs(b["mean_wire_stretch_fraction"]) < 0.01 < abs(a["mean_wire_stretch_fraction"])


def test_an_unknown_method_is_refused():
    with pytest.raises(InputError, match=r"no deployment method called 'magic'\. Choose one of constant_wire,"):
        deploy(SILK, straight(), method="magic")


@pytest.mark.parametrize("method", [ConstantWire(), Zhong2016()], ids=["constant_wire", "zhong2016"])
def test_the_mirrored_artery_gives_the_mirrored_contour(method):
    mirror = np.array([1.0, -1.0, 1.0])
    here = tube(arc(7.0, 1.0, 12, 0.25), 2.0, 1.8, around=96)
    rng = np.random.default_rng(3)
    vertices_mm = here.parent.landing_surface.vertices_mm
    vertices_mm = vertices_mm + 0.05 * np.sin(vertices_mm @ rng.normal(size=(3, 3)))
    here = on_parent(here, landing_surface=Surface(vertices_mm, here.parent.landing_surface.faces))
    axis = Centerline(here.parent.axis.points_mm * mirror, here.parent.axis.inscribed_radius_mm)
    flipped = Surface(vertices_mm * mirror, here.parent.landing_surface.faces[:, ::-1])
    there = on_parent(here, axis=axis, landing_surface=flipped)
    a, b = (deploy(SILK, x, size=SIZE, landing=Landing(14.0), method=method).stent.nodes_mm for x in (here, there))
    columns = -np.arange(a.shape[1]) % a.shape[1]
    assert (a * mirror)[:, columns] == pytest.approx(b, abs=1e-5)


@pytest.mark.parametrize("method", ["constant_wire", "zhong2016"])
def test_twice_the_rows_and_columns_give_the_same_device(method, monkeypatch):
    coarse = deployed(method, wavy)
    monkeypatch.setattr(formulas, "NODE_SPACING_LIMIT_MM", 0.135)
    fine = deploy(SILK, wavy(), size=SIZE, landing=Landing(18.0), method=method)
    assert fine.stent.nodes_mm.shape[1] == 2 * coarse.stent.nodes_mm.shape[1]
    assert fine.stent.deployed_length_mm == pytest.approx(coarse.stent.deployed_length_mm, rel=0.006)
    inside_mm = coarse.stent.nodes_mm[2:-2].reshape(-1, 3)
    assert np.quantile(fine.stent.contour.closest(inside_mm)[1], 0.99) < 0.01


@pytest.mark.parametrize("method", ["constant_wire", "zhong2016"])
@pytest.mark.parametrize(("anchor", "row"), [("proximal", 0), ("distal", -1)])
def test_an_end_lies_where_it_is_landed(method, anchor, row):
    done = deploy(SILK, straight(), size=SIZE, landing=Landing(19.5, anchor), method=method)
    assert done.stent.row_abscissa_mm[row] == pytest.approx(19.5, abs=1e-9)


@pytest.mark.parametrize("method", ["constant_wire", "zhong2016"])
def test_a_device_that_leaves_the_artery_is_refused(method):
    with pytest.raises(LandingError, match=r"extends \d\.\d mm beyond the proximal end"):
        deploy(SILK, straight(), size=SIZE, landing=Landing(5.0), method=method)


@pytest.mark.parametrize("fraction", [-0.2, 0.1, 0.2])
def test_a_pushed_braid_is_shorter_and_denser_and_its_wires_as_long_as_before(fraction):
    natural, pushed = (
        deploy(SILK, straight(2.05), size=SIZE, compaction_fraction=part).stent for part in (0.0, fraction)
    )
    assert 2 * (2.05 - DD_MM) == pytest.approx(SIZE.diameter_mm)
    assert pushed.deployed_length_mm / natural.deployed_length_mm == pytest.approx(1 - fraction, abs=0.01)
    pieces = [len(s.nodes_mm) - 1 for s in (natural, pushed)]
    wire_mm = [n * device.piece_length_mm(SILK, s.size) for n, s in zip(pieces, (natural, pushed), strict=True)]
    assert wire_mm[1] == pytest.approx(wire_mm[0], rel=0.01)
    hidden = [measure(straight(2.05), deploy(SILK, straight(2.05), size=s.size)) for s in (natural, pushed)]
    assert np.sign(hidden[1]["metal_coverage_fraction"] - hidden[0]["metal_coverage_fraction"]) == np.sign(fraction)
    assert hidden[1]["metal_coverage_fraction"] == pytest.approx(
        formulas.coverage_fraction(SILK, pushed.size, SIZE.diameter_mm), rel=0.02
    )


def test_pushed_together_the_papers_own_device_is_shorter_too():
    done = deploy(SILK, straight(2.05), size=SIZE, compaction_fraction=0.2, method="zhong2016")
    assert done.stent.deployed_length_mm == pytest.approx(0.8 * SIZE.length_mm, rel=1e-9)


def test_what_cannot_be_compacted_is_refused():
    with pytest.raises(DeviceError, match="its wires would be too steep"):
        formulas.compacted(SILK, SIZE, 0.5)
    with pytest.raises(DeviceError, match=r"its wires would be pulled straight\. Give a fraction nearer to 0"):
        formulas.compacted(SILK, SIZE, -3.0)
    with pytest.raises(DeviceError, match="its cells are joined"):
        formulas.compacted(ENTERPRISE, ENTERPRISE.sizes[0], 0.1)


def test_a_second_device_lands_on_the_inner_face_of_the_first_where_they_overlap():
    artery = tube(line(60), 1.9)
    first = deploy(SILK, artery, size=SIZE, landing=Landing(32.0, "proximal"))
    second = deploy(SILK, artery, size=SIZE, landing=Landing(38.0, "distal"), inside=(first.stent,))
    rows_mm = second.stent.row_abscissa_mm
    radius_mm = np.linalg.norm(second.stent.nodes_mm[..., :2], axis=2)
    within, before = rows_mm > 32.6, rows_mm < 31.4
    assert min(within.sum(), before.sum()) > 20
    assert radius_mm[within] == pytest.approx(1.9 - 3 * DD_MM, abs=0.003)
    assert radius_mm[before] == pytest.approx(1.9 - DD_MM, abs=0.002)
    assert second.wall_gap_mm[within].max() < 1e-6
    # Narrower inside the first, the second is longer than alone.
    alone = deploy(SILK, artery, size=SIZE, landing=Landing(38.0, "distal"))
    assert second.stent.deployed_length_mm > alone.stent.deployed_length_mm + 0.05
    # Wires of the two devices do not touch: the inner face keeps the second's outermost wire off.
    points_mm = second.stent.wire_points_mm
    points_mm = points_mm[(points_mm[:, 2] > 33.0) & (points_mm[:, 2] < 37.5)]
    inner = Surface(inner_nodes_mm(first.stent).reshape(-1, 3), first.stent.contour.faces)
    off_mm = inner.closest(points_mm)[1]
    assert off_mm.min() > 0.5 * 0.03 - 0.002


def anatomy_of(path, outlet_mm=None):
    if path.name.endswith(".raw.gz"):  # the scan of 256 voxels cubed, whose edge is not stored
        vessel = segment(read_image(path, spacing_mm=0.43, shape=(256, 256, 256)))
    else:
        vessel = Vessel(repair(read_surface(path)[0])[0])
    return restore(trim(trace(vessel)), outlet_mm=outlet_mm)


@pytest.mark.validation
def test_across_a_bifurcation_a_device_goes_into_the_branch_that_is_asked_for(shared_data):
    path = shared_data / "bifurcation_with_sac.stl"
    ends = [opening.center_mm for opening in anatomy_of(path).vessel.outlets[:2]]
    for wanted, other in (ends, ends[::-1]):
        anatomy = anatomy_of(path, wanted)
        done = deploy(SILK, anatomy)
        assert measure(anatomy, done)["max_outside_mm"] <= 0.002
        assert done.terminated_fraction[-1] >= 0.99
        last_mm = done.stent.nodes_mm[-1].mean(axis=0)
        assert np.linalg.norm(last_mm - wanted) < np.linalg.norm(last_mm - other)


CASES = (
    "aneurisk_C0038.vtp",
    "aneurisk_beta.vtp",
    "visc2011_metres.stl",
    "bifurcation_with_sac.stl",
    "bifurcation_coarse.vtp",
    "siphon_dirty.stl",
    "philips_3dra_256.raw.gz",
)


@cache
def restored(path):
    return anatomy_of(path)


@pytest.mark.validation
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("design", [SILK, ENTERPRISE], ids=["silk", "enterprise"])
def test_in_real_arteries_every_node_lies_inside_and_the_ends_as_near_to_the_wall_as_the_middle(
    shared_data, case, design
):
    anatomy = restored(shared_data / case)
    done = deploy(design, anatomy)
    assert done.terminated_fraction[-1] >= 0.99
    # The landing surface is closed across sac and branches: what is not outside it is in neither.
    assert measure(anatomy, done)["max_outside_mm"] <= 0.002
    # A row that has its free perimeter, or whose artery is wider, touches where it can, and no more is asked of it.
    free_mm, axis = done.stent.size.free_diameter_mm, anatomy.parent.axis
    artery_mm = 2 * np.interp(done.stent.row_abscissa_mm, axis.abscissa_mm, anatomy.parent.section_radius_mm)
    is_free = (perimeters(done.stent.nodes_mm) > 0.99 * np.pi * free_mm) | (artery_mm > free_mm)
    gap_mm = np.where(is_free, 0.0, done.wall_gap_mm.max(axis=1))
    assert max(gap_mm[:3].max(), gap_mm[-3:].max()) <= max(0.002, gap_mm[3:-3].max())
    stretch = wire_stretches(done.stent)
    assert abs(stretch.mean()) < 0.005
    assert np.quantile(np.abs(stretch), 0.95) < (0.04 if design is SILK else 0.03)
