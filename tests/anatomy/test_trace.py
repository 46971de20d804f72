"""Openings and centerlines on vessels with a known axis."""

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from shapes import sphere

from vstent import phantoms
from vstent.anatomy.morphology import morphology
from vstent.anatomy.openings import open_ends, opening_at
from vstent.anatomy.repair import repair
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.short_cuts import along_arms
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import InputError, VesselError
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.kernels import curves, triangles
from vstent.kernels.medial import Medial, cost_graph, path_to, shortest_paths


def traced(phantom: phantoms.Phantom) -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantom)))


@pytest.fixture(scope="module")
def torus() -> Vessel:
    return traced(phantoms.torus_arc())


@pytest.fixture(scope="module")
def fork() -> Vessel:
    return traced(phantoms.bifurcation())


@pytest.fixture(scope="module")
def compiled(fork: Vessel) -> Anatomy:
    """Everything that is compiled on first use, so that the time for it counts on no example."""
    return restore(trim(fork))


def test_centerline_and_inscribed_radius_of_a_torus(torus: Vessel) -> None:
    line = torus.centerlines[0]
    inner = (line.abscissa_mm > 2) & (line.abscissa_mm < line.length_mm - 2)
    points = line.points_mm[inner]
    from_axis = np.hypot(np.hypot(points[:, 0], points[:, 2]) - 8.0, points[:, 1])
    assert from_axis.mean() < 0.001
    assert from_axis.max() < 0.003
    assert np.abs(line.inscribed_radius_mm[inner] - 2.0).mean() < 0.001
    assert abs(line.length_mm - 8 * np.pi) < 0.1


def test_openings_have_the_areas_and_directions_of_the_ends(fork: Vessel) -> None:
    phantom = phantoms.bifurcation()
    for opening, (center, normal, radius) in zip([fork.inlet, *fork.outlets], _by_opening(fork, phantom), strict=True):
        np.testing.assert_allclose(opening.area_mm2, np.pi * radius**2, rtol=0.02)
        np.testing.assert_allclose(opening.center_mm, center, atol=0.05)
        assert opening.normal @ normal > 0.999
    assert fork.inlet.area_mm2 > fork.outlets[0].area_mm2


def _by_opening(vessel: Vessel, phantom: phantoms.Phantom) -> list:
    ends = phantom.ends
    return [min(ends, key=lambda e: np.linalg.norm(e[0] - o.center_mm)) for o in [vessel.inlet, *vessel.outlets]]


def test_every_outlet_is_reached_along_the_axis_of_its_branch(fork: Vessel) -> None:
    for line, opening in zip(fork.centerlines, fork.outlets, strict=True):
        np.testing.assert_allclose(line.points_mm[-1], opening.center_mm, atol=1e-3)
        np.testing.assert_allclose(line.points_mm[0], fork.inlet.center_mm, atol=1e-3)
        axis = phantoms.bifurcation().parent.points_mm * [np.sign(opening.center_mm[0]), 1, 1]
        # At the fork the inscribed spheres widen and the medial axis is no longer either tube's: legs only.
        leg = line.points_mm[line.abscissa_mm > 17]
        assert curves.project(axis, leg)[1].mean() < 0.03


def test_rigid_motion_moves_the_centerline(torus: Vessel) -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([30.0, -20.0, 7.0])
    moved = trace(
        Vessel(Surface(torus.lumen.vertices_mm @ turn.T + shift, torus.lumen.faces)),
        inlet_mm=(turn @ torus.inlet.center_mm + shift),
    )
    there = torus.centerlines[0].points_mm @ turn.T + shift
    assert curves.project(there, moved.centerlines[0].points_mm)[1].max() < 0.02


