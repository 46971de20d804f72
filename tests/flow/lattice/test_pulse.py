"""Pulsatile flow against Womersley's, and the waveforms that drive it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from womersley import MEAN_MEAN_M_S, OMEGA, PULSE, RADIUS_M, SWING, womersley_m_s, womersley_wss_Pa

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.errors import InputError
from vstent.flow import domain, sampling, simulation as flow
from vstent.flow.case import PHASES, FlowField
from vstent.flow.lattice import engine as lattice_engine, pace as lattice_pace
from vstent.flow.lattice.pace import pace
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics, Waveform
from vstent.flow.simulation import simulate_case
from vstent.flow.stopping import cycle_change, cycles_advice
from vstent.flow.waveform import OLDER_ADULT_ICA, waveform_of
from vstent.geometry.vessel import Vessel


@cache
def pulsing(cell_size_mm: float, max_cycles: int = 4) -> FlowField:
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=14.0, radius_mm=2.0))))
    inflow_mL_s = MEAN_MEAN_M_S * np.pi * RADIUS_M**2 * 1e6
    numerics = Numerics(cell_size_mm=cell_size_mm, lattice_speed=0.05, max_cycles=max_cycles)
    settings = FlowSettings(inflow_mL_s=inflow_mL_s, waveform=PULSE, numerics=numerics)
    return simulate_case(vessel_case(vessel, settings))


def in_steps(longer: float) -> FlowField:
    """The same on wide cells, in steps that are by turns the shortest and so many times as long."""
    with pytest.MonkeyPatch.context() as patch:
        steps = 2 * np.rint(200 / np.tile([1, longer], PHASES // 2)).astype(int)
        patch.setattr(lattice_engine, "pace", lambda *case: steps)
        return pulsing.__wrapped__(0.4, max_cycles=2)


def along(field: FlowField) -> float:
    return np.sign(field.velocity_m_s[:, 2].mean())


FINE = pytest.param(0.2, 0.01, 2.0, marks=pytest.mark.validation)
"""20 cells a diameter."""


@pytest.mark.parametrize(("cell_size_mm", "of_peak", "degrees"), [(0.25, 0.0125, 2.0), FINE])
def test_velocity_is_womersleys_at_every_phase(cell_size_mm: float, of_peak: float, degrees: float) -> None:
    field = pulsing(cell_size_mm)
    assert field.is_converged
    r_mm = np.linspace(0, 1.8, 10)
    points = np.stack([r_mm, 0 * r_mm, np.full(10, 7.0)], axis=1)
    error = []
    for phase in field.phases:
        found = along(field) * sampling.values_at(field.at_phase(phase), points)[0][:, 2]
        error.append(np.abs(found - womersley_m_s(r_mm * 1e-3, phase.time_s)).max())
    peak_m_s = womersley_m_s(np.zeros(1), 0.0).max()
    print(f"Womersley, {cell_size_mm} mm: within {max(error) / peak_m_s:.2%} of the peak")  # noqa: T201
    assert max(error) < of_peak * peak_m_s


def test_a_pulse_that_begins_from_a_coarser_one_soon_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    at_rest = pulsing(0.25)  # the tube holds too few wider cells for a guess
    for module in (flow, domain):
        monkeypatch.setattr(module, "MIN_CELLS", 20)
    second = 2 * PHASES - 1
    assert pulsing.__wrapped__(0.25, max_cycles=2).residual[second] < 0.05 * at_rest.residual[second]


def fast(speed_m_s: np.ndarray) -> float:
    """What all but a thousandth keep below."""
    return float(np.quantile(speed_m_s, 0.999))


SWING_OF_HALF = Waveform(1.0, (0.5,), (0.0,))


def steps_of(waveform: Waveform, speed_m_s: np.ndarray | None, way_mm: float = 1e-6) -> np.ndarray:
    """Steps of every phase of a pulse whose blood is that fast at the end of each; None: that is not known."""
    field = pulsing(0.25)
    case = vessel_case(
        trace(Vessel(field.wall)), FlowSettings(waveform=waveform, numerics=Numerics(lattice_speed=0.05))
    )
    fastest_m_s = np.array([fast(np.linalg.norm(phase.velocity_m_s[0], axis=1)) for phase in field.phases])
    phases = [] if speed_m_s is None else zip(field.phases, speed_m_s / fastest_m_s, strict=True)
    known = replace(
        field, phases=tuple(replace(phase, velocity_m_s=(s * phase.velocity_m_s[0],)) for phase, s in phases)
    )
    with pytest.MonkeyPatch.context() as patch:
        volume_mm3 = way_mm * case.vessel.inlet.area_mm2
        patch.setattr(lattice_pace, "extended_volume_mm3", lambda vessel: volume_mm3)
        return pace(case, 0.25, known)


def test_time_steps_go_by_the_fastest_blood_of_their_phase() -> None:
    """At either of its ends, or so much faster as the flow is in between; never more than three times the shortest."""
    flow = 2 + np.cos(2 * np.pi * np.arange(1, PHASES + 1) / PHASES)
    for speed_m_s in (0.1 * flow, 0.1 * flow**3):
        expected = 1.1 * np.maximum(speed_m_s, np.roll(speed_m_s, 1)) / PHASES / (0.05 * 0.25e-3)
        found = steps_of(SWING_OF_HALF, speed_m_s)
        assert (found % 2 == 0).all()
        np.testing.assert_allclose(found, np.maximum(expected, expected.max() / 3), atol=2.01)
    half, steady_m_s = np.pi / PHASES, np.full(PHASES, 0.3)  # now the flow's peak lies between two moments
    between = Waveform(1.0, (0.5 * np.cos(half),), (0.5 * np.sin(half),))
    peak = 1.5 / (1 + 0.5 * np.cos(half))
    assert steps_of(between, steady_m_s)[0] == pytest.approx(peak * steps_of(SWING_OF_HALF, steady_m_s)[5], abs=2)


def test_where_no_cycle_is_known_blood_is_faster_as_the_flow_is_and_goes_on_for_a_phase() -> None:
    flow = 1 + 0.5 * np.cos(2 * np.pi * np.arange(PHASES + 1) / PHASES)
    within = np.maximum(flow[1:], flow[:-1])
    expected = 1.1 * fast(pulsing(0.25).speed_m_s) * np.maximum(within, np.roll(within, 1)) / PHASES / (0.05 * 0.25e-3)
    found = steps_of(SWING_OF_HALF, None)
    np.testing.assert_allclose(found, np.maximum(expected, expected.max() / 3), atol=2.01)


def test_longer_steps_store_little_blood_on_its_way() -> None:
    """Sound, 0.577 cells a step, takes so long that T^2 q'' / 2 is 0.5 % of the flow, or they are the shortest."""
    flow = 2 + np.cos(2 * np.pi * np.arange(1, PHASES + 1) / PHASES)
    way_mm, time_s = 42.0, np.linspace(0, 1, 20 * 200 + 1)
    steps, free = (steps_of(SWING_OF_HALF, 0.1 * flow, way) for way in (way_mm, 1e-6))
    factor = SWING_OF_HALF.factor(time_s)
    curvature = np.abs(np.gradient(np.gradient(factor, time_s), time_s))
    of_phase = [slice(200 * k + 4, 200 * (k + 1) - 3) for k in range(PHASES)]
    store = np.array([curvature[part].max() / factor[part].mean() for part in of_phase])
    sound_s = way_mm / (3**-0.5 * 0.25 / (1 / PHASES / steps))
    stored = 0.5 * sound_s**2 * store
    longer, limited = steps < steps.max(), steps > free + 2
    assert (stored[longer] < 0.00505).all()
    assert (stored[longer & limited] > 0.0049).all()
    assert longer.sum() > 5
    assert (limited & longer).any()


def test_a_flow_goes_on_as_it_was_when_the_steps_change() -> None:
    """Twenty times a cycle they become a quarter longer or as short again; but for a cell beside the inlet's rim."""
    shorter, changing = in_steps(1.0), in_steps(1.25)
    assert changing.steps == pytest.approx(0.9 * shorter.steps, rel=0.01)
    inside, along_wall = ((z > 1) & (z < 13) for z in (shorter.centers_mm[:, 2], shorter.wall.vertices_mm[:, 2]))
    limits = {
        "velocity_m_s": (inside, 0.0015),
        "pressure_Pa": (inside, 0.007),
        "wall_shear_stress_Pa": (along_wall, 0.0025),
    }
    for name, (where, of_largest) in limits.items():
        found, wanted = (
            np.array([getattr(one.at_phase(phase), name)[where] for phase in one.phases]) for one in (changing, shorter)
        )
        assert np.abs(found - wanted).max() < of_largest * np.abs(wanted).max(), name


