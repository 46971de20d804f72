"""What comes back from OpenFOAM: fields read, brought to the grid, failures put into words, a tube's exact flow."""

import re
import shutil
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.deployment.deploy import deploy
from vstent.devices.catalogue import find_design
from vstent.errors import FlowError, ReadError
from vstent.flow import domain, sampling
from vstent.flow.case import PHASES, Sheet, Target
from vstent.flow.ends import Resistance, outflows
from vstent.flow.engines import Outcome, Progress, run
from vstent.flow.openfoam import folder as folders, program, results, scatter
from vstent.flow.openfoam.bridge import Snapshot, bridge
from vstent.flow.openfoam.dialects import Flavour
from vstent.flow.openfoam.engine import OpenFoam, State
from vstent.flow.openfoam.setup import FoamSetup
from vstent.flow.problem import flow_case, vessel_case
from vstent.flow.settings import FlowSettings, Numerics, Waveform
from vstent.flow.simulation import simulate_case
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel

HEADER = "FoamFile\n{\n    class volVectorField;\n}\ndimensions [0 1 -1 0 0 0 0];\n"


def write(path: Path, inside: str, **patches: str) -> None:
    body = "".join(f"    {name}\n    {{\n        type x;\n        {value}\n    }}\n" for name, value in patches.items())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{HEADER}internalField {inside};\n\nboundaryField\n{{\n{body}}}\n")


def test_fields_are_read_as_openfoam_writes_them(tmp_path: Path) -> None:
    write(
        tmp_path / "7" / "U",
        "nonuniform List<vector>\n3\n(\n(1 2 3)\n(4 5 -6e-7)\n(7 8 9)\n)\n",
        wall="",
        inlet="value           nonuniform List<vector> 2((1 0 0) (0 1 0));",
        inlet_2=f"refValue\n        {{\n{12 * ' '}value   nonuniform List<vector> 2((0 0 3) (0 0 4));\n        }}",
        outlet_1="value           uniform (0 0 2.5);",
        outlet_2="value           nonuniform List<vector> 2{(1 1 1)};",
    )
    found = results.read_field(tmp_path, "7", "U")
    np.testing.assert_array_equal(found.inside, [[1, 2, 3], [4, 5, -6e-7], [7, 8, 9]])
    assert {name: rows.tolist() for name, rows in found.patches.items()} == {
        "inlet": [[1, 0, 0], [0, 1, 0]],
        "outlet_1": [[0, 0, 2.5]],
        "outlet_2": [[1, 1, 1]] * 2,
    }
    assert {name: rows.tolist() for name, rows in found.references.items()} == {"inlet_2": [[0, 0, 3], [0, 0, 4]]}
    assert results.times(tmp_path) == ["7"]


def test_parts_are_put_together_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for part in range(11):
        wall = "nonuniform 0()" if part else "nonuniform List<scalar> 1(5)"
        write(tmp_path / f"processor{part}" / "0.05" / "p", f"nonuniform List<scalar> 2({part} {part + 0.5})")
        write(tmp_path / f"processor{part}" / "0.05" / "U", "uniform 0", wall=f"value {wall};")
        (tmp_path / f"processor{part}" / "0.3").mkdir()
    np.testing.assert_array_equal(results.read_field(tmp_path, "0.05", "p").inside[:, 0], np.arange(22) / 2)
    np.testing.assert_array_equal(results.read_field(tmp_path, "0.05", "U").patches["wall"], [[5.0]])
    assert results.times(tmp_path) == ["0.05"]  # 0.3 is not complete