@pytest.mark.parametrize("crotch", ["a sac", "joined walls"])
def test_a_fork_has_the_same_lines_from_any_of_its_ends(crotch: str) -> None:
    phantom = phantoms.bifurcation(
        radius_mm=1.65, daughter_radius_mm=1.3, half_angle_rad=0.6 if crotch == "a sac" else 0.35
    )
    if crotch == "a sac":
        phantom = replace(phantom, sac=phantoms.Sac(np.array([0.0, 0.4, 16.5]), np.array([0.0, 0.0, 1.0]), 2.6, 2.6))
    wall = Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))
    trunk, *arms = (trace(wall, inlet_mm=end[0]).centerlines for end in phantom.ends)
    for line in (line for lines in arms for line in lines):
        off_mm = np.min([curves.project(other.points_mm, line.points_mm)[1] for other in trunk], axis=0)
        assert off_mm.max() < 0.05  # 2.8 and 0.9 mm through the crotch


def ring_of_arteries(*, is_filled: bool) -> Medial:
    """Spheres along the sides of a triangle, one of them thin, and along an arm at each corner; or with its middle."""
    sides = np.array([[np.cos(turn), np.sin(turn), 0.0] for turn in np.pi * np.array([0.5, 7 / 6, 11 / 6])])
    share = np.linspace(0.0, 1.0, 80, endpoint=False)[:, None]
    corners = 5.0 * sides
    limbs = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    arms = [corner * (1.0 + share) for corner in corners]
    radius = np.full(480, 1.3)
    radius[161:240] = 0.8
    loop, along = np.arange(240), np.arange(240).reshape(3, 80) + 240
    edges = [np.stack([loop, np.roll(loop, -1)], axis=1)]
    edges += [np.stack([np.append(80 * k, row[1:-1]), row[1:]], axis=1) for k, row in enumerate(along)]
    middle = np.random.default_rng(0).uniform(-4.0, 4.0, (900 * is_filled, 3)) * [1.0, 1.0, 0.0]
    points = np.concatenate([*limbs, *arms, middle])
    return Medial(points, np.append(radius, np.ones(len(middle))), np.concatenate(edges).astype(np.int32))


@pytest.mark.parametrize("is_filled", [True, False])
def test_a_path_leaves_a_thin_limb_for_two_wide_ones_in_a_fork_and_not_in_a_ring(is_filled: bool) -> None:
    graph = ring_of_arteries(is_filled=is_filled)
    cap_mm = np.full(len(graph.radius), np.inf)
    inlet, *outlets = 319, 399, 479
    _, before = shortest_paths(cost_graph(graph, cap_mm), inlet)
    wide, thin = paths = [path_to(before, outlet) for outlet in outlets]
    assert 200 in thin
    led = along_arms(graph, paths, cap_mm)
    np.testing.assert_array_equal(led[0], wide)
    assert (80 in led[1]) == is_filled
    assert (200 in led[1]) != is_filled


def test_flat_caps_are_taken_off() -> None:
    phantom = phantoms.tube(end_radius_mm=1.5)
    opened = Vessel(phantoms.phantom_surface(phantom))
    capped = open_ends(Vessel(opened.closed))[0]
    assert [o.role for o in capped.openings] == ["inlet", "outlet_1"]
    np.testing.assert_allclose([o.diameter_mm for o in capped.openings], [4.0, 3.0], rtol=0.01)


def test_a_blind_arm_is_opened_and_a_sac_is_not() -> None:
    phantom = phantoms.with_sac(phantoms.torus_arc(), abscissa_mm=12.0)
    vessel = Vessel(phantoms.phantom_surface(phantom))
    outlet = vessel.lumen.boundary_loops[1]
    dome = _domed(vessel, outlet)
    assert len(dome.boundary_loops) == 1
    opened, _ = open_ends(Vessel(dome))
    assert len(opened.openings) == 2
    np.testing.assert_allclose(opened.outlets[0].diameter_mm, 4.0, rtol=0.05)