def test_cycles_that_go_on_differing_are_told_from_those_that_become_alike() -> None:
    assert "more cycles will not" in cycles_advice(np.array([0.094, 0.093, 0.089]), 4, is_converged=False)
    assert "allow more cycles" in cycles_advice(np.array([0.4, 0.09]), 3, is_converged=False)
    assert "allow more cycles" in cycles_advice(np.array([0.09]), 2, is_converged=False)
    assert "single cycle" in cycles_advice(np.zeros(0), 1, is_converged=False)
    assert "periodic" in cycles_advice(np.array([0.09, 0.085, 0.084]), 4, is_converged=True)


def test_inflow_is_the_waveforms() -> None:
    field = pulsing(0.25)
    time_s = np.array([phase.time_s for phase in field.phases])
    found = np.array([phase.inflow_mL_s for phase in field.phases])
    np.testing.assert_allclose(time_s, PULSE.period_s * np.arange(1, PHASES + 1) / PHASES)
    np.testing.assert_allclose(found / found.mean(), PULSE.factor(time_s), atol=0.002)


@pytest.mark.parametrize(("cell_size_mm", "of_peak", "degrees"), [(0.25, 0.0125, 2.0), FINE])
def test_wall_shear_stress_has_womersleys_amplitude_and_phase(
    cell_size_mm: float, of_peak: float, degrees: float
) -> None:
    field = pulsing(cell_size_mm)
    z = field.wall.vertices_mm[:, 2]
    time_s = np.array([phase.time_s for phase in field.phases])
    stress = along(field) * np.array([p.wall_shear_stress_Pa[(z > 5) & (z < 9), 2].mean() for p in field.phases])
    mean_Pa, amplitude_Pa = womersley_wss_Pa()
    found = 2 * (stress * np.exp(-1j * OMEGA * time_s)).mean()
    lag = np.degrees(np.angle(found / amplitude_Pa))
    print(f"Womersley, {cell_size_mm} mm: WSS phase {lag:+.2f} degrees, amplitude {abs(found / amplitude_Pa) - 1:+.2%}")  # noqa: T201
    assert stress.mean() == pytest.approx(mean_Pa, rel=0.02)
    assert abs(found) == pytest.approx(abs(amplitude_Pa), rel=0.02)
    assert abs(lag) < degrees


