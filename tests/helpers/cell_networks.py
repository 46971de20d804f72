"""Networks of unit cells with known flow rates, for the transport of contrast."""

import numpy as np

from vstent.angiography.network import Network


def network(inside, flux_along, *, openings):
    """A network of unit cells of a mask (i, j, k).

    `flux_along(axis, cells)` gives the flow rates through the upper faces of cells, and `openings` the faces
    (cells, axis, sign, opening, flux out).
    """
    cells = np.argwhere(inside).astype(np.int32)
    index = np.full(np.array(inside.shape) + 1, -1)
    index[tuple(cells.T)] = np.arange(len(cells))
    left, right, axes, fluxes = [], [], [], []
    for axis in range(3):
        beyond = index[tuple((cells + np.eye(3, dtype=int)[axis]).T)]
        own = np.flatnonzero(beyond >= 0)
        left.append(own)
        right.append(beyond[own])
        axes.append(np.full(len(own), axis))
        fluxes.append(flux_along(axis, cells[own]))
    for at, axis, sign, opening, out in openings:
        own, other = index[tuple(np.atleast_2d(at).T)], np.full(len(np.atleast_2d(at)), len(cells) + opening)
        left.append(own if sign > 0 else other)
        right.append(other if sign > 0 else own)
        axes.append(np.full(len(own), axis))
        fluxes.append(sign * np.broadcast_to(out, len(own)))
    faces = (np.concatenate(one) for one in (left, right, axes))
    n = len(cells)
    fixed = np.concatenate(fluxes)[None], np.zeros(1), np.inf, 2, 1, 0.0
    return Network(cells, np.ones(n), 1.0, cells * 1.0, np.ones(n), *faces, *fixed)


def tube(radius, length, *, is_plug=False):
    """A round tube along z with a mean speed of about 1 cell per s, plug or parabolic."""
    size = int(2 * radius) + 3
    x, y, _ = np.indices((size, size, length))
    distance = np.hypot(x - (size - 1) / 2, y - (size - 1) / 2)
    inside = distance < radius

    def speed(cells):
        r = np.hypot(cells[:, 0] - (size - 1) / 2, cells[:, 1] - (size - 1) / 2)
        return np.ones(len(cells)) if is_plug else 2 * (1 - (r / radius) ** 2)

    section = np.argwhere(inside[:, :, 0])
    first, last = (np.c_[section, np.full(len(section), end)] for end in (0, length - 1))
    ends = [(first, 2, -1, 0, -speed(first)), (last, 2, 1, 1, speed(last))]
    return network(inside, lambda axis, cells: speed(cells) if axis == 2 else np.zeros(len(cells)), openings=ends)
