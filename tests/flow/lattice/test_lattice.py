"""The lattice-Boltzmann kernels against their algebra, and the grid and field kernels against geometry."""

from dataclasses import replace
from functools import cache

import numba
import numpy as np
import pytest
from shapes import sphere

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.flow.lattice.engine import LatticeBoltzmann
from vstent.flow.lattice.kernels import d3q19, lanes
from vstent.flow.lattice.kernels.collision import collided, relaxed, squared_reach
from vstent.flow.lattice.scales import ODD_RATE as VESSEL_ODD_RATE
from vstent.flow.lattice.setup import Grid, address, build_links, parabolic_weights, thickest
from vstent.flow.lattice.state import speeds
from vstent.flow.lattice.stepping import advance
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings
from vstent.geometry.vessel import Vessel
from vstent.kernels import directions, sampling, voxels

STRIDE = 40
RATE, ODD_RATE, NO_LIMIT = 1.6, 0.7, 1e9
NO_SCREEN = d3q19.no_screen(1)
NOTHING_SENT_BACK = d3q19.NO_LINKS, *d3q19.undivided(1)


def populations(seed=0):
    """Random shifted populations of one segment of STRIDE cells."""
    small = np.random.default_rng(seed).normal(scale=0.01, size=(19, STRIDE)).astype(np.float32)
    return np.concatenate([small.ravel(), np.zeros(lanes.COUNT, np.float32)])


def even_step(f, screen=NO_SCREEN, limit=NO_LIMIT, law=(0, 0, 0, 0)):
    """Collide all cells and bring the populations home: the even step leaves each at its opposite's place."""
    result = f.copy()
    address = (np.arange(19) * STRIDE)[None, None].astype(np.int32)
    relaxation = np.float32(1 / RATE), np.float32(law), np.float32([limit]), np.float32(ODD_RATE)
    d3q19.update(result, (address, np.array([STRIDE], np.int32), relaxation, screen), *NOTHING_SENT_BACK)
    return result[: -lanes.COUNT].reshape(19, STRIDE)[d3q19.OPPOSITE]


def momentum(f):
    return np.einsum("qd,qk->kd", directions.VELOCITIES.astype(float), f.astype(float))


def test_the_velocity_set_is_isotropic_to_fourth_order():
    c, w = directions.VELOCITIES.astype(float), d3q19.WEIGHTS
    delta = np.eye(3)
    assert w.sum() == pytest.approx(1)
    np.testing.assert_allclose(np.einsum("q,qa,qb->ab", w, c, c), delta / 3, atol=1e-15)
    expected = sum(np.einsum(rule, delta, delta) for rule in ("ab,cd->abcd", "ac,bd->abcd", "ad,bc->abcd")) / 9
    np.testing.assert_allclose(np.einsum("q,qa,qb,qc,qd->abcd", w, c, c, c, c), expected, atol=1e-15)
    np.testing.assert_array_equal(c[d3q19.OPPOSITE], -c)


@pytest.mark.parametrize("cells", [1, 5, 8, 13, 16, 39])
def test_a_segment_of_any_length_collides_as_its_cells_do_alone_and_no_other_is_touched(cells):
    """Eight cells are worked on at once; none of them twice, and the next row is not written to."""
    f = populations(7)
    address = (np.arange(19) * STRIDE)[None, None].astype(np.int32)
    relaxation = np.float32(1 / RATE), np.zeros(4, np.float32), np.float32([NO_LIMIT]), np.float32(ODD_RATE)
    together = f.copy()
    d3q19.update(together, (address, np.array([cells], np.int32), relaxation, NO_SCREEN), *NOTHING_SENT_BACK)
    alone = f.copy()
    one = np.ones(1, np.int32)
    for cell in range(cells):
        d3q19.update(alone, (address + np.int32(cell), one, relaxation, NO_SCREEN), *NOTHING_SENT_BACK)
    np.testing.assert_array_equal(together, alone)


@cache
def bend():
    arc = phantoms.torus_arc(bend_radius_mm=5.0, angle_rad=1.0, radius_mm=2.0)
    return vessel_case(trace(Vessel(phantoms.phantom_surface(arc, edge_mm=0.5))), FlowSettings(inflow_mL_s=3.0))


