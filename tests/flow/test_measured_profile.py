"""A measured inlet profile: its table, its plane and outline, and the flow that it gives in an inlet."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.errors import InputError, ReadError
from vstent.flow.ends import Inflow
from vstent.flow.measured import MeasuredProfile, read_profile
from vstent.flow.problem import vessel_case
from vstent.flow.registration import registered
from vstent.flow.settings import FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.flow.waveform import read_waveform
from vstent.geometry.vessel import Vessel
from vstent.kernels.arrays import Floats
from vstent.study.settings import settings_of

RADIUS_MM, MEAN_M_S, PIXEL_MM = 2.5, 0.3, 0.25
FLOW_ML_S = MEAN_M_S * np.pi * RADIUS_MM**2


def picture(skew: float = 0.0) -> Floats:
    """Rows x, y, speed of a picture of Poiseuille's flow around (7, -3), away from the eye; `skew` moves it along x."""
    ticks = np.arange(-3.0, 3.01, PIXEL_MM)
    x, y = (one.ravel() for one in np.meshgrid(ticks, ticks))
    inside = np.hypot(x, y) < RADIUS_MM
    speed = 2 * MEAN_M_S * (1 - (x**2 + y**2) / RADIUS_MM**2) * (1 + skew * x / RADIUS_MM)
    return np.stack([x + 7, y - 3, np.where(inside, -speed, 0.0)], axis=1)


def over_time(factor: Floats, period_s: float = 0.9) -> Floats:
    """Rows t, x, y, speed of that picture times a factor at every moment."""
    one = picture()
    moments = [np.column_stack([np.full(len(one), period_s * k / len(factor)), one[:, :2], factor[k] * one[:, 2]])
               for k in range(len(factor))]  # fmt: skip
    return np.concatenate(moments)


def written(folder: Path, rows: Floats, titles: str = "x, y, v") -> str:
    """The path of a table of these rows."""
    path = folder / "profile.csv"
    path.write_text("\n".join([titles, *(", ".join(f"{value:.9g}" for value in row) for row in rows)]))
    return str(path)


def measured(folder: Path, rows: Floats) -> MeasuredProfile:
    profile = read_profile(written(folder, rows))
    assert isinstance(profile, MeasuredProfile)
    return profile


def circle(radius_mm: float, turn: Rotation) -> tuple[Floats, Floats]:
    """A round section and its outward normal."""
    angle = 2 * np.pi * np.arange(200) / 200
    flat = radius_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return turn.apply(flat) + np.array([1.0, 2.0, 3.0]), turn.apply([0.0, 0.0, 1.0])


def test_area_and_flow_are_those_of_the_picture(tmp_path: Path) -> None:
    section = measured(tmp_path, picture()).section
    assert section.area_mm2 == pytest.approx(np.pi * RADIUS_MM**2, rel=0.02)
    assert section.flow_mL_s == pytest.approx([FLOW_ML_S], rel=0.01)


@pytest.mark.parametrize("angle", [0.0, 40.0, 180.0])
def test_the_flow_of_a_round_section_is_carried_over_to_another_in_any_position(angle: float, tmp_path: Path) -> None:
    section_mm, normal = circle(2.0, Rotation.from_euler("x", angle, degrees=True))
    points_mm = section_mm.mean(axis=0) + np.linspace(0.0, 0.95, 20)[:, None] * (
        section_mm[30] - section_mm.mean(axis=0)
    )
    velocity = registered(measured(tmp_path, picture()).section, section_mm, normal, points_mm)[0]
    np.testing.assert_allclose(
        velocity @ -normal, 2 * (1 - np.linspace(0.0, 0.95, 20) ** 2), atol=0.09
    )  # a pixel is a tenth of the radius
    np.testing.assert_allclose(velocity, np.outer(velocity @ normal, normal), atol=1e-9)


def test_the_same_picture_in_space_gives_the_same_flow(tmp_path: Path) -> None:
    """Six columns in the frame of the patient, turned with the section."""
    flat = picture(skew=0.5)
    turn = Rotation.from_euler("xyz", [20.0, 30.0, 50.0], degrees=True)
    still = np.zeros((len(flat), 1))
    places = np.hstack([flat[:, :2], still])
    velocity = np.hstack([still, still, flat[:, 2:]])
    section_mm, normal = circle(2.0, Rotation.identity())
    points_mm = section_mm[::9] * 0.6 + 0.4 * section_mm.mean(axis=0)
    plain = registered(measured(tmp_path, np.hstack([places, velocity])).section, section_mm, normal, points_mm)
    space = measured(tmp_path, np.hstack([turn.apply(places), turn.apply(velocity)]))
    turned = registered(space.section, turn.apply(section_mm), turn.apply(normal), turn.apply(points_mm))
    np.testing.assert_allclose(turned, turn.apply(plain[0])[None], atol=0.02)
    assert "turned by 0 degrees" in space.section.described(turn.apply(normal))
    skewed = plain[0] @ -normal  # faster on the side of larger x, which is kept
    assert np.corrcoef(skewed, points_mm[:, 0])[0, 1] > 0.95


