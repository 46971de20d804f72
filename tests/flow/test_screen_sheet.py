"""A screen on the grid takes as much of blood as the thin sheet, or the row of wires, that it stands for."""

import numpy as np
import pytest

from vstent.flow.case import Sheet
from vstent.flow.drag import COIL_INERTIA, concentration, drag_per_length, permeability_mm2 as permeability_mm2_of
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.scales import ODD_RATE
from vstent.flow.lattice.screen import on_grid
from vstent.flow.media import bands
from vstent.kernels import directions

SHAPE = np.array([32, 1, 32])
"""Cells of a box that repeats in all directions; nothing varies along its second axis."""
CELL_M, STEP_S = 1e-4, 1.1e-5
"""Those of an artery's flow at a grid spacing of 0.1 mm, at its usual time step."""
VISCOSITY_M2_S, DENSITY_KG_M3 = 0.004 / 1060, 1060.0
VISCOSITY = VISCOSITY_M2_S * STEP_S / CELL_M**2
SETTLED = 1e-5
"""Change in 500 steps, of the largest speed, at which the flow has settled."""


def samples(normal: np.ndarray, resistance_Pa_s_m: float, offset: float) -> Sheet:
    """A plane through the box, so many cells off its cells' centres."""
    x, y = (a.ravel() for a in np.meshgrid(*((np.arange(8 * n) + 0.5) / 8 for n in SHAPE[:2]), indexing="ij"))
    level = SHAPE[2] / 2 + offset
    z = (level - x * normal[0] / normal[2]) % SHAPE[2]
    points_mm = 1e3 * CELL_M * np.stack([x, y, z], axis=1)
    area_mm2, alike = np.full(len(x), (1e3 * CELL_M / 8) ** 2 / normal[2]), np.full(len(x), resistance_Pa_s_m)
    return Sheet(points_mm, np.tile(normal, (len(x), 1)), area_mm2, alike, alike, 0 * alike, alike, alike)


def entries(media: tuple[Sheet, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Cells (e,) of the box, and what they resist (e, ENTRY): what lies beyond a side comes in at the other."""
    around = np.stack(np.meshgrid(*(np.arange(-1, n + 1) for n in SHAPE), indexing="ij"), axis=-1) % SHAPE
    index = np.ravel_multi_index(tuple(np.moveaxis(around, -1, 0)), tuple(SHAPE)).astype(np.int32)
    spread = on_grid(media, index, np.full(3, -1e3 * CELL_M), 1e3 * CELL_M)
    linear = np.stack([spread.along_Pa_s_m2, spread.across_Pa_s_m2], axis=1) * STEP_S / DENSITY_KG_M3
    twice = spread.spread_Pa_s_m / DENSITY_KG_M3 * STEP_S / CELL_M
    inertial = spread.inertial_per_m * CELL_M
    return spread.cell, np.column_stack([spread.normal, linear, inertial, twice]).astype(np.float32)


def row(diameter_mm: float, spacing: int, offset: float) -> Sheet:
    """Wires along y across the box, so many cells apart, their axes so many off its cells' centres."""
    cell_mm = 1e3 * CELL_M
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, SHAPE[0], spacing) + offset, np.arange(0, SHAPE[1], 0.5)))
    points_mm = cell_mm * np.stack([x, y, np.full(len(x), SHAPE[2] / 2 + offset)], axis=1)
    along_mm, upwards = np.tile([0, 0.5 * cell_mm, 0], (len(x), 1)), np.tile([0.0, 0.0, 1.0], (len(x), 1))
    band_mm, area_mm2 = bands(points_mm, along_mm, upwards, np.full(len(x), cell_mm * spacing))
    # Beside wires so far apart lie none that cross them, but a screen gives either family half of its resistance.
    drag = 2 * DENSITY_KG_M3 * VISCOSITY_M2_S * drag_per_length(diameter_mm, cell_mm * spacing) / (CELL_M * spacing)
    one, across = np.ones(band_mm[..., 0].size), band_mm.shape[1]
    lying = np.repeat(upwards, across, axis=0), np.repeat(area_mm2, across), drag * one, drag * one, 0 * one
    points_mm = band_mm.reshape(-1, 3) % (cell_mm * SHAPE)
    return Sheet(points_mm, *lying, diameter_mm * one, cell_mm * spacing * one)


