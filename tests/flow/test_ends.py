"""Boundary conditions of the openings: what the settings say, and that each type keeps its value and the mass."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import jv

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.errors import InputError
from vstent.flow import sampling
from vstent.flow.case import FlowCase, Sheet
from vstent.flow.domain import section_pressure_Pa
from vstent.flow.ends import (
    ASSUMED,
    MEAN_INLET_SPEED_M_S,
    End,
    FlowRate,
    Inflow,
    Pressure,
    Resistance,
    ends_of,
    outflows,
)
from vstent.flow.indices import balance, residuals
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import Waveform
from vstent.geometry.vessel import Vessel
from vstent.kernels import curves
from vstent.units import M3_PER_ML, PA_PER_MMHG

INFLOW_ML_S = 1.0
SETTINGS = FlowSettings(inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.4, tolerance=0.002))


@cache
def fork() -> Vessel:
    """A tube with a branch: one inlet and two outlets, the second 2.4 mm wide."""
    straight = phantoms.tube(length_mm=14.0, radius_mm=2.0)
    phantom = phantoms.with_branch(straight, abscissa_mm=6.0, direction=[1, 0, 1], radius_mm=1.2, length_mm=7.0)
    return trace(Vessel(phantoms.phantom_surface(phantom)))


def test_murray_gives_all_outlets_but_the_widest_their_share_of_the_cubes_of_the_diameters() -> None:
    inlet, wide, narrow = fork().openings
    share = narrow.diameter_mm**3 / (wide.diameter_mm**3 + narrow.diameter_mm**3)
    assert 0.1 < share < 0.3
    ends = ends_of(fork(), replace(SETTINGS, outlets="murray"))
    assert ends == (Inflow(INFLOW_ML_S), Pressure(0.0), FlowRate(pytest.approx(share * INFLOW_ML_S)))
    assert ends_of(fork(), SETTINGS) == (Inflow(INFLOW_ML_S), Pressure(0.0), Pressure(0.0))
    by_default = ends_of(fork(), FlowSettings())
    assert by_default[0] == Inflow(pytest.approx(MEAN_INLET_SPEED_M_S * inlet.area_mm2), ASSUMED)


def test_resistances_matter_unless_every_flow_is_given() -> None:
    free, split = (vessel_case(fork(), replace(SETTINGS, outlets=word)) for word in ("zero_pressure", "murray"))
    assert not free.is_split_given
    assert split.is_split_given
    assert vessel_case(trace(Vessel(phantoms.phantom_surface(phantoms.tube())))).is_split_given


@pytest.mark.parametrize(
    "ends",
    [
        (Inflow(INFLOW_ML_S), Pressure(), FlowRate(0.4)),
        (Inflow(INFLOW_ML_S), FlowRate(0.7), Pressure()),
        (Inflow(INFLOW_ML_S), Pressure(), Pressure(1.0)),
    ],
)
def test_every_end_keeps_its_value_and_what_enters_leaves(ends: tuple[End, ...]) -> None:
    field = simulate_case(replace(vessel_case(fork(), SETTINGS), ends=ends))
    assert field.is_converged
    assert field.inlets_mL_s[0] == pytest.approx(INFLOW_ML_S, rel=2e-3)
    assert field.outlets_mL_s.sum() == pytest.approx(field.inflow_mL_s, rel=3e-3)
    for end, found_mL_s in zip(ends[1:], field.outlets_mL_s, strict=True):
        if isinstance(end, FlowRate):
            assert found_mL_s == pytest.approx(end.mean_mL_s, rel=3e-3)


def test_a_pressure_at_an_outlet_sends_the_blood_to_the_other() -> None:
    even, level, higher = (
        simulate_case(replace(vessel_case(fork(), SETTINGS), ends=(Inflow(INFLOW_ML_S), *map(Pressure, pressures_Pa))))
        for pressures_Pa in ((0.0, 0.0), (30.0, 30.0), (30.0, 31.0))
    )
    # A pressure common to all outlets shifts that of the vessel and moves no blood.
    np.testing.assert_allclose(level.outlets_mL_s, even.outlets_mL_s, rtol=2e-3)
    np.testing.assert_allclose(level.pressure_Pa - even.pressure_Pa, 30.0, rtol=0.01)
    assert "outlet_2_asked_share_fraction" not in balance(vessel_case(fork(), SETTINGS), even)  # pressures alone
    murray = balance(vessel_case(fork(), replace(SETTINGS, outlets="murray")), even)
    assert murray["outlet_1_asked_share_fraction"] == pytest.approx(1 - murray["outlet_2_asked_share_fraction"])
    assert higher.outlets_mL_s[1] < 0.92 * level.outlets_mL_s[1]
    assert higher.inlet_pressure_Pa[0] > level.inlet_pressure_Pa[0] + 0.1


# -- resistances and Windkessels ---------------------------------------------------------------------------------------

PULSE_MOMENTS = 200
PERIOD_S = 1.0
TIME_S = PERIOD_S * np.arange(PULSE_MOMENTS) / PULSE_MOMENTS


def windkessel(proximal: float, compliance: float, distal: float) -> Resistance:
    """A Windkessel with resistances in Pa s/mL and a compliance in mL/Pa."""
    total = proximal + distal
    return Resistance(1.0, 0.0, total * compliance, proximal / total, total)


def test_a_steady_windkessel_is_its_resistance() -> None:
    """Closed form of svZeroDSolver's steady case: p = Q R = 10,000; 500 more before a tube with R = 100."""
    flows, common = outflows([windkessel(1000.0, 1e-4, 1000.0)], np.array([5.0]), np.zeros((1, 1)))
    assert flows[0, 0] == pytest.approx(5.0)
    assert common[0] == pytest.approx(10_000.0)
    _, behind_tube = outflows([windkessel(1000.0, 1e-4, 1000.0)], np.array([5.0]), np.full((1, 1), -500.0))
    assert behind_tube[0] == pytest.approx(10_500.0)