def test_the_flow_follows_from_the_table_unless_one_is_given(tmp_path: Path) -> None:
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=14.0, radius_mm=2.0))))
    settings = FlowSettings(profile=measured(tmp_path, picture(skew=0.6)), numerics=Numerics(cell_size_mm=0.25))
    case = vessel_case(vessel, settings)
    assert isinstance(case.ends[0], Inflow)
    assert case.ends[0].mean_mL_s == pytest.approx(FLOW_ML_S, rel=0.01)
    assert case.inflow_source.startswith("measured: mean 0.30 m/s through 19.7 mm2, 0 degrees from the normal")
    given = vessel_case(vessel, replace(settings, inflow_mL_s=3.0))
    assert given.inflow_mL_s == 3.0
    assert given.inflow_source.startswith("profile measured: ")
    field = simulate_case(case)
    assert field.is_converged
    assert field.inlets_mL_s[0] == pytest.approx(case.inflow_mL_s, rel=3e-3)
    # Near the inlet the blood is faster on one side, across the axis.
    axis = case.vessel.inlet.normal
    grid = field.finest
    depth = (case.vessel.inlet.center_mm - grid.centers_mm) @ axis
    near = np.abs(depth - 1.0) < 0.2
    across = grid.centers_mm[near] - case.vessel.inlet.center_mm
    moment = (grid.velocity_m_s[near] @ -axis) @ (across - (across @ axis)[:, None] * axis) / near.sum()
    assert np.linalg.norm(moment) > 0.1 * MEAN_M_S


def test_a_table_over_time_gives_its_waveform_and_its_flow_at_every_moment(tmp_path: Path) -> None:
    """With a moment of backward flow."""
    factor = 1 + 1.3 * np.sin(2 * np.pi * np.arange(20) / 20) + 0.2 * np.cos(4 * np.pi * np.arange(20) / 20)
    path = written(tmp_path, over_time(factor), "t, x, y, v")
    flow = settings_of({"inlet-profile": path}).flow
    assert flow is not None
    assert flow.waveform is not None
    assert flow.waveform.period_s == pytest.approx(0.9)
    np.testing.assert_allclose(flow.waveform.factor(0.9 * np.arange(20) / 20), factor, atol=1e-6)
    assert factor.min() < -0.2
    assert settings_of({"inlet-profile": path, "steady": True}).flow.waveform is None  # type: ignore[union-attr]
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=12.0, radius_mm=1.5))))
    coarse = Numerics(cell_size_mm=0.4, lattice_speed=0.2)
    field = simulate_case(vessel_case(vessel, replace(flow, inflow_mL_s=1.0, numerics=coarse)))
    assert field.is_converged
    asked = flow.waveform.factor(np.array([phase.time_s for phase in field.phases]))
    np.testing.assert_allclose([phase.inflow_mL_s for phase in field.phases], asked, atol=0.02)
    with pytest.raises(
        InputError, match="has times, and another waveform is given: leave out --pulsatile or the times"
    ):
        vessel_case(vessel, replace(flow, waveform=read_waveform("ica_older_adults")))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[:, :2], "give 3 or 4 or 6 or 7 finite numbers"),
        (lambda rows: rows * [1.0, 1.0, 100.0], r"has a speed of 60 m/s: give m/s \(27 cm/s are 0.27 m/s\)"),
        (lambda rows: rows * [1e-3, 1e-3, 1.0], "cover 1.97e-05 mm2: give their coordinates in mm"),
        (lambda rows: rows * [1.0, 1.0, 0.0], "blood moves at 0 points of the inlet profile in .*: give at least 8"),
        (lambda rows: rows * [1.0, 0.0, 1.0], "not spread over a plane section: give those of one plane"),
        (lambda rows: np.column_stack([rows[:, 0] > 7, rows]), "has other points at 1 s than at 0 s: give the same"),
        (lambda rows: over_time(np.ones(3)), "has 3 times: give at least 5 of one cycle, equally spaced"),
    ],
)
def test_a_bad_table_is_refused_with_what_to_do(change: Callable[[Floats], Floats], said: str, tmp_path: Path) -> None:
    with pytest.raises((InputError, ReadError), match=said):
        read_profile(written(tmp_path, change(picture())))


def test_a_word_is_kept_and_another_is_refused_with_the_words() -> None:
    assert read_profile("plug") == "plug"
    with pytest.raises(InputError, match=r"'plugg' is none of developed, plug, womersley, and no such file exists"):
        read_profile("plugg")
    with pytest.raises(InputError, match=r"'ica' is not ica_older_adults, and no such file exists"):
        read_waveform("ica")
