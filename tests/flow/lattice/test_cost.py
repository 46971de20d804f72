"""What a flow will cost is foretold, and why it failed is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from shapes import sphere
from tubes import line, tube

from vstent.errors import FlowError
from vstent.flow import domain
from vstent.flow.case import PHASES, Target
from vstent.flow.engines import DivergenceError
from vstent.flow.lattice.cost import MOST_CELLS, block_rate, estimate, refuse_too_large
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.memory import free_memory_bytes
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.geometry.surface import Surface

NUMERICS = Numerics(cell_size_mm=0.2)


def case_of(inflow_mL_s=2.0, waveform=None, **numerics):
    settings = FlowSettings(inflow_mL_s=inflow_mL_s, waveform=waveform, numerics=replace(NUMERICS, **numerics))
    return vessel_case(tube(line(8.0), 2.0).vessel, settings)


def test_the_cells_foretold_are_the_grids():
    case = case_of()
    assert estimate(case).cells == pytest.approx(len(domain.build(case.vessel, 0.2).cells), rel=0.01)


def test_twice_as_fine_costs_eight_times_the_cells_and_pulsatile_steps_twice():
    coarse, fine = (estimate(case_of(cell_size_mm=size, waveform=OLDER_ADULT_ICA)) for size in (0.2, 0.1))
    assert fine.cells == pytest.approx(8 * coarse.cells, rel=1e-3)
    assert fine.steps == pytest.approx(2 * coarse.steps, rel=0.02)
    assert fine.seconds == pytest.approx(16 * coarse.seconds, rel=0.02)
    per_cell = (fine.memory_bytes - coarse.memory_bytes) / (fine.cells - coarse.cells)
    assert 600 < per_cell < 1600


def test_the_pulsatile_steps_foretold_are_those_made():
    case = case_of(waveform=OLDER_ADULT_ICA)
    state = PulsatileLatticeBoltzmann(0.2).init(case, None)
    assert len(state.pace) == PHASES
    assert estimate(case).steps == state.pace.sum() * case.numerics.max_cycles


def test_the_time_foretold_is_of_a_measured_rate():
    assert 1e6 < block_rate(on_gpu=False) < 1e11
    cost = estimate(case_of())
    assert cost.seconds == pytest.approx(3.5 * cost.cells * 96_000 / block_rate(on_gpu=False), rel=1e-4)


def test_what_does_not_fit_is_refused_with_the_cell_size_that_does():
    case, free_bytes = case_of(cell_size_mm=0.02), 1e9
    with pytest.raises(FlowError, match="use a grid spacing of") as refusal:
        refuse_too_large(case, free_bytes)
    fitting_mm = float(str(refusal.value).split("use a grid spacing of ")[1].split(" mm")[0])
    assert 0.02 < fitting_mm < 0.1
    refuse_too_large(case_of(cell_size_mm=1.05 * fitting_mm), free_bytes)
    with pytest.raises(FlowError):
        refuse_too_large(case_of(cell_size_mm=0.9 * fitting_mm), free_bytes)
    assert free_memory_bytes() > 1e7


def test_more_cells_than_can_be_numbered_are_refused_whatever_the_memory():
    assert 19 * 1.05 * MOST_CELLS < 2**31
    case = case_of(cell_size_mm=0.007)
    assert estimate(case).cells > MOST_CELLS
    with pytest.raises(
        FlowError, match=r"more than the largest number of 100 million.* use a grid spacing of 0\.01\d? mm"
    ):
        refuse_too_large(case, free_bytes=1e15)


def test_too_long_a_time_step_is_named_with_the_last_good_state():
    with pytest.raises(FlowError, match="diverged") as error:
        simulate_case(case_of(cell_size_mm=0.4, lattice_speed=25.0, max_steps=4000))
    assert "use half the lattice speed" in str(error.value)


def test_a_narrow_place_inside_is_computed_with_a_shorter_time_step(monkeypatch):
    case, tried = case_of(cell_size_mm=0.4, inflow_mL_s=1.0, tolerance=0.02), []
    real = LatticeBoltzmann.init

    def ill_guessed(engine, case, start):
        tried.append(case.numerics.lattice_speed)
        faster = replace(case.numerics, lattice_speed=8 * case.numerics.lattice_speed)
        return real(engine, replace(case, numerics=faster), start)

    monkeypatch.setattr(LatticeBoltzmann, "init", ill_guessed)
    field = simulate_case(case)
    asked = case.numerics.lattice_speed
    assert tried == pytest.approx([asked, 0.5 * asked, 0.25 * asked])
    assert field.outlets_mL_s.sum() == pytest.approx(field.inflow_mL_s, rel=0.02)


def test_a_guess_that_diverges_is_done_without(monkeypatch):
    case = case_of(cell_size_mm=0.4, inflow_mL_s=1.0, tolerance=0.02)
    monkeypatch.setattr(LatticeBoltzmann, "coarsening", None)
    wanted = simulate_case(case)
    monkeypatch.setattr(LatticeBoltzmann, "coarsening", 1.5)
    monkeypatch.setattr("vstent.flow.simulation.MIN_CELLS", 100)
    monkeypatch.setattr("vstent.flow.domain.MIN_CELLS", 100)
    tried = []
    real = LatticeBoltzmann.init

    def ill_guessed(engine, case, start):
        state = real(engine, case, start)
        tried.append(engine.cell_size_mm)
        if engine.cell_size_mm > 0.5:
            state.populations[:] = np.nan
        return state

    monkeypatch.setattr(LatticeBoltzmann, "init", ill_guessed)
    np.testing.assert_array_equal(simulate_case(case).velocity_m_s, wanted.velocity_m_s)
    assert tried == pytest.approx([0.6, 0.6, 0.6, 0.6, 0.4])


def test_a_guess_whose_grid_is_too_coarse_is_done_without(monkeypatch):
    """At 45 degrees to the grid a throat of 0.5 mm is closed at a grid spacing of 0.44 mm and open at 0.11 mm."""
    points, frames = line(18.0)
    radius = 2.0 - 1.75 * np.exp(-(((points[:, 2] - 8.0) / 1.5) ** 2))
    turn = np.array([[1, 0, 1], [0, 2**0.5, 0], [-1, 0, 1]]) / 2**0.5
    vessel = tube((points @ turn.T, frames @ turn.T), radius).vessel
    settings = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.11, max_steps=60))
    case, tried = vessel_case(vessel, settings), []
    real = LatticeBoltzmann.init

    def told(engine, case, start):
        tried.append(engine.cell_size_mm)
        return real(engine, case, start)

    monkeypatch.setattr(LatticeBoltzmann, "init", told)
    monkeypatch.setattr("vstent.flow.simulation.MIN_CELLS", 500)
    with pytest.raises(domain.CoarseGridError):
        domain.build(vessel, 0.44)
    assert simulate_case(case).finest.cell_size_mm == 0.11
    assert tried == pytest.approx([0.44, 0.22, 0.11])


def test_what_diverges_after_it_was_resumed_begins_anew_from_the_guess(monkeypatch):
    case, tried = case_of(cell_size_mm=0.1), []

    def stub(engine, case, *, start, progress, saved, save):
        tried.append((engine.cell_size_mm, case.numerics.lattice_speed, start))
        if len(tried) == 1:
            raise DivergenceError("too fast")
        return SimpleNamespace(levels=(engine.cell_size_mm,))

    class Kept:
        def load(self, run):
            return {"begun": np.zeros(1)} if run == "answer" else None

        def save(self, run, saved):
            pass

    monkeypatch.setattr("vstent.flow.simulation.run", stub)
    assert simulate_case(case, checkpoint=Kept()).levels == (0.1,)
    speed = case.numerics.lattice_speed
    assert tried == [(0.1, speed, None), (0.2, speed, None), (0.1, 0.5 * speed, SimpleNamespace(levels=(0.2,)))]


def test_a_sac_smaller_than_a_cell_is_told_as_that():
    sac = Surface(sphere(0.08).vertices_mm + np.array([0.07, 0.07, 4.07]), sphere(0.08).faces)
    case = replace(case_of(cell_size_mm=0.4), target=Target(sac, None))
    with pytest.raises(FlowError, match=r"of 0\.4 mm no cell is inside the sac .* near \(0\.1, 0\.1, 4\.1\) mm: use"):
        simulate_case(case)


def test_the_last_good_check_is_told_with_time_speed_and_place():
    case = case_of(cell_size_mm=0.4, inflow_mL_s=1.0)
    engine = LatticeBoltzmann(0.4)
    state = engine.init(case, None)
    while len(state.history) < 3:
        state = engine.step(state)
    good_ms = 1e3 * state.steps * state.scales.step_s
    speed = np.linalg.norm(state.snapshots[-1].velocity, axis=1).max() * state.scales.speed_m_s
    state.populations[:] = np.nan
    while not (reached := engine.terminate(engine.step(state))) or not np.isnan(reached):
        pass
    said = engine.trouble(state)
    assert f"between {good_ms:.3g} and" in said
    assert f"{speed:.2g} m/s at (" in said
    assert "too coarse" in said  # neither too fast for its time step, nor coming back
