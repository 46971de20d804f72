"""Analytic arteries for the tests: a tube round any smooth axis with any section."""

from dataclasses import replace

import numpy as np

from vstent.devices.stent import tube_faces
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Aneurysm, Centerline, Opening, Path, Vessel


def line(length_mm, step_mm=0.2):
    z = np.linspace(0.0, length_mm, round(length_mm / step_mm) + 1)
    return np.stack([0 * z, 0 * z, z], axis=1), np.broadcast_to(np.eye(3)[[2, 0, 1]], (len(z), 3, 3))


def arc(bend_radius_mm, turn_rad, straight_mm=8.0, step_mm=0.2):
    """Straight, bent in the x-z plane, straight: points and frames (tangent, toward the bend's center, y)."""
    n = round(straight_mm / step_mm)
    m = round(bend_radius_mm * turn_rad / step_mm)
    angle = np.concatenate([np.zeros(n), np.linspace(0, turn_rad, m + 1), np.full(n, turn_rad)])
    tangent = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    inward = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=1)
    bend = bend_radius_mm * np.array([1.0, 0.0, 0.0]) - bend_radius_mm * inward[n : n + m + 1]
    before = np.outer(np.linspace(-straight_mm, 0, n, endpoint=False), tangent[0])
    after = bend[-1] + np.outer(np.linspace(0, straight_mm, n + 1)[1:], tangent[-1])
    points = np.concatenate([before, bend, after])
    return points, np.stack([tangent, inward, np.cross(tangent, inward)], axis=1)


def tube(path, first_radius_mm, second_radius_mm=None, *, around=160):
    """An anatomy round `path`: elliptic sections with half-axes (n,) or numbers along the two frame axes."""
    points, frames = path
    a = np.broadcast_to(np.asarray(first_radius_mm, float), len(points))
    b = a if second_radius_mm is None else np.broadcast_to(np.asarray(second_radius_mm, float), len(points))
    angle = 2 * np.pi * np.arange(around) / around
    ring = a[:, None, None] * np.cos(angle)[:, None] * frames[:, None, 1]
    ring = ring + b[:, None, None] * np.sin(angle)[:, None] * frames[:, None, 2]
    vertices = (points[:, None] + ring).reshape(-1, 3)
    surface = Surface(vertices, tube_faces(len(points), around))
    ends = (
        Opening(points[0], -frames[0, 0], float(np.pi * a[0] * b[0]), "inlet"),
        Opening(points[-1], frames[-1, 0], float(np.pi * a[-1] * b[-1]), "outlet_1"),
    )
    axis = Centerline(points, np.minimum(a, b))
    vessel = Vessel(surface, ends, (axis,))
    parent = Path(PARENT, axis, np.sqrt(a * b), surface, np.zeros(len(vertices), dtype=bool))
    return Anatomy(vessel, (parent,), ())


def on_parent(anatomy, **changes):
    """The anatomy with changed fields of its parent path."""
    return replace(anatomy, paths=(replace(anatomy.parent, **changes),))


def with_neck(anatomy, proximal_mm, distal_mm):
    """A straight tube with a round neck on its +x side; the sac is only the neck itself."""
    middle_mm = anatomy.parent.axis.at(np.array([0.5 * (proximal_mm + distal_mm)]))[0]
    center_mm = middle_mm + np.array([anatomy.parent.section_radius_mm[0], 0, 0])
    surface = anatomy.parent.landing_surface
    radius_mm = 0.5 * (distal_mm - proximal_mm)
    middle = surface.corners_mm.mean(axis=1)
    is_neck = (np.linalg.norm(middle - center_mm, axis=1) < radius_mm) & (middle[:, 0] > 0)
    neck = Surface(surface.vertices_mm, surface.faces[is_neck])
    angle = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    rim_mm = center_mm + radius_mm * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    sac = Aneurysm(neck, neck, rim_mm)
    is_restored = np.zeros(len(surface.vertices_mm), dtype=bool)
    is_restored[surface.faces[is_neck]] = True
    return replace(on_parent(anatomy, is_restored=is_restored), aneurysms=(sac,))
