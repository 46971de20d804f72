"""The screen of a braid, calibrated on wires that are walls in a piece of the neck, and finer around a narrow neck."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_neck import covered

import vstent
from vstent.flow import simulation
from vstent.flow.case import PHASES, FlowCase, FlowField
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.indices import indices, neck_diameter_mm
from vstent.flow.lattice import calibration, cost, stepping
from vstent.flow.lattice.cost import estimate
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.lattice.levels import sizes_mm
from vstent.flow.lattice.state import State
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import Waveform
from vstent.kernels.arrays import Floats
from vstent.units import duration

CELL_MM = 0.2
INDICES = ("neck_inflow_mL_s", "mean_sac_velocity_m_s", "mean_sac_wss_Pa")


@pytest.fixture(scope="module")
def braided() -> FlowCase:
    """A short tube with a sac, and the part of a braid that lies over its neck."""
    return covered(vstent.find_design("silk"), FlowSettings(inflow_mL_s=1.0))


def with_numerics(case: FlowCase, **changes: object) -> FlowCase:
    return replace(case, numerics=replace(case.numerics, **changes))


def found(field: FlowField, case: FlowCase) -> Floats:
    of_flow = indices(field, case.sac, case.ostium)
    return np.array([of_flow[key] for key in INDICES])


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_screen_is_calibrated_to_what_stands_for_its_wires(
    braided: FlowCase, times: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a known screen in place of the walls: its flow is found from half and from twice its resistance."""
    known = with_numerics(braided, cell_size_mm=CELL_MM)
    real = calibration._resistance

    def resistance(case: FlowCase, *of_tile: Any) -> tuple[float, float]:
        return real(known if case.numerics.wires == "resolved" else case, *of_tile)

    monkeypatch.setattr(calibration, "tile", lambda case, _: with_numerics(case, wires="resolved"))
    monkeypatch.setattr(calibration, "_resistance", resistance)
    wanted = found(simulate_case(known), known)
    begun = calibration.scaled(known, times)
    assert (np.abs(found(simulate_case(begun), begun) / wanted - 1) > 0.1)[:2].all()
    told: list[float] = []
    field = simulate_case(with_numerics(begun, wires="calibrated"), progress=lambda now: told.append(now.fraction))
    assert told == sorted(told)
    share = simulation.ROUND_SHARE
    of_tiles = [sum((n + share) / 3 < one <= (n + 1) / 3 for one in told) for n in range(calibration.ROUNDS)]
    assert of_tiles == calibration.ROUNDS * [2 * calibration.READINGS]
    factor = float(field.advice.split("it resists ")[1].split(" times")[0])
    assert factor == pytest.approx(1 / times, rel=0.02)
    # The time step is another one, to which the shear stress of 13 cells across a neck is sensitive.
    assert (np.abs(found(field, known) / wanted - 1) < (0.03, 0.03, 0.15)).all()


def test_a_tile_has_the_walls_near_a_point_and_the_screen_elsewhere(braided: FlowCase) -> None:
    case = with_numerics(braided, cell_size_mm=CELL_MM)
    assert case.ostium is not None
    center_mm = case.ostium.vertices_mm.mean(axis=0)
    walls = calibration.tile(case, center_mm)
    assert walls.wires is not None
    away_mm = np.linalg.norm(walls.wires.corners_mm.mean(axis=1) - center_mm, axis=1)
    assert away_mm.max() < calibration.TILE_MM + 0.05
    assert case.wires is not None
    of_whole = np.linalg.norm(case.wires.corners_mm.mean(axis=1) - center_mm, axis=1) < calibration.TILE_MM - 0.1
    assert len(away_mm) > of_whole.sum()
    assert min(calibration.cost(case)) > 0


def test_a_screen_with_wide_pores_is_left_and_it_is_told(braided: FlowCase) -> None:
    wide = tuple(replace(one, spacing_mm=3 * one.spacing_mm) for one in braided.media)
    case = with_numerics(replace(braided, media=wide), cell_size_mm=1.5 * CELL_MM)
    assert not calibration.suits(case)
    field, screen = (simulate_case(with_numerics(case, wires=wires)) for wires in ("calibrated", "screen"))
    assert "The screen is not calibrated" in field.advice
    np.testing.assert_array_equal(field.velocity_m_s, screen.velocity_m_s)


