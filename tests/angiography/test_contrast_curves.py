"""Injections and the times of curves against their integrals and exact values."""

import numpy as np
import pytest

from vstent.angiography.bolus import Bolus
from vstent.angiography.curves import Curves
from vstent.errors import InputError


@pytest.mark.parametrize("shape", ["constant", "gamma"])
def test_all_iodine_injected_enters(shape):
    flow_mL_s = 4.0
    bolus = Bolus(iodine_mg_mL=320, amount_mL=3, rate_mL_s=2, start_s=0.4, shape=shape)
    inflow, most = bolus.inflow([flow_mL_s])
    times = np.linspace(0, 30, 12_001)
    values = np.array([inflow(time) for time in times])
    assert flow_mL_s * np.trapezoid(values, times) == pytest.approx(320 * 3, rel=1e-3)
    assert values.max() == pytest.approx(most, rel=1e-6)
    assert values[times < 0.4].max() == 0


@pytest.mark.parametrize("shape", ["constant", "gamma"])
def test_all_iodine_injected_enters_a_pulse(shape):
    """The blood of diastole carries more of it than that of systole, and the start within the cycle does not matter."""
    cycle = np.arange(20) / 20
    pulse = 4 + 1.9 * np.sin(2 * np.pi * cycle)
    for start_s in (0.0, 0.3):
        bolus = Bolus(iodine_mg_mL=320, amount_mL=3, rate_mL_s=2, start_s=start_s, shape=shape)
        inflow, most = bolus.inflow(pulse, cycle, 1.0)
        times = np.linspace(0, 12, 3_001)
        values = np.array([inflow(time) for time in times])
        assert np.trapezoid(values * np.interp(times, cycle, pulse, period=1.0), times) == pytest.approx(960, rel=1e-3)
        assert values.max() <= most


@pytest.mark.parametrize("rate_mL_s", [3.0, 9.0])
def test_agent_that_the_flow_cannot_carry_enters_later(rate_mL_s):
    """In diastole the flow is slower than the injection: the blood there is pure agent, and nothing is lost."""
    cycle = np.arange(20) / 20
    pulse = 3.7 + 1.9 * np.sin(2 * np.pi * cycle)
    inflow, most = Bolus(iodine_mg_mL=300, amount_mL=3, rate_mL_s=rate_mL_s).inflow(pulse, cycle, 1.0)
    times = np.linspace(0, 5, 5_001)
    values = np.array([inflow(time) for time in times])
    assert np.trapezoid(values * np.interp(times, cycle, pulse, period=1.0), times) == pytest.approx(900, rel=2e-3)
    assert values.max() == most == 300


def test_a_faster_injection_than_the_flow_is_pure_agent_for_amount_over_flow():
    inflow, most = Bolus(amount_mL=3.0, rate_mL_s=9.0).inflow([4.0])
    assert most == 300.0
    assert [inflow(time) for time in (0.1, 0.7, 0.77)] == pytest.approx([300.0, 300.0, 0.0])


def test_a_curve_is_linear_between_its_points_and_zero_beyond():
    inflow, most = Bolus(curve=((0.5, 0.0), (1.0, 80.0), (2.0, 0.0))).inflow([4.0])
    assert most == 80.0
    assert [inflow(time) for time in (0.4, 0.75, 1.0, 1.5, 2.5)] == [0.0, 40.0, 80.0, 40.0, 0.0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"amount_mL": -1.0}, "amount is -1"),
        ({"rate_mL_s": 0.0}, "rate is 0"),
        ({"start_s": -0.1}, "starts at -0.1 s"),
        ({"curve": ((1.0, 2.0), (0.5, 1.0))}, "do not increase"),
        ({"curve": ((0.0, -2.0), (0.5, 1.0))}, "negative"),
    ],
)
def test_an_impossible_injection_is_refused_in_a_sentence(given, words):
    with pytest.raises(InputError, match=words):
        Bolus(**given)


def test_times_of_a_well_mixed_sac():
    """A sac with the time constant tau behind an artery: centroid later by tau, half-life tau ln 2."""
    tau, box = 1.3, 0.8
    times = np.linspace(0, 12, 12_001)
    parent = np.where(times < box, 100.0, 0.0)
    filled = 100 * (1 - np.exp(-np.minimum(times, box) / tau))
    sac = filled * np.exp(-np.maximum(times - box, 0) / tau)
    found = Curves(times, sac, parent).measures()
    assert found["contrast_mean_transit_s"] == pytest.approx(tau, rel=2e-3)
    assert found["washout_half_life_s"] == pytest.approx(tau * np.log(2), rel=2e-3)
    assert found["contrast_retention_s"] == pytest.approx(tau * np.log(2), rel=2e-3)
    assert found["contrast_peak_s"] == pytest.approx(box, abs=2e-3)
    assert found["contrast_peak_fraction"] == pytest.approx(1 - np.exp(-box / tau), rel=1e-3)
    assert found["contrast_arrival_s"] == pytest.approx(-tau * np.log(1 - 0.1 * (1 - np.exp(-box / tau))), rel=2e-2)


def test_what_the_window_does_not_reach_is_left_out():
    times = np.linspace(0, 1, 101)
    found = Curves(times, times, np.exp(-times)).measures()
    assert "washout_half_life_s" not in found
    assert "contrast_retention_s" not in found
    assert Curves(times, 0 * times, np.exp(-times)).measures() == {}
