"""Compile the kernels of a deployment ahead of its first use: ``python -m vstent.kernels.warm``, in the set-up."""

import numpy as np

from vstent.kernels import coverage, tree


def warm() -> None:
    """Call every kernel once on next to nothing; numba keeps what it compiles beside the source."""
    vertices, faces = np.eye(3), np.array([[0, 1, 2]], dtype=np.int32)
    tiny = tree.build(vertices, faces)
    tree.closest_points(tiny, vertices)
    tree.segments_cross(tiny, vertices, 2 * vertices)
    row, column = np.meshgrid(np.arange(3.0), np.arange(4.0), indexing="ij")
    nodes = np.stack([np.cos(np.pi / 2 * column), np.sin(np.pi / 2 * column), row], axis=-1)
    coverage.covered_fractions(nodes, nodes[0], nodes[1], np.full(4, 0.01), 2)


if __name__ == "__main__":
    warm()
