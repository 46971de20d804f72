"""The command line as a user meets it: help, errors, exit codes, resume."""

import argparse
import io
import json
import subprocess
import sys
import zipfile
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import tubes
from shapes import sphere
from vessel_truth import read_centerlines

from vstent import phantoms
from vstent.cli import main, rank, run as cli_run
from vstent.errors import InputError
from vstent.flow.settings import FlowSettings
from vstent.geometry.surface import Surface
from vstent.io.surfaces import read_surface
from vstent.io.writers import write_stl
from vstent.study.folder import CACHE
from vstent.study.stages import check_inflow


@pytest.fixture(scope="module")
def artery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A curved artery with a sac, as an STL file."""
    path = tmp_path_factory.mktemp("input") / "ärtery with space.stl"
    write_stl(path, phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.35))
    return path


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from vstent.cli import main\n"
        "try: main(['run', '--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'numba', 'vtkmodules', 'scipy', 'rich'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "Research use only" in done.stdout


BAD = {
    "a text file named .stl": ("text.stl", b"hello\n", [], "not a .stl"),
    "an empty mesh": ("empty.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", [], "holds no surface"),
    "a volume without spacing": ("scan.raw", bytes(4096), ["--shape", "16,16,16"], "spacing"),
    "a volume without shape": ("scan.raw", bytes(4096), ["--spacing", "0.4"], "shape"),
    "a volume of zeros": ("scan.raw", bytes(4096), ["--shape", "16,16,16", "--spacing", "0.4"], "lumen"),
    "a waveform of one column": ("pulse.csv", b"0\n1\n", ["--pulsatile", "FILE"], "line 1"),
    "a pulse that runs back": ("pulse.csv", b"0,1\n2,1\n1,1\n3,1\n4,1", ["--pulsatile", "FILE"], "do not increase"),
    "a pulse in milliseconds": (
        "pulse.csv",
        b"ms,flow\n0,1\n200,3\n400,2\n600,1.5\n800,1.2\n1000,1\n",
        ["--pulsatile", "FILE"],
        "with times in seconds",
    ),
    "a device that does not exist": ("text.stl", b"hello\n", ["--device", "slik"], "silk"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_ends_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, content, options, said = BAD[name]
    (tmp_path / file).write_bytes(content)
    out = tmp_path / "out"
    given = [option.replace("FILE", str(tmp_path / file)) for option in options]
    assert main(["run", str(tmp_path / file), "--out", str(out), *given]) == 2
    assert _complaint(capsys, said)
    assert not out.exists()


@pytest.mark.parametrize("command", ["trace", "restore"])
@pytest.mark.parametrize("name", [name for name, bad in BAD.items() if not {"--device", "--pulsatile"} & set(bad[2])])
def test_the_parts_refuse_bad_input_as_the_whole_does(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, content, options, said = BAD[name]
    (tmp_path / file).write_bytes(content)
    assert main([command, str(tmp_path / file), "--out", str(tmp_path / "out"), *options]) == 2
    assert _complaint(capsys, said)
    assert main([command, str(tmp_path / "none.stl"), "--out", str(tmp_path / "out")]) == 2
    assert _complaint(capsys, "does not exist")
    assert not (tmp_path / "out").exists()


def test_trace_writes_wall_openings_and_centerlines(
    artery: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the output is redirected on a system without the letters of its tables."""
    printed = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(printed, encoding="cp932", write_through=True))
    out, phantom = tmp_path / "out", phantoms.demo_phantom()
    assert main(["trace", str(artery), "--out", str(out), "--units", "mm"]) == 0
    assert b" mm? " in printed.getvalue()
    assert sorted(file.name for file in out.iterdir()) == [CACHE, "centerlines.vtp", "openings.json", "vessel.vtp"]
    openings = json.loads((out / "openings.json").read_text())["openings"]
    assert [o["role"] for o in openings] == ["inlet", "outlet_1", "outlet_2"]
    for opening in openings:
        center, normal, radius = min(phantom.ends, key=lambda end: np.linalg.norm(end[0] - opening["center_mm"]))
        np.testing.assert_allclose(opening["center_mm"], center, atol=0.05)
        assert np.dot(opening["normal"], normal) > 0.999
        assert opening["diameter_mm"] == pytest.approx(2 * radius, rel=0.02)
        assert opening["area_mm2"] == pytest.approx(np.pi * radius**2, rel=0.04)
    lines = read_centerlines(out / "centerlines.vtp")
    assert len(lines) == 2
    wall, _ = read_surface(out / "vessel.vtp", units="mm")
    for line, opening in zip(lines, openings[1:], strict=True):
        np.testing.assert_allclose(line.points_mm[[0, -1]], [o["center_mm"] for o in (openings[0], opening)], atol=1e-3)
        np.testing.assert_allclose(line.inscribed_radius_mm, wall.inscribed_radius(line.points_mm), atol=1e-4)


