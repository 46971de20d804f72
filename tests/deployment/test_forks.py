"""Stents at a fork: no wire through another or outside the artery, and one cell through which the second one passes."""

from functools import cache

import numpy as np
import pytest
from brute import BruteWall, least_gap_mm
from forks import PHANTOM, arm, fork
from scipy.spatial import cKDTree

from vstent.anatomy.read import read_vessel
from vstent.anatomy.restore.paths import on_path
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.deployment.coverage import together
from vstent.deployment.deploy import deploy
from vstent.deployment.forks import CATHETER_MM, passage, pushed_mm
from vstent.deployment.measure import measure
from vstent.devices.catalogue import find_design
from vstent.devices.design import piece_length_mm
from vstent.devices.treatment import read_treatment
from vstent.errors import InputError, LandingError
from vstent.study.stages import deploy_implant

STENT = "enterprise 4.5x22"


@cache
def treated(text):
    """The deployed stents of a treatment, and their measures."""
    found = {}
    for implant in read_treatment(text).implants:
        found[implant.id] = deploy_implant(implant, fork(), [found[name].stent for name in implant.inside])
    return [one.stent for one in found.values()], [measure(fork(), one) for one in found.values()]


Y = f"{STENT} > outlet_1 + {STENT} > outlet_2"
KISSING = f"{STENT} > outlet_1 | {STENT} > outlet_2"
LOOSE = f"{STENT} > outlet_1 + enterprise 4.5x14 > outlet_2 @ fork"
OPEN_CELLS = "neuroform_atlas 4x21 > outlet_1 + neuroform_atlas 4x21 > outlet_2"
HORIZONTAL = f"{STENT} outlet_1 > outlet_2"


def test_only_the_parent_artery_is_restored_before_another_path_is_asked_for():
    assert [path.name for path in fork().paths] == ["parent"]
    assert [path.name for path in arm("outlet_2").paths] == ["outlet_2", "parent"]
    assert on_path(arm("outlet_2"), "parent").parent is fork().parent
    assert arm("outlet_1") is arm("outlet_1")


@pytest.mark.parametrize("name", ["outlet_1", "outlet_2"])
def test_a_path_into_an_arm_is_that_of_the_phantom(name):
    path = arm(name).parent
    end_mm = next(one.center_mm for one in fork().vessel.openings if one.role == name)
    (side,) = {np.sign(end_mm[0])}
    true = PHANTOM.parent if side > 0 else PHANTOM.parent.points_mm * [-1.0, 1.0, 1.0]
    true_mm = true if side < 0 else true.points_mm
    first_mm, last_mm = path.own_mm
    is_own = (path.axis.abscissa_mm > first_mm + 1) & (path.axis.abscissa_mm < last_mm - 1)
    away_mm = np.linalg.norm(path.axis.points_mm[is_own, None] - true_mm, axis=2)
    is_clear = path.axis.points_mm[is_own, 2] < 9.5  # before the fork, and in the arm beyond the sac
    is_clear |= path.axis.points_mm[is_own, 2] > 16.5
    assert away_mm.min(axis=1)[is_clear].max() < 0.06
    assert away_mm.min(axis=1).max() < 0.45
    radius_mm = PHANTOM.parent.inscribed_radius_mm[away_mm.argmin(axis=1)]
    np.testing.assert_allclose(path.section_radius_mm[is_own][is_clear], radius_mm[is_clear], rtol=0.02)


def test_both_arms_of_a_symmetric_fork_have_mirrored_paths():
    one, other = (arm(name).parent.axis for name in ("outlet_1", "outlet_2"))
    assert (
        np.linalg.norm(
            other.at(other.nearest_abscissa_mm(one.points_mm * [-1, 1, 1])) - one.points_mm * [-1, 1, 1], axis=1
        ).max()
        < 0.2
    )


def test_a_path_from_arm_to_arm_has_both_of_them_and_not_the_trunk():
    path = arm("outlet_1>outlet_2").parent
    ends_mm = [one.center_mm for one in fork().vessel.outlets]
    own_mm = path.axis.at(np.array(path.own_mm))
    np.testing.assert_allclose(own_mm, ends_mm, atol=0.15)
    assert path.axis.points_mm[:, 2].min() > 12.0
    np.testing.assert_allclose(path.section_radius_mm, 1.5, atol=0.1)
    ((first, last),) = [path.span_mm(sac) for sac in fork().aneurysms]
    assert first < 0.5 * path.axis.length_mm < last


@pytest.mark.parametrize("name", ["outlet_3", "inlet", "outlet_1>outlet_1", "outlet_1>outlet_2>outlet_1", ">", ""])
def test_what_is_no_path_is_refused(name):
    with pytest.raises(InputError, match="no path"):
        on_path(fork(), name)


@pytest.mark.parametrize("text", [Y, KISSING, LOOSE, OPEN_CELLS])
def test_no_wire_passes_through_another_or_the_wall(text):
    stents, measures = treated(text)
    assert least_gap_mm(*stents) >= 0
    assert max(one["max_outside_mm"] for one in measures) <= 0.002
    assert max(one["p95_wire_stretch_fraction"] for one in measures) < 0.02


