"""Resolved wires in a periodic cell against the closed forms of rows and arrays of cylinders."""

import numpy as np
import pytest

from vstent.flow.crossing_cell import VISCOSITY, Wires, crossing_wires, flow_through, passing, row_of_wires
from vstent.flow.screen import drag_per_length

DIAMETER = 6


def drag(wires: Wires) -> float:
    """Force on a wire over its length, viscosity and the superficial velocity."""
    flow = flow_through(wires, np.array([0.0, 0.0, 1e-6]))
    return float(flow.force[2] / wires.shape[0] / (VISCOSITY * flow.superficial_velocity[2]))


def square_array_drag(solid_fraction: float) -> float:
    """Sangani and Acrivos 1982 (Int. J. Multiphase Flow 8, 193), dilute expansion."""
    c = solid_fraction
    return 4 * np.pi / (np.log(1 / np.sqrt(c)) - 0.738 + c - 0.887 * c**2 + 2.038 * c**3)


@pytest.mark.parametrize("spacing", [12, 18, pytest.param(36, marks=pytest.mark.validation)])
def test_drag_in_a_square_array_of_cylinders_at_six_cells_a_wire(spacing: int) -> None:
    exact = square_array_drag(np.pi * DIAMETER**2 / 4 / spacing**2)
    assert drag(row_of_wires(spacing, spacing, DIAMETER)) == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("spacing", [18, pytest.param(36, marks=pytest.mark.validation)])
def test_drag_of_a_row_of_cylinders_at_six_cells_a_wire(spacing: int) -> None:
    exact = float(drag_per_length(np.float64(DIAMETER), np.float64(spacing)))
    assert drag(row_of_wires(spacing, 48, DIAMETER)) == pytest.approx(exact, rel=0.03)


def test_crossing_wires_close_on_themselves_and_hold_their_volume() -> None:
    wires = crossing_wires(24, 32, 24, 6.0)
    flow = flow_through(wires, np.array([0.0, 0.0, 1e-5]))
    length = 2 * np.hypot(24, 32)
    assert (~flow.is_blood).sum() == pytest.approx(length * np.pi * 9.0, rel=0.05)
    solid = ~flow.is_blood
    for axis in (0, 1):  # every section across an axis cuts both families alike
        per_section = solid.sum(axis=tuple({0, 1, 2} - {axis}))
        assert per_section.min() > 0.8 * per_section.mean()
    # nothing is made or lost: what goes up through one level goes up through all
    through = flow.velocity[..., 2].sum(axis=(0, 1))
    np.testing.assert_allclose(through, through.mean(), rtol=0.02)


def test_opposed_flow_between_nothing_is_the_parabola_of_each_side() -> None:
    height, force = 40, 1e-6
    nothing = Wires((4, 4, height), (), (), 1.0)
    speed = flow_through(nothing, np.array([force, 0.0, 0.0]), is_opposed=True).velocity[..., 0].mean(axis=(0, 1))
    z = np.arange(height) - 0.5 * height
    exact = 0.5 * force / VISCOSITY * z * (0.5 * height - np.abs(z))
    np.testing.assert_allclose(speed, exact, atol=3e-3 * exact.max())


def test_no_shear_passes_wires_that_touch() -> None:
    assert abs(passing(row_of_wires(6, 40, 6.0), 1e-6)) < 0.03 * 6


def test_the_shear_that_passes_does_not_hang_on_how_far_the_next_wires_are() -> None:
    spacing = 20 * 2**-0.5
    near, far = (passing(crossing_wires(20, 20, height, 1.4), 1e-6) / spacing for height in (40, 56))
    assert 0.02 < near < 0.06
    assert far == pytest.approx(near, abs=0.005)
