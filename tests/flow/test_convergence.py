"""Refinement: observed order, extrapolation and scatter, on exact series and on a tube."""

import json
from pathlib import Path

import numpy as np
import pytest

from vstent import phantoms
from vstent.cli import main
from vstent.flow.convergence import RATIO, SAFETY, Scatter, observed, scatter
from vstent.io.writers import write_stl


@pytest.mark.parametrize("order", [1.0, 1.6, 2.0])
def test_order_and_limit_of_an_exact_series_are_found(order):
    sizes = np.array([RATIO**2, RATIO, 1.0])
    coarse, middle, fine = 3.0 - 0.2 * sizes**order
    found = observed((coarse, middle, fine))
    assert found.order == pytest.approx(order)
    assert found.extrapolated == pytest.approx(3.0)
    assert found.uncertainty_fraction == pytest.approx(SAFETY * 0.2 / fine)


def test_a_series_without_a_direction_has_no_order_but_an_uncertainty():
    found = observed((1.0, 1.2, 1.1))
    assert (found.order, found.extrapolated) == (None, None)
    assert found.uncertainty_fraction == pytest.approx(SAFETY * 0.2 / 1.1)


def test_a_chance_order_does_not_shrink_the_uncertainty():
    found = observed((1.0, 1.1, 1.101))
    assert found.order > 10
    assert found.extrapolated == pytest.approx(1.101 + 0.001)


def test_scatter_is_half_the_range_over_the_mean():
    assert scatter((1.0, 4.0, 1.0)) == Scatter((1.0, 4.0, 1.0), 2.0, 0.75)


def test_the_command_compares_three_grids_time_steps_and_positions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    radius_mm, length_mm, inflow_mL_s = 2.0, 16.0, 0.5
    tube = phantoms.tube(length_mm=length_mm, radius_mm=radius_mm)
    write_stl(tmp_path / "tube.stl", phantoms.phantom_surface(tube))
    command = ["flow", str(tmp_path / "tube.stl"), "--out", str(tmp_path / "out"), "--units", "mm", "--convergence"]
    assert main([*command, "--flow-rate", str(inflow_mL_s), "--grid-spacing", "0.25"]) == 0
    assert "limit" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "convergence.json").read_text())
    assert found["cell_size_mm"]["sizes"] == pytest.approx([0.5, 0.25 * RATIO, 0.25])
    stress_Pa = 4 * 0.004 * inflow_mL_s * 1e-6 / (np.pi * (radius_mm * 1e-3) ** 3)
    exact = {"pressure_drop_Pa": 2 * length_mm / radius_mm * stress_Pa, "mean_wss_Pa": stress_Pa}
    for key, value in exact.items():
        of_grid, of_step = (found[name]["quantities"][key] for name in ("cell_size_mm", "lattice_speed"))
        assert of_grid["values"][2] == pytest.approx(value, rel=0.03)
        assert np.ptp(of_step["values"]) < 0.01 * value
        lying = found["grid_position"][key]
        assert lying["values"][0] == of_grid["values"][1]
        assert lying["mean"] == pytest.approx(value, rel=0.03)
        assert lying["uncertainty_fraction"] < 0.02
