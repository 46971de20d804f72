"""Where wires are at home on a contour, beside the plain search."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vstent.kernels.coverage import homes


def test_points_are_at_home_at_their_nearest_nodes_wherever_the_point_before_was():
    """On a tube bent to a hairpin the way downhill from one leg ends on its inner side, not on the other leg."""
    turn, around = np.meshgrid(np.linspace(0, 1.2 * np.pi, 120), 2 * np.pi * np.arange(48) / 48, indexing="ij")
    out_mm = 4.0 + 1.9 * np.cos(around)
    nodes_mm = np.stack([out_mm * np.cos(turn), out_mm * np.sin(turn), 1.9 * np.sin(around)], axis=-1)
    rng = np.random.default_rng(3)
    walk_mm = nodes_mm[np.arange(119), rng.integers(0, 48)] + rng.normal(scale=0.05, size=(119, 3))
    points_mm = np.concatenate([walk_mm, nodes_mm.reshape(-1, 3)[rng.permutation(5760)[:2000]]])
    found_mm = nodes_mm.reshape(-1, 3)[homes(nodes_mm, points_mm)]
    nearest_mm = cKDTree(nodes_mm.reshape(-1, 3)).query(points_mm)[0]
    assert np.linalg.norm(found_mm - points_mm, axis=1) == pytest.approx(nearest_mm, abs=1e-12)