def test_a_windkessel_begins_in_its_periodic_state() -> None:
    """From rest the differential equation needs 33 cycles to 1 % (R_d C = 7 s in a cycle of 1 s)."""
    proximal, compliance, distal = 1000.0, 1e-4, 70_000.0
    inflow = 2.2 + 2.5 * np.sin(2 * np.pi * TIME_S)
    _, common = outflows([windkessel(proximal, compliance, distal)], inflow, np.zeros((PULSE_MOMENTS, 1)), PERIOD_S)
    stored_Pa, step_s, course = 0.0, PERIOD_S / PULSE_MOMENTS, []
    for k in range(80 * PULSE_MOMENTS):
        middle = 2.2 + 2.5 * np.sin(2 * np.pi * (k + 0.5) * step_s)
        kept = np.exp(-step_s / (distal * compliance))
        course.append(stored_Pa + proximal * inflow[k % PULSE_MOMENTS])
        stored_Pa = kept * stored_Pa + (1 - kept) * distal * middle
    np.testing.assert_allclose(course[-PULSE_MOMENTS:], common, rtol=1e-3)
    away = np.abs(np.reshape(course, (-1, PULSE_MOMENTS)) - common).max(axis=1) / common.mean()
    assert 1 + np.flatnonzero(away < 0.01)[0] == 33
    assert away[0] > 0.5


