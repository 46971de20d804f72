"""Transport of contrast against exact solutions: fronts, dispersion, residence times, conservation and bounds."""

from dataclasses import replace

import numpy as np
import pytest
from cell_networks import network, tube

from vstent.angiography import transport
from vstent.angiography.transport import Transport
from vstent.angiography.washout import wash_out


def upper_face(net, cells, axis):
    """The upper face of cells along an axis, -1 at a wall."""
    found = np.full(len(net.cells) + net.openings, -1)
    along = np.flatnonzero(net.axis == axis)
    found[net.left[along]] = along
    return found[cells]


def at_end(march, interval_s, end_s):
    """The last frame."""
    *_, (_, values) = march.frames(interval_s, end_s)
    return values


@pytest.mark.parametrize("is_plug", [True, False])
def test_a_front_moves_with_the_blood(is_plug):
    length, end_s = 80, 30.0
    net = tube(4.5, length, is_plug=is_plug)
    march = Transport(net, inflow=lambda _: 1.0)
    values = at_end(march, end_s, end_s)
    axial = net.flux_mm3_s[0][upper_face(net, np.arange(len(net.cells)), 2)]  # cells per s
    for speed in np.unique(axial.round(6))[-3:]:
        line = np.isclose(axial, speed, atol=1e-5)
        filled = values[line].sum() / (line.sum() / length)
        assert filled == pytest.approx(speed * end_s, rel=0.01)
        sharp = (values[line] > 0.05) & (values[line] < 0.95)
        assert sharp.sum() / (line.sum() / length) < 6  # a first-order scheme needs more than twenty


def channel(across, length):
    """A plane channel along z with parallel walls and a mean speed of 1 cell per s."""
    inside = np.ones((1, across, length), dtype=bool)

    def speed(cells):
        return 1.5 * (1 - ((cells[:, 1] - (across - 1) / 2) / (across / 2)) ** 2)

    section = np.argwhere(inside[:, :, 0])
    first, last = (np.c_[section, np.full(across, end)] for end in (0, length - 1))
    ends = [(first, 2, -1, 0, -speed(first)), (last, 2, 1, 1, speed(last))]
    return network(inside, lambda axis, cells: speed(cells) if axis == 2 else np.zeros(len(cells)), openings=ends)


def test_dispersion_is_that_of_taylor_and_aris():
    """D_eff = D (1 + 2 Pe^2 / 105) between parallel walls (Wooding 1960, J. Fluid Mech. 7, 501)."""
    across, peclet = 16, 12.0
    net = channel(across, 20 * across)
    half, z = across / 2, net.cells[:, 2].astype(float)
    mean_speed = net.flux_mm3_s[0][net.axis == 2].mean()
    diffusivity = mean_speed * half / peclet
    unit_s = half**2 / diffusivity
    start = np.exp(-(((z - 40) / 10) ** 2))
    spreads, means = [], []
    march = Transport(net, diffusivity_mm2_s=diffusivity, initial=start)
    for _, values in march.frames(0.4 * unit_s, 1.6 * unit_s):
        means.append(np.average(z, weights=values))
        spreads.append(np.average((z - means[-1]) ** 2, weights=values))
    assert np.diff(means)[2:] == pytest.approx(0.4 * unit_s * mean_speed, rel=0.01)
    found = np.diff(spreads)[2:] / 2 / (0.4 * unit_s)
    assert found == pytest.approx(diffusivity * (1 + 2 / 105 * peclet**2), rel=0.05)


def cavity(n):
    """Potential flow through a channel with a cavity above: cells, sac, inflow of the sac, and the stream function.

    The stream function at the corners of the cells gives flow rates that balance exactly.
    """
    nx, ny, low, high, deep = 8 * n, 5 * n, 2 * n, 6 * n, 2 * n
    inside = np.zeros((nx, ny), dtype=bool)
    inside[:, :deep] = True
    inside[low:high, deep:] = True
    psi = np.zeros((nx + 1, ny + 1))
    free = np.zeros_like(psi, dtype=bool)
    free[1:-1, 1:-1] = inside[1:, 1:] & inside[:-1, 1:] & inside[1:, :-1] & inside[:-1, :-1]
    psi[:, deep:] = 1.0
    psi[[0, -1], : deep + 1] = np.arange(deep + 1) / deep
    for _ in range(60 * n):
        for parity in (0, 1):
            mean = 0.25 * (np.roll(psi, 1, 0) + np.roll(psi, -1, 0) + np.roll(psi, 1, 1) + np.roll(psi, -1, 1))
            now = free & ((np.indices(psi.shape).sum(axis=0) % 2) == parity)
            psi[now] += 1.8 * (mean - psi)[now]
    u, v = np.diff(psi, axis=1), -np.diff(psi, axis=0)  # through the lower x and lower y faces

    def flux(axis, cells):
        x, y = cells[:, 0], cells[:, 1]
        return [u[np.minimum(x + 1, nx), y], v[x, np.minimum(y + 1, ny)], np.zeros(len(cells))][axis]

    rows = np.arange(deep)
    first, last = (np.c_[np.full(deep, x), rows, np.zeros(deep, int)] for x in (0, nx - 1))
    ends = [(first, 0, -1, 0, -u[0, :deep]), (last, 0, 1, 1, u[nx, :deep])]
    net = network(inside[:, :, None], flux, openings=ends)
    sac = np.flatnonzero(net.cells[:, 1] >= deep)
    neck = v[low:high, deep]
    return net, sac, float(np.maximum(neck, 0).sum()), (u, v, deep)