def test_a_blind_arm_with_a_stenosis_at_its_origin_is_opened() -> None:
    trunk = phantoms.tube(length_mm=28.0)
    direction = np.array([1.0, 0.0, 1.0])
    branched = phantoms.with_branch(trunk, abscissa_mm=8.0, direction=direction, radius_mm=1.3, length_mm=24.0)
    branch = branched.branches[0]
    narrow = 1.3 - 0.65 * np.exp(-(((branch.abscissa_mm - 7.0) / 2.0) ** 2))
    vessel = Vessel(
        phantoms.phantom_surface(replace(branched, branches=(replace(branch, inscribed_radius_mm=narrow),)))
    )
    ends_mm = [triangles.polygon_centroid(vessel.lumen.vertices_mm[loop]) for loop in vessel.lumen.boundary_loops]
    of_branch = int(np.linalg.norm(ends_mm - branch.points_mm[-1], axis=1).argmin())
    opened, _ = open_ends(Vessel(_domed(vessel, vessel.lumen.boundary_loops[of_branch])))
    assert [round(o.diameter_mm, 1) for o in opened.openings] == [4.0, 4.0, 2.6]


@pytest.mark.parametrize("elongation", [1.0, 1.8])
def test_stumps_are_opened_where_blood_has_no_other_way_in_and_out_and_a_sac_is_not(elongation: float) -> None:
    short = phantoms.with_sac(phantoms.tube(length_mm=16.0), abscissa_mm=8.0, elongation=elongation)
    dome = Vessel(phantoms.phantom_surface(short)).lumen
    for _ in range(2):
        dome = _domed(Vessel(dome), dome.boundary_loops[0])
    opened, _ = open_ends(Vessel(dome))
    assert len(opened.openings) == 2
    np.testing.assert_allclose([o.diameter_mm for o in opened.openings], 4.0, rtol=0.03)
    along = opened.inlet.center_mm - opened.outlets[0].center_mm
    assert np.abs(along @ short.parent.points_mm[-1]) / 16.0 == pytest.approx(np.linalg.norm(along), rel=1e-3)


def _domed(vessel: Vessel, loop: np.ndarray) -> Surface:
    """Close one opening by a half sphere, as a scan shows a vessel whose contrast ends."""
    points = vessel.lumen.vertices_mm
    center, outward = triangles.polygon_centroid(points[loop]), -triangles.polygon_area_vector(points[loop])
    outward = outward / np.linalg.norm(outward)
    rings, vertices, faces = [loop], [points], [vessel.lumen.faces]
    for angle in np.linspace(0, np.pi / 2, 9)[1:-1]:
        ring = center + np.cos(angle) * (points[loop] - center) + 2.0 * np.sin(angle) * outward
        rings.append(np.arange(len(loop)) + sum(map(len, vertices)))
        vertices.append(ring)
    vertices.append((center + 2.0 * outward)[None])
    tip = sum(map(len, vertices)) - 1
    for low, high in pairwise(rings):
        n_low, n_high = np.roll(low, -1), np.roll(high, -1)
        faces += [np.stack([n_low, low, high], 1), np.stack([n_low, high, n_high], 1)]
    faces.append(np.stack([np.roll(rings[-1], -1), rings[-1], np.full(len(loop), tip)], 1))
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def test_a_thin_branch_with_a_coarse_cap_is_opened() -> None:
    capped = phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.8).closed
    assert len(open_ends(Vessel(repair(capped)[0]))[0].outlets) == 2


def test_a_sphere_has_no_way_in() -> None:
    with pytest.raises(VesselError, match=r"near .* has \d openings.*be bone: choose a point in the artery \(--at\)"):
        open_ends(Vessel(sphere(3.0)))


def test_the_inlet_can_be_chosen(fork: Vessel) -> None:
    chosen = trace(replace(fork, centerlines=()), inlet_mm=fork.outlets[1].center_mm)
    np.testing.assert_array_equal(chosen.inlet.center_mm, fork.outlets[1].center_mm)
    assert chosen.outlets[0].area_mm2 == fork.inlet.area_mm2