def test_a_flow_that_a_run_begins_from_leaves_no_blood_at_rest_between_the_parts(tmp_path: Path) -> None:
    rest = "value uniform (0 0 0);"
    field = simulate_case(
        vessel_case(tube(), FlowSettings(inflow_mL_s=FLOW_ML_S, numerics=Numerics(cell_size_mm=0.5, max_steps=96)))
    )
    parts = {name: field.centers_mm[chosen] for name, chosen in (("processor0", [9, 2]), ("processor1", [5, 70, 3]))}
    for name, points_mm in parts.items():
        rows = " ".join(f"({x:.9g} {y:.9g} {z:.9g})" for x, y, z in points_mm * 1e-3)
        write(tmp_path / name / "0" / "C", f"nonuniform List<vector> {len(points_mm)}({rows})")
        write(tmp_path / name / "0" / "U", "uniform (0 0 0)", inlet=rest, procBoundary0to1=rest, outlet_1=rest)
        write(tmp_path / name / "0" / "p", "uniform 0", procBoundary0to1through2="value uniform 0;")
    folders.begin_from(tmp_path, field)
    for name, points_mm in parts.items():
        velocity_m_s, pressure_Pa = sampling.values_at(field, points_mm)
        speed, pressure = (results.read_field(tmp_path / name, "0", one) for one in ("U", "p"))
        np.testing.assert_allclose(speed.inside, velocity_m_s, rtol=1e-5)
        np.testing.assert_allclose(pressure.inside[:, 0], pressure_Pa / field.blood.density_kg_m3, rtol=1e-5)
        assert sorted(speed.patches) == ["inlet", "outlet_1"]
        assert not pressure.patches


@pytest.mark.parametrize(
    "inside", ["nonuniform List<vector> 2((1 2 3))", "nonuniform List<vector> 2((1 2 3", "uniform"]
)
def test_a_damaged_field_is_refused(inside: str, tmp_path: Path) -> None:
    write(tmp_path / "1" / "U", inside)
    with pytest.raises(ReadError, match="damaged"):
        results.read_field(tmp_path, "1", "U")


def test_fits_are_exact_for_quadratic_functions_and_third_order_for_others() -> None:
    rng = np.random.default_rng(3)
    error = []
    for count in (4000, 32000):
        sources = rng.uniform(-1, 1, (count, 3))
        targets = rng.uniform(-0.8, 0.8, (200, 3))
        fit = scatter.fits(sources, targets)
        bowl = [
            4 + points @ [1.0, -2.0, 0.5] + points[:, 0] * points[:, 1] - points[:, 2] ** 2
            for points in (sources, targets)
        ]
        np.testing.assert_allclose(fit @ bowl[0], bowl[1], atol=1e-4)
        error.append(np.sqrt(np.mean((fit @ np.sin(3 * sources[:, 0]) - np.sin(3 * targets[:, 0])) ** 2)))
    assert error[1] < 0.2 * error[0]  # half the spacing: an eighth of the error
    flat = np.concatenate([rng.uniform(-1, 1, (500, 2)), np.zeros((500, 1))], axis=1)
    above = scatter.fits(flat, np.array([[0.1, 0.2, 0.05]]))
    assert above @ flat[:, 0] == pytest.approx(0.1, abs=1e-3)


def test_a_mean_of_near_points_keeps_between_them_and_apart_by_normals() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.01]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]])
    mean = scatter.near_means(np.hstack([points, normals]), np.array([[0.0, 0, 0.005, 0, 0, 1]]), 0.1)
    weight = np.asarray(mean.todense())[0]
    assert weight.sum() == pytest.approx(1)
    assert weight[0] > 0.9
    assert weight[3] < 0.01


def test_jets_thinner_than_a_cell_go_through_the_neck_as_the_mesh_has_them(tmp_path: Path) -> None:
    """Between wires 0.23 mm apart blood goes in and out by a cosine: in by its size times the area over pi."""
    along, height = np.arange(-1.2, 1.2, 0.05), np.arange(6.8, 7.2, 0.05)
    inside_mm = np.stack(np.meshgrid(along, along, height, indexing="ij"), axis=-1).reshape(-1, 3)
    rows = " ".join(f"({x:.9g} {y:.9g} {z:.9g})" for x, y, z in inside_mm * 1e-3)
    at_wall = "value nonuniform List<vector> 1((0.002 0 0.007));"
    write(tmp_path / "0" / "C", f"nonuniform List<vector> {len(inside_mm)}({rows})", wall=at_wall, inlet=at_wall)
    corners_mm = np.array([[-1.0, -1, 7], [1, -1, 7], [1, 1, 7], [-1, 1, 7]])
    neck = Surface(corners_mm, np.array([[0, 1, 2], [0, 2, 3]]))
    case = vessel_case(tube(), target=Target(neck, neck))
    across = bridge(case, domain.build(case.vessel, 0.2), tmp_path)
    speed_m_s = np.r_[0.1 * np.cos(2 * np.pi * inside_mm[:, 0] / 0.23 + 0.4), np.zeros(2)]
    through = sampling.through_mL_s(across.to_ostium @ speed_m_s[:, None] * [0, 0, 1], across.ostium_area_mm2)
    assert sampling.inflow_mL_s(through) == pytest.approx(0.1 * neck.area_mm2 / np.pi, rel=0.02)


