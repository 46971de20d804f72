"""Coils in sacs: distances by brute force over all pairs of segments, lengths, loops, zones and refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from test_basket import ball

from vstent.deployment.coils import bend_radii_mm, deploy_coils, measure_coils, next_size
from vstent.deployment.deploy import deploy
from vstent.deployment.struts import struts
from vstent.devices.catalogue import find_design, find_size
from vstent.devices.ranges import altered, values_at
from vstent.devices.stent import Landing
from vstent.devices.treatment import Treatment, read_treatment
from vstent.errors import InputError, LandingError
from vstent.geometry.surface import Surface
from vstent.kernels import rods
from vstent.plan.ranges import Ranges
from vstent.plan.uncertainty import COIL_RESULTS, made_wider, vary, vary_seeds
from vstent.reporting.uncertainty import uncertainty_of
from vstent.study.keys import is_varied, study_keys
from vstent.study.settings import Settings
from vstent.study.stages import deploy_all, deploy_implant
from vstent.study.store import Store

COILS = find_design("coils")
WOUND_MM = 0.305
SAC = ball(2.5, 1.2)


@cache
def filled(density=0.25, seed=0):
    return deploy_coils(COILS, SAC, density, seed=seed)


def gaps_mm(coils):
    """Smallest distance between the axes of all pairs of segments that are not within three segments of one coil."""
    first, last, _ = coils.pieces_mm
    wire = coils.point_wires[coils.piece_starts]
    i, j = np.triu_indices(len(first), 1)
    is_apart = (j - i > 3) | (wire[i] != wire[j])
    i, j = i[is_apart], j[is_apart]
    u, v, w = last[i] - first[i], last[j] - first[j], first[i] - first[j]
    best = np.full(len(i), np.inf)
    a, b, c, d, e = (np.einsum("pk,pk->p", x, y) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = a * c - b * b
        candidates = [((b * e - c * d) / inner, (a * e - b * d) / inner)]
        candidates += [(np.full(len(i), s), (e + s * b) / c) for s in (0.0, 1.0)]
        candidates += [((t * b - d) / a, np.full(len(i), t)) for t in (0.0, 1.0)]
    for s, t in candidates:  # the inside, and the four edges of the square of both places
        s, t = np.clip(np.nan_to_num(s), 0, 1), np.clip(np.nan_to_num(t), 0, 1)
        best = np.minimum(best, np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1))
    return best


def test_no_coil_enters_another_or_the_wall_and_none_is_stretched_or_kinked():
    coils = filled().stent
    assert gaps_mm(coils).min() > WOUND_MM
    assert SAC.aneurysms[0].sac.signed_distance(coils.wire_points_mm).max() < -0.5 * WOUND_MM + 0.01
    first, last, _ = coils.pieces_mm
    length_mm = np.linalg.norm(last - first, axis=1)
    np.testing.assert_allclose(length_mm, WOUND_MM, rtol=0.01)
    assert bend_radii_mm(coils.wire_points_mm, coils.wire_starts).min() > WOUND_MM


def test_the_density_is_reached_in_balance_and_is_that_of_the_solids():
    done = filled()
    coils = done.stent
    assert done.outcome == "terminated"
    assert done.terminated_fraction[0] > 0.95
    assert coils.density_fraction == pytest.approx(0.25, abs=0.01)
    sac_mm3 = SAC.aneurysms[0].sac.volume_mm3
    assert struts(coils).volume_mm3 / sac_mm3 == pytest.approx(coils.density_fraction, rel=0.01)
    assert coils.wire_length_mm == pytest.approx(sum(one.length_mm for one in coils.coils), rel=0.01)


def test_loops_keep_their_curl_where_the_sac_allows_and_the_framing_coil_lies_on_the_wall():
    coils = filled(0.1, seed=2).stent
    framing_mm = coils.wire_points_mm[: coils.wire_starts[1]]
    radius_mm = np.median(bend_radii_mm(framing_mm, np.array([0, len(framing_mm)])))
    assert radius_mm == pytest.approx(0.5 * coils.coils[0].diameter_mm, rel=0.3)
    depth_mm = -SAC.aneurysms[0].sac.signed_distance(framing_mm)
    points_mm = np.random.default_rng(0).uniform((-2.5, -2.5, -0.3), (2.5, 2.5, 4.7), (20_000, 3))
    inside = -SAC.aneurysms[0].sac.signed_distance(points_mm)
    is_rim = inside[inside > 0] < 0.8
    assert (depth_mm < 0.8).mean() / is_rim.mean() > 1.3 * (depth_mm > 0.8).mean() / (~is_rim).mean()


def test_seeds_repeat_a_result_to_the_last_bit_and_others_give_another():
    again = deploy_coils("coils", SAC, 0.1, seed=2).stent
    np.testing.assert_array_equal(again.wire_points_mm, filled(0.1, seed=2).stent.wire_points_mm)
    other = deploy_coils("coils", SAC, 0.1, seed=3).stent
    assert len(other.wire_points_mm) != len(again.wire_points_mm) or (
        np.abs(other.wire_points_mm - again.wire_points_mm).max() > 0.1
    )


def test_the_spread_over_seeds_is_that_of_the_same_coils_placed_otherwise():
    coils = deploy_coils(COILS, SAC, 0.08, seed=2).stent
    varied = vary_seeds(SAC, coils, Ranges(samples=3))
    assert (varied.names, varied.n_failed) == (COIL_RESULTS, 0)
    first = measure_coils(SAC, coils)
    np.testing.assert_allclose(varied.values[0], [first[name] for name in COIL_RESULTS], rtol=0.02)
    again = measure_coils(SAC, deploy_coils(COILS, SAC, coils.coils, seed=4).stent)
    assert varied.values[2].tolist() == [again[name] for name in COIL_RESULTS]
    assert np.ptp(varied.values[:, 1:], axis=0).min() > 0
    told = varied.metrics()
    assert told["shares"]["neck_density_fraction"] == {"rest_fraction": 1.0}
    (row,) = uncertainty_of({"treatments": {"coils": {"uncertainty": told}}}, {})
    assert row.words == "3 deployments. Varied: the seed, which places the catheter and turns the framing coil."


def test_a_stent_and_the_coils_that_it_keeps_in_vary_together(tmp_path):
    """Every sample is the stent as varied alone, with the same coils placed behind it with the next seed."""
    sac, size = ball(4.0, 3.0), find_size(find_design("enterprise"), diameter_mm=4.5, length_mm=14)
    kept = deploy("enterprise", sac, size=size, landing=Landing(8.0))
    coils = deploy_coils(COILS, sac, 0.02, inside=[kept.stent], seed=2).stent
    ranges = Ranges(samples=2, landing_mm=0.5, device_mm=0.05)
    both, alone = vary(sac, kept, ranges, [coils]), vary(sac, kept, ranges)
    assert both.names == (*alone.names, *COIL_RESULTS)
    np.testing.assert_array_equal(both.values[:, : len(alone.names)], alone.values)
    assert both.n_failed == 0
    design, made = altered(kept.stent.design, size, values_at(ranges.numbers_of(kept.stent.design), both.points[1, 4:]))
    made = made_wider(design, made, 0.05 * both.points[1, 2])
    stent = deploy(design, sac, size=made, landing=Landing(kept.stent.middle_abscissa_mm + 0.5 * both.points[1, 1]))
    again = measure_coils(sac, deploy_coils(COILS, sac, coils.coils, inside=[stent.stent], seed=3).stent)
    assert both.values[1, -3:].tolist() == [again[name] for name in COIL_RESULTS]
    (row,) = uncertainty_of({"treatments": {"both": {"uncertainty": both.metrics()}}}, {})
    assert "landing ±0.500" in row.words
    assert row.words.endswith("catalogue, the seed, which places the catheter and turns the framing coil.")


@pytest.mark.parametrize(
    ("text", "is_so"),
    [
        ("bare", False),
        ("enterprise", True),
        ("coils", True),
        ("enterprise + coils(20%)", True),
        ("enterprise & coils", False),
        ("silk + silk", False),
        ("silk + silk + coils", False),
    ],
)
def test_one_device_varies_alone_or_with_coils(text, is_so):
    treatment = Treatment("bare") if text == "bare" else read_treatment(text)
    assert is_varied(treatment) is is_so
    settings = replace(Settings(), treatments=(treatment,), flow=None, uncertainty=Ranges())
    assert (f"vary {treatment.name}" in study_keys("", settings)) is is_so


def test_zones_share_out_all_coil():
    found = measure_coils(SAC, filled().stent)
    assert 0.1 < found["neck_density_fraction"] < 0.4
    assert found["packing_density_fraction"] == filled().stent.density_fraction
    assert found["min_bend_radius_mm"] > WOUND_MM
    assert 0 < found["neck_covered_by_coils_fraction"] < 1
    assert found["coil_beyond_neck_mm"] < 1


def test_coils_get_smaller_and_together_as_long_as_wanted():
    sizes, left_mm = [], 1000.0
    while size := next_size(COILS, 180.0, sizes, left_mm):
        sizes.append(size)
        left_mm -= size.length_mm
    assert sizes[0].diameter_mm == 7.0  # a sphere of 180 mm3 is 7.005 mm wide
    widths = [one.diameter_mm for one in sizes]
    assert widths == sorted(widths, reverse=True)
    assert abs(left_mm) <= 5


def test_forces_are_the_slopes_of_the_energy():
    draw, n, length = np.random.default_rng(0), 12, 0.3
    x = np.cumsum(draw.normal(size=(n, 3)) * 0.1 + [0.25, 0, 0], axis=0)
    frame = np.cross(np.diff(x, axis=0, append=x[-1:] + 1), draw.normal(size=(n, 3)))
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    is_segment = np.ones(n, bool)
    is_segment[[5, n - 1]] = False
    laws = rods.Laws(length, 0.31, 100.0, 0.8, length / 0.39, 20.0)
    here = rods.Rods(x, frame, 0.2 * draw.normal(size=(n, 2)), is_segment, np.zeros(n, bool))

    def energy(shift, turn):
        moved = rods.Rods(*[values.copy() for values in here])
        rods._move(moved, 0, n, shift.ravel().copy(), turn, 1e9)
        work = np.zeros((n, 3)), np.zeros(n), np.zeros((3 * n, rods.BAND)), np.zeros((n, 2))
        return rods._bend(moved, laws, 0, n, *work), work

    zero, still = np.zeros((n, 3)), np.zeros(n)
    _, (force, torque, *_) = energy(zero, still)
    for i in range(n):
        turn = np.eye(n)[i] * 1e-6
        assert torque[i] == pytest.approx((energy(zero, -turn)[0] - energy(zero, turn)[0]) / 2e-6, abs=1e-5)
        for c in range(3):
            shift = zero.copy()
            shift[i, c] = 1e-6
            slope = (energy(-shift, still)[0] - energy(shift, still)[0]) / 2e-6
            assert force[i, c] == pytest.approx(slope, abs=1e-4)


def test_the_band_matrix_is_solved():
    draw, rows = np.random.default_rng(1), 30
    matrix = draw.normal(size=(rows, rows)) * (np.abs(np.subtract.outer(range(rows), range(rows))) < rods.BAND)
    matrix = matrix + matrix.T + 30 * np.eye(rows)
    band = np.array([[matrix[i, i - k] if i >= k else 0.0 for k in range(rods.BAND)] for i in range(rows)])
    right = draw.normal(size=rows)
    solution = right.copy()
    rods._solve(band, solution, 0, rows)
    np.testing.assert_allclose(matrix @ solution, right, atol=1e-10)


def test_treatments_state_density_and_seed():
    one = read_treatment("enterprise + coils(22.5%, seed 3)")
    assert one.name == "enterprise+coils"
    assert one.implants[1].density_fraction == 0.225
    assert one.implants[1].seed == 3
    assert one.implants[1].inside == ("enterprise",)
    assert read_treatment("coils").implants[0].density_fraction is None


def test_treatments_name_their_coils_one_by_one():
    implants = read_treatment("enterprise + target(6 mm x 20 cm, 3x80 mm,2 x 1.5cm, seed 4)").implants
    assert implants[1].coils == ((6.0, 200.0), (3.0, 80.0), (2.0, 15.0))
    assert (implants[1].density_fraction, implants[1].seed, implants[1].is_proposed) == (None, 4, False)
    for text in ("coils(25%, 6 x 20 cm)", "coils(6 x 20)", "coils(seed 3)", "coils()", "coils(6 x 20 cm 3 x 8 cm)"):
        with pytest.raises(InputError, match="is not an implant"):
            read_treatment(text)
    for text in ("silk +", "| silk > outlet_1", "name ="):
        with pytest.raises(InputError, match="lacks a device"):
            read_treatment(text)


def test_given_coils_are_placed_in_their_order_with_their_loops_and_lengths():
    done = deploy_implant(read_treatment("coils(4.5 mm x 3 cm, 2 x 1.5 cm)").implants[0], SAC)
    assert [one.coil_label for one in done.stent.coils] == ["4.5 mm x 3 cm", "2 mm x 1.5 cm"]
    assert done.stent.wire_length_mm == pytest.approx(45, abs=WOUND_MM)
    assert (done.outcome, "2 coils (4.5 mm x 3 cm, 2 mm x 1.5 cm)" in done.advice) == ("terminated", True)
    assert measure_coils(SAC, done.stent)["size"] == f"{done.stent.density_fraction:.0%}"


def test_what_does_not_fit_is_refused():
    for text, words in (
        ("coils(60%)", "up to 40%"),
        ("coils 3x20", "give a packing density, or loops x length"),
        ("coils(1 mm x 4 cm)", "have loops of 2 to 25 mm"),
        ("target(6 mm x 80 cm)", "have a length of 10 to 500 mm"),
        ("coils(6 mm x 50 cm)", "cannot fill 56% of a sac"),
        ("silk(20%)", "neither a packing density nor a list of coils"),
        ("silk(3 x 4 cm)", "neither a packing density nor a list of coils"),
        ("coils > outlet_1", "leave out its path"),
        ("web_sls > outlet_1", "leave out its path"),
    ):
        with pytest.raises(LandingError, match=words):
            deploy_implant(read_treatment(text).implants[0], SAC)
    basket = deploy("web_sls", ball(3.5, 1.5)).stent
    with pytest.raises(LandingError, match="do not share a sac"):
        deploy_coils("coils", ball(3.5, 1.5), inside=[basket])
    with pytest.raises(LandingError, match="two lines of coils, do not share a sac"):
        deploy_coils("axium", SAC, 0.1, inside=[filled(0.1, seed=2).stent])
    with pytest.raises(LandingError, match="come last"):
        deploy("silk", SAC, inside=[filled(0.1, seed=2).stent])
    with pytest.raises(LandingError, match="no line of coils"):
        deploy_coils("silk", SAC)


def test_the_order_of_devices_in_a_sac_is_checked_before_any_is_deployed(tmp_path):
    stages = []
    for text, words in (
        ("coils + enterprise", "Coils come last in a treatment, and only once"),
        ("coils(3%) + axium(3%)", "Coils come last in a treatment, and only once"),
        ("web_sls + silk", "WEB SLS lies in a sac alone"),
        ("silk > outlet_1 | web_sls > outlet_2", "WEB SLS lies in a sac alone"),
    ):
        settings = Settings(treatments=(read_treatment(text),), flow=None)
        store = Store(tmp_path, lambda now: stages.append(now.stage))
        with pytest.raises(LandingError, match=words):
            deploy_all(SAC, settings, store, study_keys("", settings))
    assert not stages


def test_every_coil_that_is_placed_is_reported(tmp_path):
    told = []
    settings = Settings(treatments=(read_treatment("coils(8%)"),), flow=None)
    found, _ = deploy_all(SAC, settings, Store(tmp_path, told.append), study_keys("", settings))
    n_coils = len(found["coils"]["coils"].stent.coils)
    words = [f"{k} {'coil' if k == 1 else 'coils'} placed" for k in range(1, n_coils + 1)]
    assert [one.detail for one in told if 0 < one.fraction < 1][:n_coils] == words


def test_more_than_the_density_asked_for_is_explained():
    deployment = deploy_coils(COILS, SAC, 0.005)
    assert deployment.stent.density_fraction > 0.015
    assert "more than the 0.5% asked for, because no shorter coils are made" in deployment.advice
    assert deployment.outcome == "iteration_limit"


def test_solids_are_closed():
    solid = struts(filled(0.1, seed=2).stent)
    assert not solid.boundary_loops
    assert isinstance(solid, Surface)


def test_coils_stay_outside_a_stent_whose_wires_none_crosses():
    """The stent runs through the sac, lengthwise, so that coils have the room beside it."""
    sac = ball(4.0, 3.0)
    size = find_size(find_design("enterprise"), diameter_mm=4.5, length_mm=14)
    stent = deploy("enterprise", sac, size=size, landing=Landing(8.0)).stent
    coils = deploy_coils("coils", sac, 0.05, inside=[stent]).stent
    assert stent.contour.closed.signed_distance(coils.wire_points_mm).min() > 0
    (a, b, half), (p, q, thick) = coils.pieces_mm, stent.pieces_mm
    fine = np.linspace(0, 1, 9)[:, None, None]
    gap_mm = cKDTree((p + fine * (q - p)).reshape(-1, 3)).query((a + fine * (b - a)).reshape(-1, 3))[0].min()
    assert gap_mm > half[0] + thick.max() - 0.01


def test_a_rod_that_is_flatter_than_its_sphere_lies_as_an_optimizer_lays_it():
    """A rod with curl 1 / 6 in a sphere of 2.5 mm, against SLSQP over the angles of its segments in one plane."""
    n, length, radius, natural = 18, 0.65, 2.5, 0.65 / 6
    laws = rods.Laws(length, 0.4, 1e4, 1.2, 1.0, 200.0)
    spacing, half = 0.1, 0.2
    low = np.full(3, -3.2)
    at = low[:, None, None, None] + spacing * np.indices((65, 65, 65))
    room = (np.linalg.norm(at, axis=0) - radius, low, spacing)
    turn = np.arange(n) * length / 1.7
    x = 1.7 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    x += 0.02 * np.random.default_rng(0).normal(size=x.shape)
    along = np.diff(x, axis=0, append=2 * x[-1:] - x[-2:-1])
    frame = np.cross([0.0, 0.0, 1.0], along)
    frame /= np.linalg.norm(frame, axis=1, keepdims=True)
    curl, is_segment = np.tile([natural, 0.0], (n, 1)), np.r_[np.ones(n - 1, bool), False]
    state = rods.Rods(x, frame, curl, is_segment, np.zeros(n, bool))
    for drag, steps in 4 * ((0.1, 300), (1.0, 300), (10.0, 200), (100.0, 100)):
        rods.advance(state, laws, n, room, drag, steps, np.zeros(3), 0)
    work = np.zeros((n, 3)), np.zeros(n), np.zeros((3 * n, rods.BAND)), np.zeros((n, 2))
    found = rods._bend(state, laws, 0, n, *work)

    def nodes(angles):
        steps = length * np.stack([np.cos(angles[2:]), np.sin(angles[2:])], axis=1)
        return angles[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    def energy(angles):
        return 0.5 / length * ((2 * np.tan(0.5 * np.diff(angles[2:])) - natural) ** 2).sum()

    guess = np.r_[1.7, 0.0, np.pi / 2 + (np.arange(n - 1) + 0.5) * length / 1.7]
    inside = {"type": "ineq", "fun": lambda angles: (radius - half) ** 2 - (nodes(angles) ** 2).sum(axis=1)}
    best = minimize(energy, guess, constraints=[inside], method="SLSQP", options={"maxiter": 500, "ftol": 1e-10})
    assert best.success
    assert found == pytest.approx(best.fun, rel=0.02)
    from_middle = np.linalg.norm(state.x, axis=1)
    np.testing.assert_allclose(from_middle, np.linalg.norm(nodes(best.x), axis=1), atol=0.1 * laws.diameter)
