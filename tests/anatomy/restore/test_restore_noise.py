"""Neck, sac and parent artery hardly move where the wall's vertices are shaken."""

import numpy as np
import pytest

from vstent.anatomy.repair import repair
from vstent.anatomy.restore.axis import Tube, _fit, _Necks
from vstent.anatomy.restore.bulges import Bulge
from vstent.anatomy.restore.landing import Landing
from vstent.anatomy.restore.neck import MOUTH, apart_mm
from vstent.anatomy.restore.path import _width_beyond_fork
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.restore.tubes import Tubes
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Centerline, Vessel
from vstent.io.surfaces import read_surface
from vstent.kernels import smoothing
from vstent.kernels.arrays import Floats

NOISE_MM = 0.05


def _shaken(wall: Surface, kind: str, seed: int) -> Surface:
    """A wall whose vertices are moved by 0.05 mm (standard deviation), each by itself or in waves of some ten edges."""
    rng = np.random.default_rng(seed)
    n = len(wall.vertices_mm)
    if kind == "white":
        return Surface(wall.vertices_mm + rng.normal(0, NOISE_MM, (n, 3)), wall.faces)
    height = rng.normal(0, 1, n)
    for _ in range(8):
        height = smoothing.averaging(n, wall.faces) @ height
    return Surface(wall.vertices_mm + (NOISE_MM / height.std()) * height[:, None] * wall.vertex_normals, wall.faces)


def _anatomy(wall: Surface, outlet_mm: Floats | None = None) -> Anatomy:
    return restore(trim(trace(Vessel(wall))), outlet_mm=outlet_mm)


def known(short: str) -> pytest.MarkDecorator:
    """Mark a case that falls short of its bound, as the limits page states."""
    return pytest.mark.xfail(reason=short, strict=True, raises=AssertionError)


# What a tenth of a voxel does to necks. C0038 and beta have triangles of 0.15 to 0.2 mm, which white noise crumples.
@pytest.mark.validation
@pytest.mark.parametrize(
    ("name", "kinds", "volume", "area"),
    [
        ("visc2011_metres.stl", ("white", "smooth"), 0.05, 0.06),
        ("bifurcation_coarse.vtp", ("white",), 0.01, 0.02),
        pytest.param("siphon_dirty.stl", ("white",), 0.05, 0.08, marks=known("volume 8 to 11 %: a branch is lost")),
        ("aneurisk_C0038.vtp", ("smooth",), 0.05, 0.06),
        pytest.param("aneurisk_beta.vtp", ("smooth",), 0.05, 0.05, marks=known("neck 16 % with one of five seeds")),
    ],
)
def test_real_necks_and_sacs_stand_noise(
    shared_data, name: str, kinds: tuple[str, ...], volume: float, area: float
) -> None:
    wall = repair(read_surface(shared_data / name)[0])[0]
    anatomy = _anatomy(wall)
    still, outlet_mm = anatomy.aneurysms[0], anatomy.parent.axis.points_mm[-1]  # the challenge's fork is one of equals
    for kind in kinds:
        for seed in (1, 2, 3):
            moved = _anatomy(_shaken(wall, kind, seed), outlet_mm).aneurysms[0]
            print(name, kind, seed, moved.sac.volume_mm3, moved.neck.area_mm2)  # noqa: T201
            assert moved.sac.volume_mm3 == pytest.approx(still.sac.volume_mm3, rel=volume)
            assert moved.neck.area_mm2 == pytest.approx(still.neck.area_mm2, rel=area)


@pytest.mark.validation
@pytest.mark.parametrize("name", ["aneurisk_C0015_no_sac.vtp", "healthy_siphon.vtk"])
def test_noise_makes_no_sac(shared_data, name: str) -> None:
    wall = repair(read_surface(shared_data / name)[0])[0]
    for seed in (1, 2, 3):
        assert _anatomy(_shaken(wall, "smooth", seed)).aneurysms == ()