def with_septa(domain, rng):
    """Put walls half-way between every tenth pair or so of neighbouring cells."""
    is_blood = np.zeros(domain.cells.max(axis=0) + 2, bool)
    is_blood[tuple(domain.cells.T)] = True
    ahead = domain.cells[:, None] + directions.VELOCITIES[1::2]
    cell, pair = np.nonzero(is_blood[tuple(np.moveaxis(ahead, -1, 0))] & (rng.random(ahead.shape[:2]) < 0.1))
    return replace(domain, septum_cell=cell, septum_direction=2 * pair + 1)


@pytest.fixture
def all_threads():
    """Let the kernels run on as many threads as there are cores."""
    before = numba.get_num_threads()
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("all_threads")
@pytest.mark.parametrize("threads", [1, 2, 5, 64])
def test_a_band_is_done_when_all_that_it_needs_is(threads):
    """Whatever the bands and whoever does them: as if every stage were done everywhere first.

    A bend has links of all kinds; walls half-way between its cells are put in.
    """
    case = bend()
    state = LatticeBoltzmann(0.3).init(case, None)
    rng = np.random.default_rng(5)
    state.populations[:] = 0.01 * rng.normal(size=state.populations.size)
    state.refill.refill[:] = 0.01 * rng.normal(size=state.refill.refill.size)
    domain, refill = with_septa(state.domain, rng), state.refill
    limit = thickest(case, domain)
    grid = Grid(domain, limit, address(domain, limit))
    a, links = grid.addressing, build_links(case, grid, state.scales)
    links.source[:] = 0.01 * rng.normal(size=links.source.size)
    all_bands = grid.bands
    assert len(all_bands) > 20
    everything = [len(a.length), len(refill.refill), len(links.source), links.start[-1], len(a.septa[0])]
    assert np.array_equal(all_bands[-1], everything)
    screen = state.screen.start, state.screen.place, state.screen.entry
    relaxation = np.float32(0.6), np.zeros(4, np.float32), state.limit, np.float32(ODD_RATE)
    cells = a.address, a.length, relaxation, screen
    back = links.path, links.weight, links.source, links.by_layer, refill.place, refill.refill, a.septa
    found = []
    shared = d3q19.share(a.length, screen[0], all_bands, threads)
    for bands, shares in ((all_bands, shared), (all_bands[[0, -1]], np.array([0, 1], np.int32))):
        f = state.populations.copy()
        d3q19.update(f, cells, back, bands, shares)
        found.append(f)
    np.testing.assert_array_equal(*found)


@pytest.mark.usefixtures("all_threads")
def test_a_flow_has_the_same_bits_on_one_thread_and_on_all():
    found = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        state = LatticeBoltzmann(0.3).init(bend(), None)
        advance(state, 200)
        assert state.populations.any()
        found.append(state.populations)
    np.testing.assert_array_equal(*found)


def test_flows_of_a_vessel_share_its_grid_and_not_their_populations():
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=8.0, radius_mm=2.0))))
    first, second, other = (
        LatticeBoltzmann(spacing_mm).init(vessel_case(one, FlowSettings(inflow_mL_s=0.5)), None)
        for one, spacing_mm in ((vessel, 0.3), (vessel, 0.3), (vessel, 0.25))
    )
    assert second.domain is first.domain
    assert second.addressing is first.addressing
    assert other.domain is not first.domain
    untouched = [second.populations.copy(), second.links.source.copy(), second.refill.refill.copy()]
    advance(first, 20)
    assert first.populations.any()
    for array, before in zip((second.populations, second.links.source, second.refill.refill), untouched, strict=True):
        np.testing.assert_array_equal(array, before)


def test_speeds_are_those_of_numpys_norm():
    velocity = np.random.default_rng(3).normal(size=(10_000, 3)).astype(np.float32)
    found = speeds(velocity)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.linalg.norm(velocity, axis=1))


