"""The parts of the flow floor whose answer is known without a run: screen, profile, wall stress, convergence."""

import json
from dataclasses import replace
from math import gamma
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tubes import arc, line, tube

from vstent.deployment.deploy import deploy
from vstent.devices import catalogue
from vstent.devices.stent import Stent
from vstent.errors import FlowError
from vstent.flow import domain
from vstent.flow.drag import (
    BREADTH,
    CROSSING_PER_SOLIDITY,
    INERTIAL_LOSS,
    LEAST_SHARE,
    concentration,
    crossing_factor,
    drag_per_length,
    inertial_loss,
    parted,
    round_diameter,
    tangential_share,
)
from vstent.flow.engines import AbstractEngine, run
from vstent.flow.lattice.scales import Scales
from vstent.flow.lattice.screen import on_grid
from vstent.flow.lattice.settling import field_left, mean_of, with_check
from vstent.flow.lattice.state import Snapshot
from vstent.flow.media import media
from vstent.flow.problem import vessel_case
from vstent.flow.profile import developed_profile
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics
from vstent.flow.stopping import fraction_left, standard_error, swings
from vstent.flow.wall_stress import mean_shear_Pa, wall_stress
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Opening, Vessel

DIAMETER_MM, LENGTH_MM, N_WIRES = 4.0, 10.0, 48


