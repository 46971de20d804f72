"""What a study writes, and that one stopped in the middle of a flow goes on from there."""

import json
import shutil
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from threading import Event, get_ident
from types import SimpleNamespace

import numpy as np
import pytest
from tubes import line, tube, with_neck

from vstent import phantoms
from vstent.cli import main
from vstent.deployment.deploy import deploy, propose_size
from vstent.devices.catalogue import find_design, find_size
from vstent.devices.design import Size
from vstent.devices.treatment import Implant, with_device
from vstent.errors import DeviceError, InputError, LandingError
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.settings import FlowSettings, Numerics
from vstent.geometry.image import Image
from vstent.geometry.surface import Surface
from vstent.io.dicom_writer import write_dicom
from vstent.io.surfaces import read_surface
from vstent.io.writers import write_stl
from vstent.study import stages
from vstent.study.crate import write_crate
from vstent.study.folder import CACHE, implant_folder
from vstent.study.keys import hash_of, study_keys
from vstent.study.outputs import write_anatomy
from vstent.study.pipeline import restore_vessel, run, trace_vessel
from vstent.study.settings import AnatomySettings, InputSettings, Settings
from vstent.study.stages import deploy_implant, engine_folders, size_of
from vstent.study.store import Key, Store


def test_every_sac_has_its_files_and_those_of_an_earlier_case_go(tmp_path: Path) -> None:
    artery = with_neck(tube(line(40.0), 2.0), 10.0, 14.0)
    (first,) = artery.aneurysms
    (second,) = with_neck(tube(line(40.0), 2.0), 24.0, 29.0).aneurysms
    (tmp_path / "sac_mine.vtp").write_text("a user's own")
    write_anatomy(tmp_path, replace(artery, aneurysms=(first, second)))
    for number, aneurysm in (("", first), ("_2", second)):
        sac, _ = read_surface(tmp_path / f"sac{number}.vtp", units="mm")
        assert sac.area_mm2 == pytest.approx(aneurysm.sac.area_mm2, rel=1e-5)
        assert (tmp_path / f"neck{number}.vtp").stat().st_size > 500
    write_anatomy(tmp_path, artery)
    assert {file.name for file in tmp_path.glob("[sn][ae]c*.vtp")} == {"sac.vtp", "neck.vtp", "sac_mine.vtp"}


def test_a_source_is_all_files_that_its_scan_is_read_from(tmp_path: Path) -> None:
    header, voxels = tmp_path / "scan.mhd", tmp_path / "scan.raw"
    header.write_text("ElementDataFile = scan.raw\n")
    voxels.write_bytes(b"one vessel")
    first = hash_of(header)
    assert first == sha256(header.read_bytes() + b"one vessel").hexdigest()
    voxels.write_bytes(b"a later one")
    assert hash_of(header) != first
    write_dicom(Image(np.arange(5 * 6 * 7, dtype=np.int16).reshape(5, 6, 7), np.eye(4)), tmp_path / "series")
    given, *others = sorted((tmp_path / "series").iterdir())
    whole = hash_of(given)
    (tmp_path / "series" / "notes.txt").write_text("not of the series")
    assert hash_of(given) == hash_of(others[-1]) == whole
    write_dicom(Image(np.zeros((5, 6, 7), dtype=np.int16), np.eye(4)), tmp_path / "other")
    others[2].write_bytes((tmp_path / "other" / others[2].name).read_bytes())
    assert hash_of(given) != whole
    assert hash_of(voxels) == sha256(b"a later one").hexdigest()


@pytest.mark.parametrize(
    ("name", "diameter_mm", "length_mm"), [("pipeline", 3.25, 30.0), ("pipeline", 3.0, 35.0), ("silk", 4.0, 15.0)]
)
def test_of_a_diameter_alone_the_length_is_as_long_as_that_diameter_needs(
    name: str, diameter_mm: float, length_mm: float
) -> None:
    artery, design = with_neck(tube(line(60), 1.75), 24.0, 36.0), find_design(name)
    size = size_of(Implant("one", name, diameter_mm), artery)
    assert (size.diameter_mm, size.length_mm) == (diameter_mm, length_mm)
    margins = {}
    for length in sorted(size.length_mm for size in design.sizes if size.diameter_mm == diameter_mm):
        stent = deploy(design, artery, size=find_size(design, diameter_mm=diameter_mm, length_mm=length)).stent
        margins[length] = min(24 - stent.proximal_abscissa_mm, stent.distal_abscissa_mm - 36)
        if length == length_mm:
            break
    assert margins.pop(length_mm) >= 3.9
    assert all(margin_mm < 4 for margin_mm in margins.values())


