"""Shape indices of sacs whose volume and area are known."""

from dataclasses import replace

import numpy as np
import pytest
from tubes import line, tube

from vstent.anatomy.morphology import beyond_plane, morphology, shape_indices
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Aneurysm

CONSTANT = (18 * np.pi) ** (1 / 3)
UP, CENTER_MM = np.array([0.0, 0.0, 1.0]), np.array([1.9, 0.0, 15.0])


def turned(radius_mm, height_mm, turns=180):
    """A sac of revolution about z, its neck a disc at height 0: radii and heights (k,) from the neck to the tip."""
    angle = 2 * np.pi * np.arange(turns) / turns
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rings = np.asarray(radius_mm)[:-1, None, None] * ring + np.asarray(height_mm)[:-1, None, None] * UP
    vertices = np.concatenate([rings.reshape(-1, 3), [height_mm[-1] * UP, 0 * UP]])
    here, there = np.arange(turns), np.roll(np.arange(turns), -1)
    top, bottom, faces = len(vertices) - 2, len(vertices) - 1, []
    for k in range(len(radius_mm) - 2):
        a, b, c, d = (x + (k + up) * turns for up in (0, 1) for x in (here, there))
        faces += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    last = (len(radius_mm) - 2) * turns
    faces.append(np.stack([here + last, there + last, np.full(turns, top)], axis=1))
    disc = np.stack([there, here, np.full(turns, bottom)], axis=1)
    sac = Surface(vertices, np.concatenate([*faces, disc]))
    return Aneurysm(sac, Surface(vertices, disc[:, ::-1]), vertices[:turns])


def half_ellipsoid(a_mm, c_mm, rings=120):
    """Half of an ellipsoid of revolution with half-axes a (across) and c (along)."""
    polar = np.linspace(np.pi / 2, 0, rings)
    return turned(a_mm * np.sin(polar), c_mm * np.cos(polar))


def indices(sac, center_mm=0 * UP, normal=UP):
    return shape_indices(beyond_plane(sac, center_mm, normal), normal)


def test_all_indices_of_a_half_sphere_are_zero():
    assert indices(half_ellipsoid(3.0, 3.0)) == pytest.approx(
        dict.fromkeys(("undulation_index", "ellipticity_index", "nonsphericity_index"), 0.0), abs=1e-3
    )


@pytest.mark.parametrize("c_mm", [1.5, 4.0, 9.0])
def test_a_half_ellipsoid_is_not_undulated_but_elliptic(c_mm):
    a_mm = 3.0
    wall_mm2 = np.pi * a_mm**2  # half of Thomsen's exact area of a spheroid
    if c_mm > a_mm:
        e = np.sqrt(1 - (a_mm / c_mm) ** 2)
        wall_mm2 *= 1 + c_mm / (a_mm * e) * np.arcsin(e)
    else:
        e = np.sqrt(1 - (c_mm / a_mm) ** 2)
        wall_mm2 *= 1 + (1 - e**2) / e * np.arctanh(e)
    expected = 1 - CONSTANT * (2 / 3 * np.pi * a_mm**2 * c_mm) ** (2 / 3) / wall_mm2
    found = indices(half_ellipsoid(a_mm, c_mm))
    assert found["undulation_index"] == pytest.approx(0.0, abs=1e-9)
    assert found["ellipticity_index"] == pytest.approx(expected, abs=1e-3)
    assert found["nonsphericity_index"] == pytest.approx(expected, abs=1e-3)


def test_a_waist_is_undulation():
    """Cylinder, waist and cap of cones: volumes and areas of frusta; the hull bridges the waist."""
    radius_mm, height_mm = np.array([2.0, 2.0, 1.0, 2.0, 0.0]), np.array([0.0, 2.0, 3.0, 4.0, 5.0])

    def solid(r, z):
        flank = np.hypot(np.diff(r), np.diff(z))
        volume = np.pi / 3 * (np.diff(z) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)).sum()
        return volume, np.pi * ((r[1:] + r[:-1]) * flank).sum()

    volume_mm3, wall_mm2 = solid(radius_mm, height_mm)
    hull_mm3, hull_mm2 = solid(radius_mm[[0, 3, 4]], height_mm[[0, 3, 4]])
    found = indices(turned(radius_mm, height_mm))
    assert found["undulation_index"] == pytest.approx(1 - volume_mm3 / hull_mm3, abs=1e-3)
    assert found["ellipticity_index"] == pytest.approx(1 - CONSTANT * hull_mm3 ** (2 / 3) / hull_mm2, abs=1e-3)
    assert found["nonsphericity_index"] == pytest.approx(1 - CONSTANT * volume_mm3 ** (2 / 3) / wall_mm2, abs=1e-3)


def test_indices_do_not_depend_on_size_or_position():
    sac = half_ellipsoid(2.0, 5.0, rings=40)
    rotation = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)

    def moved(points_mm):
        return 3.7 * points_mm @ rotation.T + [10.0, -4.0, 7.0]

    other = replace(
        sac,
        sac=Surface(moved(sac.sac.vertices_mm), sac.sac.faces),
        neck=Surface(moved(sac.neck.vertices_mm), sac.neck.faces),
    )
    assert indices(other, moved(0 * UP), rotation @ UP) == pytest.approx(indices(sac), abs=1e-9)


@pytest.mark.parametrize("lean_rad", [-0.5, 0.0, 0.7])
def test_the_inflow_angle_grows_with_the_lean_downstream(lean_rad):
    """A slender sac on the +x side of an artery along z, leaning with the flow."""
    sac = half_ellipsoid(1.5, 6.0, rings=40)
    points_mm = sac.sac.vertices_mm[:, [2, 0, 1]]  # z becomes x
    points_mm = points_mm + np.tan(lean_rad) * points_mm[:, :1] * UP + CENTER_MM
    leaning = replace(
        sac,
        sac=Surface(points_mm, sac.sac.faces),
        neck=Surface(points_mm, sac.neck.faces),
        neck_mm=points_mm[: len(sac.neck_mm)],
    )
    found = morphology(replace(tube(line(32), 1.9), aneurysms=(leaning,)))
    # The farthest point of the dome is not quite its tip.
    assert found["inflow_angle_rad"] == pytest.approx(np.pi / 2 + lean_rad, abs=0.03)