def test_a_branch_from_the_sac_is_cut_off_by_its_own_wall_at_its_mouth() -> None:
    z = np.linspace(0, 20, 81)
    artery = Landing(np.stack([0 * z, 0 * z, z], axis=1), np.full((81, 72), 2.0), np.zeros((81, 72), dtype=bool))
    x = np.array([3.0, 3.4, 5.0, 5.5, 6.5, 7.5])  # its root, its wall at the artery's, 0.4 mm, 2 mm from it, and beyond
    along_mm = np.array([0.0, 0.0, 0.0, 1.0, 1.5, 2.5])
    branch = Tubes(np.stack([x, 0 * x, 0 * x + 10], axis=1), np.ones(6))
    found = apart_mm([artery], branch, along_mm, 0.8)
    full_mm = 0.8 - MOUTH
    np.testing.assert_allclose(found, full_mm * np.array([0, 0.5, 1, 1, 0.5, 0]), atol=0.01)


def test_a_sac_does_not_make_the_branch_behind_it_the_wider_one() -> None:
    s = np.arange(0.0, 30.0, 0.1)
    turn = np.maximum(s - 10, 0.0)
    wide = np.where((s > 10) & (s < 18), 3.0, 1.2)  # its medial line runs through a sac
    behind_sac = Centerline(np.stack([turn, 0 * s, s - 0.3 * turn], axis=1), wide)
    onward = Centerline(np.stack([0 * s, 0 * s, s], axis=1), np.full(len(s), 1.5))
    off = wide < 2
    assert _width_beyond_fork(behind_sac, onward, off) == pytest.approx(1.2)
    assert _width_beyond_fork(onward, behind_sac, np.ones(len(s), dtype=bool)) == pytest.approx(1.5)


def test_a_sac_hangs_square_to_its_foot_wherever_its_dome_is() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    foot = np.stack([2 * np.cos(angle), 3 * np.sin(angle), 0 * angle], axis=1)
    for ring in (foot, foot[::-1]):
        sac = Bulge(foot + np.array([5.0, 0.0, 2.0]), ring, np.array([9.0, 0.0, 3.0]), 3.0)
        np.testing.assert_allclose(sac.inward, [0, 0, 1], atol=1e-12)


def test_across_a_neck_the_axis_goes_to_the_medial_line_and_into_it_stays() -> None:
    n, n_rays = 40, 48
    z = 0.25 * np.arange(n)
    medial = np.stack([0 * z, 0 * z, z], axis=1)
    points = medial + np.array([0.3, 0.4, 0.0])
    none = np.zeros((n, n_rays))
    for axis in (0, 1):
        across = np.eye(2)[axis] * np.ones((n, 1))
        oval = np.tile([2.0, 0.3, -0.2], (n, 1))
        necks = _Necks(Tube(points, oval), np.full(n, 10.0 * n_rays), none > 0, across)
        moved, fitted = _fit(none, none, necks, medial)
        direction = (moved - points).mean(axis=0)
        # A straight artery's normals are two directions square to z; the axis has moved along one of them only.
        assert np.linalg.norm(direction) == pytest.approx(abs(direction @ _normal(points, axis)), rel=1e-6)
        assert (moved - medial) @ _normal(points, axis) == pytest.approx(0.0, abs=1e-3)
        np.testing.assert_allclose(fitted[:, 0], 2.0, rtol=1e-6)
        # A circle counts for a five-hundredth of what the oval across a neck does.
        np.testing.assert_allclose(_oval_in_world(fitted, moved) * 1.002, _oval_in_world(oval, points), rtol=1e-6)


def _oval_in_world(oval: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Oval of a tube along z as a complex number of twice the angle from x."""
    first = Centerline(points, np.ones(len(points))).frames[:, 1]
    return (oval[:, 1] + 1j * oval[:, 2]) * np.exp(2j * np.arctan2(first[:, 1], first[:, 0]))


def _normal(points: np.ndarray, axis: int) -> np.ndarray:
    return Centerline(points, np.ones(len(points))).frames[0, 1 + axis]
