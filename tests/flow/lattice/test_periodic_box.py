"""Resolved wires in a periodic box against closed forms and published drags of cylinders."""

import numpy as np
import pytest
from periodic_box import (
    VISCOSITY,
    BoxFlow,
    crossing_wires,
    flow_through,
    periodic_domain,
    row_of_wires,
    sheet_speed,
    swept,
    wire,
)

from vstent.flow.drag import drag_per_length, round_diameter
from vstent.geometry.surface import Surface

DIAMETER = 6
UP = np.array([0.0, 0.0, 1e-6])
FAXEN = (-0.9156892732, 0.5, 0.05464866, -0.26462967, 0.792986), (1.26653975, -0.9180433, 1.8771010, -4.66549)
"""Coefficients of Faxen's series for a cylinder midway in a plane Poiseuille flow."""


def drag_of_row(spacing: int, height: int, diameter: float = DIAMETER) -> float:
    """Force on a wire over its length, viscosity and the superficial velocity."""
    flow = flow_through((4, spacing, height), row_of_wires(spacing, height, diameter), UP)
    return float(UP[2] * spacing * height / (VISCOSITY * flow.superficial_velocity[2]))


@pytest.mark.parametrize(
    ("spacing", "solid_fraction", "published"),
    [(12, 0.2, 51.53), (18, 0.1, 24.83), pytest.param(24, 0.05, 15.56, marks=pytest.mark.validation)],
)
def test_drag_in_a_square_array_of_cylinders(spacing: int, solid_fraction: float, published: float) -> None:
    """Sangani and Acrivos 1982, Int. J. Multiphase Flow 8, 193, table 1; six cells a wire."""
    diameter = spacing * np.sqrt(4 * solid_fraction / np.pi)
    assert drag_of_row(spacing, spacing, diameter) == pytest.approx(published, rel=0.02)


@pytest.mark.parametrize("spacing", [18, pytest.param(36, marks=pytest.mark.validation)])
def test_drag_of_a_row_of_cylinders_at_six_cells_a_wire(spacing: int) -> None:
    exact = float(drag_per_length(np.float64(DIAMETER), np.float64(spacing)))
    assert drag_of_row(spacing, 48) == pytest.approx(exact, rel=0.02)


WIDE = 4.1
"""Width of the channel in diameters of the cylinder, as in Schaefer and Turek."""


def channel(diameter: float, degrees: int) -> tuple[tuple[int, int, int], list[Surface], np.ndarray]:
    """Return the box, its cylinder and its wall, and the direction of a channel at 0, 17 or 45 degrees to the grid.

    The channel closes on itself across the borders of the box.
    """
    width = WIDE * diameter
    way, (long, wide) = {0: ((1, 0), (0, 1)), 17: ((10, 3), (10, 3)), 45: ((1, 1), (2, 1))}[degrees]
    along = np.array(way) / np.hypot(*way)
    if degrees == 0:
        box, apart = (round(18 * diameter), int(width) + 4), int(width) + 4
    else:  # the box holds one length of the channel, or two that join
        per = np.hypot(*way) if degrees == 17 else 2 * np.hypot(*way)
        m = int(np.ceil((width + 3) * per / (long * wide)))
        box, apart = (long * m, wide * m), long * wide * m / per
    inner, outer = 0.5 * width, apart - 0.5 * width
    section = np.array([[-6.0, inner], [6.0, inner], [6.0, outer], [-6.0, outer]])
    middle, reach = np.array([0.3, 0.4, 2.0]), 1.2 * np.hypot(*box)
    direction = np.r_[along, 0.0]
    wall = swept(middle + reach * np.array([[-1.0], [1.0]]) * direction, section)
    return (*box, 4), [wire(middle, (0, 0, 1), diameter, 12.0), wall], direction


def drag_in_channel(diameter: float, degrees: int, reynolds: float, relaxation_steps: float, rounds: int = 1) -> float:
    """Drag of the cylinder over viscosity, length and the highest speed of a Poiseuille flow with the same flow rate.

    The Reynolds number of the mean speed is adjusted in `rounds` computations.
    """
    box, solids, along = channel(diameter, degrees)
    width, viscosity = WIDE * diameter, (relaxation_steps - 0.5) / 3
    force = 12 * viscosity * (reynolds * viscosity / diameter) / width**2 * along
    length = {0: box[0], 17: np.hypot(*box[:2]), 45: np.sqrt(2) * box[0]}[degrees]
    for _ in range(rounds):
        flow = flow_through(box, solids, force, relaxation_steps=relaxation_steps, settled=1e-5)
        mean = flow.velocity.sum(axis=(0, 1, 2)) @ along / (length * box[2] * width)
        driven, force = force, force * reynolds * viscosity / diameter / mean
    pushed = driven @ along * np.pi * diameter**2 / 4 * box[2]  # a pressure gradient acts on the cylinder, too
    return float((flow.drag[0] @ along + pushed) / box[2] / (viscosity * 1.5 * mean))