def braid(angle_rad, wire_um=30.0, outside_mm=0.0):
    """A straight tube of helices, half of them left-handed, so far outside a contour of rows and columns."""
    z = np.linspace(0, LENGTH_MM, 400)
    turn = 2 * np.tan(angle_rad) * z / DIAMETER_MM
    wires = []
    for k in range(N_WIRES):
        hand, start = (1 if k % 2 else -1), 4 * np.pi * (k // 2) / N_WIRES
        phase = hand * turn + start
        radius_mm = 0.5 * DIAMETER_MM + outside_mm
        wires.append(np.stack([radius_mm * np.cos(phase), radius_mm * np.sin(phase), z], axis=1))
    angle = 2 * np.pi * np.arange(48) / 48
    rows = np.linspace(0, LENGTH_MM, 50)
    ring = 0.5 * DIAMETER_MM * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    nodes = ring[None] + rows[:, None, None] * [0, 0, 1]
    design = catalogue.find_design("silk")
    starts = np.arange(N_WIRES + 1) * len(z)
    size = catalogue.find_size(design)
    return Stent(design, size, nodes, rows, np.concatenate(wires), starts, np.full(N_WIRES, wire_um))


def test_drag_of_a_row_of_cylinders_is_tamada_and_fujikawas():
    assert drag_per_length(1.0, 6.0) == pytest.approx(
        10.70, rel=5e-3
    )  # 10.744; the table of references rounds to 10.70
    far = drag_per_length(1.0, np.array([1e3, 1e4]))
    assert 8 * np.pi / far[1] - 8 * np.pi / far[0] == pytest.approx(2 * np.log(10), rel=1e-5)


def test_a_square_strut_and_a_flat_one_have_the_round_diameters_known_of_them() -> None:
    """Outer conformal radius: Gamma(1/4)^2 / (4 pi^(3/2)) of a square's side; a quarter of a flat strip's width."""
    square = 2 * gamma(0.25) ** 2 / (4 * np.pi**1.5)
    assert round_diameter(3.0, 3.0) == pytest.approx(3 * square)
    assert round_diameter(1.0, 1e-6) == pytest.approx(0.5, rel=1e-4)
    assert round_diameter(2.0, 1.0) == pytest.approx(round_diameter(1.0, 2.0))
    assert 1.5 < round_diameter(2.0, 1.0) < 2 * square


def test_the_screen_of_a_laser_cut_device_resists_as_its_round_wires_would() -> None:
    stent = deploy(catalogue.find_design("enterprise"), tube(line(26), 1.9)).stent
    wide = round_diameter(78.0, 78.0)
    thin = replace(stent.design, strut_thickness_um=1e-3)
    flat = replace(stent, design=thin, wire_diameter_um=np.full_like(stent.wire_diameter_um, 2 * wide))
    (one,), (other,) = media(stent, Blood()), media(flat, Blood())
    for name in ("normal_resistance_Pa_s_m", "tangential_resistance_Pa_s_m", "inertial_loss"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-3)


def test_the_inertial_loss_vanishes_without_wires():
    assert inertial_loss(0.0) == 0
    assert inertial_loss(0.03) == pytest.approx(2 * inertial_loss(0.015))
    assert inertial_loss(0.2) == inertial_loss(0.1) == INERTIAL_LOSS


@pytest.mark.parametrize(("degrees", "expected"), [(70, 480.0), (60, 250.0)])
def test_the_screen_of_a_braid_resists_as_its_closed_form(degrees, expected):
    (made,) = media(braid(np.radians(degrees)), Blood())
    middle = (made.points_mm[:, 2] > 2) & (made.points_mm[:, 2] < LENGTH_MM - 2)
    found = made.normal_resistance_Pa_s_m[middle]
    spacing_mm = np.pi * DIAMETER_MM * np.cos(np.radians(degrees)) / (N_WIRES / 2)
    law = 2 * 0.004 * drag_per_length(0.03, spacing_mm) / (spacing_mm * 1e-3)
    assert law == pytest.approx(expected, rel=0.01)
    law *= crossing_factor(0.03, spacing_mm)
    assert found.mean() == pytest.approx(law, rel=0.02)
    assert found.std() < 0.03 * law
    share = made.tangential_resistance_Pa_s_m[middle] / found
    lengthwise = np.cos(np.radians(degrees)) ** 2
    assert share.mean() == pytest.approx(tangential_share(0.03 / spacing_mm, lengthwise), rel=0.02)
    assert made.area_mm2.sum() == pytest.approx(np.pi * DIAMETER_MM * LENGTH_MM, rel=0.005)


@pytest.fixture(scope="module")
def resolved():
    """The kept table of resolved crossing wires."""
    return json.loads((Path(__file__).parents[2] / "benchmarks" / "screen.json").read_text())


def test_a_screen_lies_where_the_wires_are():
    outside_mm = 0.08
    (made,) = media(braid(np.radians(65), outside_mm=outside_mm), Blood())
    radius_mm = np.hypot(*made.points_mm[:, :2].T)
    assert radius_mm.mean() == pytest.approx(0.5 * DIAMETER_MM + outside_mm, abs=0.003)
    assert made.area_mm2.sum() == pytest.approx(np.pi * (DIAMETER_MM + 2 * outside_mm) * LENGTH_MM, rel=0.005)


def test_wires_so_near_that_their_bands_melt_are_a_sheet_and_far_ones_are_lines() -> None:
    near_mm, far_mm = np.array([0.05, 0.15, 0.25]), np.array([2.0, 4.0])
    np.testing.assert_array_equal(concentration(0.03, near_mm, 0.15), 1.0)
    np.testing.assert_array_equal(parted(near_mm), 0.0)
    np.testing.assert_array_equal(parted(far_mm), 1.0)
    assert 0 < parted(0.8) < parted(1.0) < 1
    assert concentration(0.09, 1.3, 0.2) < concentration(0.09, 1.3, 0.1)  # a finer grid slows blood more by itself
    slender = tangential_share(0.07, 0.5, 1.0)
    assert slender == pytest.approx(0.75)  # half along, half across
    assert tangential_share(0.07, 0.5, 0.0) > tangential_share(0.07, 0.5, 0.5) > slender


def test_struts_far_apart_leave_open_what_lies_between_them() -> None:
    stent = deploy(catalogue.find_design("enterprise"), tube(line(26), 1.9)).stent
    (made,) = media(stent, Blood())
    start = stent.piece_starts
    part = np.linspace(0, 1, 20)[:, None, None]
    axes_mm = (1 - part) * stent.wire_points_mm[start] + part * stent.wire_points_mm[start + 1]
    away_mm = cKDTree(axes_mm.reshape(-1, 3)).query(made.points_mm)[0]
    assert (away_mm < 0.5 * BREADTH * made.spacing_mm + 0.02).all()
    lumen_mm = tube(line(26), 1.9).vessel.lumen.vertices_mm
    along_mm = np.ptp(stent.nodes_mm[..., 2])
    spanned = np.abs(lumen_mm[:, 2] - stent.nodes_mm[..., 2].mean()) < 0.4 * along_mm
    to_band_mm = cKDTree(made.points_mm).query(lumen_mm[spanned])[0]
    assert (to_band_mm > 0.2).mean() > 0.1


def test_crossing_wires_resist_as_resolved_ones(resolved):
    for row in resolved:
        assert crossing_factor(row["diameter_over_spacing"], 1.0) == pytest.approx(row["crossing_factor"], rel=0.05)
    slope = np.mean([(row["crossing_factor"] - 1) / row["diameter_over_spacing"] for row in resolved])
    assert slope == pytest.approx(CROSSING_PER_SOLIDITY, abs=0.01)
    assert crossing_factor(0.0, 1.0) == 1


def test_blood_keeps_as_much_of_its_way_along_a_screen_as_in_resolved_wires(resolved):
    for row in resolved:
        lengthwise = np.cos(np.radians(row["angle_deg"])) ** 2
        law = 1 / tangential_share(row["diameter_over_spacing"], lengthwise)
        assert law == pytest.approx(max(row["normal_over_tangential"], LEAST_SHARE), abs=0.1)
    assert tangential_share(0.0, 1.0) < tangential_share(0.0, 0.0) < tangential_share(0.1, 0.0)


def test_blood_at_an_angle_loses_as_much_to_inertia_as_in_resolved_wires(resolved):
    sparse = [row["inertial_loss"] for row in resolved if row["diameter_over_spacing"] < 0.15]
    assert np.mean(sparse) == pytest.approx(INERTIAL_LOSS, abs=0.03)


def test_thicker_wires_resist_more_and_none_of_it_is_lost_inside_the_blood():
    (thin,), (thick,) = (media(braid(np.radians(65), um), Blood()) for um in (30.0, 50.0))
    assert (thick.normal_resistance_Pa_s_m > thin.normal_resistance_Pa_s_m).all()
    index = np.arange(31 * 31 * 61, dtype=np.int32).reshape(31, 31, 61)
    spread = on_grid((thin,), index, np.array([-3.0, -3.0, -1.0]), 0.2)
    total = (spread.along_Pa_s_m2 * 0.2**3 * 1e-3).sum()
    assert total == pytest.approx((thin.normal_resistance_Pa_s_m * thin.area_mm2).sum(), rel=1e-9)
    np.testing.assert_allclose(np.linalg.norm(spread.normal, axis=1), 1.0)


def test_the_profile_of_a_round_section_is_a_parabola():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    normal = np.array([0.6, 0.0, 0.8])
    first, second = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])
    section = 2.0 * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    radius = np.linspace(0, 1.8, 10)
    speed = developed_profile(section, normal, radius[:, None] * first + 0.3 * normal)
    np.testing.assert_allclose(speed / speed[0], 1 - (radius / 2) ** 2, atol=0.006)