def test_two_cycles_find_the_flow_of_a_fork_with_unlike_windkessels() -> None:
    """Arms with resistance and inertance, against complex impedances."""
    ends = [windkessel(2e3, 1e-4, 5e3), windkessel(1e3, 2e-4, 9e3)]
    resistance, inertance = np.array([300.0, 100.0]), np.array([20.0, 10.0])
    inflow = 3.0 + 2.0 * np.sin(2 * np.pi * TIME_S) + 0.5 * np.cos(6 * np.pi * TIME_S)
    rate_per_s = 2 * np.pi * np.arange(PULSE_MOMENTS // 2 + 1) / PERIOD_S
    arms = resistance + 1j * np.outer(rate_per_s, inertance)
    whole = arms + np.stack([end.at(0.0) * end.relative_impedance(rate_per_s) for end in ends], axis=1)
    exact = np.fft.rfft(inflow)[:, None] / whole / (1 / whole).sum(axis=1, keepdims=True)
    flows = outflows(ends, inflow, np.zeros((PULSE_MOMENTS, 2)), PERIOD_S)[0]
    for _ in range(2):
        pressure = -np.fft.irfft(arms * np.fft.rfft(flows, axis=0), PULSE_MOMENTS, axis=0)
        flows = outflows(ends, inflow, pressure, PERIOD_S)[0]
    np.testing.assert_allclose(flows.sum(axis=1), inflow, atol=1e-9)
    harmonics = np.fft.rfft(flows, axis=0)[[0, 1, 3]]
    np.testing.assert_allclose(harmonics, exact[[0, 1, 3]], rtol=0.01)


@pytest.mark.parametrize("mean_Pa", [1e3, 12.4e3, 20e3])
def test_without_a_device_each_outlet_has_its_share_at_any_mean_pressure(mean_Pa: float) -> None:
    ends = [Resistance(share, mean_Pa) for share in (1.5, 1.0, 0.5)]
    flows, common = outflows(ends, np.array([3.0]), np.array([[0.0, -200.0, 150.0]]))
    np.testing.assert_allclose(flows, [[1.5, 1.0, 0.5]])
    assert common[0] == pytest.approx(mean_Pa)


def test_a_pressure_common_to_all_outlets_moves_no_blood() -> None:
    ends, pressure_Pa = [windkessel(2e3, 1e-4, 5e3), windkessel(1e3, 2e-4, 9e3)], np.zeros((PULSE_MOMENTS, 2))
    pressure_Pa[:, 1] = 300 * np.sin(2 * np.pi * TIME_S)
    inflow, pulse_Pa = np.full(PULSE_MOMENTS, 3.0), 12e3 + 5e3 * np.cos(2 * np.pi * TIME_S)
    plain, common = outflows(ends, inflow, pressure_Pa, PERIOD_S)
    raised, less = outflows(ends, inflow, pressure_Pa + pulse_Pa[:, None], PERIOD_S)
    np.testing.assert_allclose(raised, plain, rtol=1e-9)
    np.testing.assert_allclose(less, common - pulse_Pa, rtol=1e-9)


def test_neither_mean_nor_pulse_pressure_changes_a_velocity() -> None:
    """Of a steady flow without a device at 0, 93 and 150 mmHg, and of a pulse with unlike compliances in one outlet.

    At 0 mmHg the shares are fixed, and the widest outlet has zero pressure.
    """
    coarse = replace(SETTINGS.numerics, cell_size_mm=0.5, tolerance=5e-4)
    settings = replace(SETTINGS, outlets="resistance", numerics=coarse)
    without = simulate_case(vessel_case(fork(), replace(settings, outlets="split")))
    low, high = (
        simulate_case(vessel_case(fork(), replace(settings, mean_pressure_mmHg=mmHg))) for mmHg in (93.0, 150.0)
    )
    for one in (low, high):
        np.testing.assert_allclose(one.velocity_m_s, without.velocity_m_s, atol=1e-3 * without.speed_m_s.max())
    assert without.common_pressure_Pa == 0.0
    assert high.common_pressure_Pa - low.common_pressure_Pa == pytest.approx(57 * PA_PER_MMHG, rel=1e-3)
    tube = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=12.0, radius_mm=1.5))))
    settings = replace(settings, outlets="windkessel", waveform=Waveform(0.951, (0.0,), (0.6,)))
    settings = replace(settings, inflow_mL_s=0.3, numerics=replace(coarse, cell_size_mm=0.35))
    stiff, soft = (
        simulate_case(vessel_case(tube, replace(settings, compliance_time_s=time_s))) for time_s in (0.05, 1.0)
    )
    for one, other in zip(stiff.phases, soft.phases, strict=True):
        np.testing.assert_allclose(one.velocity_m_s[0], other.velocity_m_s[0], atol=1e-3 * stiff.speed_m_s.max())