@pytest.mark.parametrize(
    ("cell_size_mm", "lattice_speed"), [(0.25, 0.1), pytest.param(0.2, 0.05, marks=pytest.mark.validation)]
)
def test_averaged_stress_and_its_oscillation_of_a_flow_through_zero_are_in_closed_form(
    cell_size_mm: float, lattice_speed: float
) -> None:
    """Q0 + Q1 sin wt: TAWSS is the mean of |t0 + t1 sin x|, OSI (1 - |t0| / TAWSS) / 2."""
    ratio = 3.0
    pulse = Waveform(PULSE.period_s, (0.0,), (ratio,))
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=14.0, radius_mm=2.0))))
    settings = FlowSettings(
        inflow_mL_s=MEAN_MEAN_M_S * np.pi * RADIUS_M**2 * 1e6,
        profile="womersley",
        waveform=pulse,
        numerics=Numerics(cell_size_mm=cell_size_mm, lattice_speed=lattice_speed),
    )
    field = simulate_case(vessel_case(vessel, settings))
    assert field.is_converged
    mean_Pa, amplitude_Pa = womersley_wss_Pa()
    swing = ratio / SWING * abs(amplitude_Pa) / mean_Pa
    assert swing > 1.5  # the stress changes its direction
    averaged_Pa = mean_Pa * (np.arcsin(1 / swing) + np.sqrt(swing**2 - 1)) * 2 / np.pi
    oscillating = 0.5 * (1 - mean_Pa / averaged_Pa)
    z = field.wall.vertices_mm[:, 2]
    is_middle = (z > 5) & (z < 9)
    found_Pa, found = field.shear_Pa[is_middle].mean(), field.oscillatory_shear_index[is_middle].mean()
    off, oscillates = found_Pa / averaged_Pa - 1, found / oscillating - 1
    print(f"Q0 + Q1 sin wt, {cell_size_mm} mm: TAWSS {off:+.2%}, OSI {oscillates:+.2%}")  # noqa: T201
    assert found_Pa == pytest.approx(averaged_Pa, rel=0.02)
    assert found == pytest.approx(oscillating, rel=0.02)