def test_of_a_length_alone_the_diameter_is_the_artery_s() -> None:
    artery, silk = with_neck(tube(line(60), 1.75), 28.0, 32.0), find_design("silk")
    found = size_of(Implant("one", "silk", length_mm=25.0), artery)
    assert found == find_size(silk, diameter_mm=3.5, length_mm=25.0)
    assert size_of(Implant("one", "silk"), artery) == propose_size(silk, artery)


def test_a_size_given_whole_is_taken_though_none_could_be_proposed(monkeypatch: pytest.MonkeyPatch) -> None:
    artery, silk = with_neck(tube(line(20), 1.45), 8.0, 12.0), find_design("silk")
    wide = Size(4.0, 8.0, 4.2)
    own = replace(silk, sizes=(Size(3.0, 25.0, 3.2), Size(3.5, 25.0, 3.7), wide))
    monkeypatch.setattr(stages, "find_design", lambda _: own)
    assert deploy_implant(Implant("one", "own", 4.0, 8.0), artery).stent.size == wide
    with pytest.raises(LandingError, match="No size of"):
        size_of(Implant("one", "own"), artery)
    with pytest.raises(DeviceError, match=r"not made in 4\.1 mm"):
        size_of(Implant("one", "own", 4.1), artery)


@pytest.fixture(scope="module")
def arteries(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two patients."""
    folder = tmp_path_factory.mktemp("arteries")
    for name, length_mm in (("first", 24.0), ("second", 26.0)):
        artery = phantoms.with_sac(phantoms.tube(length_mm=length_mm), abscissa_mm=12.0, width_mm=5.0, neck_mm=3.5)
        write_stl(folder / f"{name}.stl", phantoms.phantom_surface(artery, edge_mm=0.9))
    return folder / "first.stl", folder / "second.stl"


@pytest.fixture(scope="module")
def stored(arteries: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Case folders of both in which nothing but their stored vessel and restored artery lies."""
    folders = tuple(tmp_path_factory.mktemp("stored") / path.stem for path in arteries)
    for path, folder in zip(arteries, folders, strict=True):
        restored = tmp_path_factory.mktemp("restored") / "out"
        restore_vessel(path, restored, settings_of(), lambda *_: None)
        shutil.copytree(restored / CACHE, folder / CACHE)
    return folders


RESULTS_OF_ONE = (
    *("report.pdf", "ranking.csv", "treatments/bare/flow/field.vtu", "treatments/leo/flow/wall.vtp"),
    *("treatments/bare/flow/openfoam/vstent.key", "treatments/bare/flow/openfoam/system/controlDict"),
)
OF_THE_USER = (
    *("notes.txt", "treatments/leo/implants/leo/mine.vtp", "treatments/my.stl"),
    "treatments/mine/flow/case/field.vtu",
)


def settings_of(*devices: str, **more: object) -> Settings:
    """Return the settings of a study of a surface in mm, with a treatment for every device and without a flow."""
    return Settings(InputSettings("mm"), treatments=tuple(map(with_device, devices)), **{"flow": None} | more)


def shown(folder: Path) -> set[str]:
    """All files that are not hidden, by their way from the folder."""
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    return {name for name in files if not name.startswith(".")}


@pytest.mark.parametrize("knows", ["input.json", "run.json"])
def test_a_folder_replaced_by_another_patient_s_holds_nothing_of_the_former(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path, knows: str
) -> None:
    first, second = arteries
    out, anew = shutil.copytree(stored[0], tmp_path / "out"), shutil.copytree(stored[1], tmp_path / "anew")
    settings = settings_of("leo")
    run(first, out, settings, lambda *_: None)
    for name in (*RESULTS_OF_ONE, *OF_THE_USER):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("of the first")
    (out / ".vstent" / "flow leo-1234.npz").write_text("kept")
    if knows == "run.json":
        (out / ".vstent" / "input.json").unlink()
    before = {name: (out / name).read_bytes() for name in shown(out)}
    with pytest.raises(InputError):
        run(
            second,
            out,
            replace(settings, treatments=(with_device("leo", length_mm=1e3),)),
            lambda *_: None,
            replaces=True,
        )
    assert {name: (out / name).read_bytes() for name in shown(out)} == before

    again = settings_of("enterprise")
    run(second, out, again, lambda *_: None, replaces=True)
    run(second, anew, again, lambda *_: None, replaces=True)
    assert shown(out) == shown(anew) | set(OF_THE_USER)
    assert (out / "vessel.vtp").read_bytes() == (anew / "vessel.vtp").read_bytes()
    assert (out / ".vstent" / "flow leo-1234.npz").read_text() == "kept"


def test_the_same_patient_keeps_what_was_found_and_another_one_that_replaces_it_does_not(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path
) -> None:
    first, second = arteries
    for folder, name in zip(stored, ("out", "anew"), strict=True):
        shutil.copytree(folder, tmp_path / name)
    moved = tmp_path / "moved.stl"
    moved.write_bytes(first.read_bytes())
    settings = settings_of("leo")
    run(first, tmp_path / "out", settings, lambda *_: None)
    (tmp_path / "out" / "report.pdf").write_text("of the first")
    before = shown(tmp_path / "out")
    restore_vessel(moved, tmp_path / "out", settings, lambda *_: None)
    run(first, tmp_path / "out", settings, lambda *_: None)
    assert shown(tmp_path / "out") == before | {"morphology.json"}
    restore_vessel(second, tmp_path / "out", settings, lambda *_: None, replaces=True)
    restore_vessel(second, tmp_path / "anew", settings, lambda *_: None)
    assert shown(tmp_path / "out") == shown(tmp_path / "anew")


def test_a_folder_replaced_with_other_settings_holds_nothing_of_the_former(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path
) -> None:
    out, anew = (shutil.copytree(stored[0], tmp_path / name) for name in ("out", "anew"))
    foam = FlowSettings(numerics=Numerics(cell_size_mm=0.5, engine="openfoam"))
    former = settings_of("leo", "enterprise", flow=foam)
    written_by_openfoam = [*engine_folders(out, former).values(), out / "convergence" / "openfoam" / "grid"]
    run(arteries[0], out, replace(former, flow=None), lambda *_: None, replaces=True)
    restore_vessel(arteries[0], out, former, lambda *_: None)
    for name in (*RESULTS_OF_ONE, *OF_THE_USER, "report.html", "ro-crate-metadata.json"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("of the former")
    for folder in written_by_openfoam:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "vstent.key").write_text("a key")
    cached = {path.name for path in (out / ".vstent").glob("*.npz")}
    with pytest.raises(InputError):
        run(
            arteries[0],
            out,
            replace(former, flow=None, treatments=(with_device("leo", length_mm=1e3),)),
            lambda *_: None,
            replaces=True,
        )
    assert (out / "report.pdf").exists()

    settings = settings_of("enterprise")
    run(arteries[0], out, settings, lambda *_: None, replaces=True)
    run(arteries[0], anew, settings, lambda *_: None, replaces=True)
    convergence = "convergence/openfoam/grid/vstent.key"
    assert shown(out) == shown(anew) | {*OF_THE_USER, "ranking.csv", "morphology.json", convergence}
    assert (out / "metrics.json").read_bytes() == (anew / "metrics.json").read_bytes()
    assert {path.name for path in (out / ".vstent").glob("*.npz")} == cached
    run(arteries[0], out, replace(settings, anatomy=AnatomySettings(upstream_mm=6.0)), lambda *_: None, replaces=True)
    assert shown(out) == shown(anew) | {*OF_THE_USER, "ranking.csv"}


def test_stopped_while_replacing_a_folder_holds_nothing_of_the_former_beside_the_new_flow(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, computed = shutil.copytree(stored[0], tmp_path / "out"), []
    real = stages.simulate_case
    stops = {"of": None}

    def counted(case: FlowCase, *, start: FlowField | None, **given: object) -> FlowField:
        if case.media and stops["of"] == case.inflow_mL_s:
            raise KeyboardInterrupt
        computed.append((bool(case.media), case.inflow_mL_s))
        return start if start is not None else real(case, start=start, **given)

    monkeypatch.setattr(stages, "simulate_case", counted)
    flow = FlowSettings(inflow_mL_s=1.0, numerics=Numerics(cell_size_mm=0.5, max_steps=20))
    slow = settings_of("leo", flow=flow)
    fast = replace(slow, flow=replace(slow.flow, inflow_mL_s=3.0))
    run(arteries[0], out, slow, lambda *_: None, replaces=True)
    (out / "report.html").write_text("of the slow flow")
    whole = shown(out)
    first = json.loads((out / "run.json").read_text())["seconds"]
    run(arteries[0], out, slow, lambda *_: None, replaces=True)  # the same again: everything stays
    assert shown(out) == whole
    again = json.loads((out / "run.json").read_text())["seconds"]
    assert {"segment", "trace", "trim", "restore", "deploy leo", "struts leo", "measure"} < set(first)
    assert again == first  # nothing was computed anew

    stops["of"] = 3.0
    with pytest.raises(KeyboardInterrupt):
        run(arteries[0], out, fast, lambda *_: None, replaces=True)
    of_flow = {"treatments/bare/flow/field.vtu", "treatments/bare/flow/wall.vtp"}
    assert {name for name in shown(out) if "/flow/" in name} == of_flow
    assert not {"metrics.json", "run.json", "report.html"} & shown(out)
    stops["of"] = None
    run(arteries[0], out, fast, lambda *_: None, replaces=True)
    assert shown(out) == whole - {"report.html"}
    assert computed == [(False, 1.0), (True, 1.0), (False, 3.0), (True, 3.0)]
    assert json.loads((out / "run.json").read_text())["settings"]["flow"]["inflow_mL_s"] == 3.0


def test_what_is_kept_damaged_is_found_anew_and_replaced(arteries: tuple[Path, Path], tmp_path: Path) -> None:
    told: list[str] = []

    def stages_told() -> set[str]:
        told.clear()
        restore_vessel(arteries[0], tmp_path, settings_of(), lambda now: told.append(now.stage))
        return set(told)

    assert stages_told() == {"segment", "trace", "trim", "restore"}
    (kept,) = (tmp_path / ".vstent").glob("anatomy-*.npz")
    kept.write_bytes(kept.read_bytes()[:100])
    assert stages_told() == {"anatomy", "vessel", "trim", "restore"}
    assert stages_told() == {"anatomy"}


def test_a_crate_does_not_outlive_what_it_describes(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path
) -> None:
    settings, out = settings_of("leo"), shutil.copytree(stored[0], tmp_path / "out")
    case = run(arteries[0], out, settings, lambda *_: None)
    write_crate(out, case.provenance, "2026-01-01")
    assert "ro-crate-metadata.json" in shown(out)
    run(arteries[0], out, settings, lambda *_: None)
    assert "ro-crate-metadata.json" not in shown(out)


def test_trimmed_otherwise_the_vessel_is_the_one_that_was_traced_and_the_result_the_same(tmp_path: Path) -> None:
    artery, told = tmp_path / "artery.stl", []
    tube = phantoms.tube(length_mm=24.0)
    write_stl(artery, phantoms.phantom_surface(phantoms.with_sac(tube, abscissa_mm=12.0), edge_mm=0.6))
    shorter = replace(settings_of(), anatomy=AnatomySettings(upstream_mm=7.0))
    restore_vessel(artery, tmp_path / "again", settings_of(), lambda *_: None)
    again, _ = restore_vessel(artery, tmp_path / "again", shorter, lambda now: told.append(now.stage))
    anew, _ = restore_vessel(artery, tmp_path / "anew", shorter, lambda *_: None)
    assert list(dict.fromkeys(told)) == ["vessel", "trim", "restore"]
    for name in ("vessel.vtp", "landing_surface.vtp", "sac.vtp", "morphology.json"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "anew" / name).read_bytes()
    np.testing.assert_array_equal(again.parent.landing_surface.vertices_mm, anew.parent.landing_surface.vertices_mm)


@pytest.mark.parametrize("given", ["at_mm", "inlet_mm"])
def test_of_two_vessels_in_one_surface_the_one_at_the_point_given_is_taken(tmp_path: Path, given: str) -> None:
    wide, thin = (phantoms.phantom_surface(phantoms.tube(radius_mm=r), edge_mm=0.6) for r in (2.0, 1.5))
    vertices = np.concatenate([wide.vertices_mm, np.add(thin.vertices_mm, [30.0, 0, 0])])
    faces = np.concatenate([wide.faces, thin.faces + len(wide.vertices_mm)])
    write_stl(tmp_path / "both.stl", Surface(vertices, faces))
    settings = settings_of()
    usual = trace_vessel(tmp_path / "both.stl", tmp_path / "usual", settings, lambda *_: None)
    assert usual.lumen.vertices_mm[:, 0].max() < 3.0
    settings = replace(settings, anatomy=AnatomySettings(**{given: (30.0, 0.0, 0.0)}))
    other = trace_vessel(tmp_path / "both.stl", tmp_path / "other", settings, lambda *_: None)
    assert other.lumen.vertices_mm[:, 0].min() > 27.0


def test_stopped_in_a_flow_it_keeps_the_finished_one_and_goes_on(
    arteries: tuple[Path, Path],
    stored: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = shutil.copytree(stored[0], tmp_path / "out")
    command = ["run", str(arteries[0]), "--out", str(out), "--units", "mm", "--device", "leo", "--grid-spacing", "0.35"]
    real, computed = stages.simulate_case, []

    def stopped_with_a_stent(case: FlowCase, *, start: FlowField | None, **given: object) -> FlowField:
        if case.media and not computed.count("leo"):
            computed.append("leo")
            raise KeyboardInterrupt
        computed.append("leo" if case.media else "bare")
        return start if start is not None else real(case, start=start, **given)

    monkeypatch.setattr(stages, "simulate_case", stopped_with_a_stent)
    assert main(command) == 130
    assert "give the same command again" in capsys.readouterr().err
    assert (out / "treatments" / "bare" / "flow" / "field.vtu").stat().st_size > 100_000
    assert not (out / "metrics.json").exists()
    assert main(command) == 0
    assert computed == ["bare", "leo", "leo"]
    metrics = json.loads((out / "metrics.json").read_text())
    # The second run was handed the bare flow: nothing changed, and every ratio is 1.
    bare, leo = (metrics["treatments"][name] for name in ("bare", "leo"))
    assert leo["change"]["neck_inflow_mL_s_ratio"] == pytest.approx(1.0)
    assert bare["flow"]["neck_inflow_mL_s"] == pytest.approx(bare["flow"]["neck_outflow_mL_s"], rel=0.1)
    report = (out / "report.html").read_text()
    assert all(f"{words}: The flow has " in report for words in ("Flow without a device", "Flow with LEO 4.5 × 15 mm"))
    left = bare["flow"]["unsettled_fraction"]
    assert (left < 0.01) == ("Flow without a device: The flow has converged" in report)
    assert leo["flow"]["unsettled_fraction"] == left > 0
    assert not any("unsettled" in key for key in leo["change"])
    provenance = json.loads((out / "run.json").read_text())
    assert len(provenance["input"]["sha256"]) == 64
    assert {"numpy", "vstent", "python"} <= set(provenance["versions"])


def test_on_a_gpu_a_flow_is_stored_while_the_next_is_computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of("leo", flow=FlowSettings(numerics=Numerics(device_gpu=True)))
    is_next_begun, threads, stored = Event(), set(), []

    def computed(case: str, *, start: object, **given: object) -> SimpleNamespace:
        if case == "leo":
            is_next_begun.set()
        return SimpleNamespace(name=case, start=start, advice="")

    def write(store: Store, name: str, key: Key, seconds: dict[str, float]) -> None:
        assert is_next_begun.wait(20.0)
        threads.add(get_ident())
        stored.append((name, list(seconds)))

    def written(folder: Path, field: object) -> None:
        stored.append(folder.relative_to(tmp_path).as_posix())

    monkeypatch.setattr("numba.threading_layer", lambda: "omp")
    monkeypatch.setattr(stages, "plan_flows", lambda *_: None)
    monkeypatch.setattr(stages, "flow_case", lambda anatomy, implants, flow: implants[0].name if implants else "bare")
    monkeypatch.setattr(stages, "simulate_case", computed)
    monkeypatch.setattr(stages, "write_field", written)
    monkeypatch.setattr("vstent.io.archive.save_data", lambda *_: None)
    monkeypatch.setattr(Store, "write", write)
    leo = {"leo": SimpleNamespace(stent=SimpleNamespace(name="leo"))}
    store, keys = Store(tmp_path / "cache"), study_keys("", settings)
    fields, failures = stages.compute_flows(tmp_path, None, {"leo": leo}, settings, store, keys)
    assert not failures
    assert fields["leo"].start is fields["bare"]
    assert get_ident() not in threads
    # The run time stored with a flow is its own, though the next one was begun before it was stored.
    assert stored == [
        *(("flow bare", ["flow bare"]), "treatments/bare/flow"),
        *(("flow leo", ["flow leo"]), "treatments/leo/flow"),
    ]


NARROW = ((16, 40.0),)
"""Wires of another Leo: number and diameter in um."""


def test_a_device_whose_wires_change_does_not_get_the_flow_of_the_former(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    artery, out = arteries[0], shutil.copytree(stored[0], tmp_path / "out")
    real, computed = stages.simulate_case, []
    design = find_design("leo")

    def computed_once(case: FlowCase, *, start: FlowField | None, **given: object) -> FlowField:
        computed.append(case.solids[0].design.wires if case.solids else ())
        return start if start is not None else real(case, start=start, **given)

    monkeypatch.setattr(stages, "simulate_case", computed_once)
    settings = settings_of("leo", flow=FlowSettings(numerics=Numerics(cell_size_mm=0.5, max_steps=20)))
    run(artery, out, settings, lambda *_: None)
    for module in ("stages", "keys"):
        monkeypatch.setattr(f"vstent.study.{module}.find_design", lambda _: replace(design, wires=NARROW))
    run(artery, out, settings, lambda *_: None)
    run(artery, out, settings, lambda *_: None)
    assert computed == [(), design.wires, NARROW]


def test_what_has_changed_is_written_again_and_nothing_else(
    arteries: tuple[Path, Path], stored: tuple[Path, Path], tmp_path: Path
) -> None:
    out, settings = shutil.copytree(stored[0], tmp_path / "out"), settings_of("leo", "enterprise")
    first = run(arteries[0], out, settings, lambda *_: None)
    files = {path: path.read_bytes() for path in out.glob("treatments/*/implants/*/*")}
    dates = {path: path.stat().st_mtime_ns for path in files}
    implant_folder(out, "leo", "leo").joinpath("struts.stl").write_text("of the user")
    implant_folder(out, "enterprise", "enterprise").joinpath("wires.vtp").unlink()
    (measured,) = (out / ".vstent").glob("measure-*.json")
    measured.write_text("{damaged")
    second = run(arteries[0], out, settings, lambda *_: None)
    assert {path: path.read_bytes() for path in files} == files
    assert all(path.stat().st_mtime_ns > dates[path] for path in files)
    run(arteries[0], out, settings, lambda *_: None)
    third = run(arteries[0], out, settings, lambda *_: None)
    assert list(third.metrics["treatments"]) == list(first.metrics["treatments"]) == ["leo", "enterprise"]
    assert third.metrics == json.loads(json.dumps(second.metrics)) == json.loads(json.dumps(first.metrics))
    before, after = (case.implants["leo"]["leo"].stent.nodes_mm for case in (first, third))
    np.testing.assert_array_equal(after, before)
    dates = {path: path.stat().st_mtime_ns for path in files}
    run(arteries[0], out, settings, lambda *_: None)
    assert {path: path.stat().st_mtime_ns for path in files} == dates