@pytest.mark.parametrize("degrees", [17, *(pytest.param(at, marks=pytest.mark.validation) for at in (0, 45))])
@pytest.mark.parametrize("diameter", [4.0, pytest.param(8.0, marks=pytest.mark.validation)])
def test_drag_of_a_cylinder_in_a_channel_in_creeping_flow(diameter: float, degrees: int) -> None:
    """Faxen's series as given by Ben Richou, Ambari and Naciri 2004, Chem. Eng. Sci. 59, 3215."""
    k = 1 / WIDE
    (first, *logs), powers = FAXEN
    series = first - (1 + sum(a * k ** (2 * n) for n, a in enumerate(logs, 1))) * np.log(k)
    published = 4 * np.pi / (series + sum(b * k ** (2 * n) for n, b in enumerate(powers, 1)))
    assert drag_in_channel(diameter, degrees, 0.1, 0.65) == pytest.approx(published, rel=0.12 / diameter)


@pytest.mark.validation
@pytest.mark.parametrize("degrees", [0, 17, 45])
@pytest.mark.parametrize("diameter", [4.0, 8.0])
def test_drag_of_a_cylinder_in_a_channel_at_reynolds_20(diameter: float, degrees: int) -> None:
    """Schaefer and Turek 1996, case 2D-1: c_D = 5.5795 at a mean speed U with U d / nu = 20."""
    published = 0.5 * 5.5795 * 20 / 1.5
    assert drag_in_channel(diameter, degrees, 20.0, 0.56, rounds=3) == pytest.approx(published, rel=0.12 / diameter)


def test_a_row_of_square_struts_holds_blood_up_as_round_wires_of_their_round_diameter() -> None:
    """Across and along; as wires as wide as they are it would be 19 and 16 % less."""
    side, spacing = 8, 36
    middle = np.array([0.0, 0.5 * spacing - 0.5, 0.5 * spacing - 0.5])
    corners = 0.5 * side * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    square = swept(middle + np.array([[-20.0], [20.0]]) * np.eye(3)[0], corners)

    def speeds(*wires: Surface) -> list[float]:
        box = (4, spacing, spacing)
        return [flow_through(box, wires, 1e-6 * np.eye(3)[k]).superficial_velocity[k] for k in (0, 2)]

    round_wires = speeds(*row_of_wires(spacing, spacing, round_diameter(side, side)))
    np.testing.assert_allclose(speeds(square), round_wires, rtol=0.015)


def test_a_gap_of_one_row_of_cells_between_wires_is_closed_and_counted() -> None:
    lower, upper, higher = (wire((0.0, 8.0, z), (1.0, 0.0, 0.0), 5.8, 12.0) for z in (8.0, 14.7, 16.7))
    domain, is_blood, _ = periodic_domain((4, 16, 24), (lower, upper))
    # The row of cells at 11 lies outside both wires; three of its cells have a wire above and below.
    assert (~is_blood[:, :, 11]).nonzero()[1].tolist() == 4 * [7, 8, 9]
    assert domain.closed_gaps == 12
    assert periodic_domain((4, 16, 24), (lower, higher))[0].closed_gaps == 0


def test_crossing_wires_close_on_themselves_and_hold_their_volume() -> None:
    flow = flow_through((32, 24, 24), crossing_wires(24, 32, 24, 6.0), np.array([0.0, 0.0, 1e-5]))
    solid = ~flow.is_blood
    assert solid.sum() == pytest.approx(2 * np.hypot(24, 32) * np.pi * 9.0, rel=0.05)
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
    swept_away = height * np.expm1(through * z / VISCOSITY) / np.expm1(through * height / VISCOSITY)
    velocity = np.zeros((1, 1, height, 3))
    velocity[..., 0] = (in_sheet + force / through * (z - swept_away)).reshape(height, -1).mean(axis=1)
    velocity[..., 2] = through
    flow = BoxFlow(velocity, np.zeros((1, 3)), np.ones((1, 1, height), bool), 0)
    assert sheet_speed(flow, np.array([force, 0.0, 0.0])) == pytest.approx(in_sheet, rel=1e-3)


def normal_over_tangential(across: int, along: int, height: int, diameter: float, apart: float = 1.0) -> float:
    """What resists blood that passes at an angle through the wires, over what resists it along."""
    force = np.array([3e-4, 0.0, 6e-4]) / height
    flow = flow_through((along, across, height), crossing_wires(across, along, height, diameter, apart), force)
    return float(sheet_speed(flow, force) / flow.superficial_velocity[2] * force[2] / force[0])


@pytest.mark.validation
def test_what_resists_blood_that_passes_at_an_angle_does_not_hang_on_how_far_the_next_wires_are() -> None:
    near, far = (normal_over_tangential(20, 20, height, 1.4) for height in (40, 56))
    assert far == pytest.approx(near, rel=0.1)
    assert 0.3 < near < 1.0


@pytest.mark.validation
def test_blood_keeps_more_of_its_way_along_wires_than_across_them_and_through_one_plane_than_two() -> None:
    along, across = (normal_over_tangential(*sides, 40, 2.0) for sides in ((14, 24), (24, 14)))
    assert along > across + 0.2
    assert normal_over_tangential(24, 14, 40, 2.0, apart=0.0) > across + 0.05
