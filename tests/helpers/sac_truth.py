"""Arteries with a glued sac of known neck and volume: tests assert what is found of them, the benchmark prints it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.segment import segment
from vstent.anatomy.trace import trace
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.surfaces import read_surface
from vstent.kernels import curves
from vstent.phantoms import Phantom, Sac, Scanner, torus_arc, tube, with_branch, with_sac


def _inside(angle_rad: float) -> np.ndarray:
    return -np.array([np.cos(angle_rad), 0.0, np.sin(angle_rad)])


def with_bleb(phantom: Phantom, *, direction: np.ndarray, radius_mm: float = 1.2) -> Phantom:
    """Return a phantom with a round daughter sac, half of which protrudes from its sac in a direction (3,)."""
    assert phantom.sac is not None
    unit = direction / np.linalg.norm(direction)
    level, _ = phantom.sac.implicit_mm(phantom.sac.center_mm + unit[None] * phantom.sac.reach_mm)
    center = phantom.sac.center_mm + (phantom.sac.reach_mm - level[0]) * unit
    return replace(phantom, blebs=(*phantom.blebs, Sac(center, unit, radius_mm, radius_mm)))


def neck_center_mm(phantom: Phantom) -> np.ndarray:
    """The point (3,) of the parent artery's wall under the center of the sac."""
    assert phantom.sac is not None
    abscissa_mm = phantom.parent.nearest_abscissa_mm(phantom.sac.center_mm[None])
    foot_mm = phantom.parent.at(abscissa_mm)[0]
    outward = (phantom.sac.center_mm - foot_mm) / np.linalg.norm(phantom.sac.center_mm - foot_mm)
    return foot_mm + np.interp(abscissa_mm[0], phantom.parent.abscissa_mm, phantom.parent.inscribed_radius_mm) * outward


X = np.array([1.0, 0.0, 0.0])
GLUED: dict[str, Callable[[], Phantom]] = {
    "straight": lambda: with_sac(tube(length_mm=40), abscissa_mm=20),
    "tapered": lambda: with_sac(tube(length_mm=40, radius_mm=2.3, end_radius_mm=1.6), abscissa_mm=20),
    "outside of a bend": lambda: with_sac(torus_arc(bend_radius_mm=9.0), abscissa_mm=14),
    "inside of a bend": lambda: with_sac(torus_arc(bend_radius_mm=9.0), abscissa_mm=14, direction=_inside(14 / 9)),
    "wide on the inside of a bend": lambda: with_sac(
        torus_arc(bend_radius_mm=9.0), abscissa_mm=14, neck_mm=6.8, direction=_inside(14 / 9)
    ),
    "beside a branch": lambda: with_branch(
        with_sac(tube(length_mm=40), abscissa_mm=20, direction=X), abscissa_mm=24, direction=np.array([1.0, 0.3, 0.5])
    ),
    "touching a branch": lambda: with_branch(
        with_sac(tube(length_mm=40), abscissa_mm=20, direction=X), abscissa_mm=24.5, direction=X
    ),
    "neck of 2 diameters": lambda: with_sac(tube(length_mm=40), abscissa_mm=20, width_mm=10, neck_mm=8),
    "sac of 3 diameters": lambda: with_sac(tube(length_mm=44), abscissa_mm=22, width_mm=12, neck_mm=5),
    "half a sphere": lambda: with_sac(tube(length_mm=40), abscissa_mm=20, width_mm=5.6, neck_mm=5.5),
    "tall": lambda: with_sac(tube(length_mm=40), abscissa_mm=20, width_mm=5, neck_mm=3, elongation=1.8),
    "small": lambda: with_sac(tube(length_mm=40), abscissa_mm=20, width_mm=4, neck_mm=2.8),
    "blebs": lambda: with_bleb(
        with_bleb(with_sac(tube(length_mm=40), abscissa_mm=20, direction=X), direction=np.array([0.2, 1.0, 0.3])),
        direction=np.array([1.0, -0.3, 0.9]),
        radius_mm=1.6,
    ),
    "demo": phantoms.demo_phantom,
}
"""The table of glued sacs."""


def anatomy_of(phantom: phantoms.Phantom) -> Anatomy:
    return restore(trace(Vessel(phantoms.phantom_surface(phantom))))


def scanned_anatomy_of(phantom: phantoms.Phantom, voxel_mm: float, seed: int = 1) -> Anatomy:
    scanner = Scanner(voxel_mm=voxel_mm, blur_mm=0.8 * voxel_mm)
    return restore(trace(segment(phantoms.scan(phantom, np.random.default_rng(seed), scanner=scanner))))


def relative_errors(anatomy: Anatomy, phantom: phantoms.Phantom) -> tuple[np.ndarray, np.ndarray]:
    """Radius error (fraction) of the landing surface's sections, and distance (mm) of its vertices to the true wall."""
    axis = anatomy.parent.axis
    first_mm, last_mm = anatomy.parent.own_mm
    inner = (axis.abscissa_mm > first_mm + 3) & (axis.abscissa_mm < last_mm - 3)
    place = curves.project(phantom.parent.points_mm, axis.points_mm[inner])[0]
    true_mm = np.interp(place, phantom.parent.abscissa_mm, phantom.parent.inscribed_radius_mm)
    rings = anatomy.parent.landing_surface.vertices_mm.reshape(len(axis.points_mm), -1, 3)[inner].reshape(-1, 3)
    wall = phantoms.tube_implicit_mm(phantom.parent, rings)[0]
    return anatomy.parent.section_radius_mm[inner] / true_mm - 1, np.abs(wall)


def beside_the_fork_without_sac(data: Path, side: float) -> tuple[Anatomy, Anatomy, np.ndarray, np.ndarray]:
    """The idealised fork with its sac and without it, restored into one branch (+1 or -1 along x).

    Also the errors of the section's radius (sections,), relative, and the distances of the landing surface (n,), mm.
    """
    sick, healthy = (
        restore(
            trace(Vessel(read_surface(data / f"bifurcation_{name}_sac.stl")[0])),
            outlet_mm=np.array([7.5 * side, 0, 10]),
        )
        for name in ("with", "without")
    )
    axis = sick.parent.axis
    first_mm, last_mm = sick.parent.own_mm
    inner = (axis.abscissa_mm > first_mm + 1.5) & (axis.abscissa_mm < last_mm - 1.5)
    place = curves.project(healthy.parent.axis.points_mm, axis.points_mm[inner])[0]
    radius_mm = np.interp(place, healthy.parent.axis.abscissa_mm, healthy.parent.section_radius_mm)
    rings_mm = sick.parent.landing_surface.vertices_mm.reshape(len(axis.points_mm), -1, 3)[inner].reshape(-1, 3)
    distance_mm = healthy.parent.landing_surface.closest(rings_mm)[1]
    return sick, healthy, sick.parent.section_radius_mm[inner] / radius_mm - 1, distance_mm


def moved_mm(anatomy: Anatomy) -> float:
    """Largest distance from the lumen of what the landing surface keeps of it."""
    own_mm = anatomy.parent.landing_surface.vertices_mm[~anatomy.parent.is_restored & ~anatomy.parent.is_continued]
    return float(anatomy.vessel.lumen.closest(own_mm)[1].max())