def test_time_averaged_stress_and_its_oscillation_are_those_of_the_phases() -> None:
    field = pulsing(0.25)
    stress = np.array([phase.wall_shear_stress_Pa for phase in field.phases], float)
    np.testing.assert_allclose(field.shear_Pa, np.linalg.norm(stress, axis=2).mean(axis=0), rtol=1e-5)
    mean = np.linalg.norm(stress.mean(axis=0), axis=1)
    np.testing.assert_allclose(field.wall_shear_stress_Pa, stress.mean(axis=0), atol=1e-4 * mean.max())
    expected = 0.5 * (1 - mean / field.shear_Pa)
    np.testing.assert_allclose(field.oscillatory_shear_index, expected, atol=1e-4)
    np.testing.assert_allclose(field.relative_residence_time_per_Pa, 1 / mean, rtol=1e-2)


def test_a_measured_waveform_is_recovered() -> None:
    time_s = np.linspace(0.2, 0.2 + OLDER_ADULT_ICA.period_s, 401)
    found = waveform_of(time_s, 7.0 * OLDER_ADULT_ICA.factor(time_s - 0.2))
    dense = np.linspace(0, 2 * OLDER_ADULT_ICA.period_s, 333)
    assert found.period_s == pytest.approx(OLDER_ADULT_ICA.period_s)
    np.testing.assert_allclose(found.factor(dense), OLDER_ADULT_ICA.factor(dense), atol=2e-4)


def test_the_published_waveform_has_its_published_range() -> None:
    factor = OLDER_ADULT_ICA.factor(np.linspace(0, OLDER_ADULT_ICA.period_s, 2001))
    assert (factor.min(), factor.max()) == pytest.approx((0.403, 2.189), abs=0.002)


@pytest.mark.parametrize(
    ("time_s", "flow", "why"),
    [
        ([0, 1, 2], [1, 1, 1], "at least 5"),
        ([0, 1, 2, 2, 4], [1, 2, 3, 2, 1], "do not increase"),
        ([0, 1, 2, 3, 4], [1, np.nan, 3, 2, 1], "number is missing"),
        ([0, 1, 2, 3, 4], [-1, -2, -3, -2, -1], "reverse its sign"),
    ],
)
def test_a_bad_waveform_is_refused(time_s: list, flow: list, why: str) -> None:
    with pytest.raises(InputError, match=why):
        waveform_of(np.array(time_s, float), np.array(flow, float))


def test_cycles_are_compared_phase_by_phase() -> None:
    cycle = 2.0 + np.sin(np.linspace(0, 2 * np.pi, PHASES, endpoint=False))[:, None] * [1.0, 0.5]
    assert cycle_change(np.concatenate([cycle, cycle])) == 0.0
    assert cycle_change(np.concatenate([cycle, 1.1 * cycle])) == pytest.approx(0.1 / 1.1)
    assert cycle_change(np.concatenate([cycle, cycle])[:-1]) == np.inf
    assert np.isnan(cycle_change(np.concatenate([cycle, np.nan * cycle])))


def test_pulsatile_flow_without_swing_is_steady_flow() -> None:
    settings = FlowSettings(inflow_mL_s=0.4, numerics=Numerics(cell_size_mm=0.4, tolerance=0.001))
    case = vessel_case(trace(Vessel(pulsing(0.25).wall)), settings)
    steady, pulsed = simulate_case(case), simulate_case(replace(case, waveform=Waveform(0.5, (0.0,), (0.0,))))
    np.testing.assert_allclose(pulsed.velocity_m_s, steady.velocity_m_s, atol=0.01 * steady.speed_m_s.max())