@pytest.mark.validation
def test_long_arms_with_unlike_windkessels_share_a_pulse_as_their_impedances_say() -> None:
    """Each arm is a tube of Womersley's impedance before its Windkessel; the flow is slow, so that the fork takes none.

    The fork is where the axes meet, and the length of each arm is what its steady flow says. Sound must be fast
    and the pulse slow, so that the arms store no blood.
    """
    straight = phantoms.tube(length_mm=34.0, radius_mm=1.5)
    phantom = phantoms.with_branch(straight, abscissa_mm=10.0, direction=[1, 0, 0.6], radius_mm=1.3, length_mm=26.0)
    vessel = trace(Vessel(phantoms.phantom_surface(phantom)))
    waveform = Waveform(2.0, (0.0,), (0.9,))
    inflow_mL_s = 0.4
    numerics = Numerics(cell_size_mm=0.3, tolerance=0.002, cycle_tolerance=0.005, max_cycles=8, lattice_speed=0.05)
    settings = FlowSettings(inflow_mL_s=inflow_mL_s, profile="womersley", waveform=waveform, numerics=numerics)
    case = vessel_case(vessel, settings)
    ends = (windkessel(60.0, 1.6e-3, 240.0), windkessel(150.0, 6e-4, 350.0))
    case = replace(case, ends=(case.ends[0], *ends))
    steady, field = simulate_case(replace(case, waveform=None)), simulate_case(case)
    assert field.is_converged
    radius_m, blood = np.array([1.5e-3, 1.3e-3]), case.blood
    rate_per_s = waveform.harmonics[0]
    beta = radius_m * np.sqrt(rate_per_s[:, None] / blood.kinematic_viscosity_m2_s) * 1j**1.5
    share = 1 - 2 * jv(1, beta) / (beta * jv(0, beta))
    per_m = 1j * rate_per_s[:, None] * blood.density_kg_m3 / (np.pi * radius_m**2 * share) * M3_PER_ML
    steady_per_m = 8 * blood.viscosity_Pa_s / (np.pi * radius_m**4) * M3_PER_ML
    at_fork_Pa = sampling.values_at(steady, straight.parent.at(np.array([10.0])))[1]
    lengths_m = (at_fork_Pa - steady.outlet_pressure_Pa) / (steady_per_m * steady.outlets_mL_s)
    whole_R = np.array([end.at(0.0) for end in ends])
    mean = (1 / (steady_per_m * lengths_m + whole_R)) / (1 / (steady_per_m * lengths_m + whole_R)).sum()
    impedance = per_m * lengths_m + np.stack([end.at(0.0) * end.relative_impedance(rate_per_s) for end in ends], axis=1)
    exact = waveform.harmonics[1][:, None] / impedance / (1 / impedance).sum(axis=1, keepdims=True)
    found = np.array([phase.outlets_mL_s for phase in field.phases]) / inflow_mL_s
    time_s = np.array([phase.time_s for phase in field.phases])
    waves = 2 * (found[None] * np.exp(-1j * np.outer(rate_per_s, time_s))[..., None]).mean(axis=1)
    print(f"lengths {1e3 * lengths_m} mm, means {found.mean(axis=0) / mean - 1}")  # noqa: T201
    print(f"amplitudes {np.abs(waves / exact) - 1}, phases {np.degrees(np.angle(waves / exact))}")  # noqa: T201
    np.testing.assert_allclose(found.mean(axis=0), mean, rtol=0.01)
    np.testing.assert_allclose(np.abs(waves), np.abs(exact), rtol=0.02)
    np.testing.assert_allclose(np.angle(waves / exact), 0.0, atol=np.radians(2))


def test_settings_state_shares_and_resistances() -> None:
    shares = replace(SETTINGS, outlets="resistance", shares=(3.0, 1.0), mean_pressure_mmHg=100.0)
    mean_Pa = pytest.approx(13_332.2)
    assert ends_of(fork(), shares)[1:] == (Resistance(0.75, mean_Pa), Resistance(0.25, mean_Pa))
    assert ends_of(fork(), replace(shares, outlets="split"))[1:] == (Pressure(), FlowRate(0.25))
    compliant = ends_of(fork(), replace(shares, outlets="windkessel"))[1]
    assert compliant == Resistance(0.75, mean_Pa, 0.69, 0.44)
    by_square = ends_of(fork(), replace(SETTINGS, outlets="split", outlet_exponent=2.0))[2]
    assert by_square == FlowRate(pytest.approx(1.2**2 / (2.0**2 + 1.2**2), rel=0.03))
    with pytest.raises(InputError, match=r"3 shares for 2 outlets: give one for each outlet, the widest first"):
        ends_of(fork(), replace(shares, shares=(1.0, 1.0, 1.0)))
    with pytest.raises(InputError, match="no effect with --outlets murray: choose split, resistance or windkessel"):
        ends_of(fork(), replace(shares, outlets="murray"))
    assert vessel_case(fork(), shares).is_split_given


def covered(case: FlowCase, resistance_Pa_s_m: float) -> FlowCase:
    """A case with a screen across the narrow branch."""
    opening = case.vessel.outlets[1]
    across = curves.any_perpendicular(opening.normal)
    axes = np.stack([across, np.cross(opening.normal, across)])
    grid = np.stack(np.meshgrid(*2 * [np.arange(-1.5, 1.5, 0.1)]), axis=-1).reshape(-1, 2)
    points_mm = opening.center_mm - 2.0 * opening.normal + grid @ axes
    column = np.ones(len(points_mm))
    sheet = Sheet(
        points_mm,
        np.tile(opening.normal, (len(points_mm), 1)),
        0.01 * column,
        resistance_Pa_s_m * column,
        0 * column,
        0 * column,
        0.03 * column,
        0.3 * column,
    )
    return replace(case, media=(sheet,))


