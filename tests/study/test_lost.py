"""Nothing that was computed is lost: every pair of an existing case and a new command."""

import json
import shutil
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from vstent import phantoms
from vstent.devices.catalogue import find_design
from vstent.devices.treatment import Implant, Placing, Treatment, with_device
from vstent.errors import FlowError, FolderError, InputError, LandingError
from vstent.flow.case import FlowCase, FlowField
from vstent.flow.settings import FlowSettings, Numerics
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Anatomy
from vstent.io.surfaces import read_surface
from vstent.io.writers import write_stl
from vstent.plan.rank import rank
from vstent.plan.uncertainty import Ranges
from vstent.study import stages
from vstent.study.folder import CACHE, INPUT
from vstent.study.keys import implant_keys, study_keys
from vstent.study.outputs import write_ranking
from vstent.study.pipeline import refine_flow, restore_vessel, run, trace_vessel
from vstent.study.progress import Progress
from vstent.study.settings import AnatomySettings, InputSettings, Settings
from vstent.study.store import Key, Store

FLOW = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.5, max_steps=20))


def of(*devices: str, **more: object) -> Settings:
    """Return the settings of a study of a surface in mm, with a treatment for every device and without a flow."""
    return Settings(InputSettings("mm"), treatments=tuple(map(with_device, devices)), **{"flow": None} | more)


PLAIN = of("leo")
"""Leo and the laser-cut devices have few wires, so that a run is short."""


