import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from told import place_in
from tubes import line, tube

from vstent import phantoms
from vstent.anatomy.repair import repair
from vstent.errors import InputError, VesselError
from vstent.geometry.surface import Surface
from vstent.io.surfaces import read_surface
from vstent.kernels import topology, triangles

ROWS, AROUND = 31, 32
SOUND = tube(line(15.0, 0.5), 2.0, 1.7, around=AROUND).parent.landing_surface
CUBE = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
CUBE_FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)


def is_sound(surface):
    """A connected, consistently outward manifold with boundary without degenerate faces."""
    edges = topology.edges_of(surface.faces)
    return (
        edges.n_uses.max() <= 2
        and not topology.clashing(surface.faces).any()
        and topology.face_components(surface.faces).max() == 0
        and len(topology.unzipped(surface.vertices_mm, surface.faces)[0]) == len(surface.vertices_mm)
        and topology.sound_faces(surface.faces).all()
        and capped_volume(surface) > 0
    )


def capped_volume(surface):
    vertices, faces = triangles.cap(surface.vertices_mm, surface.faces, surface.boundary_loops)
    return triangles.volume(vertices[faces])


def with_faces(surface, faces, vertices=()):
    return Surface(
        np.concatenate([surface.vertices_mm, np.reshape(vertices, (-1, 3))]),
        np.concatenate([surface.faces, np.reshape(faces, (-1, 3))]),
    )


def test_a_sound_surface_is_left_as_it_is():
    surface, notes = repair(SOUND)
    assert notes == ()
    np.testing.assert_array_equal(surface.vertices_mm, SOUND.vertices_mm)
    np.testing.assert_array_equal(surface.faces, SOUND.faces)


def test_triangle_soup_is_welded():
    surface, notes = repair(Surface(SOUND.corners_mm.reshape(-1, 3), np.arange(3 * len(SOUND.faces)).reshape(-1, 3)))
    assert len(surface.vertices_mm) == len(SOUND.vertices_mm)
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND))
    assert notes == (
        f"{3 * len(SOUND.faces) - len(SOUND.vertices_mm)} duplicate vertices merged (closer than 2e-05 mm).",
    )


def test_duplicate_and_degenerate_faces_are_dropped_and_counted():
    doubled = with_faces(SOUND, [*SOUND.faces[:5], *SOUND.faces[7:9, ::-1], [3, 3, 8], [5, 6, 5]])
    surface, notes = repair(doubled)
    assert notes == ("7 duplicate faces and 2 degenerate faces dropped.",)
    np.testing.assert_array_equal(surface.faces, SOUND.faces)


def test_inside_out_is_turned():
    surface, notes = repair(Surface(SOUND.vertices_mm, SOUND.faces[:, ::-1]))
    assert notes == ("The surface was inside out; all faces were reversed.",)
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND))


def test_faces_turned_at_random_agree_again():
    turned = np.random.default_rng(0).random(len(SOUND.faces)) < 0.4
    surface, notes = repair(Surface(SOUND.vertices_mm, np.where(turned[:, None], SOUND.faces[:, ::-1], SOUND.faces)))
    assert is_sound(surface)
    assert notes == (f"{turned.sum()} faces reoriented.",)


def test_the_one_face_that_disagrees_is_turned_even_if_it_is_the_first():
    faces = np.array(SOUND.faces)
    faces[0] = faces[0, ::-1]
    surface, notes = repair(Surface(SOUND.vertices_mm, faces))
    assert notes == ("1 face reoriented.",)
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND))


def triangulations(low, high):
    """Every triangulation of the polygon low..high, as lists of triangles."""
    if high - low < 2:
        return [[]]
    return [
        [(low, k, high), *left, *right]
        for k in range(low + 1, high)
        for left in triangulations(low, k)
        for right in triangulations(k, high)
    ]


@pytest.mark.parametrize("seed", range(6))
def test_least_area_is_the_least_of_all_triangulations(seed):
    rng = np.random.default_rng(seed)
    polygon = rng.normal(size=(7, 3))
    taken = np.zeros((7, 7), dtype=bool)
    for a, b in rng.choice(7, (seed, 2)):
        taken[a, b] = taken[b, a] = abs(a - b) not in (0, 1, 6)
    allowed = [
        t for t in triangulations(0, 6) if not any(taken[f[i], f[j]] for f in t for i, j in ((0, 1), (1, 2), (0, 2)))
    ]
    patch = topology.least_area(polygon, taken)
    assert (patch is None) == (not allowed)
    if allowed:
        best = min(triangles.areas(polygon[np.array(t)]).sum() for t in allowed)
        assert triangles.areas(polygon[patch]).sum() == pytest.approx(best)
        assert sorted(map(tuple, np.sort(patch, axis=1).tolist())) in [sorted(t) for t in allowed]


def test_a_polygon_without_a_free_chord_gets_no_patch():
    taken = np.zeros((4, 4), dtype=bool)
    taken[0, 2] = taken[2, 0] = taken[1, 3] = taken[3, 1] = True
    assert topology.least_area(np.random.default_rng(0).normal(size=(4, 3)), taken) is None


