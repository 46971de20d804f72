"""The FDA's benchmark nozzle at throat Re 500 against its five PIV experiments (Hariharan et al. 2011).

Hariharan et al. 2011, J. Biomech. Eng. 133, 041002; sudden expansion, z = 0 where it is, flow along +z.
"""

import re
import shutil
import zipfile
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from axisymmetric import axial_speed

from vstent.flow import sampling
from vstent.flow.case import FlowField
from vstent.flow.problem import vessel_case
from vstent.flow.settings import Blood, FlowSettings, Numerics
from vstent.flow.simulation import simulate_case
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Opening, Vessel

BLOOD = Blood(density_kg_m3=1056.0, viscosity_Pa_s=0.0035)
INFLOW_ML_S = 5.20624
"""The nominal flow. What the five carry is less: see `own_flow_mL_s`."""
INLET_MM, CONE_MM, THROAT_MM, WIDE_RADIUS_MM, RADIUS_MM = 4.0, 22.685, 40.0, 6.0, 2.0
AROUND, EDGE_MM = 96, 0.5
BEFORE_THE_CONE_MM = (-88.0, -64.0)
SECTIONS_MM = (-20.0, -8.0, 0.0, 8.0, 16.0, 24.0, 32.0, 60.0, 80.0)
BEYOND = 0.03
"""How far outside the spread of the five a velocity may be, as a fraction of the section's peak."""
NOMINAL_BEYOND = 0.045
"""The same at the nominal flow."""


def narrowing(end_mm: float) -> list[tuple[float, float]]:
    """Inlet tube, cone and throat up to z = `end_mm`: (z, r) of the wall."""
    knots = [(-THROAT_MM - CONE_MM - INLET_MM, WIDE_RADIUS_MM), (-THROAT_MM - CONE_MM, WIDE_RADIUS_MM)]
    return [*knots, (-THROAT_MM, RADIUS_MM), (end_mm, RADIUS_MM)]


def nozzle(end_mm: float) -> Vessel:
    """The narrowing and what follows up to z = `end_mm`: the wide tube behind the step where that is > 0."""
    knots = narrowing(min(end_mm, 0.0))
    if end_mm > 0:
        knots += [(0.0, WIDE_RADIUS_MM), (end_mm, WIDE_RADIUS_MM)]
    profile = np.concatenate([_cut(a, b) for a, b in pairwise(knots)] + [[knots[-1]]])
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(AROUND, z)], axis=1) for z, r in profile]
    wall = Surface(np.concatenate(rings), _tube_faces(len(profile)))
    ends = [(profile[0], -1.0, "inlet"), (profile[-1], 1.0, "outlet_1")]
    area = 0.5 * AROUND * np.sin(2 * np.pi / AROUND)
    openings = [Opening([0, 0, z], [0, 0, sign], area * r**2, role) for (z, r), sign, role in ends]
    return Vessel(wall, tuple(openings))