@pytest.mark.parametrize(
    ("said", "code", "words"),
    [
        ("Time = 3\n#0 Foam::sigFpe::sigHandler\nCourant Number mean: 2 max: 345.6\n", 136, "time step is too long"),
        ("Time = 3\n\nsigFpe\n", 136, "at 3: a cell of the mesh is too flat, or there is strong backflow"),
        ("Time = 3s\n\nsigFpe\n", 136, "at 3: a cell"),
        ("--> FOAM FATAL ERROR: \nno such\nfield\n\n    From function x\n", 1, "no such field"),
        ("", -9, "memory was not sufficient"),
    ],
)
def test_a_failure_is_put_into_words(said: str, code: int, words: str) -> None:
    assert words in program.cause(said, code)


def test_the_release_is_no_part_of_the_reason() -> None:
    said = "--> FOAM FATAL ERROR: (openfoam-2406 patch=241206)\nno such field\n\n    From void Foam::f()\n"
    assert program.cause(said, 1) == "no such field"


@pytest.mark.parametrize(
    ("installed", "found"),
    [
        ({"openfoam9": "surfaceFeatures", "openfoam11": "foamRun", "openfoam13": "foamRun"}, ("org", "openfoam13")),
        ({"openfoam-dev": "foamRun", "openfoam10": "surfaceFeatures"}, ("org", "openfoam-dev")),
        ({"openfoam2312": "surfaceFeatureExtract", "openfoam2406": "surfaceFeatureExtract"}, ("com", "openfoam2406")),
        ({"openfoam9": "surfaceFeatures"}, None),
    ],
)
def test_the_newest_release_is_found_and_one_too_old_is_not(
    installed: dict[str, str], found: tuple[Flavour, str] | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, tool in installed.items():
        place = tmp_path / name / "platforms" / "linux64GccDPInt32Opt" / "bin"
        place.mkdir(parents=True)
        (place / tool).touch(0o755)
        (tmp_path / name / "etc").mkdir()
        (tmp_path / name / "etc" / "bashrc").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(program, "INSTALLED", (str(tmp_path / "openfoam*"),))
    if found is None:
        with pytest.raises(FlowError, match="was not found"):
            program.find()
    else:
        assert program.find() == program.Program(found[0], tmp_path / found[1] / "etc" / "bashrc")


def test_without_openfoam_its_install_command_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(program, "INSTALLED", ())
    with pytest.raises(FlowError, match="apt-get install openfoam"):
        run(OpenFoam(0.3, tmp_path / "case"), vessel_case(tube(), FlowSettings(inflow_mL_s=1.0)))
    assert not (tmp_path / "case").exists()


def test_a_screen_is_refused() -> None:
    one = np.ones(1)
    screen = Sheet(np.zeros((1, 3)), np.ones((1, 3)), one, one, one, one, one, one)
    with pytest.raises(FlowError, match="struts"):
        OpenFoam(0.3, Path("nowhere")).init(vessel_case(tube(), media=(screen,)), None)


RADIUS_MM, LENGTH_MM, FLOW_ML_S = 2.0, 14.0, 3.0


def tube() -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=LENGTH_MM, radius_mm=RADIUS_MM))))


@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
def test_openfoams_flow_follows_resistances(tmp_path: Path) -> None:
    """Resistances as small as those of the vessel: the flow is far from the shares that it begins with."""
    straight = phantoms.tube(length_mm=14.0, radius_mm=2.0)
    phantom = phantoms.with_branch(straight, abscissa_mm=6.0, direction=[1, 0, 1], radius_mm=1.2, length_mm=7.0)
    case = vessel_case(trace(Vessel(phantoms.phantom_surface(phantom))), FlowSettings(inflow_mL_s=1.0))
    ends = tuple(Resistance(0.5, 100.0, resistance_Pa_s_mL=whole) for whole in (100.0, 200.0))
    case = replace(case, ends=(case.ends[0], *ends))
    field = run(OpenFoam(0.5, tmp_path / "case"), case)
    assert field.is_converged
    flow_mL_s, common_Pa = outflows(ends, np.ones(1), field.outlet_pressure_Pa[None])
    assert field.outlets_mL_s == pytest.approx(flow_mL_s[0], abs=1e-3)
    assert field.common_pressure_Pa == pytest.approx(common_Pa[0])
    assert field.outlets_mL_s[1] < 0.31  # less than a third: its arm resists too