def test_layers_share_no_line_of_the_cache_and_no_vector_reaches_into_another():
    """Beyond a segment vectors write again what they have read, while another thread may be at the next layer."""
    state = LatticeBoltzmann(0.3).init(bend(), None)
    domain, a = state.domain, state.addressing
    beyond = domain.cells[domain.link_cell] + directions.VELOCITIES[domain.link_direction]
    layer = np.concatenate([domain.cells[:, 0], beyond[:, 0]])
    place = np.concatenate([a.place, a.link_address[:, 3] % a.stride])
    first, last = (np.array([side(place[layer == x]) for x in np.unique(layer)]) for side in (np.min, np.max))
    assert len(first) > 20
    assert (first[1:] - last[:-1]).min() == lanes.COUNT + 1
    assert a.stride - last[-1] >= lanes.COUNT


def test_what_lies_beyond_a_segment_has_no_effect_and_stays():
    """Fast blood there makes the vector take the branch that raises the viscosity."""
    cells, stride, rng = 5, 3 * lanes.COUNT, np.random.default_rng(0)
    slow = 1e-3 * rng.normal(size=(19, stride)).astype(np.float32)
    fast = slow.copy()
    fast[:, cells:] = rng.normal(size=(19, stride - cells))
    relaxation = np.float32(0.52), np.zeros(4, np.float32), np.full(1, 75.0, np.float32), np.float32(ODD_RATE)
    address = stride * np.arange(19, dtype=np.int32)[None, None]
    of_cells = address, np.full(1, cells, np.int32), relaxation, d3q19.no_screen(1)
    found = []
    for f in (slow, fast):
        stored = np.r_[f.ravel(), np.zeros(lanes.COUNT, np.float32)]
        d3q19.update(stored, of_cells, d3q19.NO_LINKS, *d3q19.undivided(1))
        found.append(stored[: -lanes.COUNT].reshape(19, stride))
    np.testing.assert_array_equal(found[0][:, :cells], found[1][:, :cells])
    np.testing.assert_array_equal(found[1][:, cells:], fast[:, cells:])


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_threads_share_cells_links_and_screens_alike(threads):
    """Half of the bands have twice the cells, the screen or the links: no share is off the mean by more than a band."""
    heavy, vectors = np.arange(80) < 40, np.full(80, 4)
    bands = np.zeros((81, 5), np.int32)
    bands[:, 0] = np.arange(81)
    screened, linked = np.r_[0, np.cumsum(heavy)], bands.copy()
    linked[1:, 2] = np.cumsum(np.where(heavy, round(4 / d3q19.LINK_WORK), 0))
    twice = {
        "cells": (vectors * (1 + heavy), np.zeros(81, int), bands),
        "screen": (vectors, screened, bands),
        "links": (vectors, np.zeros(81, int), linked),
    }
    work = {"cells": 4 * (1 + heavy), "screen": np.where(heavy, 4 * d3q19.SCREENED_WORK, 4), "links": 4 * (1 + heavy)}
    for kind, (length, screen_start, of_bands) in twice.items():
        shares = d3q19.share(lanes.COUNT * length, screen_start, of_bands, threads)
        assert (shares[0], shares[-1]) == (0, 80)
        done = np.diff(np.r_[0, np.cumsum(work[kind])][shares])
        assert np.abs(done - done.mean()).max() <= work[kind].max() + 0.01


def test_a_collision_keeps_mass_and_momentum():
    f = populations()
    before, after = f[: -lanes.COUNT].reshape(19, STRIDE), even_step(f)
    np.testing.assert_allclose(after.sum(axis=0), before.sum(axis=0), atol=2e-7)
    np.testing.assert_allclose(momentum(after), momentum(before), atol=2e-7)
    assert np.abs(after - before).max() > 1e-3


def equilibrium(f):
    c, w = directions.VELOCITIES.astype(float), d3q19.WEIGHTS
    u = momentum(f)
    return w[:, None] * (f.sum(axis=0) + 3 * c @ u.T + 4.5 * (c @ u.T) ** 2 - 1.5 * (u**2).sum(axis=1))


def stress_of(f):
    """Traceless second moments (cells, 3, 3) of what departs from equilibrium."""
    c = directions.VELOCITIES.astype(float)
    traceless = np.einsum("qa,qb->qab", c, c) - np.eye(3) * (c**2).sum(axis=1)[:, None, None] / 3
    return np.einsum("qab,qk->kab", traceless, f - equilibrium(f))


