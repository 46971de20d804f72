"""Live flow: whatever device was there before, it comes to the flow that a run of its own finds on the same grid."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.flow.case import FlowCase, Sheet
from vstent.flow.domain import default_cell_size_mm
from vstent.flow.engines import DivergenceError, run
from vstent.flow.indices import indices, neck_diameter_mm, parent_diameter_mm
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.live import (
    CELLS_ACROSS_NECK,
    CELLS_ACROSS_PARENT,
    KNOWN,
    BareFlow,
    LiveFlow,
    Stepping,
    average,
    known,
    preview_spacing_mm,
)
from vstent.flow.lattice.stepping import twin
from vstent.flow.media import media
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.archive import load_data, save_data

SETTINGS = FlowSettings(inflow_mL_s=1.5, numerics=Numerics(cells_per_diameter=13.0, cells_across_neck=0.0))
"""A default grid coarser than a preview's: the preview takes it."""


@cache
def anatomy() -> Anatomy:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=28.0), abscissa_mm=14.0, width_mm=5.0, neck_mm=3.6)
    return restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))


@cache
def case() -> FlowCase:
    return flow_case(anatomy(), (), SETTINGS)


@cache
def devices() -> tuple[tuple[Sheet, ...], tuple[Sheet, ...]]:
    designs = (vstent.find_design(name) for name in ("silk", "enterprise"))
    dense, sparse = (media(vstent.deploy(one, anatomy()).stent, case().blood) for one in designs)
    return dense, sparse


@pytest.fixture(scope="module")
def live() -> LiveFlow:
    return LiveFlow(case())


def settled(live: LiveFlow) -> tuple[float, float]:
    """Return neck inflow and sac velocity once they stay within 0.1 % over a tenth of a second of blood."""
    before = np.zeros(2)
    for _ in range(60):
        live.advance(0.0)
        while not live.read().is_settled:
            live.advance(0.2)
        now = live.read()
        found = np.array([now.neck_inflow_mL_s, now.sac_velocity_m_s])
        if np.abs(found / np.maximum(before, 1e-12) - 1).max() < 1e-3:
            return float(found[0]), float(found[1])
        before = found
        live.advance(1.0)
    pytest.fail(f"after a minute the flow still changes from {before} to {found}")


@cache
def alone(live: LiveFlow, one: tuple[Sheet, ...]) -> tuple[float, float]:
    """Return neck inflow and sac velocity of a run of its own, in the same coarse flow."""
    engine = LatticeBoltzmann(live.cell_size_mm)
    fine = replace(case(), media=one, numerics=replace(SETTINGS.numerics, refine=("sac",), tolerance=1e-3))
    found = indices(run(engine, fine, start=live.outer), fine.sac, fine.ostium)
    return found["neck_inflow_mL_s"], found["mean_sac_velocity_m_s"]


def test_the_flow_without_a_device_is_that_of_a_run(live: LiveFlow) -> None:
    live.place(())
    np.testing.assert_allclose(settled(live), alone(live, ()), rtol=0.03)
    assert live.bare == live.read()
    assert live.change("neck_inflow_mL_s") == (0.0, 0.0)


def test_an_exchanged_device_comes_to_its_own_flow(live: LiveFlow) -> None:
    dense, sparse = devices()
    for one in (sparse, dense, (), dense):
        live.place(one)
        np.testing.assert_allclose(settled(live), alone(live, one), rtol=0.03)


def test_a_covered_branch_loses_as_much_as_its_resistance_says() -> None:
    """A branch beside the sac: live and full computation agree on what the device leaves of its flow."""
    straight = phantoms.with_sac(phantoms.tube(length_mm=28.0), abscissa_mm=14.0, width_mm=5.0, neck_mm=3.6)
    phantom = phantoms.with_branch(straight, abscissa_mm=14.0, direction=[-1, 0, 0.6], radius_mm=1.0, length_mm=9.0)
    branched = restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))
    settings = replace(SETTINGS, outlets="resistance", mean_pressure_mmHg=20.0)
    bare = flow_case(branched, (), settings)
    silk = media(vstent.deploy("silk", branched).stent, bare.blood)
    dense = tuple(replace(one, normal_resistance_Pa_s_m=40 * one.normal_resistance_Pa_s_m) for one in silk)
    live = LiveFlow(bare)
    live.place(dense)
    while not live.read().is_settled or not live.bare.is_settled:
        live.advance(0.5)
    bare = replace(bare, numerics=replace(SETTINGS.numerics, refine=("sac",), cell_size_mm=live.cell_size_mm))
    first = simulate_case(bare)
    after = simulate_case(replace(bare, media=dense), start=first)
    in_branch = [sorted(one.readings[-1][2:].reshape(2, -1)[1])[-2] for one in (live._bare, live._shown)]
    left = after.outlets_mL_s[1] / first.outlets_mL_s[1]
    before, now = (indices(one, bare.sac, bare.ostium)["neck_inflow_mL_s"] for one in (first, after))
    assert left < 0.95
    assert in_branch[1] / in_branch[0] == pytest.approx(left, abs=0.02)
    change, band = live.change("neck_inflow_mL_s")
    assert change == pytest.approx(100 * (now / before - 1), abs=3 + band)