@pytest.mark.parametrize("cells_per_diameter", [10, 20])
def test_wall_stress_of_an_exact_poiseuille_flow_is_exact(cells_per_diameter):
    vessel = tube(line(8.0), 2.0).vessel
    grid = domain.build(vessel, 4.0 / cells_per_diameter)
    radius2 = (grid.centers_mm[:, :2] ** 2).sum(axis=1)
    velocity = np.stack([0 * radius2, 0 * radius2, 1 - radius2 / 4.0], axis=1)
    pressure_Pa = 3.0 - 2.0 * grid.centers_mm[:, 2]
    stress, pressure = wall_stress(grid, velocity, pressure_Pa, lumen=vessel.lumen, blood=Blood())
    z = vessel.lumen.vertices_mm[:, 2]
    middle = (z > 2) & (z < 6)
    # 0.44 % at most, from the facets: depths are those of a polygon, the velocity that of the circle round it.
    np.testing.assert_allclose(stress[middle, 2], 0.004 * 1.0 / 2e-3 * 2, rtol=0.005)
    np.testing.assert_allclose(pressure[middle], 3.0 - 2.0 * z[middle], atol=1e-6)
    # As much of a flow that goes to and fro: beside a wall the mean speed grows by the mean shear rate.
    speed = 2 / np.pi * velocity[:, 2]
    sizes_Pa = mean_shear_Pa(grid, 0 * velocity, speed, lumen=vessel.lumen, blood=Blood())
    np.testing.assert_allclose(sizes_Pa[middle], 2 / np.pi * 0.004 * 1.0 / 2e-3 * 2, rtol=0.005)


