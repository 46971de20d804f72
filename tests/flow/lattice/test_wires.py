"""Wires of a device as walls of the flow grid in a vessel, on one grid and in a refined region."""

from dataclasses import replace

import numpy as np
import pytest
from small_neck import covered

import vstent
from vstent.deployment.struts import struts, united
from vstent.errors import FlowError
from vstent.flow import domain, simulation
from vstent.flow.case import FlowCase
from vstent.flow.indices import indices
from vstent.flow.lattice import levels, stepping
from vstent.flow.lattice.cost import estimate, refuse_too_large
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.levels import sizes_mm
from vstent.flow.lattice.reading import exchanged, force_N
from vstent.flow.lattice.state import State
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Floats, Ints
from vstent.units import duration

CELL_MM = 0.075


@pytest.fixture(scope="module")
def resolved() -> FlowCase:
    """A short tube with a sac, and the part of a device with wide struts that lies over its neck."""
    design = replace(vstent.find_design("enterprise"), strut_width_um=220.0, strut_thickness_um=220.0)
    numerics = Numerics(cell_size_mm=CELL_MM, wires="resolved")
    return covered(design, FlowSettings(inflow_mL_s=1.0, numerics=numerics))


def test_the_blood_is_the_lumen_without_the_wires(resolved: FlowCase) -> None:
    assert resolved.wires is not None
    bare = domain.build(resolved.vessel, CELL_MM)
    grid = domain.build(resolved.vessel, CELL_MM, wires=resolved.wires)
    left = bare.index[tuple(grid.cells.T)]
    assert (left >= 0).all()
    gone = np.setdiff1d(np.arange(len(bare.cells)), left)
    inside = united(resolved.wires).signed_distance(bare.centers_mm) < 0  # an exact union of the solids
    assert inside[gone].sum() == inside.sum()
    closed = ~inside[gone]
    assert grid.closed_gaps <= closed.sum() < grid.closed_gaps + 0.05 * inside.sum()  # the rest is enclosed


@pytest.fixture(scope="module")
def flow(resolved: FlowCase) -> State:
    """The steady flow through it."""
    engine = LatticeBoltzmann(CELL_MM)
    state = engine.init(resolved, None)
    while len(state.history) < 16:
        stepping.step(state)
    return state


def test_walls_wires_and_ends_together_take_up_no_momentum_in_steady_flow(flow: State) -> None:
    address, stride = flow.links.address, flow.addressing.stride
    of_walls = slice(flow.links.start[-1], None)
    direction = address[:, 2] // stride
    on_walls = exchanged(flow.populations, address[of_walls], direction[of_walls]).sum(axis=0)
    whole = exchanged(flow.populations, address, direction).sum(axis=0)
    np.testing.assert_allclose(whole, 0.0, atol=0.015 * np.linalg.norm(on_walls))


def test_blood_drags_wires_along(resolved: FlowCase, flow: State) -> None:
    assert resolved.wires is not None
    force, direction = force_N(flow), flow.links.wire_direction
    momentum = exchanged(flow.populations, flow.links.address[flow.links.of_wires], direction).sum(axis=0)
    scales = flow.scales
    speed = scales.cell_m / scales.step_s
    np.testing.assert_allclose(force, momentum * 1060.0 * scales.cell_m**2 * speed**2)
    along = np.gradient(resolved.vessel.centerlines[0].points_mm, axis=0).mean(axis=0)
    assert force @ along > 0


def test_wires_too_thin_for_the_grid_are_walls_on_a_finer_level(resolved: FlowCase) -> None:
    """Of a wire that is a wall neither a band nor a region of coils resists any more."""
    sheet = resolved.media[0]
    in_sac_mm, still = sheet.points_mm + np.array([0.4, 0.0, 0.0]), np.zeros_like(sheet.normals)
    coils = replace(sheet, points_mm=in_sac_mm, normals=still, spacing_mm=sheet.wire_diameter_mm)
    numerics = replace(resolved.numerics, cell_size_mm=2 * CELL_MM)
    case = replace(resolved, media=(*resolved.media, coils), numerics=numerics)
    assert domain.wires_of(case, 2 * CELL_MM) is None
    state = LatticeBoltzmann(2 * CELL_MM).init(case, None)
    coarse, fine = state.levels
    assert len(coarse.screen.cell) > 0
    assert not len(fine.screen.cell)
    assert not len(coarse.links.of_wires)
    assert len(fine.links.of_wires) > 1000
    made, foretold = sum(len(level.domain.cells) for level in state.levels), estimate(case).cells
    assert made == pytest.approx(foretold, rel=0.25)
    assert state.kept == (state,)