@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
def test_openfoams_flow_in_a_tube_is_poiseuilles(tmp_path: Path) -> None:
    engine = OpenFoam(0.3, tmp_path / "case")
    case = vessel_case(tube(), FlowSettings(inflow_mL_s=FLOW_ML_S))
    field = run(engine, case)
    assert field.is_converged
    assert field.inflow_mL_s == pytest.approx(FLOW_ML_S, rel=1e-4)
    assert field.outlets_mL_s.sum() == pytest.approx(field.inflow_mL_s, rel=1e-3)
    along = np.sign(field.velocity_m_s[:, 2].mean())
    pressure = sampling.values_at(field, np.array([[0, 0, 4.0], [0, 0, 10.0]]))[1]
    gradient = 8 * 0.004 * FLOW_ML_S * 1e-6 / (np.pi * (RADIUS_MM * 1e-3) ** 4)
    assert -along * np.diff(pressure)[0] / 6e-3 == pytest.approx(gradient, rel=0.02)
    z = field.wall.vertices_mm[:, 2]
    stress = along * field.wall_shear_stress_Pa[(z > 5) & (z < 9), 2]
    expected = 4 * 0.004 * FLOW_ML_S * 1e-6 / (np.pi * (RADIUS_MM * 1e-3) ** 3)
    assert stress.mean() == pytest.approx(expected, rel=0.02)
    assert np.abs(stress / expected - 1).max() < 0.05
    # The same case goes on from the last time written: nothing is left to do.
    assert run(engine, case).steps <= field.steps / 2


@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
def test_struts_over_an_ostium_are_meshed_in_as_many_cells_as_told_and_hold_blood_up(tmp_path: Path) -> None:
    """No sac is needed; the wires are five times as thick as a strut, so that few cells do, and run into each other."""
    trunk = phantoms.tube(length_mm=18.0, radius_mm=1.6)
    side = {"abscissa_mm": 9.0, "direction": np.array([1.0, 0, 1]), "radius_mm": 0.9, "length_mm": 5.0}
    anatomy = restore(trace(Vessel(phantoms.phantom_surface(phantoms.with_branch(trunk, **side), edge_mm=0.3))))
    stent = deploy(find_design("enterprise"), anatomy).stent
    thick = replace(
        stent,
        design=replace(stent.design, strut_thickness_um=400.0),
        wire_diameter_um=np.full_like(stent.wire_diameter_um, 400.0),
    )
    branch_mL_s = []
    for name, devices in (("bare", ()), ("thick", (thick,))):
        case = flow_case(anatomy, devices, FlowSettings(inflow_mL_s=FLOW_ML_S, numerics=Numerics(tolerance=0.02)))
        engine = OpenFoam(0.35, tmp_path / name, layers=0)
        field = run(engine, case)
        assert field.outlets_mL_s.sum() == pytest.approx(FLOW_ML_S, rel=1e-3)
        branch_mL_s.append(field.outlets_mL_s[1])
        told = [float(number.replace(",", "")) for number in re.findall(r"([\d,]+) thousand", engine.cost(case))]
        meshed = float(re.findall(r"on (\d+) cells", field.advice)[0]) / 1e3
        assert len(told) == 1 + (name == "thick")
        assert meshed == pytest.approx(sum(told), rel=0.4)
    assert branch_mL_s[1] < 0.9 * branch_mL_s[0]