class Box:
    """The box's populations, and what drives them."""

    def __init__(self, media: tuple[Sheet, ...], force: np.ndarray, velocity: np.ndarray) -> None:
        self.cells = np.argwhere(np.ones(SHAPE, bool))
        last = SHAPE[2] - 1
        cut = (self.cells[:, 2] == 0) | (self.cells[:, 2] == 1) | (self.cells[:, 2] == last)
        first = np.flatnonzero(cut)
        self.length = np.diff(np.r_[first, len(cut)]).astype(np.int32)
        even = first[:, None] + len(cut) * np.arange(19)
        behind = [self._number(self.cells[first] - c) for c in directions.VELOCITIES]
        odd = np.stack([d3q19.OPPOSITE[q] * len(cut) + behind[q] for q in range(19)], axis=1)
        self.address = np.stack([even, odd]).astype(np.int32)
        cell, entry = entries(media)
        segment = np.searchsorted(first, cell, side="right") - 1
        start = np.searchsorted(segment, np.arange(len(first) + 1)).astype(np.int32)
        self.screen = start, (cell - first[segment]).astype(np.int32), entry
        self.force = force
        self.f = np.zeros(19 * len(cut) + lanes.COUNT, np.float32)
        self.place = np.arange(len(cut), dtype=np.int32)
        d3q19.set_equilibrium(self.f, len(cut), self.place, np.zeros(len(cut)), velocity)

    def _number(self, cells: np.ndarray) -> np.ndarray:
        return np.ravel_multi_index(tuple((cells % SHAPE).T), tuple(SHAPE))

    def advance(self, pairs: int) -> None:
        rows = len(self.length)
        limit = np.full(rows, np.inf, np.float32)
        relaxation = np.float32(3 * VISCOSITY + 0.5), np.zeros(4, np.float32), limit, np.float32(ODD_RATE)
        cells = self.address, self.length, relaxation, self.screen
        kick = (3 * d3q19.WEIGHTS * (directions.VELOCITIES @ (2 * self.force))).astype(np.float32)
        for _ in range(pairs):
            self.f[: 19 * len(self.cells)].reshape(19, -1)[:] += kick[:, None]
            d3q19.update(self.f, cells, d3q19.NO_LINKS, *d3q19.undivided(rows))

    def velocity(self) -> np.ndarray:
        return d3q19.moments(self.f, len(self.cells), self.place)[:, 1:] + self.force


@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5])
@pytest.mark.parametrize(("resistance_Pa_s_m", "within"), [(60.0, 0.04), (380.0, 0.16)])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5**0.5, 0.0, 0.5**0.5)], ids=["along an axis", "at 45 degrees"])
def test_blood_leaves_a_screen_as_it_would_leave_a_thin_sheet(
    normal: tuple[float, float, float], resistance_Pa_s_m: float, within: float, offset: float
) -> None:
    """Steady advection and diffusion between sheets a height apart, driven along them (see `sheet_speed`)."""
    n, along = np.array(normal), np.array([normal[2], 0.0, -normal[0]])
    through, height = 0.05 * STEP_S / CELL_M, SHAPE[2] * normal[2]
    resistance = resistance_Pa_s_m / DENSITY_KG_M3 * STEP_S / CELL_M
    leaving = 2 * through
    force = resistance / height * (through * n + leaving * along)
    away = (np.argwhere(np.ones(SHAPE, bool)) @ (n / n[2]) - SHAPE[2] / 2 - offset) % SHAPE[2] * n[2]
    gain = resistance * leaving / height / through
    arriving = leaving + gain * (away - height * np.exp((away - height) * through / VISCOSITY))
    box = Box((samples(n, resistance_Pa_s_m, offset),), force, through * n + arriving[:, None] * along)
    before, now = np.zeros(len(away)), arriving
    for _ in range(200):
        if np.abs(now - before).max() < SETTLED * np.abs(now).max():
            break
        box.advance(250)
        before, now = now, box.velocity() @ along
    else:
        pytest.fail("the flow through the box has not settled")
    behind = (away > 4) & (away < 0.4 * height)
    slope, found = np.polyfit(away[behind], now[behind], 1)
    assert slope == pytest.approx(gain, rel=0.03)
    assert found == pytest.approx(leaving, rel=within)
    np.testing.assert_allclose(box.velocity()[behind] @ n, through, rtol=0.01)


def speeds_along(levels: list[float], resistances: list[float], through: float, force: float) -> np.ndarray:
    """Speed along thin sheets, in the layers of the box: steady advection and diffusion, driven by a uniform force."""
    height = float(SHAPE[2])
    steep = -1 / (through * np.expm1(through * height / VISCOSITY))

    def response(z: np.ndarray | float) -> np.ndarray | float:
        """Speed at a height over a sheet of unit drag, but for a constant."""
        return steep * np.exp(through * (z % height) / VISCOSITY) + (z % height) / (through * height)

    at = np.array([[response(here - there) for there in levels] for here in levels])
    balance = np.block([[np.eye(len(levels)) - at * resistances, -np.ones((len(levels), 1))], [*resistances, 0.0]])
    *speeds, constant = np.linalg.solve(balance, [*np.zeros(len(levels)), force * height])
    layers = np.arange(SHAPE[2], dtype=float)
    drags = zip(levels, np.array(resistances) * speeds, strict=True)
    return constant + sum(drag * response(layers - level) for level, drag in drags)