def test_interpolation_between_levels_is_exact_for_cubic_functions(resolved: FlowCase) -> None:
    case = replace(resolved, numerics=replace(resolved.numerics, cell_size_mm=2 * CELL_MM))
    coarse, fine = LatticeBoltzmann(2 * CELL_MM).init(case, None).levels
    assert coarse.interface is not None
    down = coarse.interface.down
    powers = np.array([(i, j, k) for i in range(4) for j in range(4 - i) for k in range(4 - i - j)])

    def cubics(level: State, place: Ints) -> Floats:
        order = np.argsort(level.addressing.place)
        cell = order[np.searchsorted(level.addressing.place, place, sorter=order)]
        return (
            (level.domain.centers_mm[cell] - resolved.vessel.lumen.vertices_mm.mean(axis=0))[:, None] ** powers
        ).prod(axis=2)

    found = np.add.reduceat(down.weight[:, :1] * cubics(coarse, down.place)[down.cell], down.start[:-1])
    is_whole = np.logical_and.reduceat(down.weight[:, 0] == down.weight[:, 1], down.start[:-1])
    assert is_whole.mean() > 0.3
    wanted = cubics(fine, down.target)
    np.testing.assert_allclose(found[is_whole], wanted[is_whole], atol=1e-6 * np.abs(wanted).max())


def test_walls_of_a_device_beside_a_neck_are_those_of_its_side_that_faces_it(resolved: FlowCase) -> None:
    over_neck = resolved.solids[0]
    middle_mm = resolved.vessel.centerlines[0].points_mm.mean(axis=0)
    turned_mm = (over_neck.wire_points_mm - middle_mm) * (-1.0, -1.0, 1.0) + middle_mm
    both = replace(resolved, solids=(over_neck, replace(over_neck, wire_points_mm=turned_mm)))
    assert resolved.sac is not None
    shrunk_mm = 0.2 * (over_neck.wire_points_mm - over_neck.wire_points_mm.mean(axis=0))
    in_sac_mm = shrunk_mm + resolved.sac.vertices_mm.mean(axis=0) + (1.5, 0.0, 0.0)
    coiled = replace(resolved, solids=(over_neck, replace(over_neck, wire_points_mm=in_sac_mm)))
    assert resolved.target is not None
    parts = (resolved.target.sac, resolved.target.ostium)
    sac, ostium = (Surface(one.vertices_mm + np.array([1.5, 0.0, 0.0]), one.faces) for one in parts)
    beside = [
        levels._around(replace(case, target=replace(resolved.target, sac=sac, ostium=ostium)))
        for case in (resolved, both, coiled)
    ]
    assert beside[0].area_mm2 > 0.5 * struts(over_neck).area_mm2
    assert beside[1].area_mm2 == pytest.approx(beside[0].area_mm2)
    in_sac_mm2 = struts(coiled.solids[1]).area_mm2
    assert beside[2].area_mm2 == pytest.approx(beside[0].area_mm2 + in_sac_mm2)


@pytest.mark.parametrize(
    ("wanted", "made"), [(1.9, 1.9), (2.1, 1.98), (3.2, 1.98), (3.4, 3.4), (6.5, 3.96), (6.7, 6.7)]
)
def test_an_open_grid_spacing_is_reduced_so_that_its_halves_suit_the_wires(
    resolved: FlowCase, wanted: float, made: float
) -> None:
    """In multiples of the largest spacing at the walls, by at most four tenths; what is printed of it suits as well."""
    assert resolved.wires is not None
    suited_mm = domain.around_walls_mm(resolved.wires)
    across_mm = min(domain.mean_diameter_mm(resolved.vessel), resolved.vessel.inlet.diameter_mm)
    count = across_mm / (wanted * suited_mm)
    numerics = replace(resolved.numerics, cell_size_mm=None, cells_per_diameter=count, cell_budget=1e9)
    case = replace(resolved, numerics=numerics)
    found_mm = domain.default_cell_size_mm(case)
    assert found_mm == pytest.approx(made * suited_mm)
    finest_mm = levels.sizes_mm(case, found_mm)[-1]
    assert domain.wires_of(case, finest_mm) is case.wires
    assert suited_mm / 2 < finest_mm <= suited_mm
    printed_mm = float(f"{found_mm:.3g}")
    assert len(levels.sizes_mm(case, printed_mm)) == len(levels.sizes_mm(case, found_mm))
    for other in (replace(numerics, wires="screen"), replace(numerics, engine="openfoam")):
        assert domain.default_cell_size_mm(replace(case, numerics=other)) == pytest.approx(wanted * suited_mm)