@pytest.mark.parametrize("thinning", [None, CarreauYasuda()])
def test_what_does_not_move_has_the_stress_of_its_mean_where_it_turns_too(thinning):
    """Along the wall it turns every 1.5 mm: the speed alone would tell half as much again in the mean."""
    vessel, blood = tube(line(8.0), 2.0).vessel, Blood(thinning=thinning)
    grid = domain.build(vessel, 0.3)
    x, y, z = grid.centers_mm.T
    velocity = np.stack([0 * x, 0 * x, (1 - (x**2 + y**2) / 4) * np.cos(np.pi * z / 1.5)], axis=1)
    still_Pa, _ = wall_stress(grid, velocity, 0 * x, lumen=vessel.lumen, blood=blood)
    found_Pa = mean_shear_Pa(grid, velocity, np.linalg.norm(velocity, axis=1), lumen=vessel.lumen, blood=blood)
    np.testing.assert_allclose(found_Pa, np.linalg.norm(still_Pa, axis=1), rtol=1e-6, atol=1e-9)


def test_the_grid_of_a_tube_has_its_volume_its_ends_and_exact_wall_distances():
    vessel = tube(line(8.0), 2.0).vessel
    grid = domain.build(vessel, 0.2)
    z = grid.centers_mm[:, 2]
    assert ((z > 0) & (z < 8)).sum() * 0.2**3 == pytest.approx(np.pi * 4 * 8, rel=0.01)
    ends = [section[:, 2].mean() for section in grid.sections]
    assert ends == pytest.approx([-4.0 * domain.INLET_EXTENSION, 8 + 4.0 * domain.OUTLET_EXTENSION])
    hit = domain.VELOCITIES[grid.link_direction] * grid.link_fraction[:, None] * 0.2 + grid.centers_mm[grid.link_cell]
    wall = grid.link_patch == 0
    np.testing.assert_allclose(np.hypot(hit[wall, 0], hit[wall, 1]), 2.0, atol=2e-3)
    np.testing.assert_allclose(hit[grid.link_patch == 1, 2], ends[0], atol=1e-9)
    np.testing.assert_allclose(hit[grid.link_patch == 2, 2], ends[1], atol=1e-9)
    assert len(grid.septum_cell) == 0


def duct(section_mm: list[tuple[float, float]], length_mm: float = 6.0) -> Vessel:
    """A prism along z over a polygon, counterclockwise; blood enters at its low end."""
    corners = np.array(section_mm)
    sides = np.roll(corners, -1, axis=0) - corners
    ring = np.concatenate(
        [a + np.linspace(0, 1, 8, endpoint=False)[:, None] * b for a, b in zip(corners, sides, strict=True)]
    )
    n, z = len(ring), np.array([0.0, length_mm])
    vertices = np.column_stack([np.tile(ring, (2, 1)), np.repeat(z, n)])
    low, next_low = np.arange(n), np.roll(np.arange(n), -1)
    faces = np.concatenate([np.stack(x, 1) for x in ((low, next_low, next_low + n), (low, next_low + n, low + n))])
    x, y = ring.T
    twice = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = 0.5 * twice.sum()
    center = [((v + np.roll(v, -1)) * twice).sum() / (6 * area) for v in (x, y)]
    ends = [
        Opening([*center, h], [0, 0, s], area, role)
        for h, s, role in zip(z, (-1, 1), ("inlet", "outlet_1"), strict=True)
    ]
    return Vessel(Surface(vertices, faces.astype(np.int32)), tuple(ends))


@pytest.mark.parametrize(("turn_degrees", "straight_mm"), [(300, 2.0), (300, 3.0)])
def test_extensions_of_openings_that_face_each_other_keep_apart(turn_degrees: float, straight_mm: float) -> None:
    """The blood is the vessel's and both extensions', none of it twice; both ends are open as a tube's."""
    vessel = tube(arc(8.0, np.radians(turn_degrees), straight_mm=straight_mm), 1.5, around=60).vessel
    grid = domain.build(vessel, 0.15)
    ends = zip(grid.sections, vessel.openings, strict=True)
    length_mm = sum(float(((section - k.center_mm) @ k.normal).max()) for section, k in ends)
    expected_mm3 = abs(vessel.closed.volume_mm3) + np.pi * 1.5**2 * length_mm
    assert len(grid.cells) * 0.15**3 == pytest.approx(expected_mm3, rel=1e-3)
    links = np.bincount(grid.link_patch)[1:]
    assert links.min() > 0.8 * 5 * np.pi * (1.5 / 0.15) ** 2


