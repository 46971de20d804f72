"""The paper's contour, eq. (1-7), against its definitions and against brute force."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
from brute import BruteWall
from tubes import arc, line, tube

from vstent.deployment import contour
from vstent.deployment.active_contour import ActiveContour, State, Stiffness
from vstent.deployment.method import AbstractMethod, Opened, run
from vstent.deployment.wall import TreeWall
from vstent.errors import InputError
from vstent.kernels import triangles

ROWS, COLUMNS = 14, 16
METHOD = ActiveContour(a1=0.05, a2=0.02, a3=0.03, a4=0.04, a5=0.015, tau=1.7)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Bare(AbstractMethod):
    """The contour alone, from a given state."""

    state: State
    wall: TreeWall

    def init(self, placement):
        return Opened(self.state, np.arange(len(self.state.nodes_mm)))

    def step(self, placement, opened):
        return dataclasses.replace(opened, contour=self.contour.step(opened.contour, self.wall))

    def result(self, placement, opened):
        return opened


def relax(contour, state, wall, progress=None):
    return run(Bare(contour=contour, state=state, wall=wall), None, progress)


@pytest.fixture(scope="module")
def artery():
    return tube(line(8, 0.5), 1.5, 1.9, around=24)


@pytest.fixture(scope="module")
def bend():
    return tube(arc(6, 1.2, 4, 0.4), 1.5, around=20)


def energy(method, v):
    """Internal energy, eq. (2), of a contour (rows, columns, 3) on a grid of spacing 1."""
    v_s, v_ss = np.diff(v, axis=0), np.diff(v, n=2, axis=0)
    v_r = np.roll(v, -1, axis=1) - v
    v_rr = np.roll(v, -1, axis=1) - 2 * v + np.roll(v, 1, axis=1)
    v_sr = np.roll(v_s, -1, axis=1) - v_s
    terms = (method.a1, v_s), (method.a2, v_ss), (method.a3, v_r), (method.a4, v_rr), (2 * method.a5, v_sr)
    return sum(weight * (d**2).sum() for weight, d in terms)


def test_the_stiffness_matrix_is_the_variation_of_the_internal_energy():
    rng = np.random.default_rng(1)
    right = rng.normal(size=(ROWS, COLUMNS, 3))
    v = Stiffness.of(METHOD, ROWS, COLUMNS).solve(right)
    k_v = (right - v) / METHOD.tau  # (I + tau K) v = right
    for _ in range(5):
        w = rng.normal(size=v.shape)
        slope = (energy(METHOD, v + 0.5 * w) - energy(METHOD, v - 0.5 * w)) / 2
        assert (w * k_v).sum() == pytest.approx(slope, rel=1e-9)


def test_elasticity_alone_leaves_a_straight_line_of_equal_points_alone():
    assert np.allclose(Stiffness.of(METHOD, ROWS, COLUMNS).solve(np.ones((ROWS, COLUMNS, 3))), 1.0, atol=1e-12)


def test_tree_and_brute_force_answer_alike_on_random_segments(bend):
    rng = np.random.default_rng(2)
    low, high = bend.parent.landing_surface.vertices_mm.min(axis=0), bend.parent.landing_surface.vertices_mm.max(axis=0)
    starts, ends = rng.uniform(low - 0.5, high + 0.5, size=(2, 150, 3))
    ends[:75] = starts[:75] + 0.3 * (ends[:75] - starts[:75])
    fast, slow = TreeWall(bend.parent.landing_surface), BruteWall(bend.parent.landing_surface)
    crossed = slow.crosses(starts, ends)
    assert 20 < crossed.sum() < 130
    assert np.array_equal(fast.crosses(starts, ends), crossed)
    a, b = fast.contact(starts[:40]), slow.contact(starts[:40])
    assert np.allclose(a.distance_mm, b.distance_mm, atol=1e-12)
    assert np.allclose(a.closest_mm, b.closest_mm, atol=1e-9)


def start(artery, method, radius_mm, rows=ROWS):
    z = np.linspace(2, 6, rows)
    across = contour.planes(artery.parent.axis)
    turn = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])  # no node has two nearest points
    nodes_mm = across.place(z, contour.circles(np.full(rows, radius_mm), COLUMNS) @ turn)
    wall, centers_mm = TreeWall(artery.parent.landing_surface), across.middle(z)
    return method.init(nodes_mm, centers_mm, wall.contact(centers_mm).distance_mm, wall)


def test_forces_are_those_of_equations_4_and_5(artery):
    method = ActiveContour(k1=0.7, k2=0.13)
    state = start(artery, method, 1.2)
    brute = BruteWall(artery.parent.landing_surface).contact(state.nodes_mm.reshape(-1, 3))
    d2 = brute.closest_mm.reshape(state.nodes_mm.shape) - state.nodes_mm
    d1 = np.linalg.norm(d2, axis=2, keepdims=True)
    radial = state.nodes_mm - state.centers_mm
    n = radial / np.linalg.norm(radial, axis=2, keepdims=True)
    assert np.allclose(method.force_mm(state), 0.7 * d1 * n + 0.13 * d2 / d1, atol=1e-12)


def test_each_node_is_put_into_its_state_and_relocated_by_equations_6_and_7(artery):
    rng = np.random.default_rng(3)
    method = ActiveContour(dd_mm=0.15)
    before = start(artery, method, 1.0)
    scale = rng.uniform(0.8, 2.2, size=(ROWS, COLUMNS, 1))
    centers = before.centers_mm
    moved = dataclasses.replace(before, nodes_mm=centers + scale * (before.nodes_mm - centers))
    after = method.classify(moved, np.ones((ROWS, COLUMNS), dtype=bool), TreeWall(artery.parent.landing_surface))

    wall = BruteWall(artery.parent.landing_surface)
    p = moved.nodes_mm.reshape(-1, 3)
    found = wall.contact(p)
    crosses = wall.crosses(before.centers_mm.reshape(-1, 3), p)
    near = ~crosses & (found.distance_mm <= 0.15)
    assert min(crosses.sum(), near.sum(), (~crosses & ~near).sum()) > 10
    unit = (p - found.closest_mm) / found.distance_mm[:, None]
    expected = np.where(near[:, None], found.closest_mm + 0.15 * unit, p)
    expected = np.where(crosses[:, None], found.closest_mm - 0.15 * unit, expected)
    assert np.allclose(after.nodes_mm.reshape(-1, 3), expected, atol=1e-9)
    assert np.array_equal(after.is_terminated.ravel(), crosses | near)


def test_a_node_exactly_on_the_wall_is_put_inside(artery):
    method = ActiveContour(dd_mm=0.1)
    state = start(artery, method, 1.0)
    corners = artery.parent.landing_surface.corners_mm
    inner = triangles.normals(corners)
    middle = corners.mean(axis=1)[np.abs(corners.mean(axis=1)[:, 2] - 4) < 1][: ROWS * COLUMNS]
    inner = inner[np.abs(corners.mean(axis=1)[:, 2] - 4) < 1][: ROWS * COLUMNS]
    nodes_mm = state.nodes_mm.reshape(-1, 3).copy()
    nodes_mm[: len(middle)] = middle
    state = dataclasses.replace(state, nodes_mm=nodes_mm.reshape(state.nodes_mm.shape))
    state = method.classify(state, np.ones((ROWS, COLUMNS), dtype=bool), TreeWall(artery.parent.landing_surface))
    assert np.allclose(state.nodes_mm.reshape(-1, 3)[: len(middle)], middle - 0.1 * inner, atol=1e-9)


def test_the_fraction_of_terminated_nodes_never_falls_and_terminated_nodes_stay(bend):
    method = ActiveContour(k1=0.15, k2=0.01)
    wall = TreeWall(bend.parent.landing_surface)
    across = contour.planes(bend.parent.axis)
    s = np.linspace(4, 10, 30)
    nodes_mm = across.place(s, contour.circles(np.full(30, 0.9), 20))
    seen = []
    centers_mm = across.middle(s)
    state = method.init(nodes_mm, centers_mm, wall.contact(centers_mm).distance_mm, wall)
    done = relax(method, state, wall, progress=lambda i, f: seen.append((i, f)))
    assert done.outcome == "terminated"
    assert len(done.terminated_fraction) > 3
    assert np.all(np.diff(done.terminated_fraction) >= 0)
    assert [f for _, f in seen] == list(done.terminated_fraction)
    assert [i for i, _ in seen] == list(range(1, len(seen) + 1))
    assert np.array_equal(done.history_mm[-1], done.opened.contour.nodes_mm)
    assert done.terminated_fraction[-1] >= 0.99 > done.terminated_fraction[-2]


def test_terminated_nodes_do_not_move(artery):
    method = ActiveContour(k1=0.2)
    wall = TreeWall(artery.parent.landing_surface)
    state = start(artery, method, 1.3)
    for _ in range(20):
        following = method.step(state, wall)
        assert np.array_equal(following.nodes_mm[state.is_terminated], state.nodes_mm[state.is_terminated])
        assert np.all(following.is_terminated[state.is_terminated])
        state = following
    assert state.terminated_fraction == 1.0


def test_too_few_iterations_are_a_result_not_an_error(artery):
    method = ActiveContour(k1=0.01, k2=0.0, iteration_limit=3)
    done = relax(method, start(artery, method, 0.8), TreeWall(artery.parent.landing_surface))
    assert done.outcome == "iteration_limit"
    assert len(done.history_mm) == len(done.energy_mm2) == 4


def test_weights_that_blow_up_are_refused(artery):
    method = ActiveContour(k1=1e308, tau=1e10)
    with pytest.raises(InputError, match="diverged in iteration 1"), np.errstate(all="ignore"):
        relax(method, start(artery, method, 0.8), TreeWall(artery.parent.landing_surface))


def test_the_energy_wakes_no_threads_whose_number_would_change_its_last_bits():
    """They would spin beside the threads that ask the wall, too."""
    work = (
        "import numpy as np; from types import SimpleNamespace as S;"
        "from vstent.deployment.active_contour import ActiveContour;"
        "r = np.random.default_rng(0);"
        "s = S(nodes_mm=r.normal(size=(400, 48, 3)), contact=S(distance_mm=np.zeros(1)));"
        "print(ActiveContour(a1=1, a2=0, a3=0, a4=0, a5=0).energy_mm2(s).hex())"
    )
    energies = [
        subprocess.run(
            [sys.executable, "-c", work], env=os.environ | {"OPENBLAS_NUM_THREADS": n}, capture_output=True, check=True
        ).stdout
        for n in ("1", "2")
    ]
    assert energies[0] == energies[1]
