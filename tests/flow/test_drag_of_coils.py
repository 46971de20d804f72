"""The permeability of coils against resolved wires in periodic boxes, and against random fibres where they are few."""

import json
from pathlib import Path

import numpy as np
import pytest

from vstent.flow.drag import permeability_mm2

ROWS = json.loads((Path(__file__).parents[2] / "benchmarks" / "meshes.json").read_text())["coils"]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['density']:.2f}")
def test_coils_let_through_what_resolved_wires_do(row):
    assert permeability_mm2(np.array(row["density"]), 0.3) == pytest.approx(row["permeability_mm2"], rel=0.015)


def test_few_coils_resist_within_a_third_as_random_fibres():
    """K = 3 r^2 / (20 f) (-ln f - 0.931) (Jackson and James 1986, eq. 26)."""
    density = np.array([0.02, 0.05, 0.1, 0.2])
    fibres_mm2 = 3 * 0.15**2 / (20 * density) * (-np.log(density) - 0.931)
    np.testing.assert_allclose(permeability_mm2(density, 0.3), fibres_mm2, rtol=0.45)
