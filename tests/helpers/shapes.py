"""Closed surfaces that several tests need."""

import numpy as np

from vstent.geometry.surface import Surface


def sphere(radius: float, rings: int = 24, sectors: int = 48) -> Surface:
    theta = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    phi = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    body = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    vertices = np.concatenate([body.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]) * radius
    j, k = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    north, south = len(vertices) - 2, len(vertices) - 1
    faces = [np.stack([np.full(sectors, north), j, k], 1)]
    for r in range(rings - 2):
        a, b = r * sectors, (r + 1) * sectors
        faces += [np.stack([a + j, b + j, b + k], 1), np.stack([a + j, b + k, a + k], 1)]
    last = (rings - 2) * sectors
    faces += [np.stack([last + k, last + j, np.full(sectors, south)], 1)]
    return Surface(vertices, np.concatenate(faces))