def moments(f):
    """Density (k,), second moments (3, 3, k) and fourth ones <aabb> (3, 3, k): all that even populations hold."""
    c = directions.VELOCITIES.astype(float)
    return f.sum(axis=0), np.einsum("qa,qb,qk->abk", c, c, f), np.einsum("qa,qb,qk->abk", c**2, c**2, f)


def assert_fourth_moments_are_asked_for_by_the_second(f):
    """Those of the equilibrium have no direction; those of the stress are what streaming makes of a gradient."""
    density, second, fourth = moments(f)
    square = momentum(f).T ** 2
    for a, b in ((0, 1), (0, 2), (1, 2)):
        stress = second[a, a] + second[b, b] - 2 * density / 3 - square[a] - square[b]
        wanted = density / 9 + (square[a] + square[b]) / 3 + stress / 2
        np.testing.assert_allclose(fourth[a, b], wanted, atol=1e-6)


def test_a_collision_relaxes_the_stress_at_its_rate_and_its_moments_are_of_no_direction():
    f = populations(1)
    before, after = f[: -lanes.COUNT].reshape(19, STRIDE).astype(float), even_step(f).astype(float)
    np.testing.assert_allclose(stress_of(after), (1 - RATE) * stress_of(before), atol=1e-6)
    _, second, _ = moments(after)
    trace = after.sum(axis=0) + (momentum(after) ** 2).sum(axis=1)
    np.testing.assert_allclose(np.einsum("aak->k", second), trace, atol=1e-6)
    assert_fourth_moments_are_asked_for_by_the_second(after)


@pytest.mark.parametrize(("stretch", "stress"), [(2.5, 2.7), (0.4, 0.37)])
def test_longer_steps_hold_the_same_flow(stretch, stress):
    """Speeds grow with the step, densities with its square, stresses as is said; then shorter ones give all back."""
    f = populations(4)
    cells, no_links = np.arange(1, STRIDE - 1, dtype=np.int32), np.zeros((0, 6), np.int32)
    longer = f.copy()
    d3q19.rescale(longer, STRIDE, cells, no_links, np.float32(stretch), np.float32(stress))
    before, after = (one[: -lanes.COUNT].reshape(19, STRIDE).astype(float) for one in (f, longer))
    np.testing.assert_array_equal(after[:, [0, -1]], before[:, [0, -1]])
    before, after = before[:, cells], after[:, cells]
    np.testing.assert_allclose(after.sum(axis=0), stretch**2 * before.sum(axis=0), atol=1e-6)
    np.testing.assert_allclose(momentum(after), stretch * momentum(before), atol=1e-6)
    np.testing.assert_allclose(stress_of(after), stress * stress_of(before), atol=1e-6)
    np.testing.assert_allclose(odd_beyond(after), stretch**2 * odd_beyond(before), atol=1e-6)
    assert_fourth_moments_are_asked_for_by_the_second(after)
    again = longer.copy()
    for s, t in ((1 / stretch, 1 / stress), (stretch, stress)):
        d3q19.rescale(again, STRIDE, cells, no_links, np.float32(s), np.float32(t))
    np.testing.assert_allclose(again, longer, atol=1e-6)


def odd_beyond(f):
    """What the odd part (19, k) has beyond its equilibrium."""
    return 0.5 * (f - f[d3q19.OPPOSITE]) - 3 * d3q19.WEIGHTS[:, None] * (directions.VELOCITIES @ momentum(f).T)


def skewness(f):
    """Third moments <abb> (3, 3, k) beyond u_a / 3 and what stands in for <aabc>: all that odd populations hold."""
    c, u, n = directions.VELOCITIES.astype(float), momentum(f).T, stress_of(f)
    third = np.einsum("qa,qb,qk->abk", c, c**2, f) - u[:, None] / 3
    for a, b in np.argwhere(~np.eye(3, dtype=bool)):
        other = 3 - a - b
        third[a, b] -= (u[a] * n[:, other, other] + 2 * u[other] * n[:, a, other]) / 6
    return third[~np.eye(3, dtype=bool)]