def test_membrane_across_the_lumen_is_dropped():
    ring = 15 * AROUND + np.arange(AROUND)
    center = len(SOUND.vertices_mm)
    membrane = np.stack([ring, np.roll(ring, -1), np.full(AROUND, center)], axis=1)
    surface, notes = repair(with_faces(SOUND, membrane, [0, 0, 7.5]))
    assert notes == (f"{AROUND} faces of sheets inside the lumen removed.",)
    np.testing.assert_array_equal(surface.faces, SOUND.faces)


def test_fin_is_dropped():
    surface, notes = repair(with_faces(SOUND, [AROUND, AROUND + 1, len(SOUND.vertices_mm)], [3.0, 0, 0.5]))
    assert notes == ("1 face of sheets inside the lumen removed.",)
    np.testing.assert_array_equal(surface.faces, SOUND.faces)


def test_loose_piece_is_dropped_and_its_size_told():
    other = Surface(SOUND.vertices_mm * 0.5 + [20.0, 9.0, 0], SOUND.faces)
    surface, notes = repair(with_faces(SOUND, other.faces + len(SOUND.vertices_mm), other.vertices_mm))
    np.testing.assert_array_equal(surface.faces, SOUND.faces)
    assert notes == (
        f"1 loose piece removed (80.0% of the area kept), the largest of them {other.area_mm2:.1f} mm2 about "
        "(20.0, 9.0, 3.8) mm; choose another piece by a point near it (--at).",
    )


def test_an_opening_that_looks_sideways_out_of_the_wall_is_told_with_its_place():
    wall = tube(line(15.0, 0.25), 2.0, 2.0, around=48).parent.landing_surface
    keep = np.linalg.norm(wall.corners_mm.mean(axis=1) - [2.0, 0, 7.5], axis=1) > 1.2
    surface, notes = repair(Surface(wall.vertices_mm, wall.faces[keep]))
    assert len(surface.boundary_loops) == 3
    (note,) = notes
    assert " mm faces sideways out of the wall. If no artery leaves there, close it in" in note
    np.testing.assert_allclose(place_in(note), [1.8, 0, 7.5], atol=0.25)


def test_a_sac_that_is_cut_open_is_closed():
    """The wall converges to an opening that is wider than both ends: that is no branch."""
    phantom = phantoms.with_sac(
        phantoms.tube(length_mm=30.0, radius_mm=1.5), abscissa_mm=15.0, width_mm=6.0, neck_mm=3.0
    )
    wall = phantoms.phantom_surface(phantom, edge_mm=0.3)
    dome_mm = wall.vertices_mm[np.argmax(np.linalg.norm(wall.vertices_mm[:, :2], axis=1))]
    outward = dome_mm * [1, 1, 0] / np.linalg.norm(dome_mm[:2])
    keep = (wall.corners_mm @ outward).max(axis=1) < dome_mm @ outward - 2.0
    surface, notes = repair(Surface(wall.vertices_mm, wall.faces[keep]))
    assert len(surface.boundary_loops) == 2
    (note,) = (note for note in notes if "a sac that is cut open" in note)
    np.testing.assert_allclose(place_in(note) @ outward, dome_mm @ outward - 2.0, atol=0.3)


def test_the_piece_at_a_point_is_kept_however_small_but_for_debris():
    other = Surface(SOUND.vertices_mm * 0.5 + [20.0, 0, 0], SOUND.faces)
    both = with_faces(SOUND, other.faces + len(SOUND.vertices_mm), other.vertices_mm)
    debris = with_faces(both, CUBE_FACES + len(both.vertices_mm), 0.1 * CUBE + [24.0, 0, 3.0])
    surface, notes = repair(debris, at_mm=np.array([23.9, 0, 3.0]))
    np.testing.assert_allclose(surface.vertices_mm, other.vertices_mm, atol=1e-9)
    assert (
        f"2 loose pieces removed (20.0% of the area kept), the largest of them {SOUND.area_mm2:.1f} mm2 about"
        in notes[0]
    )


def test_two_cubes_that_kiss_along_an_edge_part():
    second = CUBE + np.array([1.0, 1.0, 0.0])
    vertices, faces = topology.weld(np.concatenate([CUBE, second]), np.concatenate([CUBE_FACES, CUBE_FACES + 8]), 1e-6)
    assert len(vertices) == 14
    assert topology.edges_of(faces).n_uses.max() == 4
    vertices, faces = topology.unzipped(vertices, faces)
    label = topology.face_components(faces)
    assert len(np.unique(faces)) == len(vertices) == 16
    assert [triangles.volume(vertices[faces[label == k]]) for k in range(label.max() + 1)] == pytest.approx([1.0, 1.0])


