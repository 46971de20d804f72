"""The permeability of coils against resolved ones in periodic boxes, straight wires, and random fibres."""

import json
from pathlib import Path

import numpy as np
import pytest

from vstent.flow.drag import WINDING, permeability_mm2
from vstent.flow.indices import between_coils

TABLE = json.loads((Path(__file__).parents[2] / "benchmarks" / "meshes.json").read_text())


@pytest.mark.parametrize("row", TABLE["packed"], ids=lambda row: f"{row['density']:.2f}")
def test_coils_let_through_what_resolved_ones_do(row):
    assert permeability_mm2(np.array(row["density"]), 0.305) == pytest.approx(row["permeability_mm2"], rel=0.15)
    assert WINDING == pytest.approx(row["winding"], rel=0.07)


@pytest.mark.parametrize("row", TABLE["coils"], ids=lambda row: f"{row['density']:.2f}")
def test_loops_side_by_side_let_through_half_as_much_again_as_straight_wires(row):
    assert 1.35 < permeability_mm2(np.array(row["density"]), 0.3) / row["permeability_mm2"] < 1.6


def test_few_coils_let_through_a_quarter_more_than_random_fibres():
    """K = 3 r^2 / (20 f) (-ln f - 0.931) (Jackson and James 1986, eq. 26)."""
    density = np.array([0.02, 0.05, 0.1, 0.2])
    fibres_mm2 = 3 * 0.15**2 / (20 * density) * (-np.log(density) - 0.931)
    np.testing.assert_allclose(permeability_mm2(density, 0.3), 1.25 * fibres_mm2, rtol=0.05)


def test_blood_between_coils_is_faster_than_a_region_and_none_is_changed_without_coils():
    found = {"mean_sac_velocity_m_s": 0.3, "turnover_time_s": 2.0, "sac_kinetic_energy_J": 1.0, "neck_inflow_mL_s": 1.0}
    assert between_coils(found, 1.0) == found
    wanted = {"mean_sac_velocity_m_s": 0.4 * WINDING, "turnover_time_s": 1.5, "sac_kinetic_energy_J": WINDING**2 / 0.75}
    assert between_coils(found, 0.75) == pytest.approx(found | wanted)