def test_a_collision_relaxes_third_moments_to_what_a_lattice_with_more_velocities_would_do():
    f = populations(6)
    before, after = f[: -lanes.COUNT].reshape(19, STRIDE).astype(float), even_step(f).astype(float)
    np.testing.assert_allclose(skewness(after), (1 - ODD_RATE) * skewness(before), atol=1e-7)


def linearised(velocity, viscosity):
    """What a collision does (19, 19) to small departures from blood in uniform motion."""
    f = np.zeros(19 + lanes.COUNT, np.float32)
    d3q19.set_equilibrium(f, 1, np.zeros(1, np.int32), np.zeros(1), velocity[None])
    small = 1e-5 * np.eye(19)
    after = [collide(f[:19] + sign * one, 3 * viscosity + 0.5) for sign in (1, -1) for one in small]
    return (np.array(after[:19]) - after[19:]).T / 2e-5


def collide(f, time):
    parts = collided(tuple(f.astype(float)), time, NO_LIMIT, VESSEL_ODD_RATE)
    return np.array(relaxed(tuple(f.astype(float)), *parts))[d3q19.OPPOSITE]


@pytest.mark.parametrize("viscosity", [1e-3, 2e-3, 4e-3, 8e-3])
def test_no_wave_grows_on_fast_blood(viscosity):
    """Von Neumann's analysis of collision and streaming; with one rate for all blood they grow by up to 11 % a step."""
    courses = np.array([(1, 0, 0), (1, 1, 0), (1, 1, 1), (2, 1, 0), (3, 2, 1)])
    along = np.array([d for d in np.ndindex(2, 2, 2) if any(d)])[:, None] * np.linspace(0.05, np.pi, 30)[:, None]
    waves = np.concatenate([along.reshape(-1, 3), np.random.default_rng(8).uniform(-np.pi, np.pi, (100, 3))])
    shift = np.exp(-1j * waves @ directions.VELOCITIES.T)
    for direction in courses / np.linalg.norm(courses, axis=1)[:, None]:
        for speed in (0.05, 0.1, 0.15, 0.2):
            step = shift[:, :, None] * linearised(speed * direction, viscosity)
            assert np.abs(np.linalg.eigvals(step)).max() < 1 + 1e-3


def test_the_equilibrium_is_what_a_collision_keeps():
    density, velocity = np.linspace(-0.1, 0.1, STRIDE), np.random.default_rng(2).normal(scale=0.05, size=(STRIDE, 3))
    f = np.zeros(19 * STRIDE + lanes.COUNT, np.float32)
    d3q19.set_equilibrium(f, STRIDE, np.arange(STRIDE), density, velocity)
    begun = f[: -lanes.COUNT].reshape(19, STRIDE)
    np.testing.assert_allclose(even_step(f), begun, atol=2e-7)
    np.testing.assert_allclose(momentum(begun), velocity, atol=2e-7)
    assert_fourth_moments_are_asked_for_by_the_second(begun)


@pytest.mark.parametrize("is_screened", [False, True])
def test_fast_blood_is_as_thick_as_the_cell_reynolds_number_allows(is_screened):
    f, limit = populations(4), 1.0
    before = f[: -lanes.COUNT].reshape(19, STRIDE).astype(float)
    screen = screen_of((0, 0, 1), 0, 0) if is_screened else NO_SCREEN
    after = even_step(f, screen, limit).astype(float)
    viscosity = np.maximum((1 / RATE - 0.5) / 3, np.linalg.norm(momentum(before), axis=1) / limit)
    assert 0.2 < (viscosity > (1 / RATE - 0.5) / 3).mean() < 0.8
    kept = 1 - 1 / (3 * viscosity + 0.5)
    np.testing.assert_allclose(stress_of(after), kept[:, None, None] * stress_of(before), atol=1e-6)