@pytest.mark.validation
@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
def test_openfoams_flow_from_two_inlets_is_the_embedded_engines(tmp_path: Path) -> None:
    fork = phantoms.bifurcation()
    legs_mm = np.array([fork.ends[k][0] for k in (1, 2)])
    vessel = trace(Vessel(phantoms.phantom_surface(fork, edge_mm=0.3)), inlet_mm=legs_mm)
    case = vessel_case(vessel, FlowSettings(inflow_mL_s=FLOW_ML_S, numerics=Numerics(cell_size_mm=0.2)))
    foam, own = run(OpenFoam(0.25, tmp_path / "case"), case), simulate_case(case)
    assert foam.is_converged
    np.testing.assert_allclose(foam.inlets_mL_s, case.inlets_mL_s, rtol=1e-4)
    assert foam.outlets_mL_s.sum() == pytest.approx(foam.inflow_mL_s, rel=1e-4)
    for found, expected in zip(foam.inlet_pressure_Pa, own.inlet_pressure_Pa, strict=True):
        assert found == pytest.approx(expected, rel=0.05)
    near = np.abs(own.centers_mm[:, 2] - 10.0) < 6.0
    velocity = sampling.values_at(foam, own.centers_mm[near])[0]
    apart = np.linalg.norm(velocity - own.velocity_m_s[near]) / np.linalg.norm(own.velocity_m_s[near])
    assert apart < 0.08


def test_of_a_flow_that_does_not_settle_neck_inflow_and_magnitudes_are_the_mean_of_its_checks(tmp_path: Path) -> None:
    case = vessel_case(tube(), FlowSettings(inflow_mL_s=FLOW_ML_S))
    grid = domain.build(case.vessel, 0.5)
    n, v = len(grid.cells), len(case.vessel.lumen.vertices_mm)
    velocity_m_s, stress_Pa = np.zeros((n, 3)), np.zeros((v, 3))
    velocity_m_s[0], stress_Pa[1] = (3, 4, 0), (0, 0, 2)
    one = Snapshot("50", velocity_m_s, np.zeros(n), stress_Pa, np.zeros(v), np.zeros(2), 1.0)
    # A flow that oscillates from check to check reports the size of its oscillation.
    other = replace(one, velocity_m_s=-velocity_m_s, wall_shear_stress_Pa=-stress_Pa, neck_inflow_mL_s=2.0)
    unused = cast("Any", SimpleNamespace(n_cells=n))
    state = State(
        case,
        FoamSetup(0.5),
        unused,
        "simpleFoam",
        tmp_path,
        grid,
        unused,
        np.arange(n, dtype=np.int32),
        deque([one, other]),
    )
    field = OpenFoam(0.5, tmp_path).result(state, Outcome(False, (0.5,), 1.0, 1.0))
    assert field.neck_inflow_mL_s == 1.5
    assert field.speed_m_s.tolist() == [5.0, *np.zeros(n - 1)]
    assert field.shear_Pa.tolist() == [0.0, 2.0, *np.zeros(v - 2)]
    assert not field.velocity_m_s.any()


@pytest.mark.skipif(shutil.which("pimpleFoam") is None, reason="OpenFOAM is not installed (apt-get install openfoam)")
def test_a_pulse_that_openfoam_stopped_in_goes_on_in_the_same_cycle(tmp_path: Path) -> None:
    """It was stopped in the second of two cycles: that one is completed, and compared with the first."""
    engine, pulse = OpenFoam(0.6, tmp_path / "case", layers=0, grid_size_mm=0.4), Waveform(0.4, (0.5,), (0.0,))
    case = vessel_case(tube(), FlowSettings(inflow_mL_s=FLOW_ML_S, waveform=pulse, numerics=Numerics(max_cycles=2)))
    checks = []

    def stopping(progress: Progress) -> None:
        checks.append(progress.fraction)
        if len(checks) == PHASES + 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(engine, case, progress=stopping)
    field = run(engine, case)
    assert len(field.residual) == PHASES - 3
    assert f"Cycle 2 differs from the previous one by {100 * field.residual[-1]:.1f} %" in field.advice
    assert field.residual[-1] < 0.05
    time_s = np.array([phase.time_s for phase in field.phases])
    np.testing.assert_allclose(time_s, 0.4 * np.arange(1, PHASES + 1) / PHASES)
    inflow_mL_s = np.array([phase.inflow_mL_s for phase in field.phases])
    np.testing.assert_allclose(inflow_mL_s, FLOW_ML_S * pulse.factor(time_s), rtol=0.02)
    inlet = case.vessel.inlet
    beside = (inlet.center_mm - field.centers_mm) @ inlet.normal < 0.3  # where the inlet's own faces are read
    speed_m_s = np.array([phase.velocity_m_s[-1][beside].mean(axis=0) @ -inlet.normal for phase in field.phases])
    np.testing.assert_allclose(speed_m_s / inflow_mL_s, (speed_m_s / inflow_mL_s).mean(), rtol=0.02)