def exit_times(u, v, deep, starts):
    """Time until particles leave the cavity, on streamlines that are exact in every cell (Pollock 1988)."""
    found = []
    for x, y in starts:
        time = 0.0
        i, j = int(x), int(y)
        while j >= deep and time < 1e5:
            steps = []
            for low, high, at, cell in ((u[i, j], u[i + 1, j], x, i), (v[i, j], v[i, j + 1], y, j)):
                slope, here = high - low, low + (high - low) * (at - cell)
                goal = high if here > 0 else low
                if here * goal <= 0:
                    steps.append((np.inf, slope, here))
                elif abs(slope) < 1e-12:
                    steps.append((((cell + (here > 0)) - at) / here, slope, here))
                else:
                    steps.append((np.log(goal / here) / slope, slope, here))
            step = min(steps[0][0], steps[1][0])
            if not np.isfinite(step):
                time = 1e5
                break
            moved = [
                at + (here * step if abs(slope) < 1e-12 else here * np.expm1(slope * step) / slope)
                for (_, slope, here), at in zip(steps, (x, y), strict=True)
            ]
            along = int(steps[1][0] < steps[0][0])
            forward = steps[along][2] > 0
            x, y = moved
            if along == 0:
                i += 1 if forward else -1
                x = float(i if forward else i + 1)
            else:
                j += 1 if forward else -1
                y = float(j if forward else j + 1)
            time += step
        found.append(time)
    return np.array(found)


def test_blood_leaves_a_sac_as_particles_do_and_after_volume_over_inflow():
    net, sac, inflow, (u, v, deep) = cavity(6)
    scale = len(sac) / inflow  # s: volume over inflow
    fast = replace(net, flux_mm3_s=net.flux_mm3_s * scale)
    found = wash_out(fast, sac, end_s=12.0)
    points = net.cells[sac][:, :2]
    offsets = (np.indices((3, 3)).reshape(2, -1).T + 0.5) / 3
    starts = (points[:, None] + offsets).reshape(-1, 2)
    times = exit_times(u, v, deep, starts) / scale
    assert found.mean_age_s == pytest.approx(times.mean(), rel=0.03)
    gone_s = np.interp(-0.1, -found.left_fraction, found.time_s)
    assert gone_s == pytest.approx(np.quantile(times, 0.9), rel=0.10)
    # All blood of the vessel has been in the sac for the sac's volume over the flow rate of the vessel.
    at_outlet = np.flatnonzero(net.right == len(net.cells) + 1)
    passing = fast.flux_mm3_s[0][at_outlet]
    march = Transport(fast, initial=np.isin(np.arange(len(net.cells)), sac).astype(float))
    frames = [values[net.left[at_outlet]].astype(float) for _, values in march.frames(0.05, 12.0)]
    assert passing @ np.trapezoid(frames, dx=0.05, axis=0) == pytest.approx(len(sac), rel=0.01)


@pytest.mark.parametrize("is_merged", [False, True])
def test_contrast_is_conserved_and_bounded(is_merged):
    net = cavity(4)[0]
    if is_merged:
        net = net.merged(net.cells[:, 1] < 6)
        assert set(net.width) == {1, 2}
    scale = 40.0
    fast = replace(net, flux_mm3_s=net.flux_mm3_s * scale)
    march = Transport(fast, inflow=lambda t: float(t < 3) * 2.0, upper=2.0, diffusivity_mm2_s=0.01)
    for _, values in march.frames(0.5, 10.0):
        assert values.min() >= -1e-6
        assert values.max() <= 2.0 + 1e-5
        assert march.balance().error_fraction < 1e-5  # single precision


def test_cells_that_hold_nothing_are_skipped_without_a_trace(monkeypatch):
    net = cavity(8)[0]
    fast = replace(net, flux_mm3_s=net.flux_mm3_s * 40.0)

    def marched():
        march = Transport(fast, inflow=lambda t: 2.0 * float(t < 1), upper=2.0, diffusivity_mm2_s=0.01)
        for _, values in march.frames(0.5, 6.0):
            yield values, march._held.is_full.mean(), march.balance().error_fraction

    skipping = list(marched())
    monkeypatch.setattr(transport, "EMPTY", -1.0)
    for (values, full, error), (wanted, every, _) in zip(skipping, marched(), strict=True):
        assert values == pytest.approx(wanted, abs=2 * 2e-5)
        assert full <= every
        assert error < 1e-5
    assert min(full for _, full, _ in skipping) < 0.8


def test_merged_cells_carry_the_same_flow_and_volume():
    net = cavity(4)[0]
    coarse = net.merged(np.ones(len(net.cells), dtype=bool))
    assert coarse.volume_mm3.sum() == pytest.approx(net.volume_mm3.sum())
    assert coarse.through_mL_s() == pytest.approx(net.through_mL_s())
    n = len(coarse.cells)
    gain = np.bincount(coarse.right, coarse.flux_mm3_s[0], n + 2) - np.bincount(
        coarse.left, coarse.flux_mm3_s[0], n + 2
    )
    assert np.abs(gain[:n]).max() < 1e-6


def test_in_a_pulse_the_front_moves_by_the_integral_of_the_speed():
    net = tube(2.5, 60, is_plug=True)
    times = tuple(np.arange(20) / 20)
    rate = 20 * (1 + 0.6 * np.sin(2 * np.pi * np.array(times)))
    pulse = replace(net, flux_mm3_s=rate[:, None] * net.flux_mm3_s[0], time_s=np.array(times), period_s=1.0)
    march = Transport(pulse, inflow=lambda _: 1.0)
    end_s = 1.5
    section = len(net.cells) / 60
    expected = 20 * (end_s + 0.6 / (2 * np.pi) * (1 - np.cos(2 * np.pi * end_s)))
    assert at_end(march, 0.05, end_s).sum() / section == pytest.approx(expected, rel=0.01)