@pytest.fixture(scope="module")
def arteries(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two patients."""
    folder = tmp_path_factory.mktemp("arteries")
    for name, length_mm in (("first", 34.0), ("second", 36.0)):
        artery = phantoms.with_sac(phantoms.tube(length_mm=length_mm), abscissa_mm=17.0, width_mm=5.0, neck_mm=3.5)
        write_stl(folder / f"{name}.stl", phantoms.phantom_surface(artery, edge_mm=0.9))
    return folder / "first.stl", folder / "second.stl"


def bare_flow(patch: pytest.MonkeyPatch) -> list[str]:
    """Compute a flow without a device once; with one it is the same. Returns what is computed, in order."""
    real, computed = stages.simulate_case, []

    def quick(case: FlowCase, *, start: FlowField | None, **given: object) -> FlowField:
        computed.append("device" if case.media else "bare")
        return start if start is not None else real(case, start=start, **given)

    patch.setattr(stages, "simulate_case", quick)
    return computed


@pytest.fixture(autouse=True)
def bare_flow_for_all(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Do that in every test."""
    return bare_flow(monkeypatch)


def quiet(*_: object) -> None:
    """Hear nothing."""


def held(folder: Path) -> dict[str, bytes]:
    """Return the files of devices and flows of a case folder, and what was found of other kinds."""
    names = ("treatments/**/*", "morphology.json", "ranking.csv", "convergence.json", "report.html")
    files = [path for name in names for path in folder.glob(name) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def restored(arteries: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Case folder of the first patient with the restored artery alone."""
    out = tmp_path_factory.mktemp("restored") / "out"
    restore_vessel(arteries[0], out, PLAIN, quiet)
    return out


@pytest.fixture
def out(restored: Path, tmp_path: Path) -> Path:
    """A copy of it, for one test."""
    return shutil.copytree(restored, tmp_path / "out")


TANDEM = Treatment("tandem", (Implant("a", "leo"), Implant("b", "leo", placing=Placing(shift_mm=2.0), inside=("a",))))
EXISTING = {
    "a device": PLAIN,
    "two devices": of("leo", "enterprise"),
    "a device and its flow": of("leo", flow=FLOW),
    "a size": replace(PLAIN, treatments=(with_device("leo", diameter_mm=4.5, length_mm=25.0),)),
    "a spread": of("leo", uncertainty=Ranges(samples=2)),
}
COMMANDS = {
    "another device": of("acclino"),
    "another device and its flow": of("enterprise", flow=FLOW),
    "the same device": PLAIN,
    "the same device and its flow": of("leo", flow=FLOW),
    "the same and two in one": replace(PLAIN, treatments=(with_device("leo"), TANDEM)),
    "another size": replace(PLAIN, treatments=(with_device("leo", diameter_mm=4.5, length_mm=15.0),)),
    "another flow": of("leo", flow=replace(FLOW, inflow_mL_s=3.0)),
    "less artery": replace(PLAIN, anatomy=AnatomySettings(upstream_mm=12.0)),
    "another spread": of("leo", uncertainty=Ranges(samples=3)),
}


@pytest.fixture(scope="module")
def existing(arteries: tuple[Path, Path], restored: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Case folders by what they hold."""
    folders = {name: shutil.copytree(restored, tmp_path_factory.mktemp("existing") / "out") for name in EXISTING}
    with pytest.MonkeyPatch.context() as patch:
        bare_flow(patch)
        for name, out in folders.items():
            run(arteries[0], out, EXISTING[name], quiet)
    return folders


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("held_before", EXISTING)
def test_after_any_command_all_that_a_folder_held_is_there_or_the_command_is_refused(
    arteries: tuple[Path, Path], existing: dict[str, Path], tmp_path: Path, held_before: str, command: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(existing[held_before], out)
    before, metrics = held(out), json.loads((out / "metrics.json").read_text())
    refused = ""
    try:
        run(arteries[0], out, COMMANDS[command], quiet)
    except InputError as error:
        refused = str(error)
    if refused:
        assert "--replace" in refused
        assert held(out) == before
        assert json.loads((out / "metrics.json").read_text()) == metrics
        return
    after = held(out)
    assert {name: after.get(name) for name in before} == before
    told = json.loads((out / "metrics.json").read_text())["treatments"]
    for name, of_treatment in metrics["treatments"].items():
        assert of_treatment.items() <= told[name].items()
    named = {one.name for one in COMMANDS[command].treatments}
    assert {*told} - {"bare"} == {*metrics["treatments"], *named} - {"bare"}


@pytest.mark.parametrize("command", [run, restore_vessel, trace_vessel, refine_flow])
def test_another_input_is_refused_unless_it_is_to_replace(
    arteries: tuple[Path, Path], existing: dict[str, Path], command: object
) -> None:
    out = existing["a device"]
    before = held(out)
    with pytest.raises(InputError, match=r"results of another input\. Give another --out, or --replace"):
        command(arteries[1], out, PLAIN, quiet)
    assert held(out) == before


def test_treatments_that_a_replacing_command_does_not_name_are_reported(
    arteries: tuple[Path, Path], existing: dict[str, Path], tmp_path: Path
) -> None:
    out, told = tmp_path / "out", []

    def removed(command: object, path: Path, settings: Settings) -> list[str]:
        told.clear()
        command(path, out, settings, lambda now: told.append((now.stage, now.detail)), replaces=True)
        return [detail for stage, detail in told if stage == "stored results"]

    shutil.copytree(existing["two devices"], out)
    sentence = "removed, because this command does not name them: {}."
    assert removed(run, arteries[0], of("leo", "enterprise")) == []
    assert removed(run, arteries[0], of("leo", "acclino")) == [sentence.format("enterprise")]
    assert removed(restore_vessel, arteries[0], PLAIN) == []
    assert removed(restore_vessel, arteries[1], PLAIN) == [sentence.format("acclino, leo")]
    assert not (out / "treatments").exists()
    assert removed(run, arteries[1], PLAIN) == []


def test_added_devices_are_what_they_are_in_a_folder_of_their_own(
    arteries: tuple[Path, Path], out: Path, restored: Path, tmp_path: Path
) -> None:
    anew = shutil.copytree(restored, tmp_path / "anew")
    run(arteries[0], out, of("leo", flow=FLOW), quiet)
    run(arteries[0], out, of("enterprise", flow=FLOW), quiet)
    run(arteries[0], anew, of("leo", "enterprise", flow=FLOW), quiet)
    assert (out / "metrics.json").read_bytes() == (anew / "metrics.json").read_bytes()


def test_a_device_added_without_flow_gets_none_and_the_flows_stay(
    arteries: tuple[Path, Path], out: Path, bare_flow_for_all: list[str]
) -> None:
    run(arteries[0], out, of("leo", flow=FLOW), quiet)
    case = run(arteries[0], out, of("acclino"), quiet)
    assert bare_flow_for_all == ["bare", "device"]
    assert set(case.fields) == {"bare", "leo"}
    assert set(case.implants) == {"leo", "acclino"}
    assert "flow" not in case.metrics["treatments"]["acclino"]
    later = run(arteries[0], out, of("acclino", flow=FLOW), quiet)
    assert bare_flow_for_all == ["bare", "device", "device"]
    assert set(later.fields) == {"bare", "leo", "acclino"}


def test_a_device_that_does_not_fit_is_a_row_with_its_reason(
    arteries: tuple[Path, Path], out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = of("leo", "enterprise")
    real = stages.deploy_implant

    def too_long(implant: Implant, *given: object) -> object:
        if implant.device == "leo":
            raise LandingError("No size of Leo fits: choose another device.")
        return real(implant, *given)

    monkeypatch.setattr(stages, "deploy_implant", too_long)
    case = run(arteries[0], out, settings, quiet)
    assert set(case.implants) == {"enterprise"}
    assert case.failures == {"leo": "not deployed: No size of Leo fits: choose another device."}
    assert json.loads((out / "metrics.json").read_text())["failures"] == case.failures
    assert case.notes[0] == f"leo: {case.failures['leo']}"
    with pytest.raises(LandingError, match=r"^leo: No size of Leo"):
        run(arteries[0], tmp_path / "none", PLAIN, quiet)
    assert not (tmp_path / "none").exists()


def test_a_flow_that_diverges_is_a_row_with_its_reason(
    arteries: tuple[Path, Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, real = of("leo", "enterprise", flow=FLOW), stages.simulate_case

    def diverging(case: FlowCase, **given: object) -> FlowField:
        if case.solids and case.solids[0].design.key == "leo":
            raise FlowError("the flow diverged: use a finer grid spacing")
        return real(case, **given)

    monkeypatch.setattr(stages, "simulate_case", diverging)
    case = run(arteries[0], out, settings, quiet)
    assert set(case.fields) == {"bare", "enterprise"}
    assert case.failures == {"leo": "flow not computed: the flow diverged: use a finer grid spacing"}
    assert case.metrics["treatments"]["leo"].keys() == {"implants", "together", "jailed_branches"}


def test_keys_change_with_what_a_stage_uses_and_with_nothing_else() -> None:
    given = replace(Settings(), treatments=(with_device("enterprise"), TANDEM))
    keys = study_keys("source", given)
    tandem = {"deploy tandem a", "deploy tandem b", "flow tandem"}
    assert {*keys} == {"vessel", "anatomy", "deploy enterprise", "flow bare", "flow enterprise"} | tandem

    def changed(**settings: object) -> set[str]:
        other = study_keys("source", replace(given, **settings))
        return {name for name in keys if name in other and other[name].given != keys[name].given}

    first, second = TANDEM.implants
    for implants, expected in (
        ((replace(first, length_mm=20.0), second), tandem),
        ((first, replace(second, length_mm=20.0)), tandem - {"deploy tandem a"}),
    ):
        assert changed(treatments=(with_device("enterprise"), Treatment("tandem", implants))) == expected
    assert changed(flow=FLOW) == {"flow bare", "flow enterprise", "flow tandem"}
    assert changed(anatomy=AnatomySettings(outlet_mm=(0.0, 0.0, 0.0))) == {*keys} - {"vessel"}
    assert changed(treatments=(replace(with_device("enterprise"), has_flow=False), TANDEM)) == set()
    assert changed(input=InputSettings(threshold=500.0)) == {*keys}
    assert all(study_keys("another", given)[name].given != key.given for name, key in keys.items())


def test_a_deployment_is_found_again_though_ranges_and_sources_of_its_numbers_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    design, anatomy = find_design("silk"), Key("given", "code")
    assert design.ranges
    assert design.facts

    def key(**numbers: object) -> Key:
        monkeypatch.setattr("vstent.study.keys.find_design", lambda _: replace(design, **numbers))
        return implant_keys(anatomy, with_device("silk"))["silk"]

    assert key(ranges=(), facts=()) == key()
    assert key(braid_angle_rad=1.1) != key()


@pytest.mark.parametrize("states", [f"{CACHE}/{INPUT}", "run.json"])
@pytest.mark.parametrize("command", [run, restore_vessel, trace_vessel, refine_flow])
def test_a_folder_of_an_older_version_is_refused_and_nothing_in_it_is_touched(
    arteries: tuple[Path, Path], tmp_path: Path, states: str, command: object
) -> None:
    (tmp_path / CACHE).mkdir()
    (tmp_path / states).write_text('{"path": "artery.stl", "sha256": "0", "settings": {"devices": ["leo"]}}')
    (tmp_path / CACHE / ".partial-0-1.npz").write_text("half")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    for replaces in (False, True):
        with pytest.raises(InputError, match=r"older version of vstent\. Give another --out, or delete that folder\."):
            command(arteries[0], tmp_path, PLAIN, quiet, replaces=replaces)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


DAMAGES = ("", "[]", "{", '{"seconds": 1}', '{"seconds": {"a": "b"}}', 9999 * "[", "\0\xff")


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_record_is_none(tmp_path: Path, damage: str) -> None:
    store, key = Store(tmp_path), Key("given", "code")
    store.path("measure", key).write_text(damage)
    store.path("measure", key, ".json").write_text(damage)
    assert store.record("measure", key) == {}
    assert store.find("measure", key, Anatomy) is None
    assert store.compute_once("measure", key, lambda: {"new": 1.0}) == {"new": 1.0}
    assert store.load("measure", key, Anatomy) is None  # the record is whole again, the archive is not
    assert store.compute_once("measure", key, lambda: {"newer": 1.0}) == {"new": 1.0}


@pytest.mark.parametrize("suffixes", [(".json", ".npz"), (".npz",)])
def test_a_damaged_or_foreign_file_is_computed_again(
    arteries: tuple[Path, Path], existing: dict[str, Path], tmp_path: Path, suffixes: tuple[str, ...]
) -> None:
    out, computed = tmp_path / "out", []
    shutil.copytree(existing["a device"], out)
    metrics, kept = (out / "metrics.json").read_bytes(), sorted((out / CACHE).glob("*-*-*.*"))
    for damage, path in zip(cycle(DAMAGES), (path for path in kept if path.suffix in suffixes), strict=False):
        path.write_text(damage)
    run(arteries[0], out, PLAIN, lambda now: computed.append(now.stage) if now.detail != "already done" else None)
    of_files = {"struts leo", "measure"} if ".json" in suffixes else set()
    assert {"segment", "trace", "trim", "restore", "deploy leo"} | of_files <= {*computed}
    assert (out / "metrics.json").read_bytes() == metrics
    assert {path.name for path in (out / CACHE).glob("*-*-*.*")} == {path.name for path in kept}
    computed.clear()
    run(arteries[0], out, PLAIN, lambda now: computed.append(now.stage) if now.fraction == 1.0 else None)
    assert "segment" not in computed


def test_a_ranking_of_another_device_keeps_the_rows_of_the_former_one(
    arteries: tuple[Path, Path], out: Path, tmp_path: Path
) -> None:
    anatomy, _ = restore_vessel(arteries[0], out, PLAIN, quiet)
    designs = [replace(find_design(name), sizes=find_design(name).sizes[:2]) for name in ("acclino", "leo")]
    for design in designs:
        write_ranking(out, rank(anatomy, [design]))
    write_ranking(tmp_path, rank(anatomy, designs))
    assert (out / "ranking.csv").read_text() == (tmp_path / "ranking.csv").read_text()


def test_a_point_in_another_frame_is_recognized(arteries: tuple[Path, Path], tmp_path: Path) -> None:
    surface, _ = read_surface(arteries[0], units="mm")
    moved = tmp_path / "moved.stl"
    write_stl(moved, Surface(surface.vertices_mm + np.array([40.0, 25.0, 0.0]), surface.faces))
    anatomy, _ = restore_vessel(moved, tmp_path / "out", PLAIN, quiet)
    x, y, z = anatomy.aneurysms[0].sac.vertices_mm.mean(axis=0).tolist()
    with pytest.raises(InputError, match=rf"Did you mean {x:.1f},{y:.1f},{z:.1f} \(the point given is RAS\)\?"):
        restore_vessel(moved, tmp_path / "other", replace(PLAIN, anatomy=AnatomySettings((-x, -y, z))), quiet)


def test_a_folder_removed_during_a_run_is_reported(arteries: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"

    def remove(now: Progress) -> None:
        if now.stage == "measure" and now.fraction == 0.0:
            shutil.rmtree(out, ignore_errors=True)

    with pytest.raises(FolderError, match="was removed while this run wrote to it, and is not complete: run it again"):
        run(arteries[0], out, PLAIN, remove)