def test_a_covered_branch_loses_as_much_as_the_network_of_resistors_says() -> None:
    """500 Pa across a screen in one of two branches."""
    share = 0.25
    coarse = replace(SETTINGS.numerics, cell_size_mm=0.5)
    settings = replace(SETTINGS, outlets="resistance", shares=(1 - share, share), numerics=coarse)
    case = vessel_case(fork(), settings)
    bare = simulate_case(case)
    assert bare.is_converged
    np.testing.assert_allclose(bare.outlets_mL_s / INFLOW_ML_S, [1 - share, share], atol=0.01 * share)
    assert bare.common_pressure_Pa == pytest.approx(93 * PA_PER_MMHG)
    area_mm2 = np.pi / 4 * fork().outlets[1].diameter_mm ** 2
    after = simulate_case(covered(case, 500.0 / (share * INFLOW_ML_S / area_mm2)), start=bare)
    assert after.is_converged
    first, second = case.resisted_as(bare).resistances
    drop_Pa = bare.outlet_pressure_Pa - after.outlet_pressure_Pa
    assert drop_Pa[1] - drop_Pa[0] > 300
    lost_mL_s = (drop_Pa[1] - drop_Pa[0]) / (first.at(0.0) + second.at(0.0))
    assert bare.outlets_mL_s[1] - after.outlets_mL_s[1] == pytest.approx(lost_mL_s, rel=0.02)
    asked = balance(case.resisted_as(bare), after)
    assert asked["outlet_2_asked_share_fraction"] == pytest.approx(share - lost_mL_s / INFLOW_ML_S, rel=1e-3)
    assert asked["outlet_2_share_fraction"] == pytest.approx(after.outlets_mL_s[1] / after.outlets_mL_s.sum())
    assert asked["common_pressure_Pa"] == pytest.approx(after.common_pressure_Pa)
    missing = residuals(case.resisted_as(bare), after)
    assert set(missing) == {f"{name}_residual_fraction" for name in ("mass", "inlet", "outlet_1", "outlet_2")}
    assert max(map(abs, missing.values())) < 3e-3
    assert 0.003 < lost_mL_s < 0.02
    assert after.outlets_mL_s.sum() == pytest.approx(INFLOW_ML_S, rel=3e-3)


def test_resistances_with_a_device_need_the_flow_without() -> None:
    case = covered(vessel_case(fork(), replace(SETTINGS, outlets="resistance")), 1.0)
    with pytest.raises(InputError, match="follow from the flow without a device: compute that first"):
        simulate_case(case)


def test_a_pulse_passes_unlike_windkessels_as_their_impedances_say() -> None:
    """The flow of every phase is that which the Windkessels answer to the pressures at the outlets."""
    waveform = Waveform(0.951, (0.0,), (0.6,))
    settings = replace(SETTINGS, waveform=waveform, numerics=replace(SETTINGS.numerics, cell_size_mm=0.5))
    ends = (Resistance(0.8, 12e3, 0.2, 0.1), Resistance(0.2, 12e3, 1.0, 0.6))
    case = vessel_case(fork(), settings)
    case = replace(case, ends=(*case.ends[:1], *ends))
    field = simulate_case(case)
    assert field.is_converged
    grid, n_inlets = field.finest, 1
    pressure_Pa = [section_pressure_Pa(case.vessel, grid, phase.pressure_Pa[0])[n_inlets:] for phase in field.phases]
    time_s = np.array([phase.time_s for phase in field.phases])
    wanted, _ = outflows(ends, INFLOW_ML_S * waveform.factor(time_s), np.array(pressure_Pa), waveform.period_s)
    found = np.array([phase.outlets_mL_s for phase in field.phases])
    (mean, harmonic), (mean_wanted, harmonic_wanted) = (np.fft.rfft(flow, axis=0)[:2] for flow in (found, wanted))
    np.testing.assert_allclose(mean.real, mean_wanted.real, rtol=0.01)
    np.testing.assert_allclose(np.abs(harmonic), np.abs(harmonic_wanted), rtol=0.02)
    np.testing.assert_allclose(np.angle(harmonic / harmonic_wanted), 0.0, atol=np.radians(2))
    assert np.degrees(np.ptp(np.angle(harmonic / mean))) > 20  # other than with fixed shares