@pytest.mark.parametrize("is_screened", [False, True])
def test_thinning_blood_relaxes_at_the_time_of_its_own_shear_rate(is_screened):
    f, law = populations(5), np.array([0.4, 30.0, 1.25, -0.624])
    before = f[: -lanes.COUNT].reshape(19, STRIDE).astype(float)
    after = even_step(f, screen_of((0, 0, 1), 0, 0) if is_screened else NO_SCREEN, law=law).astype(float)
    size = np.sqrt(2 * (stress_of(before) ** 2).sum(axis=(1, 2)))
    time = np.full(STRIDE, 1 / RATE + law[0])
    for _ in range(50):
        time = 1 / RATE + law[0] * (1 + (law[1] * 1.5 * size / time) ** law[2]) ** law[3]
    assert np.ptp(time) > 0.02
    np.testing.assert_allclose(stress_of(after), (1 - 1 / time)[:, None, None] * stress_of(before), atol=2e-4)


def screen_of(normal, along, across, quadratic=0.0, spread=0.0):
    """The same resistance in every cell of the segment."""
    entry = np.array([*normal, along, across, quadratic, spread], np.float32)
    return np.array([0, STRIDE], np.int32), np.arange(STRIDE, dtype=np.int32), np.tile(entry, (STRIDE, 1))


def test_a_screen_without_resistance_collides_as_none():
    f = populations(2)
    two_roundings = 2 * np.finfo(np.float32).eps
    np.testing.assert_allclose(even_step(f, screen_of((0, 0, 1), 0, 0)), even_step(f), rtol=two_roundings, atol=3e-9)


def test_a_screen_takes_the_momentum_of_its_law():
    f = populations(3)
    normal, along, across, quadratic, spread = np.array([0.6, 0.0, 0.8]), 0.7, 0.3, 6.5, 0.05
    start = momentum(f[: -lanes.COUNT].reshape(19, STRIDE))
    force = momentum(even_step(f, screen_of(normal, along, across, quadratic, spread))) - start
    velocity = start + 0.5 * force
    normal_speed = velocity @ normal
    tangential = velocity - normal_speed[:, None] * normal
    viscosity, stands_out = (1 / RATE - 0.5) / 3, 0.25 - (1 / ODD_RATE - 0.5) * (1 / RATE - 0.5)
    fourth, sixth = (normal**4).sum(), (normal**6).sum()
    stir = viscosity + 0.5 * np.abs(normal_speed)
    shared = 2 / (1 + np.sqrt(1 + 4 * spread / stir))
    size, part = np.linalg.norm(velocity, axis=1), shared
    for _ in range(20):
        thin = across + 0.5 * quadratic * size
        part = shared / (1 + stands_out * (3 - 8 * fourth + 6 * sixth) * shared * thin / stir)
        size = np.hypot(normal_speed, part * np.linalg.norm(tangential, axis=1))
    law = -((along + quadratic * size) * normal_speed)[:, None] * normal
    law -= (part * (across + 0.5 * quadratic * size))[:, None] * tangential
    np.testing.assert_allclose(force, law, atol=5e-3 * np.abs(law).max())
    linear = momentum(even_step(f, screen_of(normal, along, across, spread=spread))) - start
    assert np.abs(force - linear).max() > 0.2 * np.abs(law).max()
    at_once = momentum(even_step(f, screen_of(normal, along, across, quadratic))) - start
    assert np.abs(force - at_once).max() > 0.02 * np.abs(law).max()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.5, 0.5, 0.5**0.5), (3**-0.5,) * 3])
def test_links_reach_as_far_along_a_normal_as_their_moments_say(normal):
    n = np.array(normal)
    along = directions.VELOCITIES @ n
    beside = (directions.VELOCITIES**2).sum(axis=1) - along**2  # the squares along both tangents
    expected = (d3q19.WEIGHTS * along**4 * beside).sum() / (d3q19.WEIGHTS * along**2 * beside).sum()
    assert squared_reach(tuple(np.float32(n))) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.499, 0.5, 0.7, 1.0])
