"""Several openings that bring blood: their roles along the whole way, and the flow through them."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.anatomy.trim import trim
from vstent.app.cases import Cases
from vstent.app.finished import reopened
from vstent.cli import main
from vstent.errors import InputError, VesselError
from vstent.flow import domain, sampling
from vstent.flow.case import FlowField
from vstent.flow.ends import FlowRate, Pressure
from vstent.flow.indices import indices
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings, Numerics, Waveform
from vstent.flow.simulation import simulate_case
from vstent.flow.streamlines import STEP_CELLS, inlet_seeds_mm, streamlines
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Centerline, Vessel
from vstent.io.writers import write_stl
from vstent.kernels.arrays import Floats
from vstent.phantoms import Phantom, Sac

SETTINGS = FlowSettings(inflow_mL_s=3.0, numerics=Numerics(cell_size_mm=0.25, tolerance=0.002))
TRUNK, RIGHT, LEFT = range(3)
"""Ends of `phantoms.bifurcation`."""


@cache
def wall(*, sac_at_mm: float | None = None, edge_mm: float = 0.3) -> Surface:
    """A Y in the plane y = 0, one leg the mirror image of the other, as surface; with a sac on its trunk."""
    fork = phantoms.bifurcation()
    if sac_at_mm is not None:
        fork = phantoms.with_sac(fork, abscissa_mm=sac_at_mm, width_mm=4.0, neck_mm=3.0, direction=np.array([0, 1, 0]))
    return phantoms.phantom_surface(fork, edge_mm=edge_mm)


def at_ends(*ends: int) -> Floats:
    """Middles (k, 3) of these ends of the Y."""
    return np.array([phantoms.bifurcation().ends[k][0] for k in ends])


@cache
def joined(*, sac_at_mm: float | None = None) -> Vessel:
    """Two arteries of one width that join: the Y, with blood from both legs."""
    return trace(Vessel(wall(sac_at_mm=sac_at_mm)), inlet_mm=at_ends(RIGHT, LEFT))


@cache
def joined_flow() -> FlowField:
    return simulate_case(vessel_case(joined(), SETTINGS))


# -- openings ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ends", [(RIGHT, LEFT), (LEFT, RIGHT), (LEFT, TRUNK), (RIGHT,)])
def test_inlets_have_the_order_given_and_the_rest_are_outlets(ends: Sequence[int]) -> None:
    vessel = trace(Vessel(wall()), inlet_mm=at_ends(*ends))
    assert [opening.role for opening in vessel.openings] == [
        *["inlet", "inlet_2"][: len(ends)],
        *["outlet_1", "outlet_2"][: 3 - len(ends)],
    ]
    np.testing.assert_allclose([inlet.center_mm for inlet in vessel.inlets], at_ends(*ends), atol=0.05)
    for line, end in zip(vessel.centerlines, vessel.far_ends, strict=True):
        np.testing.assert_allclose(line.points_mm[[0, -1]], [vessel.inlet.center_mm, end.center_mm], atol=1e-3)


@pytest.mark.parametrize(
    ("points_mm", "said"),
    [
        (
            [[0, 0, 0], [0, 1, 0]],
            r"two inlets are the same opening, 3.5 mm wide at .* \(0.0, 0.0, 0.0\) mm and \(0.0, 1.0",
        ),
        ([[0, 0, 0], [0, 90, 0]], r"no opening of the vessel is near \(0.0, 90.0, 0.0\) mm"),
        (at_ends(TRUNK, RIGHT, LEFT), "all 3 openings of the vessel are inlets and none is an outlet"),
    ],
)
def test_inlets_that_cannot_be_are_refused(points_mm: Floats, said: str) -> None:
    with pytest.raises(InputError, match=said):
        trace(Vessel(wall()), inlet_mm=points_mm)


def with_interrupted_branch(phantom: Phantom) -> Phantom:
    """A branch 1 mm wide and 10 mm up, through which nothing comes."""
    thin = phantoms.with_branch(phantom, abscissa_mm=10.0, direction=np.array([1, 0, 0]), radius_mm=0.5)
    *others, last = thin.branches
    throat = np.where(np.abs(last.abscissa_mm - 5.0) < 0.5, 0.05, 0.5)
    return replace(thin, branches=(*others, replace(last, inscribed_radius_mm=throat)))


def test_an_inlet_that_nothing_connects_is_refused_however_thin() -> None:
    """A thin outlet would be closed."""
    thin = with_interrupted_branch(phantoms.tube())
    ends_mm = [thin.ends[k][0] for k in (0, 2)]
    cut = Vessel(phantoms.phantom_surface(thin, edge_mm=0.25))
    with pytest.raises(VesselError, match=r"inlet_2, .* is not connected to the inlet"):
        trace(cut, inlet_mm=np.array(ends_mm))


def test_outlets_are_numbered_by_those_that_are_left() -> None:
    """The flow of one is named by its number: there is no gap where a wider one is closed."""
    side = np.array([-1, 0, 0])
    tube = phantoms.with_branch(phantoms.tube(), abscissa_mm=16.0, direction=side, radius_mm=0.4)
    vessel = trace(Vessel(phantoms.phantom_surface(with_interrupted_branch(tube), edge_mm=0.2)))
    assert [opening.role for opening in vessel.openings] == ["inlet", "outlet_1", "outlet_2"]
    assert vessel.outlets[1].center_mm[0] < -5.0
    assert any("has no connection to the inlet and was closed." in note for note in vessel.notes)


# -- geometry ----------------------------------------------------------------------------------------------------------


def test_an_opening_that_is_cut_shorter_keeps_its_role() -> None:
    whole = joined(sac_at_mm=5.0)
    cut = trim(whole, upstream_mm=12.0, downstream_mm=12.0)
    assert [opening.role for opening in cut.openings] == ["inlet", "inlet_2", "outlet_1"]
    (right, left, trunk), (whole_right, whole_left, whole_trunk) = cut.openings, whole.openings
    assert 2.0 < right.center_mm[0] < whole_right.center_mm[0] - 3.0
    assert -2.0 > left.center_mm[0] > whole_left.center_mm[0] + 0.5
    assert trunk.center_mm[2] == pytest.approx(whole_trunk.center_mm[2], abs=1e-9)


def test_inlets_behind_one_cut_are_one() -> None:
    cut = trim(joined(sac_at_mm=3.5), upstream_mm=4.5, downstream_mm=12.0)
    assert [opening.role for opening in cut.openings] == ["inlet", "outlet_1"]
    assert cut.inlet.center_mm[2] == pytest.approx(3.5 + 4.5, abs=0.3)
    (note,) = (note for note in cut.notes if "inlet_2" in note)
    assert "was cut off: its blood enters elsewhere." in note


def arch(*knots_mm: Sequence[float], radius_mm: float) -> Centerline:
    points = phantoms.spline(np.array(knots_mm, dtype=float))
    return Centerline(points, np.full(len(points), radius_mm))


def ring() -> Phantom:
    """Two arteries upwards, joined by an arch with a sac between them and by another one beneath: a ring."""
    right = arch((10, 0, 0), (10, 0, 20), (10, 0, 45), radius_mm=1.6)
    over = arch(
        (10, 0, 26), (6, 0, 31), (0, 0, 33), (-6, 0, 31), (-10, 0, 26), (-10, 0, 13), (-10, 0, 0), radius_mm=1.4
    )
    beneath = arch((10, 0, 7), (0, 24, 7), (-10, 0, 7), (-14, -8, 7), radius_mm=0.8)
    return Phantom("ring", right, (over, beneath), sac=Sac(np.array([0, 0, 36.4]), np.array([0, 0, 1.0]), 2.6, 2.6))


def test_in_a_ring_a_way_that_is_cut_still_brings_what_lies_beyond_it() -> None:
    """Beyond the cut that is made first lies an opening that then still hangs on the other way round."""
    whole = trace(Vessel(phantoms.phantom_surface(ring(), edge_mm=0.35)), inlet_mm=np.array([[10, 0, 0], [-10, 0, 0]]))
    cut = trim(whole, upstream_mm=30.0, downstream_mm=16.0)
    assert [opening.role for opening in cut.inlets] == ["inlet", "inlet_2"]
    second = cut.inlets[1].center_mm
    np.testing.assert_allclose(second[:2], [-10.0, 0.0], atol=1.0)
    assert 18.0 < second[2] < 27.0


@cache
def siphon(sac_at_mm: float, *, second: int = 1) -> Vessel:
    """An artery that brings blood from both ends, to a branch; or from one end and the branch."""
    healthy = phantoms.with_branch(phantoms.siphon(), abscissa_mm=19.0, direction=np.array([0.3, -1.0, -0.12]))
    phantom = phantoms.with_sac(healthy, abscissa_mm=sac_at_mm, width_mm=6.0, neck_mm=4.0)
    ends_mm = np.array([phantom.ends[k][0] for k in (0, second)])
    return trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.35)), inlet_mm=ends_mm)


def test_a_cut_beyond_which_more_leaves_than_enters_is_an_outlet() -> None:
    cut = trim(siphon(10.0, second=2), upstream_mm=9.0, downstream_mm=6.0)
    assert [opening.role for opening in cut.openings] == ["inlet", "outlet_1"]
    (note,) = (note for note in cut.notes if "inlet_2" in note)
    assert note.endswith("was cut off: that cut is an outlet now.")


def test_the_parent_artery_leads_to_an_inlet_only_where_it_is_told_to() -> None:
    vessel = siphon(sac_at_mm=10.0)
    anatomy, forced = restore(vessel), restore(vessel, outlet_mm=vessel.inlets[1].center_mm)
    for found, end in ((anatomy, vessel.outlets[0]), (forced, vessel.inlets[1])):
        np.testing.assert_allclose(found.parent.axis.points_mm[-1], end.center_mm, atol=0.5)
        assert f"to {end.role} " in found.notes[0]
        assert len(found.aneurysms) == 1


def test_a_sac_on_the_artery_from_another_inlet_is_told_with_what_to_give() -> None:
    vessel = siphon(sac_at_mm=30.0)
    anatomy = restore(vessel)
    assert not anatomy.aneurysms
    (note,) = (note for note in anatomy.notes if "is on the artery from inlet_2" in note)
    assert note.endswith("give that opening as the first inlet (--inlet).")
    turned = trace(Vessel(vessel.lumen), inlet_mm=np.array([inlet.center_mm for inlet in vessel.inlets[::-1]]))
    assert len(restore(turned).aneurysms) == 1


# -- flow --------------------------------------------------------------------------------------------------------------


def test_two_arteries_of_one_width_bring_half_each_and_the_trunk_takes_all() -> None:
    field = joined_flow()
    assert field.is_converged
    np.testing.assert_allclose(field.inlets_mL_s, [1.5, 1.5], rtol=2e-3)
    assert field.outlets_mL_s[0] == pytest.approx(field.inflow_mL_s, rel=1e-4)
    assert field.inflow_mL_s == pytest.approx(3.0, rel=1e-3)
    assert field.inlet_pressure_Pa[0] == pytest.approx(field.inlet_pressure_Pa[1], rel=0.01)


def test_the_flow_of_two_arteries_of_one_width_is_its_own_mirror_image() -> None:
    field = joined_flow()
    mirror = np.array([-1.0, 1.0, 1.0])
    inside = field.centers_mm[np.abs(field.centers_mm[:, 2] - 12.0) < 8.0]
    velocity, mirrored = (sampling.values_at(field, points)[0] for points in (inside, inside * mirror))
    apart = np.sqrt(((velocity - mirrored * mirror) ** 2).sum(axis=1).mean() / (velocity**2).sum(axis=1).mean())
    assert apart < 0.04


def test_without_a_flow_given_every_inlet_has_the_mean_speed_of_its_own() -> None:
    vessel = trace(Vessel(wall()), inlet_mm=at_ends(LEFT, TRUNK))
    case, given = (vessel_case(vessel, replace(SETTINGS, inflow_mL_s=flow)) for flow in (None, 3.0))
    np.testing.assert_allclose(case.inlets_mL_s, [0.27 * inlet.area_mm2 for inlet in vessel.inlets])
    cubes = np.array([inlet.diameter_mm**3 for inlet in vessel.inlets])
    np.testing.assert_allclose(given.inlets_mL_s, 3.0 * cubes / cubes.sum())
    field = simulate_case(replace(case, numerics=replace(case.numerics, cell_size_mm=0.35)))
    np.testing.assert_allclose(field.inlets_mL_s, case.inlets_mL_s, rtol=3e-3)
    assert field.outlets_mL_s.sum() == pytest.approx(case.inflow_mL_s, rel=3e-3)


def test_outlets_share_what_all_inlets_bring() -> None:
    vessel = trace(Vessel(phantoms.phantom_surface(ring(), edge_mm=0.35)), inlet_mm=[[10, 0, 0], [-10, 0, 0]])
    case = vessel_case(vessel, FlowSettings(inflow_mL_s=4.0, outlets="murray"))
    cubes = np.array([outlet.diameter_mm**3 for outlet in vessel.outlets])
    flows_mL_s = 4.0 * cubes / cubes.sum()
    assert case.ends[2:] == (Pressure(0.0), *(FlowRate(pytest.approx(one)) for one in flows_mL_s[1:]))


def test_every_inlet_has_a_number_and_streamlines_of_its_own() -> None:
    field = joined_flow()
    found = indices(field)
    assert [found["inlet_flow_mL_s"], found["inlet_2_flow_mL_s"]] == field.inlets_mL_s.tolist()
    assert [found["inlet_pressure_Pa"], found["inlet_2_pressure_Pa"]] == field.inlet_pressure_Pa.tolist()
    seeds_mm = inlet_seeds_mm(field, joined(), 70)
    right, left = ((sign * seeds_mm[:, 0] > 2).sum() for sign in (1, -1))
    assert right + left == len(seeds_mm) == 70
    assert abs(right - left) <= 4


def test_streamlines_go_from_opening_to_opening() -> None:
    vessel, field = joined(), joined_flow()
    lines = streamlines(field, inlet_seeds_mm(field, vessel, 70))
    first, last = lines.points_mm[lines.starts[:-1]], lines.points_mm[lines.starts[1:] - 1]
    beyond_mm = [(lines.points_mm - opening.center_mm) @ opening.normal for opening in vessel.openings]
    assert len(first) == 70
    assert np.max(beyond_mm) < 1e-3
    step_mm = STEP_CELLS * field.finest.cell_size_mm
    into, out = (
        np.max([(ends - opening.center_mm) @ opening.normal for opening in openings], axis=0)
        for ends, openings in ((first, vessel.inlets), (last, vessel.outlets))
    )
    assert (into > -step_mm).all()
    assert (out > -step_mm).mean() > 0.9  # beside the wall some end in blood that stands


def test_streamlines_a_little_outside_the_wall_end_at_the_openings_too() -> None:
    """Between cells velocity does not end at the wall: such a line passed an opening beside its rim, and went on."""
    vessel, field = joined(), joined_flow()
    wall = vessel.lumen
    beside_mm = wall.vertices_mm + 0.2 * field.finest.cell_size_mm * wall.vertex_normals
    before_mm = np.min([(one.center_mm - beside_mm) @ one.normal for one in vessel.openings], axis=0)
    lines = streamlines(field, beside_mm[(before_mm > 0.5) & (before_mm < 3.0)])
    beyond_mm = [(lines.points_mm - one.center_mm) @ one.normal for one in vessel.openings]
    assert len(lines.starts) > 100
    assert np.max(beyond_mm) < 1e-3


def test_a_pulse_enters_by_all_inlets_at_once() -> None:
    pulse = Waveform(0.4, (0.3,), (0.2,))
    settings = FlowSettings(inflow_mL_s=3.0, waveform=pulse, numerics=Numerics(cell_size_mm=0.4, max_cycles=1))
    case = vessel_case(joined(), settings)
    field = simulate_case(case)
    time_s = np.array([phase.time_s for phase in field.phases])
    expected_mL_s = np.outer(pulse.factor(time_s), case.inlets_mL_s)
    np.testing.assert_allclose([phase.inlets_mL_s for phase in field.phases], expected_mL_s, rtol=0.01)


def test_refinement_in_the_sac_takes_in_what_every_inlet_brings() -> None:
    anatomy = restore(joined(sac_at_mm=5.0))
    settings = FlowSettings(inflow_mL_s=3.0, numerics=Numerics(cell_size_mm=0.2))
    whole, close = (
        simulate_case(flow_case(anatomy, (), replace(settings, numerics=replace(settings.numerics, refine=refine))))
        for refine in ((), ("sac",))
    )
    np.testing.assert_allclose(close.inlets_mL_s, whole.inlets_mL_s, rtol=5e-3)
    sac = anatomy.aneurysms[0]
    inflow = [indices(field, sac.sac, sac.neck)["neck_inflow_mL_s"] for field in (whole, close)]
    # Two thirds of the inflow at 0.1 mm everywhere; the longer time steps of the refined grid are 2 % nearer to that.
    assert inflow[1] == pytest.approx(inflow[0], rel=0.08)


def test_a_grid_that_does_not_reach_an_inlet_is_refused() -> None:
    thin = phantoms.with_branch(phantoms.tube(), abscissa_mm=6.0, direction=np.array([1, 0, 1]), radius_mm=0.25)
    ends_mm = np.array([thin.ends[k][0] for k in (0, 2)])
    vessel = trace(Vessel(phantoms.phantom_surface(thin, edge_mm=0.15)), inlet_mm=ends_mm)
    with pytest.raises(domain.CoarseGridError, match=r"reaches inlet_2 \(0.49 mm wide at .*: use a finer grid spacing"):
        domain.build(vessel, 0.45)


# -- a study -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inlets")
    write_stl(folder / "y.stl", wall(sac_at_mm=5.0, edge_mm=0.7))
    inlets = [f"--inlet={','.join(map(str, end_mm))}" for end_mm in at_ends(RIGHT, LEFT)]
    words = ["--units", "mm", "--device", "leo", "--grid-spacing", "0.5", "--flow-rate", "3", *inlets]
    assert main(["run", str(folder / "y.stl"), "--out", str(folder / "first"), *words]) == 0
    return folder / "first"


def test_a_study_keeps_its_inlets_from_the_command_line_to_the_numbers_and_back(study: Path, tmp_path: Path) -> None:
    assert main(["run", str(study / "run.json"), "--out", str(tmp_path / "again")]) == 0
    for name in ("openings.json", "metrics.json"):
        assert (study / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    openings = json.loads((study / "openings.json").read_text())["openings"]
    assert [opening["role"] for opening in openings] == ["inlet", "inlet_2", "outlet_1"]
    for flow in (
        (metrics := json.loads((study / "metrics.json").read_text()))["treatments"]["bare"]["flow"],
        metrics["treatments"]["leo"]["flow"],
    ):
        entering = flow["inlet_flow_mL_s"] + flow["inlet_2_flow_mL_s"]
        assert flow["outlet_1_flow_mL_s"] == pytest.approx(entering, rel=1e-3)
        index = flow["neck_inflow_mL_s"] / entering / flow["inflow_area_fraction"]
        assert flow["inflow_concentration_index"] == pytest.approx(index)


def test_the_page_keeps_the_inlets_of_a_study_that_it_opens(study: Path, tmp_path: Path) -> None:
    case = reopened(Cases(tmp_path), study)
    told = json.loads((study / "run.json").read_text())["settings"]["anatomy"]["inlet_mm"]
    assert case.state.choices.model_dump(mode="json")["inlet_mm"] == told
    assert np.array(case.state.settings().anatomy.inlet_mm).tolist() == told == at_ends(RIGHT, LEFT).tolist()