@pytest.mark.parametrize("text", [Y, OPEN_CELLS])
def test_all_struts_of_the_second_pass_one_cell_of_the_first(text):
    first, second = treated(text)[0]
    cell = passage(first, arm("outlet_2").parent)
    starts_mm, ends_mm, half_mm = second.pieces_mm
    near = np.linalg.norm(starts_mm - cell.center_mm, axis=1) < 6
    crossing = BruteWall(first.contour).crosses(starts_mm[near], ends_mm[near])
    at_mm = 0.5 * (starts_mm + ends_mm)[near][crossing] - cell.center_mm
    aside_mm = np.linalg.norm(at_mm - np.outer(at_mm @ cell.outward, cell.outward), axis=1)
    assert crossing.sum() >= second.design.n_columns
    assert aside_mm.max() + half_mm.max() < cell.radius_mm
    # The circle touches a strut of the first stent and holds none.
    a, b, wide_mm = first.pieces_mm
    share = np.clip(np.einsum("ij,ij->i", cell.center_mm - a, b - a) / np.einsum("ij,ij->i", b - a, b - a), 0, 1)
    to_struts_mm = np.linalg.norm(a + share[:, None] * (b - a) - cell.center_mm, axis=1) - wide_mm
    assert cell.radius_mm == pytest.approx(to_struts_mm.min(), abs=0.02)
    waist_mm = second.row_diameter_mm.min()
    assert CATHETER_MM / 2 < waist_mm < 2 * cell.radius_mm < first.row_diameter_mm.min()


def test_stents_side_by_side_share_the_trunk_evenly():
    stents = treated(KISSING)[0]
    shares_mm2 = []
    for stent in stents:
        row = int(np.abs(stent.nodes_mm[..., 2].mean(axis=1) - 6.0).argmin())
        x, y = stent.nodes_mm[row, :, 0], stent.nodes_mm[row, :, 1]
        shares_mm2.append(0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
        side = np.sign(stent.nodes_mm[-1, :, 0].mean())
        assert (side * x > 0).all()
    assert shares_mm2[0] == pytest.approx(shares_mm2[1], rel=0.03)
    trunk_mm2 = np.pi * 1.75**2
    assert 0.7 * trunk_mm2 < sum(shares_mm2) < trunk_mm2


def test_a_stent_that_begins_at_the_fork_touches_no_strut_of_the_first():
    first, second = treated(LOOSE)[0]
    starts_mm, ends_mm, _ = second.pieces_mm
    near = np.linalg.norm(starts_mm - first.nodes_mm.reshape(-1, 3)[:, None], axis=2).min(axis=0) < 2
    assert not BruteWall(first.contour).crosses(starts_mm[near], ends_mm[near]).any()
    assert 0.1 < cKDTree(first.wire_points_mm).query(second.wire_points_mm)[0].min() < 1.5


def test_metal_over_a_neck_at_a_fork_is_that_of_both_stents():
    single = together(fork(), treated(Y)[0][:1])["neck_union_coverage_fraction"]
    both = together(fork(), treated(Y)[0])
    assert set(both) == {"neck_union_coverage_fraction"}
    assert 0.03 < single < both["neck_union_coverage_fraction"] < 0.25


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"silk > outlet_1 + {STENT} > outlet_2", "a braid whose pores are"),
        (f"{STENT} > outlet_1 + {STENT} > outlet_1 @ fork", "needs a stent before it"),
        (f"{STENT} outlet_1>outlet_2 | {STENT} > outlet_2", "do not run side by side"),
    ],
)
def test_what_cannot_be_is_refused_with_a_sentence(text, match):
    with pytest.raises(LandingError, match=match):
        treated(text)


@pytest.mark.validation
@pytest.mark.parametrize(
    ("case", "stent"), [("C0011", "enterprise 4.5x14"), ("C0091", "neuroform_atlas 3x15")], ids=["acom", "basilar"]
)
@pytest.mark.parametrize("sign", ["+", "|"])
def test_no_wire_passes_through_another_at_the_forks_of_patients(shared_data, case, stent, sign):
    anatomy = restore(trim(trace(read_vessel(shared_data / "aneurisk" / f"{case}.vtp"))))
    found = {}
    for implant in read_treatment(f"{stent} > outlet_2 {sign} {stent} > outlet_3").implants:
        found[implant.id] = deploy_implant(implant, anatomy, [found[name].stent for name in implant.inside])
        assert measure(anatomy, found[implant.id])["max_outside_mm"] <= 0.002
    assert least_gap_mm(*(one.stent for one in found.values())) >= 0


def test_a_pushed_cell_is_as_wide_as_the_widest_polygon_with_its_struts_allows():
    """A rhombus with sides l is l sin(angle) wide between its sides; a regular octagon (1 + sqrt 2) l."""
    closed, opened = (deploy(find_design(name), arm("outlet_1")).stent for name in ("enterprise", "neuroform_atlas"))
    turn = np.linspace(0.01, np.pi, 1000)
    for stent, widest in ((closed, np.sin(turn).max()), (opened, 1 + np.sqrt(2))):
        strut_mm = 2 * stent.pieces_mm[2].max()
        assert pushed_mm(stent) == pytest.approx(
            widest * piece_length_mm(stent.design, stent.size) - strut_mm, rel=1e-4
        )


@pytest.mark.validation
def test_a_cell_that_a_tight_bend_has_closed_is_refused(shared_data):
    anatomy = restore(trace(read_vessel(shared_data / "bifurcation_with_sac.stl")))
    first, second = read_treatment(Y).implants
    done = deploy_implant(first, anatomy)
    with pytest.raises(LandingError, match=r"is 0.43 mm wide, and a microcatheter 0.7 mm"):
        deploy_implant(second, anatomy, [done.stent])
