"""`vstent export`: what other solvers get, as a user asks for it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from foam_dictionary import parse
from shapes import sphere

from vstent import phantoms
from vstent.cli import main
from vstent.devices.treatment import read_treatment, with_device
from vstent.geometry.surface import Surface
from vstent.io.surfaces import read_surface
from vstent.io.vtk_reader import read_mesh
from vstent.io.writers import write_stl
from vstent.study.folder import CACHE
from vstent.study.pipeline import run
from vstent.study.settings import InputSettings, Settings


@pytest.fixture(scope="module")
def artery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("input") / "artery.stl"
    write_stl(path, phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.35))
    return path


@pytest.fixture(scope="module")
def studied(artery: Path) -> Path:
    out = artery.parent / "case"
    placed = with_device("enterprise", center_mm=26.0)
    run(
        artery,
        out,
        Settings(InputSettings(units="mm"), treatments=(placed, read_treatment("Y = enterprise@1")), flow=None),
        lambda *_: None,
    )
    return out


def test_where_a_device_lies_is_not_guessed(studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(studied, tmp_path / "case")
    (tmp_path / "case" / "run.json").write_text("{")
    words = ["export", "openfoam", str(tmp_path / "case"), "--device", "enterprise", "--out", str(tmp_path / "foam")]
    assert main(words) == 2
    assert "run the case again" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "foam").exists()


def test_a_case_of_an_older_version_is_refused_and_nothing_of_it_is_touched(
    studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = shutil.copytree(studied, tmp_path / "old")
    run_record = json.loads((old / "run.json").read_text()) | {"layout": -1}
    (old / "run.json").write_text(json.dumps(run_record))
    before = {file: file.read_bytes() for file in old.rglob("*") if file.is_file()}
    assert main(["export", "patches", str(old), "--out", str(tmp_path / "patches")]) == 2
    assert "an older version of vstent. Run its study again into another folder" in " ".join(
        capsys.readouterr().err.split()
    )
    assert {file: file.read_bytes() for file in old.rglob("*") if file.is_file()} == before
    assert not (tmp_path / "patches").exists()


def test_the_vessel_exported_is_that_of_the_run(
    studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = shutil.copytree(studied, tmp_path / "case")
    (stored,) = (case / CACHE).glob("anatomy-*.npz")
    for key in (12 * "0", 12 * "f"):
        stored.with_name(f"anatomy-{key}-{key}.npz").write_text("another")
    assert main(["export", "patches", str(case), "--out", str(tmp_path / "patches")]) == 0
    stored.unlink()
    assert main(["export", "patches", str(case), "--out", str(tmp_path / "other")]) == 2
    assert "does not hold the artery of its run" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "other").exists()


def test_patches_of_a_studied_case_are_watertight(studied: Path, tmp_path: Path) -> None:
    out = tmp_path / "patches"
    assert main(["export", "patches", str(studied), "--out", str(out)]) == 0
    said = {one["name"]: one for one in json.loads((out / "patches.json").read_text())["patches"]}
    assert list(said) == ["wall", "sac", "inlet", "outlet_1", "outlet_2"]
    openings = json.loads((studied / "openings.json").read_text())["openings"]
    for opening in openings:
        assert said[opening["role"]]["area_mm2"] == pytest.approx(opening["area_mm2"], rel=0.01)
        assert np.dot(said[opening["role"]]["normal"], opening["normal"]) > 0.999
    whole, _ = read_surface(out / "patches.stl", units="mm")
    assert whole.boundary_loops == ()
    assert whole.area_mm2 == pytest.approx(sum(one["area_mm2"] for one in said.values()), rel=1e-4)
    sac, _ = read_surface(studied / "sac.vtp", units="mm")
    assert said["sac"]["area_mm2"] < sac.area_mm2  # without its neck
    neck = Surface(*read_mesh(out / "neck.stl")[:2])
    assert said["sac"]["area_mm2"] + neck.area_mm2 == pytest.approx(sac.area_mm2, rel=0.02)


def test_an_openfoam_case_of_a_studied_case_has_its_device_over_the_neck(studied: Path, tmp_path: Path) -> None:
    out = tmp_path / "foam"
    options = ["--device", "enterprise", "--grid-spacing", "0.2", "--flow-rate", "2.5", "-j", "2", "--flavour", "com"]
    assert main(["export", "openfoam", str(studied), "--out", str(out), *options]) == 0
    assert (out / "Allrun").stat().st_mode & 0o111
    assert "mpirun -np 2 simpleFoam -parallel" in (out / "Allrun").read_text()
    assert "--ntasks=2" in (out / "submit.slurm").read_text()
    assert not (out / ".vstent").exists()
    geometry = parse((out / "system" / "snappyHexMeshDict").read_text())["geometry"]
    assert set(geometry) == {"lumen", "neck", "struts", "before_outlet_2"}  # the branch is narrow
    whole = Surface(*read_mesh(studied / "treatments" / "enterprise" / "implants" / "enterprise" / "struts.stl")[:2])
    near = Surface(*read_mesh(out / "constant" / "triSurface" / "struts.stl")[:2])
    assert 0.2 < near.area_mm2 * 1e6 / whole.area_mm2 < 0.5
    assert whole.closest(near.vertices_mm * 1e3)[1].max() < 0.01  # the last section before a cut turns a little
    lumen, _ = read_surface(out / "constant" / "triSurface" / "lumen.stl", units="m")
    assert lumen.boundary_loops == ()
    mean = (out / "constant" / "boundaryData" / "inlet" / "0" / "U").read_text().splitlines()[-1]
    inlet = json.loads((studied / "openings.json").read_text())["openings"][0]
    flow_m3_s = -np.dot([float(x) for x in mean.strip("()").split()], inlet["normal"]) * inlet["area_mm2"] * 1e-6
    assert flow_m3_s == pytest.approx(2.5e-6, rel=0.01)


def test_a_treatment_of_the_case_is_exported_by_its_name_alone(studied: Path, tmp_path: Path) -> None:
    out, same = tmp_path / "foam", tmp_path / "same"
    assert main(["export", "openfoam", str(studied), "--out", str(out), "--treatment", "Y"]) == 0
    assert main(["export", "openfoam", str(studied), "--out", str(same), "--treatment", "enterprise@1"]) == 0
    name = Path("constant") / "triSurface" / "struts.stl"
    assert (out / name).read_text() == (same / name).read_text()


@pytest.mark.parametrize("what", ["openfoam", "patches"])
def test_a_studied_vessel_is_not_found_otherwise(
    what: str, studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--upstream", "9", "--downstream", "9", "--frame", "ras", "--acquisition", "2", "--units", "mm"]
    words += ["--crop", "0,0,0,9,9,9", "--spacing", "0.2", "--shape", "9,9,9", "--threshold", "5"]
    words += ["--at", "1,2,3", "--inlet", "1,2,3", "--outlet", "1,2,3"]
    assert main(["export", what, str(studied), "--out", str(tmp_path / "out"), *words]) == 2
    named = " ".join(capsys.readouterr().err.split()).split("leave out ")[1].split(", ")
    assert sorted(named) == sorted(word for word in words if word.startswith("--"))
    assert not (tmp_path / "out").exists()


def test_a_size_that_is_given_is_not_that_of_the_case(
    studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--treatment", "enterprise 9x9"]
    assert main(["export", "openfoam", str(studied), "--out", str(tmp_path / "out"), *words]) == 2
    assert "Enterprise is not made in 9 mm x 9 mm" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_openfoam_case_holds_one_treatment(
    studied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--device", "silk", "--device", "enterprise"]
    assert main(["export", "openfoam", str(studied), "--out", str(tmp_path / "out"), *words]) == 2
    assert "give one --device or --treatment" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--layers", "-3"], "give at least 0"),
        (["--engine", "nonsense"], "unrecognized"),
        (["--refine", "sac"], "unrecognized"),
        (["--gpu"], "unrecognized"),
    ],
)
def test_options_that_openfoams_case_has_no_use_for_are_refused(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["export", "openfoam", "artery.stl", "--out", "out", *words])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err


def test_bad_input_leaves_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stl(tmp_path / "sphere.stl", sphere(3.0))
    for what in ("openfoam", "patches"):
        command = ["export", what, str(tmp_path / "sphere.stl"), "--out", str(tmp_path / "out"), "--units", "mm"]
        assert main(command) == 2
        assert "openings" in capsys.readouterr().err
        assert main(["export", what, str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
        assert "does not exist" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