def _cut(a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
    """Points (k, 2) from a to b, b left out."""
    count = max(1, round(np.hypot(b[0] - a[0], b[1] - a[1]) / EDGE_MM))
    return np.linspace(a, b, count, endpoint=False)


def _tube_faces(rings: int) -> np.ndarray:
    """Faces between rings of `AROUND` vertices along +z, outward."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(AROUND), indexing="ij")
    a, b = i * AROUND + j, i * AROUND + (j + 1) % AROUND
    c, d = a + AROUND, b + AROUND
    return np.concatenate([np.stack(x, axis=-1).reshape(-1, 3) for x in ((a, b, d), (a, d, c))]).astype(np.int32)


@pytest.fixture(scope="module")
def experiments(shared_data: Path) -> list[dict[str, np.ndarray]]:
    """Every experiment: arrays (n, 2) of a place and an axial velocity, by place, by the name of the plot."""
    archive = shared_data.parent / "reference" / "fda_nozzle" / "SE_exp_0500.zip"
    if not archive.exists():
        pytest.skip("the PIV data (../shared/reference) are not on this machine")
    with zipfile.ZipFile(archive) as files:
        texts = [files.read(name).decode().replace("\r\n", "\n") for name in files.namelist() if name.endswith(".txt")]
    assert len(texts) == 5
    return [_plots(text) for text in texts]


def _plots(text: str) -> dict[str, np.ndarray]:
    found = {}
    for name, count, body in re.findall(
        r"^plot-(\S*axial-velocity\S*(?: -?[\d.]+)?)[^\n]*\n(\d+)\n((?:[-+\d].*\n?)*)", text, re.M
    ):
        rows = [[float(x) for x in line.split()[:2]] for line in body.splitlines()[: int(count)]]
        found[name.removesuffix(" 0")] = np.array(sorted(rows))
    return found


def profile(z_mm: float) -> str:
    """Name of the plot of a profile."""
    return f"profile-axial-velocity-at-z {1e-3 * z_mm:.5f}"


def own_flow_mL_s(experiments: list[dict[str, np.ndarray]]) -> float:
    """Mean flow that the five carry by their profiles in the inlet tube: 4.7 to 5.1 mL/s, 5 % less than nominal.

    What passes there passes behind the step too: with the nominal flow no solution can be inside the spread there.
    """
    r_mm = np.linspace(-WIDE_RADIUS_MM, WIDE_RADIUS_MM, 2001)
    flows_mL_s = []
    for one in experiments:
        for z_mm in BEFORE_THE_CONE_MM:
            r_m, speed_m_s = one[profile(z_mm)].T
            within = np.abs(r_m) < 1e-3 * WIDE_RADIUS_MM
            speed = np.interp(r_mm, np.r_[r_mm[0], 1e3 * r_m[within], r_mm[-1]], np.r_[0.0, speed_m_s[within], 0.0])
            flows_mL_s.append(np.pi * np.trapezoid(np.abs(r_mm) * speed, r_mm))
    return float(np.mean(flows_mL_s))


def spread(experiments: list[dict[str, np.ndarray]], name: str, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest velocity (n,) of the experiments that have this plot, at places (n,) in m."""
    measured = [one[name] for one in experiments if name in one]
    assert len(measured) >= 3
    values = [np.interp(at, *one.T) for one in measured]
    return np.min(values, axis=0), np.max(values, axis=0)


def radii_mm(z_mm: float) -> np.ndarray:
    """Where a profile is compared, (37,) from side to side."""
    return np.linspace(-0.9, 0.9, 37) * (RADIUS_MM if z_mm <= 0 else WIDE_RADIUS_MM)


def beyond(speed: np.ndarray, experiments: list[dict[str, np.ndarray]], z_mm: float) -> np.ndarray:
    """How far a profile (37,) at z is outside the spread (37,), as fractions of the measured peak."""
    low, high = spread(experiments, profile(z_mm), 1e-3 * radii_mm(z_mm))
    return np.maximum(np.maximum(low - speed, speed - high), 0.0) / high.max()


class Outside(NamedTuple):
    """How far a flow is outside the spread at a section, as fractions of the measured peak."""

    along_x: float
    """The profile along x."""
    along_y: float
    around: float
    """The mean around the axis."""
    axis: float
    """The speed on the axis."""

    def __str__(self) -> str:
        """One line."""
        return (
            f"outside the spread by {self.along_x:.1%} of the peak (profile along x), {self.along_y:.1%} (along y), "
            f"{self.around:.1%} (mean around the axis), {self.axis:.1%} (axis)"
        )


def center_mm(field: FlowField, z_mm: float) -> np.ndarray:
    """Middle (2,) of a section's axial momentum flux."""
    x_mm, y_mm = np.meshgrid(*2 * [np.linspace(-WIDE_RADIUS_MM, WIDE_RADIUS_MM, 121)])
    within = np.hypot(x_mm, y_mm) < 0.95 * (RADIUS_MM if z_mm <= 0 else WIDE_RADIUS_MM)
    places = np.column_stack([x_mm[within], y_mm[within], np.full(within.sum(), z_mm)])
    flux = sampling.values_at(field, places)[0][:, 2] ** 2
    return np.asarray(flux @ places[:, :2] / flux.sum())


def outside(field: FlowField, experiments: list[dict[str, np.ndarray]], z_mm: float) -> Outside:
    """Compare a flow with the experiments at a section."""
    r_mm = radii_mm(z_mm)
    angle = np.pi / 12 * np.arange(24)
    ring = [r_mm[:, None] * np.cos(angle), r_mm[:, None] * np.sin(angle), np.full((37, 24), z_mm)]
    speed = sampling.values_at(field, np.stack(ring, axis=-1).reshape(-1, 3))[0][:, 2].reshape(37, 24)
    along_x, along_y, around = (
        beyond(found, experiments, z_mm) for found in (speed[:, 0], speed[:, 6], speed.mean(axis=1))
    )
    middle = 18
    return Outside(float(along_x.max()), float(along_y.max()), float(around.max()), float(along_x[middle]))


def test_the_profile_in_the_throat_is_inside_the_spread_of_the_experiments(
    experiments: list[dict[str, np.ndarray]],
) -> None:
    settings = FlowSettings(blood=BLOOD, inflow_mL_s=INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.5))
    field = simulate_case(vessel_case(nozzle(-4.0), settings))
    assert field.outlets_mL_s[0] == pytest.approx(field.inflow_mL_s, rel=1e-3)
    assert field.inflow_mL_s == pytest.approx(INFLOW_ML_S, rel=5e-3)
    assert outside(field, experiments, -20.0).axis < BEYOND


@pytest.mark.validation
def test_a_round_jet_stays_round() -> None:
    """With the usual equilibrium of D3Q19 it becomes a cross on the grid's diagonals: 22 % here."""
    settings = FlowSettings(
        blood=BLOOD, inflow_mL_s=0.4 * INFLOW_ML_S, numerics=Numerics(cell_size_mm=0.5, lattice_speed=0.02)
    )
    field = simulate_case(vessel_case(nozzle(14.0), settings))
    angle = np.pi / 4 * np.arange(8)
    r_mm = np.array([1.0, 1.5, 2.0, 2.5])[:, None]
    ring = np.stack([r_mm * np.cos(angle), r_mm * np.sin(angle), np.full((4, 8), 6.0)], axis=-1)
    speed = sampling.values_at(field, ring.reshape(-1, 3))[0][:, 2].reshape(4, 8)
    on_axes, on_diagonals = speed[:, 0::2].mean(axis=1), speed[:, 1::2].mean(axis=1)
    assert np.abs(on_axes - on_diagonals).max() < 0.06 * field.speed_m_s.max()