def test_a_point_far_from_every_opening_chooses_none(fork: Vessel) -> None:
    untraced, outlet = replace(fork, centerlines=()), fork.outlets[1]
    reach_mm = max(5.0, 2 * outlet.diameter_mm)
    near, far = (outlet.center_mm + factor * reach_mm * outlet.normal for factor in (0.99, 1.01))
    assert opening_at(untraced, near) is outlet
    with pytest.raises(InputError, match="mm away"):
        trace(untraced, inlet_mm=far)
    within = fork.centerlines[1].points_mm[-len(fork.centerlines[1].points_mm) // 3]
    assert np.linalg.norm(within - outlet.center_mm) > reach_mm
    assert opening_at(untraced, within) is outlet
    assert "mm from the given point" in trace(untraced, inlet_mm=within).notes[-1]
    assert trace(untraced, inlet_mm=near).notes == untraced.notes


@pytest.mark.parametrize(("daughter_radius_mm", "is_told"), [(1.45, True), (1.35, False)])
def test_an_outlet_nearly_as_wide_as_the_inlet_is_told_once_with_both_places(
    daughter_radius_mm: float, is_told: bool
) -> None:
    untraced = Vessel(phantoms.phantom_surface(phantoms.bifurcation(daughter_radius_mm=daughter_radius_mm)))
    vessel = trace(untraced)
    told = [note for note in vessel.notes if "because it is the widest opening" in note]
    assert len(told) == is_told
    assert not any(
        "because it is the widest opening" in note for note in trace(untraced, inlet_mm=vessel.inlet.center_mm).notes
    )
    for note in told:
        places = [[float(x) for x in place.split(")")[0].split(",")] for place in note.split("at (")[1:]]
        np.testing.assert_allclose(places, [vessel.inlet.center_mm, vessel.outlets[0].center_mm], atol=0.05)
        widths = [float(width.split()[-1]) for width in note.split(" mm wide")[:-1]]
        np.testing.assert_allclose(widths, [vessel.inlet.diameter_mm, vessel.outlets[0].diameter_mm], atol=0.05)


def test_a_guess_of_the_inlet_is_not_made_anew_by_trimming() -> None:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=40.0), abscissa_mm=20.0, width_mm=5.0, neck_mm=3.5)
    whole = trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35)))
    trimmed = trim(whole, upstream_mm=10.0, downstream_mm=10.0)
    assert [note for note in trimmed.notes if "because it is the widest opening" in note] == [whole.notes[-1]]


def test_the_band_of_the_threshold_is_carried_to_the_measures() -> None:
    image = phantoms.scan(phantoms.siphon(), np.random.default_rng(0), scanner=phantoms.Scanner(0.4, 0.3))
    scanned = segment(image)
    anatomy = restore(trim(trace(scanned)))
    assert anatomy.vessel.threshold_band_mm == scanned.threshold_band_mm > 0.02
    assert morphology(anatomy)["diameter_threshold_band_mm"] == scanned.threshold_band_mm


def _differences(found: Vessel, expected: Vessel) -> tuple[float, float]:
    """Largest distance and largest difference of radius between the lines of two vessels."""
    far, wide = [], []
    for line, other in zip(found.centerlines, expected.centerlines, strict=True):
        place, distance = curves.project(other.points_mm, line.points_mm)
        far.append(distance.max())
        there = np.interp(place, other.abscissa_mm, other.inscribed_radius_mm)
        wide.append(np.abs(there - line.inscribed_radius_mm).max())
    return max(far), max(wide)


