"""`vstent flow` as a user meets it, in a vessel without a sac."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

from vstent import phantoms
from vstent.cli import main, options
from vstent.errors import FlowError
from vstent.flow.case import FlowCase
from vstent.flow.openfoam.engine import OpenFoam
from vstent.flow.settings import Blood, CarreauYasuda
from vstent.io.writers import write_stl

RADIUS_MM, LENGTH_MM, INFLOW_ML_S = 2.0, 16.0, 0.8
STRESS_PA = 4 * 0.004 * INFLOW_ML_S * 1e-6 / (np.pi * (RADIUS_MM * 1e-3) ** 3)


def test_flow_alone_in_a_tube_is_poiseuilles_and_is_not_computed_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_stl(tmp_path / "tube.stl", phantoms.phantom_surface(phantoms.tube(length_mm=LENGTH_MM, radius_mm=RADIUS_MM)))
    out = tmp_path / "out"
    command = ["flow", str(tmp_path / "tube.stl"), "--out", str(out), "--units", "mm", "--steady"]
    command += ["--flow-rate", str(INFLOW_ML_S), "--grid-spacing", "0.25"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert "Inlet flow" in said.out
    assert "Grid spacing 0.25 mm (" in said.err
    assert sorted(file.name for file in (out / "treatments" / "bare" / "flow").iterdir()) == ["field.vtu", "wall.vtp"]
    bare = json.loads((out / "metrics.json").read_text())["treatments"]["bare"]["flow"]
    assert bare["inlet_flow_mL_s"] == pytest.approx(INFLOW_ML_S, rel=5e-3)
    assert bare["outlet_1_flow_mL_s"] == pytest.approx(bare["inlet_flow_mL_s"], rel=1e-3)
    assert bare["pressure_drop_Pa"] == pytest.approx(2 * LENGTH_MM / RADIUS_MM * STRESS_PA, rel=0.05)
    points, stress = _wall(out / "treatments" / "bare" / "flow" / "wall.vtp")
    middle = np.abs(points[:, 2] - LENGTH_MM / 2) < 4
    along = np.sign(stress[middle, 2].mean())
    np.testing.assert_allclose(along * stress[middle].mean(axis=0), [0, 0, STRESS_PA], atol=0.03 * STRESS_PA)
    assert main(command) == 0
    assert "already done" in capsys.readouterr().err


def test_openfoam_gets_the_vessel_after_its_cost_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def refused(engine: OpenFoam, case: FlowCase, start: object) -> None:
        asked.append((engine.folder, case.solids))
        raise FlowError("It is not here")

    monkeypatch.setattr(OpenFoam, "init", refused)
    monkeypatch.setattr("vstent.flow.openfoam.program.find", lambda: None)  # as if it were installed
    write_stl(tmp_path / "tube.stl", phantoms.phantom_surface(phantoms.tube(length_mm=LENGTH_MM, radius_mm=RADIUS_MM)))
    command = ["flow", str(tmp_path / "tube.stl"), "--out", str(tmp_path / "out"), "--engine", "openfoam"]
    assert main([*command, "--units", "mm"]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert 0 < told.index("OpenFOAM: about") < told.index("It is not here")
    assert asked == [(tmp_path / "out" / "treatments" / "bare" / "flow" / "openfoam", ())]
    assert main([*command, "--units", "mm", "--convergence", "--grid-spacing", "0.25"]) == 1
    assert "It is not here" in capsys.readouterr().err
    assert asked[1] == (tmp_path / "out" / "convergence" / "openfoam" / "cell_size_mm-0.5", ())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], Blood()),
        (["--viscosity", "0.0035", "--density", "1050"], Blood(1050.0, 0.0035)),
        (["--shear-thinning"], Blood(1060.0, 0.00345, CarreauYasuda())),
        (["--shear-thinning", "--viscosity", "0.004"], Blood(1060.0, 0.004, CarreauYasuda())),
    ],
)
def test_the_blood_asked_for_is_the_blood_computed(words: list[str], expected: Blood) -> None:
    parser = argparse.ArgumentParser()
    options.add_settings(parser, "flow")
    assert options.given_settings(parser.parse_args(words)).flow.blood == expected


@pytest.mark.parametrize("words", [["--steady", "--pulsatile"], ["--pulsatile", "--steady"]])
def test_what_excludes_each_other_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["flow", "tube.stl", "--out", "out", *words])
    assert stopped.value.code == 2
    assert "not allowed with" in capsys.readouterr().err


def test_flows_on_several_grids_are_those_without_a_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flow", "tube.stl", "--out", "out", "--convergence", "--device", "silk"]) == 2
    assert "--convergence compares flows without a device" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "flow"])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--engine", "nonsense"], "There is no 'nonsense'"),
        (["--engine", "openfoam", "--refine", "sac"], "does not support a finer grid"),
        (["--engine", "openfoam", "--wires", "calibrated"], "leave out --wires calibrated"),
        (["--engine", "openfoam", "--gpu"], "does not support a GPU"),
    ],
)
def test_an_engine_is_refused_before_anything_is_read(
    command: str, words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(tmp_path / "none.stl"), "--out", str(tmp_path / "out"), *words]) == 2
    assert said in capsys.readouterr().err


def _wall(path: Path) -> tuple[np.ndarray, np.ndarray]:
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput()
    stress = data.GetPointData().GetArray("wall_shear_stress_Pa")
    return vtk_to_numpy(data.GetPoints().GetData()), vtk_to_numpy(stress)