@pytest.fixture(scope="module")
def jet(experiments: list[dict[str, np.ndarray]]) -> FlowField:
    """The whole nozzle, 20 cells across the throat, at the flow that the five carry.

    With 16 the jet is not quite round, and profiles along x are outside by up to 6.7 % of the peak.
    """
    inflow_mL_s = own_flow_mL_s(experiments)
    settings = FlowSettings(
        blood=BLOOD, inflow_mL_s=inflow_mL_s, numerics=Numerics(cell_size_mm=0.2, max_steps=200_000)
    )
    return simulate_case(vessel_case(nozzle(95.0), settings))


@pytest.mark.validation
def test_the_axis_of_the_jet_is_inside_the_spread_of_the_experiments(
    jet: FlowField, experiments: list[dict[str, np.ndarray]]
) -> None:
    print(f"\n{len(jet.centers_mm)} cells, {jet.steps} steps, {jet.seconds:.0f} s: {jet.advice}")  # noqa: T201
    print(f"flow of the five: {own_flow_mL_s(experiments):.2f} mL/s")  # noqa: T201
    found = {z_mm: outside(jet, experiments, z_mm) for z_mm in SECTIONS_MM}
    for z_mm, one in found.items():
        x_mm, y_mm = center_mm(jet, z_mm)
        print(f"z {z_mm:5.0f} mm: {one}; its middle at x {x_mm:+.3f}, y {y_mm:+.3f} mm")  # noqa: T201
    assert jet.outlets_mL_s[0] == pytest.approx(jet.inflow_mL_s, rel=1e-3)
    assert max(one.axis for one in found.values()) < BEYOND


@pytest.mark.validation
@pytest.mark.parametrize("z_mm", SECTIONS_MM)
def test_every_profile_of_the_jet_is_inside_the_spread_of_the_experiments(
    jet: FlowField, experiments: list[dict[str, np.ndarray]], z_mm: float
) -> None:
    found = outside(jet, experiments, z_mm)
    assert max(found.along_x, found.along_y, found.around) < BEYOND


@pytest.mark.validation
@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
@pytest.mark.parametrize("is_nominal", [True, False])
def test_an_axisymmetric_solution_is_inside_the_spread_at_the_flow_of_the_five_alone(
    experiments: list[dict[str, np.ndarray]], tmp_path: Path, is_nominal: bool
) -> None:
    """At the nominal flow it is outside by more than 3 % of the peak behind the step, whoever computes it."""
    inflow_mL_s = INFLOW_ML_S if is_nominal else own_flow_mL_s(experiments)
    wide = 95.0, WIDE_RADIUS_MM
    speed = axial_speed(tmp_path, narrowing(0.0), wide, inflow_mL_s, BLOOD, edge_mm=0.2)
    found = []
    for z_mm in SECTIONS_MM:
        found.append(beyond(speed(np.full(37, z_mm), radii_mm(z_mm)), experiments, z_mm).max())
        print(f"z {z_mm:5.0f} mm, {inflow_mL_s:.2f} mL/s: outside by {found[-1]:.1%} of the peak")  # noqa: T201
    least, most = (BEYOND, NOMINAL_BEYOND) if is_nominal else (0.0, BEYOND)
    assert least < max(found) < most


@pytest.mark.validation
@pytest.mark.parametrize(("cell_size_mm", "most"), [(0.47, 0.035), (0.5, 0.045), (0.53, 0.035)])
def test_a_jet_leaves_a_lip_straight_however_it_lies_on_the_grid(cell_size_mm: float, most: float) -> None:
    """As it lies, 1.9, 3.8 and 2.2 % of the peak; with blood sent back where links clip its corner, 8, 9 and 4 %.

    At the nominal flow blood is too fast for 4 to 5 % of these cells, and computed thicker there: 4.8 % for 2.8.
    """
    settings = FlowSettings(blood=BLOOD, inflow_mL_s=0.6 * INFLOW_ML_S, numerics=Numerics(cell_size_mm=cell_size_mm))
    field = simulate_case(vessel_case(nozzle(14.0), settings))
    angle = np.pi / 12 * np.arange(24)
    ring = np.stack([1.8 * np.cos(angle), 1.8 * np.sin(angle), np.full(24, 8.0)], axis=1)
    harmonics = np.abs(np.fft.rfft(sampling.values_at(field, ring)[0][:, 2])) / 12 / field.speed_m_s.max()
    print(f"\nonce to four times around: {100 * harmonics[1:5]} %")  # noqa: T201
    assert harmonics[1:4].max() < most