def test_restore_writes_the_parent_artery_and_a_study_goes_on_from_it(
    artery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, phantom = tmp_path / "out", phantoms.demo_phantom()
    assert main(["restore", str(artery), "--out", str(out), "--units", "mm"]) == 0
    assert "Sac volume" in capsys.readouterr().out
    found = json.loads((out / "morphology.json").read_text())
    sac, _ = read_surface(out / "sac.vtp", units="mm")
    assert found["sac_volume_mm3"] == pytest.approx(abs(sac.volume_mm3), rel=1e-4)
    assert found["sac_volume_mm3"] == pytest.approx(phantom.sac_volume_mm3, rel=0.05)
    landing, _ = read_surface(out / "landing_surface.vtp", units="mm")
    assert landing.closest(phantom.sac.center_mm[None] + 3.0 * phantom.sac.direction)[1] > 5.0  # the dome is gone
    written = {file.name: file.read_bytes() for file in out.glob("*.vtp")}
    command = ["run", str(artery), "--out", str(out), "--units", "mm", "--device", "leo", "--no-flow"]
    assert main(command) == 0
    assert "already done" in capsys.readouterr().err
    assert json.loads((out / "metrics.json").read_text())["vessel"] == found
    assert {name: (out / name).read_bytes() for name in written} == written


def test_without_a_sac_restore_says_so_and_leaves_none_of_another_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "sac.vtp").write_text("of another case")
    write_stl(tmp_path / "healthy.stl", phantoms.phantom_surface(phantoms.siphon(), edge_mm=0.4))
    assert main(["restore", str(tmp_path / "healthy.stl"), "--out", str(out), "--units", "mm"]) == 0
    assert "No sac was found" in capsys.readouterr().err
    names = {file.name for file in out.iterdir() if file.is_file()}
    assert names == {"centerlines.vtp", "landing_surface.vtp", "morphology.json", "openings.json", "vessel.vtp"}
    assert "sac_volume_mm3" not in json.loads((out / "morphology.json").read_text())


def test_without_a_sac_no_device_is_deployed_unless_it_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_stl(tmp_path / "healthy.stl", phantoms.phantom_surface(phantoms.siphon(), edge_mm=0.4))
    given = [str(tmp_path / "healthy.stl"), "--units", "mm", "--device", "silk", "--out"]
    for command in (["run", *given, str(tmp_path / "case"), "--no-flow"], ["rank", *given, str(tmp_path / "ranked")]):
        assert main(command) == 2
        assert _complaint(capsys, "No aneurysm was found, so no size or place of a device is proposed.")
    assert not (tmp_path / "case").exists()
    assert main(["run", *given, str(tmp_path / "placed"), "--no-flow", "--center", "20"]) == 0
    assert main(["run", *given, str(tmp_path / "anyway"), "--no-flow", "--no-aneurysm"]) == 0