def test_wires_around_which_no_cell_can_be_refined_are_refused(
    resolved: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(levels, "near_wires", lambda _, grid, __: np.zeros(len(grid.cells), dtype=bool))
    case = replace(resolved, numerics=replace(resolved.numerics, cell_size_mm=2.2 * CELL_MM))
    with pytest.raises(domain.CoarseGridError, match=r"a grid of 0\.165 mm .* use a finer grid spacing"):
        LatticeBoltzmann(2.2 * CELL_MM).init(case, None)


def test_walls_that_do_not_fit_in_memory_are_refused_in_favour_of_a_screen(resolved: FlowCase) -> None:
    """A coarser grid may have finer walls, and need more."""
    with pytest.raises(FlowError, match=r"1e-05 GB of memory are free: use a screen \(--wires screen\)"):
        refuse_too_large(resolved, free_bytes=1e4)


@pytest.mark.parametrize(("finer", "most"), [(1, 0.01), (2, 0.07)])
def test_wires_on_a_finer_level_are_those_of_the_uniform_fine_grid(
    resolved: FlowCase, flow: State, finer: int, most: float
) -> None:
    """The force as well: within 3 %. The coarsest grid has 19 or 9 cells across the artery."""
    case = replace(resolved, numerics=replace(resolved.numerics, cell_size_mm=2**finer * CELL_MM))
    engine = LatticeBoltzmann(2**finer * CELL_MM)
    state = engine.init(case, None)
    assert len(state.levels) == 1 + finer
    while len(state.history) < 16:
        stepping.step(state)
    np.testing.assert_allclose(state.history[-1], flow.history[-1], rtol=most)
    force, wanted = force_N(state.levels[-1]), force_N(flow)
    assert np.linalg.norm(force - wanted) < 0.03 * np.linalg.norm(wanted)
    between = state.interface
    assert between is not None
    assert np.abs(between.lack).max() < 1e-4


def test_walls_begin_from_a_screen_on_one_level_that_is_stored_apart(resolved: FlowCase) -> None:
    """A stored flow with the screen as it is has a finer level around the neck: it must not be continued as that."""
    names: list[str] = []

    class Names:
        def load(self, run: str) -> None:
            names.append(run)

        def save(self, run: str, saved: object) -> None: ...

    numerics = Numerics(cells_per_diameter=12.0, wires="resolved", max_steps=100)
    case = replace(resolved, numerics=numerics)
    assert len(sizes_mm(replace(case, numerics=replace(numerics, wires="screen")), 2 * CELL_MM)) == 2
    began: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        init = LatticeBoltzmann.init
        patch.setattr(LatticeBoltzmann, "init", lambda *of: (began.append(len((state := init(*of)).levels)), state)[1])
        simulate_case(case, checkpoint=Names())
    assert [name for name in names if "guess" not in name] == ["resolved", "screen answer"]
    assert began[-2:] == [1, 2]


@pytest.mark.validation
def test_what_a_flow_with_walls_ends_with_does_not_depend_on_the_screen_that_it_began_from(resolved: FlowCase) -> None:
    """Begun from a screen of half and of twice the resistance, whose flows differ by a tenth: within 1 %."""
    keys = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")
    found: dict[str, list[Floats]] = {"screen": [], "resolved": []}
    for times in (0.5, 2.0):
        resistances = ("normal_resistance_Pa_s_m", "tangential_resistance_Pa_s_m", "inertial_loss")
        changed = ({name: times * getattr(sheet, name) for name in resistances} for sheet in resolved.media)
        media = tuple(replace(sheet, **values) for sheet, values in zip(resolved.media, changed, strict=True))
        for wires, values in found.items():
            numerics = replace(resolved.numerics, cell_size_mm=2 * CELL_MM, wires=wires)
            field = simulate_case(replace(resolved, media=media, numerics=numerics))
            assert field.is_converged
            of_flow = indices(field, resolved.sac, resolved.ostium)
            values.append(np.array([of_flow[key] for key in keys]))
    assert (np.abs(found["screen"][0] / found["screen"][1] - 1) > 0.1).all()
    np.testing.assert_allclose(*found["resolved"], rtol=0.01)


def test_open_wires_are_decided_by_time_and_the_reason_is_told(
    resolved: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_open = replace(resolved, numerics=replace(resolved.numerics, wires="auto", cell_size_mm=2 * CELL_MM))
    most_s = estimate(replace(is_open, numerics=replace(is_open.numerics, wires="resolved"))).seconds
    seconds = simulation.USUAL_PART * most_s
    monkeypatch.setattr(simulation, "QUICK_S", seconds + 1.0)
    assert simulation._decided(is_open)[0].numerics.wires == "resolved"
    monkeypatch.setattr(simulation, "QUICK_S", seconds - 1.0)
    chosen, reason = simulation._decided(is_open)
    assert chosen.numerics.wires == "screen"
    assert f"The wires are a screen: resolving them would take about {duration(seconds)}" in reason
    assert reason in simulation.foretell_cost(is_open)
    bare = replace(is_open, media=(), solids=(), numerics=Numerics(cell_size_mm=0.3, max_steps=96))
    unsteady = simulate_case(bare)
    assert unsteady.finest.mean_speed_m_s is not None
    steady = replace(unsteady, levels=(replace(unsteady.finest, mean_speed_m_s=None),))
    monkeypatch.setattr(simulation, "QUICK_S", seconds + 1.0)
    chosen = [simulation._decided(is_open, start)[0].numerics.wires for start in (steady, unsteady)]
    assert chosen == ["resolved", "screen"]