def test_a_corner_that_a_link_clips_parts_nothing_but_a_wall_thinner_than_a_cell_does() -> None:
    """Blood sent back at the lip of the FDA's nozzle by 13 such links turned its jet."""
    step = duct([(0, 0), (4, 0), (4, 2), (2.1, 2), (2.1, 4), (0, 4)])
    assert len(domain.build(step, 0.25).septum_cell) == 0
    tip = np.array([2.5, 2.03])
    wedge = duct([(0, 0), (4, 0), (4, 1.73), (2.5, 2.03), (4, 2.33), (4, 4), (0, 4)])
    grid = domain.build(wedge, 0.25)
    start = grid.centers_mm[grid.septum_cell]
    end = start + 0.25 * domain.VELOCITIES[grid.septum_direction]
    offset = np.stack([start, end])[..., :2] - tip
    beyond = np.abs(offset[..., 1]) - 0.2 * offset[..., 0]  # beyond the wall on either side: positive in the blood
    assert len(start) > 50
    assert (beyond > 0).all()
    assert (offset[0, :, 1] * offset[1, :, 1] < 0).all()
    assert (offset[..., 0].max(axis=0) > 0).all()


def test_what_is_left_to_go_is_foretold_from_an_exponential_approach():
    time = np.arange(80.0)
    history = np.stack([3.0 + np.exp(-time / 17), np.full(80, 2.0)], axis=1)
    left = np.exp(-79 / 17) / 3.0
    assert 0.5 * left < fraction_left(history) < 3 * left
    assert np.isnan(fraction_left(np.array([[1.0, np.nan]])))
    assert fraction_left(history[:4]) == np.inf


@pytest.mark.parametrize("period", [7.0, 13.0, 23.0])
def test_what_is_left_of_a_swing_is_neither_missed_nor_mistaken(period: float) -> None:
    """A change of means passes through zero at every turn: what is left then looks like nothing, or like the whole."""
    time = np.arange(120.0)
    history = (3.0 + 0.1 * np.exp(-time / 17) * np.cos(2 * np.pi * time / period))[:, None]
    left = 0.1 / 3.0 * np.exp(-time / 17)
    found = np.array([fraction_left(history[:n]) for n in range(60, 120)])
    assert (found > 0.5 * left[59:-1]).all()
    assert (found < 12 * left[59:-1]).all()


def test_a_mean_is_told_with_what_it_ranges_over_and_how_it_moves() -> None:
    time = np.arange(40.0)
    drift, wave = 2.0 + 0.01 * time, 5.0 + 0.5 * np.cos(np.pi * time / 4)  # eight checks: a whole period
    swing, moved = swings(np.stack([drift, wave], axis=1), 8)
    assert swing == pytest.approx(1.0 / 5.0)
    assert moved == pytest.approx(0.08 / drift[-8:].mean())
    assert np.isnan(swings(drift[:12, None], 8)[1])


def test_the_mean_of_what_swings_is_told_with_its_error() -> None:
    """Of an autoregressive swing it is known: the mean lies within two standard errors in 95 of a hundred runs."""
    rng, keep, checks = np.random.default_rng(7), 0.6, 200
    runs = np.zeros((checks, 400))
    runs[0] = rng.normal(size=400)
    for k in range(1, checks):
        runs[k] = keep * runs[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=400)
    true = 0.1 * np.sqrt((1 + keep) / (1 - keep) / checks)
    found = np.array([standard_error(1 + 0.1 * run[:, None]) for run in runs.T])
    assert np.median(found) == pytest.approx(true, rel=0.25)
    assert (np.abs(0.1 * runs.mean(axis=0)) < 2 * found).mean() > 0.9
    assert standard_error(1 + 0.1 * runs[:23, :1]) == np.inf


