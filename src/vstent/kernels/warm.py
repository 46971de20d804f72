"""Compile kernels ahead of their first use: ``python -m vstent.kernels.warm``, in the set-up.

Those of a deployment, and the one that takes a flow's time: in the process that has compiled it, numba runs another
machine code than it keeps, a quarter slower and different in the last bits from that of every later process.
"""

import numpy as np

from vstent.kernels import coverage, lattice, net, tree


def warm() -> None:
    """Call every kernel once on next to nothing, the last ones first; numba keeps what it compiles."""
    row, column = np.meshgrid(np.arange(3.0), np.arange(4.0), indexing="ij")
    nodes = np.stack([np.cos(np.pi / 2 * column), np.sin(np.pi / 2 * column), row], axis=-1)
    _slide(nodes)
    coverage.covered_fractions(nodes, nodes[0], nodes[1], np.full(4, 0.01), 2)
    vertices, faces = np.eye(3), np.array([[0, 1, 2]], dtype=np.int32)
    tiny = tree.build(vertices, faces)
    tree.closest_points(tiny, vertices)
    tree.segments_cross(tiny, vertices, 2 * vertices)
    _stream()


def _slide(nodes_mm: np.ndarray) -> None:
    line, column = np.array([0, 0, 1, 1, 2, 2]), np.array([0, 2, 1, 3, 0, 2])
    ends = np.array([[0, 1, 2, 3], [2, 3, 5, 4]])
    around_mm = 0.5 * (np.roll(nodes_mm, -1, axis=1) - np.roll(nodes_mm, 1, axis=1))
    chart = np.concatenate([nodes_mm, np.gradient(nodes_mm, axis=0), around_mm], axis=2)
    beside, bends = np.array([1, 0, 3, 2, 5, 4]), np.array([[0], [2], [5]])
    few, next_to, pieces, wires = (values.astype(np.uint32) for values in (line, beside, ends, bends))
    tiny = net.Net(chart, line, column, few, next_to, pieces, np.ones(2), np.zeros(3), wires)
    net.slide(tiny, net.Weights(1.5, 0.1, 0.1, 0.1, 1), net.Descent(1, 0.1, 0.1))


def _stream() -> None:
    """Update one cell at rest, with every argument of the type that a flow has."""
    stride = lattice.LANES
    lattice.update(
        np.zeros(20 * stride, np.float32),
        stride * np.arange(19, dtype=np.int32)[None],
        np.ones(1, np.int32),
        np.float32(1.0),
        np.zeros(4, np.float32),
        np.full(1, np.inf, np.float32),
        np.float32(1.0),
        np.zeros(2, np.int32),
        np.zeros(0, np.int32),
        np.zeros((0, 6), np.float32),
        1,
    )


if __name__ == "__main__":
    warm()