def test_both_flows_step_until_the_one_without_a_device_is_known(live: LiveFlow) -> None:
    live.place(())
    live.place(devices()[0])
    assert max(live.bare.error.values()) < KNOWN
    without = [one.copy() for one in live._bare.readings]
    live.advance(0.0)
    np.testing.assert_array_equal(live._bare.readings, without)
    live._bare.forget()
    populations = live.state.populations.copy()
    live.advance(0.0)
    assert len(live._bare.readings) == 1
    assert not np.array_equal(live.state.populations, populations)
    while live._unknown == (live._bare, live._shown):
        live.advance(0.0)
    assert max(live.bare.error.values()) < max(KNOWN, *live.read().error.values())


def test_only_the_flow_without_a_device_is_prepared_until_it_is_known(live: LiveFlow) -> None:
    live.place(())
    live.place(devices()[0])
    settled(live)
    shown, populations = live.read(), live.state.populations.copy()
    live._bare.forget()
    live.prepare(60.0)
    assert live.is_prepared
    known = len(live._bare.readings)
    live.prepare(60.0)
    assert len(live._bare.readings) == known
    assert live.read() == shown
    np.testing.assert_array_equal(live.state.populations, populations)


def test_a_stored_flow_continues_to_the_last_bit(live: LiveFlow, tmp_path: Path) -> None:
    live.place(())
    save_data(tmp_path / "bare.npz", live.stored())
    again = LiveFlow(case(), stored=load_data(tmp_path / "bare.npz", BareFlow))
    assert again.bare == live.bare
    for one in (again, live):
        one.place(devices()[0])
        one._shown.advance()
        one._bare.advance()
    assert again.change("neck_inflow_mL_s") == live.change("neck_inflow_mL_s")
    for name in ("_shown", "_bare"):
        stored, other = (getattr(one, name).state for one in (again, live))
        np.testing.assert_array_equal(stored.populations, other.populations)


def test_a_change_lies_within_its_band_while_the_flow_adapts(live: LiveFlow) -> None:
    live.place(())
    settled(live)
    live.place(devices()[0])
    course = []
    for _ in range(150):
        live.advance(0.0)
        course.append(live.change("neck_inflow_mL_s"))
    end, error = course[-1]
    assert error < 3.0
    assert sum(np.isfinite(one[1]) for one in course) > 100
    assert all(abs(percent - end) <= points + error for percent, points in course)


def test_an_average_lies_within_its_uncertainty_of_the_limit() -> None:
    steps, rng = np.arange(200), np.random.default_rng(4)
    for rate in (0.8, 0.95, 0.98):
        decaying = 1 + 0.5 * rate**steps
        for n in range(3, len(steps)):
            mean, error = average(decaying[:n])
            assert abs(mean - 1) <= error * mean + 1e-12, (rate, n)
    missed = 0
    for _ in range(200):
        noise = rng.normal(size=300)
        noisy = 1 + 0.1 * np.convolve(noise, 0.7 ** np.arange(20), "valid")
        mean, error = average(noisy)
        missed += abs(mean - 1) > error * mean
    assert missed <= 20


def test_what_a_recent_reading_said_holds_still() -> None:
    rng = np.random.default_rng(5)
    values = 1 + 0.1 * np.convolve(rng.normal(size=150), 0.7 ** np.arange(20), "valid")
    for n in range(2, len(values)):
        (mean, error), own = known(values[:n]), average(values[:n])
        assert mean == own[0]
        assert error <= own[1]
        before, reach = known(values[: n - 1])[0], average(values[: n - 1])[1]
        assert error * mean <= reach * before + abs(mean - before) + 1e-12


def test_few_readings_say_nothing() -> None:
    assert average(np.linspace(1.0, 2.0, 8)) == (1.5, np.inf)


def test_an_exchange_changes_the_screen_and_nothing_else(live: LiveFlow) -> None:
    live.place(devices()[0])
    before = live.state.populations.copy()
    live.place(devices()[1])
    np.testing.assert_array_equal(live.state.populations, before)
    assert len(live.state.screen.cell) > 0
    live.place(())
    assert len(live.state.screen.cell) == 0


def test_a_flow_that_diverges_says_so(live: LiveFlow) -> None:
    lost = Stepping(twin(live.state), 2)
    lost.state.populations[:] = np.nan
    with pytest.raises(DivergenceError):
        lost.advance()
    assert np.isfinite(live.state.populations).all()


def test_the_grid_is_as_coarse_as_neck_and_artery_allow() -> None:
    fine = replace(case(), numerics=replace(SETTINGS.numerics, cells_per_diameter=80.0, cell_size_mm=0.5))
    assert fine.ostium is not None
    across = neck_diameter_mm(fine.ostium) / CELLS_ACROSS_NECK, parent_diameter_mm(fine) / CELLS_ACROSS_PARENT
    assert preview_spacing_mm(fine) == min(across)
    assert preview_spacing_mm(case()) == default_cell_size_mm(case()) > preview_spacing_mm(fine)