def test_what_drifts_has_no_mean() -> None:
    """Its whole range is what it is unsure by, although its batches differ by little, and though it swings as well."""
    time = np.arange(60.0)
    drift = 1 + 0.1 * np.exp(-time / 40)
    assert standard_error(drift[:, None]) == pytest.approx(np.ptp(drift) / drift.mean())
    swinging = drift + 0.02 * np.sin(time)
    assert standard_error(swinging[:, None]) > 0.2 * np.ptp(drift)


def test_a_vortex_that_creeps_has_no_mean_though_its_speed_has() -> None:
    blocks: tuple[Snapshot, ...] = ()
    scales, checks = Scales(1e-4, 1e-5, Blood()), 64
    for angle in np.linspace(0.0, 0.4, checks):
        velocity = np.array([[np.cos(angle), np.sin(angle), 0.0], [9.0, 9.0, 9.0]], np.float32)
        blocks = with_check(blocks, Snapshot(scales, velocity, np.zeros(2, np.float32), np.zeros(1)))
    assert sum(block.checks for block in blocks) == checks
    still = np.ones((checks, 2))
    assert standard_error(still) == 0.0
    # The last half turns from 0.2 to 0.4: its halves' means are 0.1 apart, and what is told is a tenth of half of it.
    assert mean_of(blocks, still, np.array([0])).left == pytest.approx(0.005, rel=0.02)
    assert mean_of(blocks, still, np.array([1])).left == 0.0


def test_what_a_field_has_left_is_told_where_its_mean_speed_turns() -> None:
    """Speed falls fast in one half and rises slowly in the other: where the mean turns, it tells nothing."""
    time = np.arange(200.0)
    fields = np.zeros((200, 2, 3), np.float32)
    fields[:, 0, 0] = 1 + 0.2 * np.exp(-time / 5)
    fields[:, 1, 1] = 1 - 0.15 * np.exp(-time / 20)
    mean = np.linalg.norm(fields, axis=2).mean(axis=1)
    left = np.linalg.norm(fields[-1] - fields, axis=(1, 2)) / np.linalg.norm(fields, axis=(1, 2))
    turn = 4 + int(np.argmin(mean))
    assert fraction_left(mean[: turn + 1, None]) < 0.001 < 0.05 < left[turn]
    found = np.array([field_left(fields[max(0, n - 6) : n + 1]) for n in range(200)])
    assert (found[turn:100] > 0.4 * left[turn:100]).all()
    np.testing.assert_allclose(found[turn + 20 : 80], left[turn + 20 : 80], rtol=0.02)
    assert np.isinf(found[:6]).all()


class Halving(AbstractEngine[list]):
    """An engine whose residual halves at every check; `ends` makes its third step misbehave."""

    def __init__(self, ends=None):
        self.ends = ends

    def init(self, case, start):
        return [1.0]

    def step(self, state):
        if self.ends is not None and len(state) == 3:
            if self.ends == "ctrl-c":
                raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
            return [*state, np.nan]
        return [*state, state[-1] / 2]

    def terminate(self, state):
        return state[-1]

    def save(self, state):
        return {"state": np.array(state)}

    def resume(self, case, saved):
        return saved["state"].tolist()

    def trouble(self, state):
        return f"the flow diverged at check {len(state) - 1}"

    def max_checks(self, state):
        return 12

    def result(self, state, outcome):
        return outcome


def flow_case_of(tolerance):
    return vessel_case(tube(line(8.0), 2.0).vessel, FlowSettings(numerics=Numerics(tolerance=tolerance)))


def test_the_driver_stops_at_the_tolerance_or_says_that_it_did_not():
    told = []
    settled = run(Halving(), flow_case_of(0.01), progress=told.append)
    assert settled.is_converged
    assert settled.residual == tuple(0.5 ** np.arange(1, 8))
    assert [now.residual for now in told] == list(settled.residual)
    assert told[-1].fraction == 1.0
    unsettled = run(Halving(), flow_case_of(1e-9))
    assert not unsettled.is_converged
    assert len(unsettled.residual) == 12


def test_the_driver_names_divergence_and_lets_ctrl_c_out_of_a_kernel():
    with pytest.raises(FlowError, match="diverged at check 3"):
        run(Halving("nan"), flow_case_of(0.01))
    with pytest.raises(KeyboardInterrupt):
        run(Halving("ctrl-c"), flow_case_of(0.01))