def test_moebius_strip_is_cut_not_looped_over():
    n = 40
    a, b = np.arange(n), np.arange(n) + n
    a2, b2 = np.where(a == n - 1, n, a + 1), np.where(a == n - 1, 0, b + 1)  # the strip closes with a half turn
    faces = np.concatenate([np.stack([a, a2, b2], axis=1), np.stack([a, b2, b], axis=1)])
    turned, _ = topology.oriented(faces)
    assert 0 < topology.clashing(turned).sum() <= 4


@pytest.mark.parametrize("missing", [1, 2, 6])
def test_holes_in_the_wall_are_filled_and_the_ends_stay_open(missing):
    around_one_vertex = np.flatnonzero((SOUND.faces == 12 * AROUND + 5).any(axis=1))
    gone = around_one_vertex[:missing]
    surface, notes = repair(Surface(SOUND.vertices_mm, np.delete(SOUND.faces, gone, axis=0)))
    assert is_sound(surface)
    assert len(surface.boundary_loops) == 2
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND), rel=1e-3)
    assert notes[-1].startswith(("1 hole in the wall closed", "2 holes in the wall closed"))


def test_an_end_partly_closed_by_a_torn_cap_is_closed_again_or_left_open_but_sound():
    vertices, faces = triangles.cap(SOUND.vertices_mm, SOUND.faces, SOUND.boundary_loops[:1])
    torn = np.delete(faces, [len(faces) - 1, len(faces) - 2], axis=0)
    surface, _ = repair(Surface(vertices, torn))
    assert is_sound(surface)
    assert len(surface.boundary_loops) == 1
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND), rel=1e-6)


def test_nothing_left_is_told():
    with pytest.raises(VesselError, match="No surface is left"):
        repair(Surface(np.zeros((5, 3)), [[0, 1, 2], [1, 2, 3], [2, 3, 4], [0, 3, 4]]))


@settings(max_examples=25, deadline=10_000)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_gone=st.integers(0, 6),
    turned=st.floats(0, 0.5),
    n_twice=st.integers(0, 50),
    soup=st.booleans(),
)
def test_a_broken_surface_is_mended(seed, n_gone, turned, n_twice, soup):
    rng = np.random.default_rng(seed)
    faces = np.array(SOUND.faces)
    inner = np.flatnonzero(((faces >= 2 * AROUND) & (faces < (ROWS - 2) * AROUND)).all(axis=1))
    faces = np.delete(faces, rng.choice(inner, n_gone, replace=False), axis=0)
    faces = np.concatenate([faces, faces[rng.integers(0, len(faces), n_twice)], [[7, 7, 9]]])
    is_turned = rng.random(len(faces)) < turned
    faces[is_turned] = faces[is_turned, ::-1]
    faces = rng.permutation(faces)
    vertices = SOUND.vertices_mm
    if soup:
        vertices = vertices[faces].reshape(-1, 3) + rng.uniform(-1e-6, 1e-6, (3 * len(faces), 3))
        faces = np.arange(3 * len(faces)).reshape(-1, 3)
    surface, notes = repair(Surface(vertices, faces))
    assert is_sound(surface)
    assert len(surface.boundary_loops) == 2
    assert len(surface.faces) == pytest.approx(len(SOUND.faces), abs=3 * n_gone)
    assert capped_volume(surface) == pytest.approx(capped_volume(SOUND), rel=2e-3)
    assert notes
    again, nothing = repair(surface)
    assert nothing == ()
    np.testing.assert_array_equal(again.faces, surface.faces)


@settings(max_examples=60, deadline=10_000)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 60), k=st.integers(3, 25))
def test_any_heap_of_triangles_is_mended_or_refused(seed, n, k):
    rng = np.random.default_rng(seed)
    heap = Surface(rng.normal(size=(k, 3)), rng.integers(0, k, (n, 3)))
    surface = mended_or_none(heap)
    assert surface is None or topology.edges_of(surface.faces).n_uses.max() <= 2


def mended_or_none(surface):
    try:
        return repair(surface)[0]
    except InputError:
        return None


@pytest.mark.parametrize(
    ("name", "n_loops", "words"),
    [
        ("aneurisk_C0038.vtp", 9, ""),
        ("aneurisk_beta.vtp", 6, ""),
        ("aneurisk_C0015_no_sac.vtp", 3, "6 degenerate faces"),
        ("visc2011_metres.stl", 1, "holes in the wall closed"),
        ("siphon_dirty.stl", 0, "5673 duplicate faces dropped.|1125 faces of sheets inside the lumen removed."),
        ("healthy_siphon.vtk", 4, "inside out"),
        ("bifurcation_coarse.vtp", 0, "1613 faces reoriented"),
        ("bifurcation_with_sac.stl", 3, ""),
    ],
)
def test_real_surfaces(shared_data, name, n_loops, words):
    surface, notes = repair(read_surface(shared_data / name)[0])
    assert is_sound(surface)
    assert len(surface.boundary_loops) == n_loops
    assert all(word in " ".join(notes) for word in words.split("|"))
    assert bool(words) == bool(notes)