def test_a_parabola_that_is_zero_at_the_wall_is_reflected_as_itself(fraction):
    # Steady populations of a flow along the link (Ginzburg and d'Humieres 2003): even and odd equilibrium p and e, and
    # what relaxation changes of the even part, the slope of e, and of the odd part, h.
    even, odd, curvature, slope = 0.2, 1 / VESSEL_ODD_RATE - 0.5, -0.3, 0.7
    h, push = -0.5 * even * curvature, 0.5 * even * curvature

    def leaving(s, sign):
        e = slope * (s - fraction) + 0.5 * curvature * (s**2 - fraction**2)
        return 1 + push * s + sign * e - (even - 0.5) * (slope + curvature * s) - sign * (odd - 0.5) * h

    e = -slope * fraction - 0.5 * curvature * fraction**2
    arriving = 1 - e - (even + 0.5) * slope + (odd + 0.5) * h
    known = [leaving(0, 1), leaving(-1, 1), leaving(0, -1), leaving(-2, 1), leaving(-1, -1)]
    weights, _ = parabolic_weights(np.array([fraction]), even + 0.5, VESSEL_ODD_RATE)
    assert weights[0] @ known == pytest.approx(arriving, abs=1e-12)


def test_voxels_count_the_volume_of_a_sphere_and_forgive_a_doubled_face():
    ball = sphere(9.0)
    corners = ball.corners_mm + 12.0 + np.array([0.13, 0.21, 0.17])
    inside = voxels.fill(corners, (24, 25, 26))
    assert inside.sum() == pytest.approx(ball.volume_mm3, rel=0.01)
    grid = np.stack(np.meshgrid(*map(np.arange, inside.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    distance = ball.signed_distance(grid - 12.0 - np.array([0.13, 0.21, 0.17]))
    np.testing.assert_array_equal(inside.ravel(), distance < 0)
    np.testing.assert_array_equal(voxels.fill(np.concatenate([corners, corners[:40]]), inside.shape), inside)


def test_interpolation_is_exact_for_linear_fields_inside():
    index = np.arange(6 * 7 * 8, dtype=np.int32).reshape(6, 7, 8)
    grid = np.argwhere(index >= 0).astype(float)
    values = (grid @ [[1.0, 0.5], [-2.0, 0.1], [0.3, 4.0]]) + 1.0
    points = np.random.default_rng(0).uniform(0, 4.9, (50, 3))
    expected = (points @ [[1.0, 0.5], [-2.0, 0.1], [0.3, 4.0]]) + 1.0
    for is_zero_outside in (True, False):
        np.testing.assert_allclose(sampling.interpolate(index, values, points, is_zero_outside), expected)


def test_cubic_interpolation_is_exact_for_cubics_and_at_rest_outside():
    index = np.arange(7 * 8 * 9, dtype=np.int32).reshape(7, 8, 9)
    points = np.random.default_rng(0).uniform(1, 4.9, (50, 3))

    def cubic(at):
        x, y, z = at.T
        return np.stack([x**3 - 2 * y**2 * z + 1, (x - 2) ** 3 * (y - 3) ** 3 * z**3], axis=1)

    found = sampling.interpolate_cubic(index, cubic(np.argwhere(index >= 0).astype(float)), points)
    np.testing.assert_allclose(found, cubic(points), rtol=1e-9, atol=1e-9)
    one = np.full((5, 5, 5), -1, np.int32)
    one[2, 2, 2] = 0
    beside = np.array([[2.5, 2, 2], [3.5, 2, 2], [2.5, 2.5, 2], [7, 2, 2]])
    found = sampling.interpolate_cubic(one, np.ones((1, 1)), beside)
    np.testing.assert_allclose(found[:, 0], [9 / 16, -1 / 16, 81 / 256, 0], atol=1e-15)


def test_streamlines_of_a_rotation_are_circles():
    index = np.arange(40 * 40 * 3, dtype=np.int32).reshape(40, 40, 3)
    x, y, _ = np.argwhere(index >= 0).T - 19.5
    velocity = np.stack([-y, x, 0 * x], axis=1)
    path, count = sampling.trace_all(index, velocity, np.array([[29.5, 19.5, 1.0]]), 0.4, 1e-9, 300)
    radius = np.hypot(path[0, :, 0] - 19.5, path[0, :, 1] - 19.5)
    assert count[0] == 300
    np.testing.assert_allclose(radius, 10.0, atol=1e-3)
    np.testing.assert_allclose(path[0, :, 3], 10.0, atol=1e-3)
