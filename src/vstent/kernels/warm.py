"""Compile the shared kernels that take time to compile, ahead of their first use."""

import numpy as np

from vstent.kernels import (
    coverage,
    curves,
    digits,
    footprints,
    medial,
    net,
    raster,
    sampling,
    sections,
    tree,
    triangles,
    voxels,
)


def warm() -> None:
    """Call every kernel of a study without a flow once with very small arrays; numba keeps the compiled code."""
    line, around = np.meshgrid(np.arange(3.0), np.arange(4.0), indexing="ij")
    nodes = np.stack([np.cos(np.pi / 2 * around), np.sin(np.pi / 2 * around), line], axis=-1)
    voxels.fill(np.zeros((0, 3, 3)), (1, 1, 1))
    _slide(nodes)
    coverage.covered_fractions(nodes, nodes[0], nodes[1], np.full(4, 0.01), 2)
    vertices, faces = np.eye(3), np.array([[0, 1, 2]], dtype=np.int32)
    faces.setflags(write=False)  # as the faces of a surface are
    tiny = tree.build(vertices, faces)
    tree.closest_points(tiny, vertices)
    tree.segments_cross(tiny, vertices, 2 * vertices)
    sections.beyond(sections.sheet(vertices, faces, np.ones((1, 1))), 0, vertices, vertices)
    tree.inscribed_radii(tree.curved(tiny, triangles.smooth_normals(vertices, faces)[faces]), vertices)
    screen = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    depth, image, sums = (np.zeros(shape, np.float32) for shape in ((2, 2), (2, 2, 3), (2, 2, 4)))
    raster.paint_triangles(screen, screen, faces, depth, image)
    raster.paint_wires(screen, np.array([0, 3], dtype=np.int32), np.ones(1), 1.0, screen, depth, image)
    raster.veil_triangles(screen, screen, np.ones(3), faces, depth, sums, depth)
    raster.resolve(image, sums, depth, 1)
    curves.parallel_frames(np.eye(3))
    curves.closed_lengths(nodes)
    digits.text_rows(["", ""], np.ones((1, 1), np.int64), 0)
    medial.widest_in_section(np.ones((1, 2)), np.ones((1, 2, 2)), 1.0, np.ones(1))


def _slide(nodes_mm: np.ndarray) -> None:
    """Slide the crossings of a tiny net once."""
    line, column = np.array([0, 0, 1, 1, 2, 2]), np.array([0, 2, 1, 3, 0, 2])
    ends = np.array([[0, 1, 2, 3], [2, 3, 5, 4]])
    around_mm = 0.5 * (np.roll(nodes_mm, -1, axis=1) - np.roll(nodes_mm, 1, axis=1))
    chart = np.concatenate([nodes_mm, np.gradient(nodes_mm, axis=0), around_mm], axis=2)
    beside, bends = np.array([1, 0, 3, 2, 5, 4]), np.array([[0], [2], [5]])
    few, next_to, pieces, wires = (values.astype(np.uint32) for values in (line, beside, ends, bends))
    tiny = net.Net(chart, line, column, few, next_to, pieces, np.ones(2), np.zeros(3), wires, pieces)
    net.slide(tiny, net.Weights(1.5, 0.1, 0.1, 0.1, 1, 0.1), net.Descent(1, 0.1, 0.1))


def sample() -> None:
    """Interpolate a flow on a grid of one cell."""
    index, numbers, points = np.zeros((2, 2, 2), np.int32), np.zeros(1), np.zeros((0, 3))
    sampling.interpolate_cubic(index, np.zeros((1, 3)), points)
    sampling.fit_wall(index, numbers, np.zeros((1, 3)), numbers, points, points, 1)


def project() -> None:
    """Project a point on a detector of four pixels."""
    arm = np.array([1.0, 2.0, 1.0, 1.0, 1.0])
    footprints.footprints(np.zeros((1, 3)), np.ones(1), np.eye(3), arm, np.array([2, 2]))