@settings(max_examples=6, deadline=20_000)
@given(seed=st.integers(0, 2**32 - 1), is_mirrored=st.booleans())
def test_motion_mirror_and_order_of_the_triangles_do_not_matter(fork: Vessel, seed: int, is_mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    motion = Rotation.random(random_state=seed).as_matrix() * ([-1, 1, 1] if is_mirrored else [1, 1, 1])
    shift = rng.normal(0, 50, 3)
    order = rng.permutation(len(fork.lumen.vertices_mm))
    faces = np.argsort(order)[rng.permutation(fork.lumen.faces)]
    faces = np.take_along_axis(faces, (rng.integers(0, 3, (len(faces), 1)) + np.arange(3)) % 3, axis=1)
    moved = Surface(fork.lumen.vertices_mm[order] @ motion.T + shift, faces[:, ::-1] if is_mirrored else faces)
    outlets = [motion @ o.center_mm + shift for o in fork.outlets]
    found = trace(Vessel(moved), inlet_mm=motion @ fork.inlet.center_mm + shift)
    lines = sorted(found.centerlines, key=lambda line: np.linalg.norm(line.points_mm[-1] - outlets[0]))
    back = [replace(line, points_mm=(line.points_mm - shift) @ motion) for line in lines]
    far_mm, wide_mm = _differences(replace(found, centerlines=tuple(back)), fork)
    assert far_mm < 0.02
    assert wide_mm < 0.01


def test_a_finer_mesh_gives_the_same_centerlines(fork: Vessel) -> None:
    finer = trace(Vessel(phantoms.phantom_surface(phantoms.bifurcation(), edge_mm=0.15)), inlet_mm=fork.inlet.center_mm)
    far_mm, wide_mm = _differences(finer, fork)
    assert far_mm < 0.02
    assert wide_mm < 0.01


@settings(max_examples=40, deadline=10_000)
@example(seed=2878, n=4, n_gone=0, squash=0.01)  # a splinter in which no sphere fits
@example(seed=3, n=46, n_gone=3, squash=1)  # the axis of its "artery" ran 40 mm away
@given(
    seed=st.integers(0, 2**32 - 1), n=st.integers(4, 50), n_gone=st.integers(0, 6), squash=st.sampled_from([0.01, 1, 9])
)
@pytest.mark.usefixtures("compiled")
def test_any_blob_is_restored_or_refused(seed: int, n: int, n_gone: int, squash: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * [1, 1, squash]
    faces = rng.permutation(ConvexHull(points).simplices)[n_gone:]
    with suppress(InputError):
        vessel = trace(Vessel(repair(Surface(points, faces))[0]))
        assert len(vessel.centerlines) == len(vessel.outlets)
        assert len(restore(trim(vessel)).parent.landing_surface.boundary_loops) == 2


def test_a_lens_of_two_flat_sides_is_no_vessel() -> None:
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    lens = np.concatenate([rim, [[0, 0, 0.05], [0, 0, -0.05]]])
    with pytest.raises(VesselError, match="flat sides"):
        trace(Vessel(repair(Surface(lens, ConvexHull(lens).simplices))[0]))


def test_a_branch_too_narrow_on_its_way_is_not_taken_for_a_blind_one() -> None:
    direction = np.array([1.0, 0.0, 1.2])
    trunk = phantoms.tube(length_mm=28.0)
    branched = phantoms.with_branch(trunk, abscissa_mm=8.0, direction=direction, radius_mm=0.6, length_mm=22.0)
    branch = branched.branches[0]
    narrow = 0.6 - 0.25 * np.exp(-(((branch.abscissa_mm - 17.0) / 1.5) ** 2))
    phantom = replace(branched, branches=(replace(branch, inscribed_radius_mm=narrow),))
    vessel = traced(phantom)
    assert [round(o.diameter_mm, 1) for o in vessel.outlets] == [4.0, 1.2]
    np.testing.assert_allclose(vessel.outlets[1].center_mm, branch.points_mm[-1], atol=0.05)
    assert vessel.centerlines[1].inscribed_radius_mm.min() == pytest.approx(0.35, abs=0.03)  # in chords of 0.25 mm