@pytest.mark.parametrize("name", ["scan.zip", "scan"])
def test_an_archive_is_to_be_unpacked(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.writestr("Patient/SE1/slice-1.dcm", b"no slice")
    assert main(["run", str(tmp_path / name), "--out", str(tmp_path / "out"), "--no-flow"]) == 2
    assert _complaint(capsys, f"{name} is an archive. Unpack it, and give the folder or the file that it holds.")


def _complaint(capsys: pytest.CaptureFixture[str], said: str) -> bool:
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("vstent: ")]
    (line,) = [line for line in lines if "compiling its numerical loops" not in line]
    return said in line


def test_a_missing_file_and_a_closed_sphere_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(tmp_path / "no.stl"), "--out", str(tmp_path / "out")]) == 2
    assert _complaint(capsys, "does not exist")
    write_stl(tmp_path / "sphere.stl", sphere(3.0))
    assert main(["run", str(tmp_path / "sphere.stl"), "--out", str(tmp_path / "out"), "--units", "mm"]) == 2
    assert _complaint(capsys, "openings")
    assert not (tmp_path / "out").exists()


def test_a_device_longer_than_the_artery_leaves_nothing_behind(
    artery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = main(
        ["run", str(artery), "--out", str(out), "--device", "silk", "--length", "40", "--diameter", "5", "--no-flow"]
    )
    assert code == 2
    assert _complaint(capsys, "exceeds the artery")
    assert not out.exists()


def test_a_surface_in_metres_gives_the_same_case(artery: Path, tmp_path: Path) -> None:
    surface, _ = read_surface(artery, units="mm")
    in_metres = tmp_path / "metres.stl"
    write_stl(in_metres, Surface(surface.vertices_mm / 1000, surface.faces))
    found = []
    for path, name in ((artery, "mm"), (in_metres, "m")):
        assert main(["restore", str(path), "--out", str(tmp_path / name)]) == 0
        found.append(json.loads((tmp_path / name / "morphology.json").read_text()))
    assert found[0].keys() == found[1].keys()
    for key, value in found[0].items():
        assert found[1][key] == (pytest.approx(value, rel=1e-5) if isinstance(value, float) else value), key


@pytest.mark.parametrize("text", ["1,2", "1,2,x", ""])
def test_points_are_checked(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["run", "scan.nii", "--out", "out", f"--at={text}"])
    assert stopped.value.code == 2
    assert "--at" in capsys.readouterr().err


def test_a_number_may_begin_with_a_minus() -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers()
    for command in (cli_run, rank):
        command.add(commands)
    words = ["--at", "-1.5,-8.0,20", "--inlet", "-.5,0,0", "--outlet", "-1e1,2,3", "--center", "-1e1", "-j", "2"]
    given = parser.parse_args(["run", "scan.nii", "--out", "out", *words])
    assert (given.at, given.inlet, given.outlet) == ((-1.5, -8.0, 20.0), [(-0.5, 0.0, 0.0)], (-10.0, 2.0, 3.0))
    assert (given.center, given.processes) == (-10.0, 2)
    assert parser.parse_args(["rank", "scan.nii", "--out", "out", "--shift", "-2,0,2"]).shift == (-2.0, 0.0, 2.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--viscosity", "4"], "4 mPa s are 0.004"),
        (["--viscosity", "1e-6"], "Pa s"),
        (["--density", "1.06"], "1.06 g/mL are 1060"),
        (["--flow-rate", "240"], "240 mL/min are 4"),
        (["--grid-spacing", "200"], "200 mm is out of range: give 0.002 to 1 mm"),
    ],
)
def test_numbers_in_other_units_are_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["flow", "artery.stl", "--out", "out", *words])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A straight artery with a sac, as an STL file."""
    path = tmp_path_factory.mktemp("input") / "artery.stl"
    phantom = phantoms.with_sac(phantoms.tube(length_mm=28.0), abscissa_mm=14.0, width_mm=5.0, neck_mm=3.6)
    write_stl(path, phantoms.phantom_surface(phantom, edge_mm=0.8))
    return path


@pytest.mark.parametrize(
    "command", [["run", "--device", "silk"], ["flow"], ["flow", "--convergence"], ["export", "openfoam"]]
)
def test_an_inflow_in_other_units_is_refused_before_anything_is_written(
    command: list[str], straight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main([*command, str(straight), "--out", str(out), "--units", "mm", "--flow-rate", "40"]) == 2
    assert _complaint(capsys, "240 mL/min are 4")
    assert not out.exists()


def test_inflows_of_arteries_are_taken() -> None:
    anatomy = tubes.with_neck(tubes.tube(tubes.line(20.0), 2.0), 8.0, 12.0)
    area_mm2 = anatomy.vessel.inlet.area_mm2
    for speed_m_s in (0.011, 0.27, 1.99):
        check_inflow(anatomy, FlowSettings(inflow_mL_s=speed_m_s * area_mm2))
    for speed_m_s in (0.009, 2.01):
        with pytest.raises(InputError, match=f"{speed_m_s:.2g} m/s"):
            check_inflow(anatomy, FlowSettings(inflow_mL_s=speed_m_s * area_mm2))


def test_two_inlets_that_leave_one_narrow_outlet_are_refused() -> None:
    anatomy = tubes.with_neck(tubes.tube(tubes.line(20.0), 2.0), 8.0, 12.0)
    inlet, outlet = anatomy.vessel.openings
    for area_mm2, is_refused in ((4.0, False), (3.0, True)):  # 0.27 m/s through two inlets of 12.6 mm2 are 6.8 mL/s
        openings = inlet, replace(inlet, role="inlet_2"), replace(outlet, area_mm2=area_mm2)
        vessel = replace(anatomy.vessel, openings=openings, centerlines=anatomy.vessel.centerlines * 2)
        with (
            pytest.raises(InputError, match="check whether each of them brings blood") if is_refused else nullcontext()
        ):
            check_inflow(replace(anatomy, vessel=vessel), FlowSettings())


@pytest.mark.parametrize("option", ["--inlet", "--outlet"])
def test_a_point_far_from_every_opening_is_refused(
    option: str, artery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["restore", str(artery), "--out", str(tmp_path / "out"), "--units", "mm", option, "900,1,2"]
    assert main(command) == 2
    assert _complaint(capsys, "no opening of the vessel is near (900.0, 1.0, 2.0) mm")
    assert not (tmp_path / "out").exists()


def test_points_where_the_vessel_was_cut_are_taken_and_what_they_choose_is_told(
    artery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["restore", str(artery), "--units", "mm", "--upstream", "7", "--downstream", "7"]
    assert main([*command, "--out", str(tmp_path / "first")]) == 0
    cut = json.loads((tmp_path / "first" / "openings.json").read_text())["openings"]
    centers = [",".join(map(str, opening["center_mm"])) for opening in cut]
    assert main([*command, "--out", str(tmp_path / "again"), "--inlet", centers[0], "--outlet", centers[1]]) == 0
    assert "mm from the given point" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("port", ["65536", "99999", "-1", "http", "8e3"])
def test_ports_that_do_not_exist_are_refused(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["app", f"--port={port}"])
    assert stopped.value.code == 2
    assert "0 to 65535" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", [["run", "none.json", "--out", "out"], ["rank", "a.stl", "--out", "out", "--criteria", "none.toml"]]
)
def test_files_besides_the_scan_are_told_where_they_are_missing(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command) == 2
    assert _complaint(capsys, "does not exist: check the path")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"vstent {version('vstent')}\n"


@pytest.mark.parametrize(
    ("words", "code", "closed"),
    [
        *(("run none.stl --out out", 2, closed) for closed in ("2>&-", "<&- >&- 2>&-")),
        *(("devices", 0, closed) for closed in ("2>&-", ">&- 2>&-")),
    ],
)
def test_closed_streams_end_in_no_traceback(words: str, code: int, closed: str, tmp_path: Path) -> None:
    command = f"exec {sys.executable} -X dev -m vstent {words} {closed}"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, "")
    assert bool(done.stdout) == (code == 0 and closed == "2>&-")