def test_wires_too_many_for_walls_are_calibrated_where_that_is_quick(
    braided: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_open = with_numerics(braided, cell_size_mm=CELL_MM, wires="auto")
    screen, walls = (estimate(with_numerics(is_open, wires=wires)).seconds for wires in ("screen", "resolved"))
    calibrating = calibration.cost(is_open)[0] + calibration.ROUNDS * simulation.USUAL_PART * screen
    assert calibrating < simulation.USUAL_PART * walls
    for allowed, chosen in (
        (simulation.USUAL_PART * walls + 1.0, "resolved"),
        (calibrating + 1.0, "calibrated"),
        (calibrating - 1.0, "screen"),
    ):
        monkeypatch.setattr(simulation, "QUICK_S", allowed)
        case, reason = simulation._decided(is_open)
        assert case.numerics.wires == chosen
        assert ("Calibrating them would take" in reason) == (chosen == "screen")
    monkeypatch.setattr(simulation, "QUICK_S", calibrating + 1.0)
    monkeypatch.setattr(simulation, "free_memory_bytes", lambda: 0.99 * calibration.cost(is_open)[1])
    assert simulation._decided(is_open)[0].numerics.wires == "screen"


@pytest.mark.parametrize(("free_bytes", "chosen"), [(1e12, "resolved"), (1e6, "calibrated")])
def test_a_gpu_resolves_wires_where_that_is_quick_and_fits_in_its_memory(
    free_bytes: float, chosen: str, braided: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulation, "require_gpu", lambda: None)
    monkeypatch.setattr(cost, "block_rate", lambda *, on_gpu: 1e12 if on_gpu else 1.0)
    monkeypatch.setattr(cost, "free_gpu_bytes", lambda: free_bytes)
    is_open = with_numerics(braided, cell_size_mm=CELL_MM, wires="auto", device_gpu=True)
    assert simulation._decided(is_open)[0].numerics.wires == chosen


def test_a_narrow_neck_with_a_screen_has_a_finer_level_unless_the_spacing_is_given(braided: FlowCase) -> None:
    """A flow without a device has none, and a screen with few cells across the neck says so."""
    assert braided.ostium is not None
    across_mm = neck_diameter_mm(braided.ostium)
    open_mm = across_mm / 20
    assert sizes_mm(braided, open_mm) == (open_mm, open_mm / 2)
    assert sizes_mm(braided, across_mm / 33) == (across_mm / 33,)
    assert sizes_mm(replace(braided, media=(), solids=()), open_mm) == (open_mm,)
    assert sizes_mm(with_numerics(braided, cell_size_mm=open_mm), open_mm) == (open_mm,)
    assert sizes_mm(with_numerics(braided, device_gpu=True), open_mm) == (open_mm, open_mm / 2)
    field = simulate_case(with_numerics(braided, cell_size_mm=CELL_MM))
    assert f"Under-resolved neck: it has {across_mm / CELL_MM:.0f} cells across" in field.advice


def test_devices_share_the_grids_around_a_neck_and_those_of_walls_do_not_pile_up(braided: FlowCase) -> None:
    case = with_numerics(braided, cells_per_diameter=18.0)
    other = replace(case, solids=tuple(replace(one) for one in case.solids))
    size_mm = default_cell_size_mm(case)
    first, second = (stepping._grids(one, size_mm) for one in (case, other))
    assert first[1][0] is second[1][0]
    around_sac = with_numerics(replace(case, media=(), solids=()), cell_size_mm=size_mm / 2, refine=("sac",))
    assert sizes_mm(around_sac, size_mm / 2) == sizes_mm(case, size_mm)
    assert stepping._grids(around_sac, size_mm / 2)[1][0] is not first[1][0]
    for thickness_um in (300.0, 310.0):  # walls of the grid itself
        solids = tuple(replace(one, wire_diameter_um=0 * one.wire_diameter_um + thickness_um) for one in case.solids)
        stepping._grids(with_numerics(replace(case, solids=solids), wires="resolved", cell_size_mm=0.12), 0.12)
    assert sum(bool(solids) for _, _, solids in stepping._GRIDS[case.vessel]) == 1


def test_the_finer_level_contains_the_screen(braided: FlowCase) -> None:
    case = with_numerics(braided, cells_per_diameter=18.0)
    coarse, fine = LatticeBoltzmann(default_cell_size_mm(case)).init(case, None).levels
    assert coarse.interface is not None
    assert coarse.interface.is_trusted[fine.screen.cell].mean() > 0.96
    resistance = (
        level.screen.entry[:, 3].sum() * level.domain.cell_size_mm**3 / level.scales.step_s for level in (coarse, fine)
    )
    assert next(resistance) == pytest.approx(next(resistance), rel=0.05)


def test_a_device_apart_from_the_neck_has_a_flow_and_says_that_it_is_not_calibrated(braided: FlowCase) -> None:
    """Its wires are farther from the sac than those that finer levels are wanted for."""
    away_mm = np.array([1.2, 0.0, 0.0])
    media = tuple(replace(one, points_mm=one.points_mm - away_mm) for one in braided.media)
    solids = tuple(replace(one, wire_points_mm=one.wire_points_mm - away_mm) for one in braided.solids)
    away = with_numerics(replace(braided, media=media, solids=solids), cells_per_diameter=8.0, cells_across_neck=10.0)
    assert not calibration.suits(away)
    assert estimate(away).cells > 0
    field = simulate_case(with_numerics(away, wires="calibrated", max_steps=100))
    assert "The screen is not calibrated: no wires over the neck" in field.advice
    field = simulate_case(with_numerics(replace(away, solids=()), wires="resolved", max_steps=100))
    assert "The wires are a screen: none of them lies over a neck or a branch." in field.advice


def test_the_cost_of_a_calibrated_flow_contains_its_tiles(braided: FlowCase) -> None:
    """The walls of a tile need more memory than the flow; where it is not free, the program does not choose them."""
    case = with_numerics(braided, cells_per_diameter=12.0, wires="calibrated")
    seconds, memory_bytes = calibration.cost(case)
    assert simulation.memory_bytes(case) == memory_bytes > 1.2 * estimate(case).memory_bytes
    said = simulation.foretell_cost(case)
    assert said.startswith(str(estimate(case)))
    assert f"takes 2 more such flows, {duration(seconds)} for wires" in said
    assert f"and {memory_bytes / 1e9:.2g} GB." in said
    bare = replace(case, media=(), solids=())
    assert simulation.foretell_cost(bare) == str(estimate(bare))


def test_a_flow_without_a_screen_says_nothing_of_calibrating_it(braided: FlowCase) -> None:
    bare = with_numerics(replace(braided, media=(), solids=()), cells_per_diameter=8.0, max_steps=100)
    assert "calibrated" not in simulate_case(with_numerics(bare, wires="calibrated")).advice


def test_a_tile_lies_in_the_middle_of_a_narrow_neck_where_most_blood_passes(braided: FlowCase) -> None:
    case = with_numerics(braided, cells_per_diameter=8.0, cells_across_neck=0.0, max_steps=100)
    center_mm = calibration.strongest_mm(case, simulate_case(case))
    assert case.ostium is not None
    depth_mm = -case.vessel.closed.signed_distance(np.stack([center_mm, *case.ostium.vertices_mm]))
    assert depth_mm[0] > 0.85 * depth_mm.max()


def test_a_screen_whose_resistance_cannot_be_read_off_stays(braided: FlowCase, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a tile that diverged, force and velocity are nan. Beside blood that passes a tile, no factor is found."""
    case = with_numerics(braided, cells_per_diameter=8.0, cells_across_neck=0.0, max_steps=100)
    screen = simulate_case(case)
    center_mm = calibration.strongest_mm(case, screen)
    for found_there in ((1.0, 0.5), (np.nan, np.nan)):
        monkeypatch.setattr(calibration, "_resistance", lambda *_, found_there=found_there: found_there)
        rounds = [(1.0, *calibration.read_off(case, case, screen, center_mm))]
        assert calibration.next_factor(rounds) == 1.0
        assert calibration.next_factor([(0.8, 2.0, 1.5), (0.9, *rounds[0][1:])]) == 0.9
    of_wires, scaled, factors = {"screen": (1.0, 1.0), "resolved": (2.0, 1.0)}, calibration.scaled, list[float]()

    def watched(case: FlowCase, factor: float) -> FlowCase:
        factors.append(factor)
        return scaled(case, factor)

    monkeypatch.setattr(calibration, "scaled", watched)
    for found_there in (lambda *_: (np.nan, np.nan), lambda case, *_: of_wires[case.numerics.wires]):
        monkeypatch.setattr(calibration, "_resistance", found_there)
        assert (
            "The screen is not calibrated: the force" in simulate_case(with_numerics(case, wires="calibrated")).advice
        )
    assert len(factors) == 2 * calibration.ROUNDS, "the last flow has the screen as it is"


def test_the_runs_of_a_calibrated_flow_are_stored_apart_from_those_with_the_screen_as_it_is(
    braided: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was stored of one must not be continued as the other, where `auto` decides otherwise the next time."""

    class Names(list[str]):
        def load(self, run: str) -> None:
            self.append(run)

        def save(self, run: str, saved: object) -> None: ...

    case = with_numerics(braided, cells_per_diameter=8.0, cells_across_neck=0.0, max_steps=100)
    monkeypatch.setattr(calibration, "_resistance", lambda *_: (1.0, 0.5))
    of_flows = [Names(), Names()]
    for wires, names in zip(("screen", "calibrated"), of_flows, strict=True):
        simulate_case(with_numerics(case, wires=wires), checkpoint=names)
    assert of_flows[0][-1] == "answer"
    assert [name for name in of_flows[1] if "answer" in name] == [
        f"{name} answer" for name in ("round 0", "round 1", "calibrated")
    ]


def test_the_screen_of_a_pulsatile_flow_is_calibrated_in_steady_ones(
    braided: FlowCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_wires = {"screen": (1.0, 1.0), "resolved": (0.9, 1.0)}
    monkeypatch.setattr(calibration, "_resistance", lambda case, *_: of_wires[case.numerics.wires])
    case = with_numerics(braided, cells_per_diameter=8.0, cells_across_neck=0.0, max_steps=100, max_cycles=1)
    pulse, begun = with_numerics(replace(case, waveform=Waveform(0.1, (0.1,), (0.0,))), wires="calibrated"), []
    bare, init = simulate_case(replace(pulse, media=(), solids=())), PulsatileLatticeBoltzmann.init

    def watched(engine: PulsatileLatticeBoltzmann, case: FlowCase, start: FlowField) -> State:
        begun.append(len(start.phases))
        return init(engine, case, start)

    monkeypatch.setattr(PulsatileLatticeBoltzmann, "init", watched)
    field = simulate_case(pulse, start=bare)
    assert begun[-1] > 0, "a pulse that begins with a steady flow needs more cycles"
    assert len(field.phases) == PHASES
    factor = calibration.next_factor([(1.0, 1.0, 0.9)])
    factor = calibration.next_factor([(1.0, 1.0, 0.9), (factor, 1.0, 0.9)])
    assert f"The screen is calibrated: it resists {factor:.3g} times" in field.advice


@pytest.mark.validation
def test_a_narrow_neck_on_a_finer_level_is_that_of_the_fine_grid(braided: FlowCase) -> None:
    """Neck inflow and sac velocity within 4 %; on the wider grid alone they are a sixth too high."""
    numerics = Numerics(cells_per_diameter=15.0, cells_across_neck=30.0)
    field = simulate_case(replace(braided, numerics=numerics))
    plain = simulate_case(with_numerics(braided, cells_per_diameter=15.0, cells_across_neck=0.0))
    fine = simulate_case(with_numerics(braided, cell_size_mm=plain.levels[0].cell_size_mm / 2.5))
    of_level, of_plain, of_fine = (found(one, braided)[:2] for one in (field, plain, fine))
    np.testing.assert_allclose(of_level, of_fine, rtol=0.04)
    assert (of_plain / of_fine > 1.1).all()


@pytest.mark.validation
def test_a_calibrated_flow_does_not_depend_on_the_screen_that_it_began_from(braided: FlowCase) -> None:
    """Begun from half and from twice the resistance: within 2 %."""
    cases = (with_numerics(calibration.scaled(braided, times), wires="calibrated") for times in (0.5, 2.0))
    np.testing.assert_allclose(*(found(simulate_case(one), one) for one in cases), rtol=0.02)
