"""A close-up computes the sac and its neck on fine cells, in a flow computed on wide ones."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from levels import with_values
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from shapes import sphere
from tubes import arc, line, tube
from womersley import MEAN_MEAN_M_S, PULSE, RADIUS_M, womersley_m_s

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.errors import FlowError, InputError
from vstent.flow import domain, sampling
from vstent.flow import simulation as flow
from vstent.flow.case import FlowCase, FlowField, Level, Sheet, Target
from vstent.flow.engines import AbstractEngine, run
from vstent.flow.indices import indices
from vstent.flow.lattice import close_up as close_ups
from vstent.flow.lattice.cost import estimate
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.pace import peak_speed_m_s
from vstent.flow.lattice.setup import thickest
from vstent.flow.lattice.stepping import build, imposed, snapshot, take_pace
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import OPENFOAM, FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy, Vessel

RADIUS_MM, INFLOW_ML_S = 2.0, 1.0
MEAN_M_S = INFLOW_ML_S / (np.pi * RADIUS_MM**2)


def ball(center_mm: tuple[float, float, float], radius_mm: float = 1.0) -> Surface:
    """Stands for a sac: what a close-up is of."""
    whole = sphere(radius_mm)
    return Surface(whole.vertices_mm + np.array(center_mm), whole.faces)


@cache
def demo() -> Anatomy:
    return restore(trim(trace(Vessel(phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.3)))))


@cache
def of_tube() -> FlowField:
    vessel = tube(line(40.0), RADIUS_MM).vessel
    settings = FlowSettings(inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.2, close_up=True, tolerance=2e-3))
    return simulate_case(vessel_case(vessel, settings, target=Target(ball((0.0, 0.0, 24.0)), None)))


def at_rest(case: FlowCase, grid: domain.Domain) -> FlowField:
    """A flow of one outlet of which nothing but what goes through it is known."""
    still, lumen = np.zeros((len(grid.cells), 3)), case.vessel.lumen
    stress = np.zeros((len(lumen.vertices_mm), 3))
    values = lumen, stress, stress[:, 0], case.inlets_mL_s, case.inlets_mL_s, np.zeros(1)
    told = case.blood, True, 0.0, "", np.zeros(1), 1, 1.0, 1.0
    level = Level(grid.cells, grid.origin_mm, grid.cell_size_mm, still, still[:, 0])
    return FlowField((level,), *values, np.zeros(1), *told)


@cache
def outer_of_demo() -> tuple[FlowCase, FlowField]:
    case = flow_case(demo(), (), FlowSettings(numerics=Numerics(cell_size_mm=0.5)))
    return case, simulate_case(case)


@cache
def pulse_of_demo() -> tuple[FlowCase, FlowField]:
    """A pulse around it, with a screen across the neck."""
    case, _ = outer_of_demo()
    points_mm = demo().aneurysms[0].neck.vertices_mm
    ones = np.ones(len(points_mm))
    resistances = 300 * ones, 150 * ones, 0.5 * ones
    screen = Sheet(points_mm, ones[:, None] * [0.0, 0.6, 0.8], 0.1 * ones, *resistances, ones, ones)
    settings = FlowSettings(waveform=OLDER_ADULT_ICA, numerics=replace(case.numerics, max_cycles=1))
    pulse = vessel_case(case.vessel, settings, target=case.target, media=(screen,))
    return pulse, simulate_case(pulse)


def test_a_close_up_of_poiseuille_flow_is_poiseuille_flow() -> None:
    field = of_tube()
    x, y, z = field.centers_mm.T
    exact = 2 * MEAN_M_S * (1 - (x**2 + y**2) / RADIUS_MM**2)
    within = (z > 15) & (z < 27)
    error = (field.velocity_m_s - exact[:, None] * [0, 0, 1])[within] / (2 * MEAN_M_S)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.002
    fall_Pa_m = -np.polyfit(z[within] * 1e-3, field.pressure_Pa[within], 1)[0]
    assert fall_Pa_m == pytest.approx(8 * 0.004 * MEAN_M_S / (RADIUS_MM * 1e-3) ** 2, rel=0.01)
    height = field.wall.vertices_mm[:, 2]
    middle = (height > 16) & (height < 26)
    stress_Pa = field.wall_shear_stress_Pa[middle, 2].mean()
    assert stress_Pa == pytest.approx(4 * 0.004 * MEAN_M_S / (RADIUS_MM * 1e-3), rel=0.02)


def test_what_surrounds_a_close_up_is_given_half_of_the_steps_and_no_neck_to_watch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = []

    def telling(engine: AbstractEngine[Any], case: FlowCase, **more: Any) -> FlowField:
        seen.append((engine.cell_size_mm, case.numerics.max_steps, case.ostium))
        return run(engine, case, **more)

    monkeypatch.setattr(flow, "run", telling)
    sac = ball((0.0, 0.0, 24.0))
    settings = FlowSettings(inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.3, close_up=True, max_steps=960))
    simulate_case(vessel_case(tube(line(40.0), RADIUS_MM).vessel, settings, target=Target(sac, sac)))
    assert seen == [(0.6, 480, None), (0.3, 960, sac)]


def test_the_flow_goes_on_across_the_cuts() -> None:
    field = of_tube()
    z = field.centers_mm[:, 2]
    radius_mm = np.hypot(*field.centers_mm[:, :2].T)
    on_axis = radius_mm < 0.3
    exact = 2 * MEAN_M_S * (1 - (radius_mm / RADIUS_MM) ** 2)
    fit = np.polyfit(z[on_axis & (z > 2) & (z < 38)], field.pressure_Pa[on_axis & (z > 2) & (z < 38)], 1)
    for cut_mm, inwards in ((24 - 1 - 3 * 2 * RADIUS_MM, 1), (24 + 1 + 2 * RADIUS_MM, -1)):
        near = on_axis & (np.abs(z - cut_mm) < 2)
        assert np.abs(field.pressure_Pa[near] - np.polyval(fit, z[near])).max() < 0.02 * abs(fit[0]) * 40
        fine = near & (inwards * (z - cut_mm) > 1.0)
        assert np.abs(field.velocity_m_s[fine, 2] - exact[fine]).max() < 0.01 * 2 * MEAN_M_S


def test_a_close_up_of_womersleys_flow_is_womersleys_flow() -> None:
    vessel = tube(line(40.0), RADIUS_MM).vessel
    inflow_mL_s = MEAN_MEAN_M_S * np.pi * RADIUS_M**2 * 1e6
    settings = FlowSettings(
        inflow_mL_s=inflow_mL_s, waveform=PULSE, numerics=Numerics(cell_size_mm=0.3, close_up=True, lattice_speed=0.05)
    )
    field = simulate_case(vessel_case(vessel, settings, target=Target(ball((0.0, 0.0, 24.0)), None)))
    assert field.is_converged
    x, y, z = field.finest.centers_mm.T
    within = (z > 15) & (z < 25)
    peak_m_s = womersley_m_s(np.zeros(1), 0.0).max()
    for phase in field.phases:
        assert phase.inflow_mL_s == pytest.approx(inflow_mL_s * PULSE.factor(np.array([phase.time_s]))[0], rel=2e-3)
        exact = womersley_m_s(1e-3 * np.hypot(x, y), phase.time_s)[:, None] * [0, 0, 1]
        error = (phase.velocity_m_s[-1] - exact)[within] / peak_m_s
        assert np.sqrt((error**2).sum(axis=1).mean()) < 0.004
        assert np.abs(error).max() < 0.01


def test_at_every_phase_cuts_let_through_what_the_flow_around_has_there() -> None:
    pulse, outer = pulse_of_demo()
    state = PulsatileLatticeBoltzmann(0.25, None, outer).init(pulse, outer)
    chosen = close_ups.close_up(pulse, outer)
    ends = state.links.openings
    part = state.links.patch - len(pulse.vessel.openings) - 1
    assert (part >= 0).all()
    assert sorted(ends[:, 0]) == [d3q19.PRESSURE, d3q19.INFLOW, d3q19.OUTFLOW]
    steps = state.steps_per_check * np.array([0.5, 1.0, 4.0, 4.5, 5.0, 20.0, 20.5])
    wanted, moments = imposed(state, steps)
    np.testing.assert_allclose(wanted[0], wanted[-1])  # it is periodic
    flow_mL_s = wanted * np.where(ends[:, 0] == d3q19.INFLOW, 1, -1) * ends[:, 7] * state.scales.flow_mL_s
    for row, phase in ((1, 0), (2, 3), (4, 4), (5, 19)):
        expected = chosen.at_phase(outer.phases[phase]).inflow_mL_s[part]
        is_flow = ends[:, 0] != d3q19.PRESSURE
        np.testing.assert_allclose(flow_mL_s[row][is_flow], expected[is_flow], rtol=1e-9)
        assert moments[row, int(moments[row, 2] > 0.5)] == phase
    inlet = ends[:, 0] == d3q19.INFLOW
    waveform = outer.inflow_mL_s * OLDER_ADULT_ICA.factor(steps * state.scales.step_s)
    np.testing.assert_allclose(flow_mL_s[:, inlet][:, 0], waveform, rtol=5e-3)


def test_what_is_built_for_some_steps_serves_longer_ones_as_if_built_for_them() -> None:
    pulse, outer = pulse_of_demo()
    state = PulsatileLatticeBoltzmann(0.25, None, outer).init(pulse, outer)
    checks = int(state.pace.argmin())
    assert state.pace[checks] < 0.7 * state.pace[0]
    state.history = [np.zeros(1)] * checks
    take_pace(state)
    fewest = state.pace[[checks]]
    wanted = build(pulse, 0.25, state.check_s, fewest, close_up=state.close_up, start=None, kept=1)
    assert state.scales == wanted.scales
    assert len(state.screen.entry) > 20
    np.testing.assert_allclose(state.screen.entry, wanted.screen.entry, rtol=1e-5)
    np.testing.assert_allclose(state.links.correction, wanted.links.correction, atol=1e-6)
    for name in ("wanted", "course", "shape"):
        expected = getattr(wanted.links, name)
        np.testing.assert_allclose(getattr(state.links, name), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_every_place_has_one_cell() -> None:
    field = of_tube()
    coarse, fine = field.levels
    assert coarse.cell_size_mm == 2 * fine.cell_size_mm
    left = cKDTree(coarse.centers_mm[field.is_finest[0]])
    assert left.query(fine.centers_mm, p=np.inf)[0].min() > 0.7 * coarse.cell_size_mm  # no fine cell in a coarse one
    whole = domain.build(tube(line(40.0), RADIUS_MM).vessel, 0.2)
    assert (field.sizes_mm**3).sum() == pytest.approx(len(whole.cells) * 0.2**3, rel=1e-2)


def test_through_a_slanting_plane_across_both_grids_passes_the_inflow() -> None:
    """The grids meet at the cut, 11 mm from the inlet: a plane at 60 degrees to the axis crosses it."""
    field = of_tube()
    ring = np.arange(48) * np.pi / 24
    normal, middle = np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)]), np.array([0.0, 0.0, 11.0])
    rim = middle + 6.0 * (
        np.outer(np.cos(ring), [0.0, 1.0, 0.0]) + np.outer(np.sin(ring), np.cross(normal, [0.0, 1.0, 0.0]))
    )
    fan = np.stack([np.zeros(48, int), 1 + np.arange(48), 1 + (1 + np.arange(48)) % 48], axis=1)
    points_mm, area_mm2 = sampling.surface_samples(Surface(np.concatenate([middle[None], rim]), fan), 0.1)
    through_mL_s = sampling.through_surface_mL_s(field, points_mm, area_mm2)
    on_fine = cKDTree(field.finest.centers_mm).query(points_mm)[0] < 0.2
    carried = np.abs(np.array([through_mL_s[on_fine].sum(), through_mL_s[~on_fine].sum()]))
    assert (carried > 0.2 * INFLOW_ML_S).all()
    assert carried.sum() == pytest.approx(INFLOW_ML_S, rel=0.01)


def test_through_every_cut_passes_what_the_openings_beyond_it_take() -> None:
    case, outer = outer_of_demo()
    engine = LatticeBoltzmann(0.25, None, outer)
    state = engine.init(replace(case, numerics=replace(case.numerics, cell_size_mm=0.25, close_up=True)), outer)
    close_up = close_ups.close_up(case, outer)
    assert close_up.inflow_mL_s.sum() == pytest.approx(0, abs=1e-3 * outer.inflow_mL_s)
    assert (np.sort(close_up.inflow_mL_s) == np.sort([*outer.inlets_mL_s, *-outer.outlets_mL_s])).all()
    while state.steps < 3000:
        state = engine.step(state)
    inflow_mL_s = -state.snapshots[-1].outflow * state.scales.flow_mL_s
    order = state.links.patch - len(case.vessel.openings) - 1
    assert inflow_mL_s == pytest.approx(close_up.inflow_mL_s[order], abs=0.003 * outer.inflow_mL_s)
    assert inflow_mL_s.sum() == pytest.approx(0, abs=0.002 * outer.inflow_mL_s)


def test_blood_may_be_thick_in_and_near_a_cut_and_behind_openings_only() -> None:
    case, outer = outer_of_demo()
    grid = close_ups.build(case, 0.25, close_ups.close_up(case, outer))
    limit = thickest(case, grid)
    in_cut = grid.cells[np.unique(grid.link_cell[grid.link_patch > len(case.vessel.openings)])]
    away = cKDTree(in_cut).query(grid.cells, p=np.inf)[0]
    assert set(limit[away <= 2]) == {5.0}
    assert set(limit[(away > 2) & (away <= 6)]) == {25.0}
    assert set(limit[away > 6]) == {75.0}
    whole = domain.build(case.vessel, 0.25)
    outside = np.zeros(len(whole.cells), dtype=bool)
    for opening in case.vessel.openings:
        offset_mm = whole.centers_mm - opening.center_mm
        outside |= (offset_mm @ opening.normal > 0) & (np.linalg.norm(offset_mm, axis=1) < 3 * opening.diameter_mm)
    assert set(thickest(case, whole)[~outside]) == {75.0}
    assert set(thickest(case, whole)[outside]) == {25.0}


def test_an_artery_that_only_passes_by_is_not_in_the_close_up() -> None:
    path = arc(2.4, np.pi, straight_mm=14.0)
    case = vessel_case(
        tube(path, 1.9).vessel,
        FlowSettings(numerics=Numerics(cell_size_mm=0.38)),
        target=Target(ball((0.0, 0.0, -9.0)), None),
    )
    outer = simulate_case(replace(case, numerics=replace(case.numerics, max_steps=240)))
    close_up = close_ups.close_up(case, outer)
    passing = outer.centers_mm[:, 0] > 2.4
    beside = passing & (np.linalg.norm(outer.centers_mm - [0, 0, -9.0], axis=1) < 4.0)
    assert beside.sum() > 100
    assert (close_up.part[passing] >= 0).all()
    fine = close_ups.build(case, 0.19, close_up)
    assert fine.centers_mm[:, 0].max() < 2.4
    assert fine.centers_mm[:, 2].min() < -14.0  # upstream it reaches the inlet's extension
    assert fine.centers_mm[:, 2].max() < -9.0 + 1.0 + 3.8 + 2 * 0.38


@pytest.mark.parametrize("gap_mm", [0.3, 0.5])
def test_a_close_up_does_not_reach_through_the_walls_of_arteries_that_touch(gap_mm: float) -> None:
    """Gaps narrower than a wide cell, along limbs and extensions."""
    middle_mm = 1.5 + 0.5 * gap_mm
    vessel = tube(arc(middle_mm, np.pi, straight_mm=28.0), 1.5).vessel
    grid = domain.build(vessel, 0.6)
    assert len(grid.septum_cell) > 100
    case = vessel_case(vessel, FlowSettings(inflow_mL_s=2.0), target=Target(ball((-1.5, 0.0, -14.0)), None))
    close_up = close_ups.close_up(case, at_rest(case, grid))
    assert (close_up.part[grid.centers_mm[:, 0] > middle_mm] >= 0).all()
    assert close_up.part_of_opening.tolist() == [0, 1]
    assert close_up.inflow_mL_s == pytest.approx([2.0, -2.0])


def test_what_a_swing_tells_is_the_close_ups_within_and_that_of_the_wide_cells_elsewhere() -> None:
    vessel = tube(line(30.0), RADIUS_MM).vessel
    case = vessel_case(vessel, FlowSettings(inflow_mL_s=INFLOW_ML_S), target=Target(ball((0.0, 0.0, 15.0)), None))
    outer = at_rest(case, domain.build(vessel, 0.5))
    outer = with_values(outer, velocity_m_s=outer.velocity_m_s + np.array([0.0, 0.0, 0.3]))
    chosen = close_ups.close_up(case, outer)
    inner = at_rest(case, close_ups.build(case, 0.25, chosen))
    of_wall = np.arange(len(vessel.lumen.vertices_mm), dtype=float)
    moving = with_values(inner, mean_speed_m_s=np.linspace(1.0, 2.0, len(inner.centers_mm)))
    moving = replace(moving, mean_shear_Pa=of_wall, neck_inflow_mL_s=3.0)
    found = close_ups.assembled(chosen, moving)
    assert found.neck_inflow_mL_s == 3.0
    assert found.levels == (*outer.levels, *moving.levels)
    outside_mm = np.array([[0.0, 0.0, 1.0], [0.5, 0.5, 29.0]])
    np.testing.assert_allclose(sampling.values_at(found, outside_mm)[0], [[0.0, 0.0, 0.3]] * 2, rtol=1e-6)
    grid = sampling.uniform(found).finest
    nearest_mm, of_inner = cKDTree(inner.centers_mm).query(grid.centers_mm)
    is_inner = nearest_mm < 1e-6
    np.testing.assert_array_equal(grid.speed_m_s[is_inner], moving.speed_m_s[of_inner[is_inner]])
    deep = ~is_inner & (np.linalg.norm(grid.centers_mm[:, :2], axis=1) < 1.0)
    deep &= np.abs(grid.centers_mm[:, 2] - 15.0) < 14.0
    assert deep.sum() > 1000
    np.testing.assert_allclose(grid.speed_m_s[deep], 0.3, rtol=1e-6)
    assert set(np.flatnonzero(found.shear_Pa != of_wall)) <= set(np.flatnonzero(found.shear_Pa == 0.0))
    assert (found.shear_Pa == of_wall).sum() > 1000
    assert (found.shear_Pa == 0.0).sum() > 1000
    assert close_ups.assembled(chosen, inner).mean_shear_Pa is None


def test_a_recess_that_leads_nowhere_belongs_to_the_close_up() -> None:
    chain = csr_matrix((np.ones(5), ([0, 1, 2, 3, 2], [1, 2, 3, 4, 5])), shape=(6, 6))
    is_beyond = np.array([True, False, False, False, True, True])
    assert close_ups._parts(chain, is_beyond, np.array([0, 4])).tolist() == [0, -1, -1, -1, 1, -1]


def test_a_vessel_that_is_all_near_is_computed_as_a_whole() -> None:
    long = Surface(sphere(1.0).vertices_mm * [1.0, 1.0, 7.0] + [0.0, 0.0, 6.0], sphere(1.0).faces)
    settings = FlowSettings(numerics=Numerics(cell_size_mm=0.4, max_steps=240))
    case = vessel_case(tube(line(8.0), RADIUS_MM).vessel, settings, target=Target(long, None))
    near = close_ups.build(case, 0.2, close_ups.close_up(case, simulate_case(case)))
    whole = domain.build(case.vessel, 0.2)
    assert len(near.cells) == pytest.approx(len(whole.cells), rel=1e-2)
    assert np.unique(near.link_patch).tolist() == [0, 1, 2]


def test_the_cells_foretold_are_enough_and_not_far_too_many() -> None:
    case, outer = outer_of_demo()
    wanted = replace(case, numerics=replace(case.numerics, cell_size_mm=0.25, close_up=True))
    made = len(close_ups.build(wanted, 0.25, close_ups.close_up(case, outer)).cells)
    assert made < estimate(wanted).cells < 1.25 * made
    whole = estimate(replace(wanted, numerics=replace(wanted.numerics, close_up=False)))
    assert estimate(wanted).steps == whole.steps / 4
    assert estimate(wanted).seconds < 0.4 * whole.seconds


def test_no_close_up_without_a_sac_or_of_what_has_none() -> None:
    bare = vessel_case(tube(line(8.0), 2.0).vessel, FlowSettings(numerics=Numerics(cell_size_mm=0.3, close_up=True)))
    with pytest.raises(FlowError, match=r"this vessel has none: switch that off \(--refine-sac\)"):
        simulate_case(bare)
    with pytest.raises(InputError, match=r"openfoam does not support a finer grid in the sac alone: .*--refine-sac"):
        simulate_case(replace(bare, numerics=replace(bare.numerics, engine=OPENFOAM)))


def test_a_close_up_is_given_a_quarter_of_the_steps() -> None:
    case, outer = outer_of_demo()
    whole, near = (LatticeBoltzmann(0.25, None, around) for around in (None, outer))
    state = near.init(case, outer)
    assert near.max_checks(state) == int(case.numerics.max_steps / 4 // state.steps_per_check) >= 12
    assert whole.max_checks(state) == int(case.numerics.max_steps // state.steps_per_check)


def test_a_close_up_starts_from_a_similar_flow_at_the_pace_of_the_flow_around_it() -> None:
    case, outer = outer_of_demo()
    engine = LatticeBoltzmann(0.25, None, outer)
    similar = with_values(outer, velocity_m_s=0.5 * outer.velocity_m_s)
    usual, from_similar = (engine.init(case, start) for start in (outer, similar))
    assert from_similar.scales.step_s == usual.scales.step_s
    usual_m_s, similar_m_s = (np.linalg.norm(snapshot(state).velocity, axis=1) for state in (usual, from_similar))
    is_fast = usual_m_s > np.quantile(usual_m_s, 0.5)
    np.testing.assert_allclose(similar_m_s[is_fast], 0.5 * usual_m_s[is_fast], rtol=0.02)


def test_a_refined_sac_starts_from_a_similar_flow_if_that_is_steady(monkeypatch: pytest.MonkeyPatch) -> None:
    case, outer = outer_of_demo()
    wanted = replace(case, numerics=replace(case.numerics, close_up=True))
    begun: list[FlowField] = []
    monkeypatch.setattr(flow._Runs, "_from_coarser", lambda *_: outer)
    monkeypatch.setattr(flow._Runs, "_run", lambda _, __, ___, ____, guess, *_____: begun.append(guess()))
    steady = with_values(outer, velocity_m_s=0.5 * outer.velocity_m_s)
    swinging = replace(steady, mean_shear_Pa=np.zeros(len(outer.wall.vertices_mm)))
    for similar in (None, steady, swinging):
        simulate_case(wanted, similar=similar)
    assert [one is two for one, two in zip(begun, (outer, steady, outer), strict=True)] == [True] * 3


def test_a_close_ups_time_step_goes_by_its_own_fastest_blood() -> None:
    """Blood that is ten times as fast, but beyond its cuts, changes nothing; within it does. It is a third longer."""
    case, outer = outer_of_demo()
    part = close_ups.close_up(case, outer).part
    for is_faster, times in ((part >= 0, 1.0), (part < 0, 10.0)):
        velocity_m_s = np.where(is_faster[:, None], 10.0, 1.0) * outer.velocity_m_s
        faster = with_values(outer, velocity_m_s=velocity_m_s)
        step_s = [LatticeBoltzmann(0.25, None, one).init(case, one).scales.step_s for one in (outer, faster)]
        assert step_s[0] == pytest.approx(times * step_s[1])
        assert step_s[0] * 1.1 * np.quantile(outer.speed_m_s[part < 0], 0.999) == pytest.approx(0.2 * 0.25e-3)


def test_a_little_blood_may_be_twice_as_fast_as_time_steps_go_by() -> None:
    """As in one narrow branch, which would cost all the vessel its time steps."""
    case, outer = outer_of_demo()
    usual_m_s = np.quantile(outer.speed_m_s, 0.999)
    few = np.zeros(len(outer.centers_mm), dtype=bool)
    few[np.argsort(outer.speed_m_s)[-len(few) // 1500 :]] = True
    assert few.mean() < 1e-3
    for times, longer in ((1.9, 1.0), (4.0, 0.5)):
        speed_m_s = np.where(few, times * usual_m_s, outer.speed_m_s)
        velocity_m_s = outer.velocity_m_s * (speed_m_s / np.maximum(outer.speed_m_s, 1e-12))[:, None]
        peak_m_s = peak_speed_m_s(case, with_values(outer, velocity_m_s=velocity_m_s))
        assert peak_m_s == pytest.approx(1.1 * usual_m_s / longer, rel=2e-3)


def test_a_close_up_tells_of_branches_too_narrow_for_the_cells_around_it() -> None:
    case, _ = outer_of_demo()
    field = simulate_case(
        replace(case, numerics=replace(case.numerics, close_up=True, cell_size_mm=0.2, max_steps=192))
    )
    assert "at a grid spacing of 0.4 mm, outlet_2 (1.3 mm) has 3.2 cells across" in field.advice
    assert "at a grid spacing of 0.2 mm" not in field.advice


@pytest.mark.validation
def test_a_close_up_of_the_demo_is_what_fine_cells_all_over_give() -> None:
    case = flow_case(demo(), (), FlowSettings(numerics=Numerics(cell_size_mm=0.14)))
    whole, near = (
        indices(simulate_case(replace(case, numerics=replace(case.numerics, close_up=close_up))), case.sac, case.ostium)
        for close_up in (False, True)
    )
    for key, most in (("neck_inflow_mL_s", 0.03), ("mean_sac_velocity_m_s", 0.03), ("mean_sac_wss_Pa", 0.05)):
        assert near[key] == pytest.approx(whole[key], rel=most), key
