"""The proposed C-arm direction on vessels for which it is known."""

from dataclasses import replace

import numpy as np

from vstent.angiography.view import axes_of
from vstent.angiography.working_projection import overlap, working_projection
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import PARENT, Anatomy, Aneurysm, Centerline, Path, Vessel


def sphere(center, radius) -> np.ndarray:
    k = np.arange(4000) + 0.5
    z, turn = 1 - 2 * k / 4000, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z**2)
    return np.array(center) + radius * np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def artery(along: np.ndarray, toward_sac: np.ndarray) -> Anatomy:
    """Return a straight artery of 2 mm radius with a sac of 3 mm radius beside it, as points with single triangles."""
    place = np.linspace(-15, 15, 121)
    line = place[:, None] * along
    side = np.cross(along, toward_sac)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = np.cos(turn)[:, None] * toward_sac + np.sin(turn)[:, None] * side
    tube = Surface((line[:, None] + 2 * ring).reshape(-1, 3), np.array([[0, 1, 2]]))
    neck = Surface(np.stack([2 * toward_sac, 2 * toward_sac + along, 2 * toward_sac + side]), np.array([[0, 1, 2]]))
    sac = Surface(sphere(4.5 * toward_sac, 3.0), np.array([[0, 1, 2]]))
    aneurysm = Aneurysm(sac, neck, 2 * toward_sac + np.outer([-2.0, 2.0], along))
    axis = Centerline(line, np.full(121, 2.0))
    n = len(tube.vertices_mm)
    parent = Path(PARENT, axis, np.full(121, 2.0), tube, np.zeros(n, bool))
    return Anatomy(Vessel(tube), (parent,), (aneurysm,))


def test_the_beam_is_across_artery_and_sac():
    head, left, front = np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
    assert np.abs(np.degrees(working_projection(artery(head, left)))).max() < 5.1  # sac to the left: frontal
    lateral = np.degrees(working_projection(artery(head, front)))  # sac in front: from the side
    assert abs(lateral[0]) > 84
    assert abs(lateral[1]) < 5.1
    oblique = np.cos(0.6) * left + np.sin(0.6) * front
    beam = axes_of(*working_projection(artery(head, oblique)))[2]
    assert np.abs(beam @ np.array([oblique, head]).T).max() < np.sin(np.radians(6))


def test_overlap_is_the_hidden_part_of_the_sac():
    sac, away = sphere([0, 0, 0], 4.0), sphere([20, 0, 0], 4.0)
    assert overlap(sac, away, axes_of(0.0, 0.0)) == 0
    assert overlap(sac, away, axes_of(np.pi / 2, 0.0)) == 1
    # Two discs of equal radius r at a distance d overlap in 2 r^2 acos(d / 2 r) - d / 2 sqrt(4 r^2 - d^2).
    lens = 2 * 16 * np.arccos(0.5) - 2 * np.sqrt(48)
    assert abs(overlap(sac, sphere([4, 0, 0], 4.0), axes_of(0.0, 0.0)) - lens / (16 * np.pi)) < 0.06


def test_without_a_sac_the_artery_is_seen_at_full_length():
    anatomy = artery(np.array([0.0, 1, 0]), np.array([1.0, 0, 0]))
    bare = replace(anatomy, aneurysms=())
    beam = axes_of(*working_projection(bare))[2]
    assert abs(beam @ [0, 1, 0]) < 1e-9