@pytest.mark.parametrize(
    ("resistance_Pa_s_m", "offsets", "within"),
    [
        (60.0, (0.25, 0.25), 0.10),
        (60.0, (0.0, 0.5), 0.13),
        (60.0, (0.0, 1.0), 0.04),
        (380.0, (0.0, 0.0), 0.06),
        (380.0, (0.0, 1.0), 0.07),
        (380.0, (0.0, 8.0), 0.04),
    ],
)
def test_blood_leaves_two_sheets_in_one_cell_or_in_several_as_it_would_leave_two_thin_ones(
    resistance_Pa_s_m: float, offsets: tuple[float, float], within: float
) -> None:
    through, force = 0.05 * STEP_S / CELL_M, 1e-5
    resistance = resistance_Pa_s_m / DENSITY_KG_M3 * STEP_S / CELL_M
    levels = [SHAPE[2] / 2 + offset for offset in offsets]
    expected = speeds_along(levels, [resistance, resistance], through, force)
    start = np.stack([expected, 0 * expected, np.full(len(expected), through)], axis=1)
    media = tuple(samples(np.array([0.0, 0.0, 1.0]), resistance_Pa_s_m, offset) for offset in offsets)
    box = Box(media, np.array([force, 0.0, 2 * resistance * through / SHAPE[2]]), np.tile(start, (SHAPE[:2].prod(), 1)))
    before, now = 0 * expected, expected
    for _ in range(200):
        if np.abs(now - before).max() < SETTLED * np.abs(now).max():
            break
        box.advance(250)
        before, now = now, box.velocity()[: SHAPE[2], 0]
    else:
        pytest.fail("the flow through the box has not settled")
    away = np.arange(5, 11)  # cells behind both
    behind = (int(max(levels)) + away) % SHAPE[2]
    (slope, found), (gain, leaving) = (np.polyfit(away, one[behind], 1) for one in (now, expected))
    assert slope == pytest.approx(gain, rel=0.03)
    assert found == pytest.approx(leaving, rel=within)
    # The drop is the sum of both, wherever they are.
    assert box.velocity()[:, 2].mean() == pytest.approx(through, rel=2e-3)


def crossing(normal: tuple[float, float, float], resistance_Pa_s_m: float) -> tuple[Sheet, float]:
    """A plane that repeats with the box and resists along its normal only, and its area per volume, in cells."""
    n = np.array(normal) / np.linalg.norm(normal)
    x, y = (a.ravel() for a in np.meshgrid(*((np.arange(8 * size) + 0.5) / 8 for size in (2 * SHAPE[0], SHAPE[1]))))
    level = SHAPE[2] / 2 + 0.25
    at = (level - x * n[0] / n[2], x) if normal[2] else (x, np.full(len(x), level))
    points_mm = 1e3 * CELL_M * np.stack([at[1], y, at[0]], axis=1) % (1e3 * CELL_M * SHAPE)
    # A plane of slope 1/2 closes on itself after twice the box; the others are laid twice.
    laid = 1 if normal == (1, 0, 2) else 2
    area = (1 / 8) ** 2 / (n[2] or 1.0) / laid
    one = np.ones(len(x))
    lying = np.tile(n, (len(x), 1)), area * (1e3 * CELL_M) ** 2 * one
    sheet = Sheet(points_mm, *lying, resistance_Pa_s_m * one, 0 * one, 0 * one, one, one)
    return sheet, area * len(x) / SHAPE.prod()


@pytest.mark.parametrize(
    ("normal", "within"), [((0, 0, 1), 1e-3), ((1, 0, 2), 0.01), ((1, 0, 1), 0.01), ((1, 0, 0), 0.05)]
)
def test_blood_passes_two_sheets_that_cross_as_it_would_pass_both(normal: tuple[int, int, int], within: float) -> None:
    """Sheets that resist along their normals only let a uniform flow be: what drives it is the drag of both."""
    velocity = np.array([0.03, 0.0, 0.05]) * STEP_S / CELL_M
    force, media = np.zeros(3), []
    for one in ((0, 0, 1), normal):
        sheet, dense = crossing(one, 380.0)
        n = np.array(one) / np.linalg.norm(one)
        force += 380.0 / DENSITY_KG_M3 * STEP_S / CELL_M * dense * (n @ velocity) * n
        media.append(sheet)
    box = Box(tuple(media), force, np.tile(velocity, (SHAPE.prod(), 1)))
    box.advance(1500)
    off = box.velocity().mean(axis=0) - velocity
    # Along a direction in which neither resists, nothing but the start sets the velocity.
    assert np.linalg.norm(off) < within * np.linalg.norm(velocity)


