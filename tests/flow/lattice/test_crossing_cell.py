"""Resolved wires in a periodic cell against the closed forms of rows and arrays of cylinders."""

import numpy as np
import pytest
from crossing_cell import (
    VISCOSITY,
    CellFlow,
    Wires,
    crossing_wires,
    flow_through,
    row_of_wires,
    sheet_speed,
)

from vstent.flow.drag import drag_per_length, round_diameter

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


def test_a_row_of_square_struts_holds_blood_up_as_round_wires_of_their_round_diameter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Across and along; as wires as wide as they are it would be 19 and 16 % less."""
    side, spacing, force = 8, 36, 1e-6
    middle = slice((spacing - side) // 2, (spacing + side) // 2)

    def is_outside(wires: Wires) -> np.ndarray:
        blood = np.ones(wires.shape, dtype=bool)
        blood[:, middle, middle] = False
        return blood

    def speeds(wires: Wires) -> np.ndarray:
        along, through = (flow_through(wires, force * np.eye(3)[k]).superficial_velocity[k] for k in (0, 2))
        return np.array([along, through])

    round_wires = speeds(row_of_wires(spacing, spacing, round_diameter(side, side)))
    monkeypatch.setattr("crossing_cell._blood", is_outside)
    monkeypatch.setattr("crossing_cell._fractions", lambda _, cells, steps: np.full(len(cells), 0.5))
    np.testing.assert_allclose(speeds(row_of_wires(spacing, spacing, side)), round_wires, rtol=0.015)


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


@pytest.mark.parametrize("through", [1e-3, 4e-2])
def test_the_speed_in_a_sheet_is_found_from_the_profile_behind_it(through: float) -> None:
    height, in_sheet, force = 64, 0.013, 2e-6
    z = (np.arange(64 * 50) + 0.5) / 50
    swept = height * np.expm1(through * z / VISCOSITY) / np.expm1(through * height / VISCOSITY)
    velocity = np.zeros((1, 1, height, 3))
    velocity[..., 0] = (in_sheet + force / through * (z - swept)).reshape(height, -1).mean(axis=1)
    velocity[..., 2] = through
    flow = CellFlow(velocity, np.zeros(3), np.ones((1, 1, height), bool))
    assert sheet_speed(flow, np.array([force, 0.0, 0.0])) == pytest.approx(in_sheet, rel=1e-3)


def normal_over_tangential(wires: Wires) -> float:
    """What resists blood that passes at an angle through the wires, over what resists it along."""
    force = np.array([3e-4, 0.0, 6e-4]) / wires.shape[2]
    flow = flow_through(wires, force)
    return float(sheet_speed(flow, force) / flow.superficial_velocity[2] * force[2] / force[0])


def test_what_resists_blood_that_passes_at_an_angle_does_not_hang_on_how_far_the_next_wires_are() -> None:
    near, far = (normal_over_tangential(crossing_wires(20, 20, height, 1.4)) for height in (40, 56))
    assert far == pytest.approx(near, rel=0.1)
    assert 0.3 < near < 1.0


def test_blood_keeps_more_of_its_way_along_wires_than_across_them_and_through_one_plane_than_two() -> None:
    along, across = (normal_over_tangential(crossing_wires(*sides, 40, 2.0)) for sides in ((14, 24), (24, 14)))
    assert along > across + 0.2
    assert normal_over_tangential(crossing_wires(24, 14, 40, 2.0, apart=0.0)) > across + 0.05
