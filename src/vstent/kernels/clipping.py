"""Cut a triangle mesh along the zero of a value at its vertices."""

import numpy as np

from vstent.kernels.arrays import Floats, Ints


def clip(vertices: Floats, faces: Ints, value: Floats) -> tuple[Floats, Ints]:
    """Return the part of a mesh where a value is at most 0.

    Faces share the vertices of the cut. Vertices that no face uses any more stay in the list.

    Parameters
    ----------
    vertices, faces : (n, 3), (m, 3); the mesh.
    value : (n,); value at every vertex, linear on every face.
    """
    positive = value[faces] > 0
    count = positive.sum(axis=1)
    keep = faces[count == 0]
    one, two = faces[count == 1], faces[(count == 2) & (value[faces].min(axis=1) < 0)]
    first = _rotated(one, np.argmax(value[one] > 0, axis=1))
    lone = _rotated(two, np.argmin(value[two] > 0, axis=1))
    edges = np.concatenate([first[:, [0, 1]], first[:, [0, 2]], lone[:, [0, 1]], lone[:, [0, 2]]])
    vertices, crossing = _crossings(vertices, edges, value)
    p01, p02 = crossing[: len(first)], crossing[len(first) : 2 * len(first)]
    q01, q02 = crossing[2 * len(first) : 2 * len(first) + len(lone)], crossing[2 * len(first) + len(lone) :]
    made = np.concatenate(
        [
            np.stack([first[:, 1], first[:, 2], p02], axis=1),
            np.stack([first[:, 1], p02, p01], axis=1),
            np.stack([lone[:, 0], q01, q02], axis=1),
        ]
    )
    sound = (made[:, 0] != made[:, 1]) & (made[:, 1] != made[:, 2]) & (made[:, 2] != made[:, 0])
    return vertices, np.concatenate([keep, made[sound]]).astype(np.int32)


def _rotated(faces: Ints, start: Ints) -> Ints:
    """Return every face rotated so that its corner number `start` comes first."""
    return faces[np.arange(len(faces))[:, None], (start[:, None] + np.arange(3)) % 3]


def _crossings(vertices: Floats, edges: Ints, value: Floats) -> tuple[Floats, Ints]:
    """Return vertices with one more per edge whose ends differ in sign, and its number for every edge (k,).

    For an edge with an end at zero, the number is that of this end.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    on_zero = (value[low] == 0) | (value[high] == 0)
    code, inverse = np.unique(low.astype(np.int64) * len(vertices) + high, return_inverse=True)
    a, b = code // len(vertices), code % len(vertices)
    span = np.where(value[a] == value[b], 1.0, value[a] - value[b])
    t = np.clip(value[a] / span, 0.0, 1.0)[:, None]
    created = vertices[a] + t * (vertices[b] - vertices[a])
    answer = np.where(on_zero, np.where(value[low] == 0, low, high), len(vertices) + inverse)
    return np.concatenate([vertices, created]), answer.astype(np.int32)


def section(vertices: Floats, faces: Ints, value: Floats) -> Floats:
    """Return the segments (s, 2, 3) along which a mesh meets the zero of `value` (n,), linear on every face."""
    is_positive = value[faces] > 0
    count = is_positive.sum(axis=1)
    lone = np.concatenate(
        [
            _rotated(faces[count == 1], np.argmax(is_positive[count == 1], axis=1)),
            _rotated(faces[count == 2], np.argmin(is_positive[count == 2], axis=1)),
        ]
    )
    ends = []
    for other in (1, 2):
        a, b = lone[:, 0], lone[:, other]
        share = (value[a] / (value[a] - value[b]))[:, None]
        ends.append(vertices[a] + share * (vertices[b] - vertices[a]))
    return np.stack(ends, axis=1)