@pytest.mark.parametrize(
    ("diameter_mm", "spacing", "offset"),
    [(0.09, 4, 0.0), (0.09, 8, 0.0), (0.09, 8, 0.25), (0.09, 8, 0.5), (0.03, 8, 0.25), (0.09, 16, 0.25)],
)
def test_wires_that_the_grid_tells_apart_hold_slow_blood_up_as_their_row_does(
    diameter_mm: float, spacing: int, offset: float
) -> None:
    """The row's law (Tamada and Fujikawa) is of the mean velocity; a grid has blood slower at wires far apart."""
    spacing_m = spacing * CELL_M
    assert concentration(diameter_mm, 1e3 * spacing_m, 1e3 * CELL_M) > 1.1
    expected = 1e-3 * STEP_S / CELL_M
    force = VISCOSITY * drag_per_length(1e-3 * diameter_mm, spacing_m) / spacing * expected / SHAPE[2]
    start = np.tile([0.0, 0.0, expected], (SHAPE.prod(), 1))
    box = Box((row(diameter_mm, spacing, offset),), np.array([0.0, 0.0, force]), start)
    before, now = 0.0, expected
    for _ in range(100):
        if abs(now - before) < 1e-4 * expected:
            break
        box.advance(500)
        before, now = now, box.velocity()[:, 2].mean()
    else:
        pytest.fail("the flow through the row has not settled")
    assert now == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("density", [0.15, 0.3])
def test_a_region_resists_alike_in_all_directions_with_inertia(density: float, way: tuple[float, float, float]) -> None:
    """The pressure gradient that drives the blood is mu u / K, and more by inertia in proportion to the speed."""
    permeability_mm2 = float(permeability_mm2_of(np.array(density), 0.3))
    places = np.argwhere(np.ones(SHAPE, bool)) + 0.3
    alike, cell_mm = np.ones(len(places)), 1e3 * CELL_M
    viscous_Pa_s_m = DENSITY_KG_M3 * VISCOSITY_M2_S / permeability_mm2 * 1e3 * alike
    loss = 4 * COIL_INERTIA * 0.3 / permeability_mm2 * alike
    region = Sheet(
        cell_mm * places,
        np.zeros((len(places), 3)),
        cell_mm**3 * alike,
        viscous_Pa_s_m,
        viscous_Pa_s_m,
        loss,
        alike,
        alike,
    )
    speed_m_s = 0.1
    gradient_Pa_m = DENSITY_KG_M3 * VISCOSITY_M2_S * speed_m_s / (permeability_mm2 * 1e-6)
    gradient_Pa_m *= 1 + COIL_INERTIA * speed_m_s * 3e-4 / VISCOSITY_M2_S
    force = gradient_Pa_m / DENSITY_KG_M3 * STEP_S**2 / CELL_M * np.array(way)
    box = Box((region,), force, np.zeros((np.prod(SHAPE), 3)))
    box.advance(2500)
    found_m_s = box.velocity() * CELL_M / STEP_S
    np.testing.assert_allclose(found_m_s, np.tile(speed_m_s * np.array(way), (len(places), 1)), atol=0.005 * speed_m_s)


def test_a_region_and_a_sheet_in_one_cell_add() -> None:
    """The region is in half of the cells of the sheet, and alone in others, where it has no axis.

    Along the normal the quadratic term of `resist` is whole, and in a region without one it is halved.
    """
    sheet = samples(np.array([0.0, 0.0, 1.0]), 60.0, 0.0)
    places = np.argwhere(np.ones(SHAPE, bool)) + 0.0
    alike = np.ones(len(places))
    region = Sheet(1e3 * CELL_M * places, np.zeros((len(places), 3)), 1e-3 * alike, alike, alike, alike, alike, alike)
    alone, both = dict(zip(*entries((sheet,)), strict=True)), dict(zip(*entries((region, sheet)), strict=True))
    of_region = dict(zip(*entries((region,)), strict=True))
    for cell, (*normal, along, across, loss, spread) in both.items():
        mine = alone.get(cell, np.zeros(7))
        assert along == pytest.approx(mine[3] + of_region[cell][3], rel=1e-5)
        assert across == pytest.approx(mine[4] + of_region[cell][4], rel=1e-5)
        assert loss == pytest.approx(mine[5] + (0.5 if cell in alone else 1.0) * of_region[cell][5], rel=1e-5)
        np.testing.assert_allclose(np.abs(normal), np.abs(mine[:3]), atol=1e-6)
        assert spread <= mine[6] + 1e-9
