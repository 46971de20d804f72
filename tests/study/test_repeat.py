"""A run is repeated from its run.json to the last bit, and what is not as it was is told."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from vstent import phantoms
from vstent.cli import main
from vstent.devices.treatment import Implant, Placing, Treatment
from vstent.errors import ReadError
from vstent.fields import sections_of
from vstent.flow.measured import MeasuredProfile
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics
from vstent.flow.waveform import OLDER_ADULT_ICA
from vstent.io.writers import write_json, write_stl
from vstent.plan.ranges import Ranges
from vstent.study import repeat as repeating
from vstent.study.crate import write_crate
from vstent.study.repeat import agreement
from vstent.study.settings import AnatomySettings, InputSettings, Settings


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A run with settings that seven digits do not hold, a coarse flow, and varied causes."""
    folder = tmp_path_factory.mktemp("repeat")
    artery = phantoms.with_sac(phantoms.tube(length_mm=24), abscissa_mm=12, width_mm=5.0, neck_mm=3.5)
    write_stl(folder / "ä scan.stl", phantoms.phantom_surface(artery, edge_mm=0.8))
    options = ["--units", "mm", "--device", "leo", "--at=0.1234567891,3,12", "--center", "12.000000123"]
    flow = ["--grid-spacing", "0.444444444444", "--flow-rate", "2.7182818284590"]
    varied = ["--uncertainty", "2", "--vary-landing", "0.1"]
    command = ["run", str(folder / "ä scan.stl"), "--out", str(folder / "first"), *options, *flow, *varied]
    assert main(command) == 0
    return folder


def test_a_repeated_run_is_the_same_to_the_last_bit(case, capsys):
    assert main(["run", str(case / "first" / "run.json"), "--out", str(case / "again"), "--ro-crate"]) == 0
    said = capsys.readouterr()
    assert "The metrics are identical to the last bit." in said.out
    assert "Not as then" not in said.err
    assert "already done" not in said.err
    first, again = case / "first", case / "again"
    of_leo = ("treatments/leo/implants/leo/wires.vtp", "treatments/leo/flow/wall.vtp")
    for name in ("metrics.json", "vessel.vtp", *of_leo, "treatments/bare/flow/field.vtu"):
        assert (first / name).read_bytes() == (again / name).read_bytes()
    one, other = (json.loads((folder / "run.json").read_text()) for folder in (first, again))
    assert one["settings"] == other["settings"]
    (treatment,) = one["settings"]["treatments"]
    assert treatment["implants"][0]["placing"]["position_mm"] == 12.000000123
    assert one["settings"]["flow"]["numerics"]["cell_size_mm"] == 0.444444444444
    _check_crate(again)


def _check_crate(folder: Path) -> None:
    graph = json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    by_id = {entity["@id"]: entity for entity in graph}
    assert len(by_id) == len(graph)
    assert by_id["ro-crate-metadata.json"]["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    shown = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and ".vstent" not in path.parts and path.name != "ro-crate-metadata.json"
    }
    assert {part["@id"] for part in by_id["./"]["hasPart"]} == shown
    for name in shown:
        assert by_id[name]["sha256"] == hashlib.sha256((folder / name).read_bytes()).hexdigest()
        assert by_id[name]["contentSize"] == str((folder / name).stat().st_size)
        assert by_id[name]["encodingFormat"] != "application/octet-stream"
    for entity in graph:
        for value in entity.values():
            for link in value if isinstance(value, list) else [value]:
                if isinstance(link, dict) and link["@id"] != "https://w3id.org/ro/crate/1.1":
                    assert link["@id"] in by_id


def test_another_input_is_refused_and_a_moved_one_is_found(case, tmp_path, capsys):
    moved = tmp_path / "moved"
    shutil.copytree(case / "first", moved / "first")
    shutil.copy(case / "ä scan.stl", moved / "scan.stl")
    write_json(moved / "first" / ".vstent" / "input.json", {"path": str(moved / "gone.stl")})
    command = ["run", str(moved / "first" / "run.json"), "--out", str(moved / "again")]
    assert main(command) == 2
    assert "--input" in capsys.readouterr().err
    found = repeating.read_record(moved / "first" / "run.json", moved / "scan.stl")
    assert found.input == moved / "scan.stl"
    (moved / "scan.stl").write_bytes((moved / "scan.stl").read_bytes() + b" ")
    assert main([*command, "--input", str(moved / "scan.stl")]) == 2
    assert "has changed since" in capsys.readouterr().err
    assert not (moved / "again").exists()


def test_other_versions_and_devices_are_told(case):
    told = json.loads((case / "first" / "run.json").read_text())
    told["versions"]["numpy"] = "1.0"
    told["devices"]["leo"] = "other wires"
    del told["machine"]
    (case / "first" / "other.json").write_text(json.dumps(told))
    differences = repeating.read_record(case / "first" / "other.json").differences
    assert any("numpy (versions): 1.0 before" in sentence for sentence in differences)
    assert any("leo (devices): other wires before" in sentence for sentence in differences)
    assert sum("(machine): absent before" in sentence for sentence in differences) == 2
    assert len(differences) == 4
    (case / "first" / "other.json").unlink()


@pytest.mark.parametrize("text", ["", "[]", '{"settings": {"colour": 1}, "input": {"sha256": ""}}', '{"settings": {}}'])
def test_what_is_no_record_is_refused_in_a_sentence(text, tmp_path, capsys):
    (tmp_path / "run.json").write_text(text)
    assert main(["run", str(tmp_path / "run.json"), "--out", str(tmp_path / "out")]) == 2
    assert "is not a run.json of this version" in capsys.readouterr().err


def test_a_record_takes_no_other_settings_nor_its_own_folder(case, capsys):
    record = str(case / "first" / "run.json")
    assert main(["run", record, "--out", str(case / "x"), "--threshold", "3"]) == 2
    assert "states all settings: give only --out" in capsys.readouterr().err
    assert main(["run", record, "--out", str(case / "first")]) == 2
    assert "another --out" in capsys.readouterr().err


ALL = Settings(
    InputSettings("cm", "ras", 2, (0.1, 0.2, 1 / 3), (5, 6, 7), ((0.0, 0.1, 0.2), (1.0, 2.0, 3.0)), 1e-3),
    AnatomySettings(
        (0.1, 1e-17, -2 / 3), ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), (7.0, 8.0, 9.0), ((0.0, 0.0, 1.0),), 9.5, 8.5, True
    ),
    (
        Treatment(
            "two",
            (
                Implant("a", "silk", 4.0, 20.0, Placing("outlet_2", 1 / 3, "distal")),
                Implant("b", "silk", placing=Placing(shift_mm=-4.0), inside=("a",)),
                Implant("c", "silk", placing=Placing("outlet_1", at_fork=True, beside=("outlet_2",)), inside=("a",)),
                Implant("d", "coils", density_fraction=0.2, coils=((2.0, 1 / 3),), seed=3),
            ),
            has_flow=False,
        ),
    ),
    FlowSettings(
        1 / 3,
        0.3,
        MeasuredProfile(((0.0, 1.0, 2.0), (3.0, 1 / 3, 4.0)), (((0.1, 0.2, 1 / 3), (0.4, 0.5, 0.6)),), 0.9),
        Blood(1050.0, 0.0035, CarreauYasuda(0.05, 2.0, 1.3, 0.3)),
        OLDER_ADULT_ICA,
        "windkessel",
        (0.5, 1 / 3),
        2.5,
        ((1 / 3, 0.1, 2.0),),
        95.0,
        0.7,
        0.4,
        Numerics(
            0.2,
            ("sac", (1.0, 2.0, 1 / 3, 4.0)),
            "resolved",
            20.0,
            40.0,
            1e5,
            0.02,
            9000,
            3,
            0.03,
            0.1,
            "openfoam",
            2,
            True,
        ),
    ),
    Ranges(7, 2, 0.1, 0.2, 0.3, 0.4, 0.5),
    "six_months",
)
"""Settings of which every one differs from its default."""


def changed(one: Any, path: str = "") -> Iterator[str]:
    """The paths of all settings in data classes that have another value than their default."""
    for field in fields(one):
        value = getattr(one, field.name)
        if value != field.default:
            yield f"{path}{field.name}"
        for nested in value if isinstance(value, tuple) else (value,):
            if is_dataclass(nested):
                yield from changed(nested, f"{path}{field.name}.")


def known(kind: type, path: str = "") -> Iterator[str]:
    """The paths of all settings."""
    for field in fields(kind):
        yield f"{path}{field.name}"
        for section in sections_of(field.type):
            yield from known(section, f"{path}{field.name}.")


def test_settings_come_back_from_json_to_the_last_bit(tmp_path):
    assert {*changed(ALL)} == {*known(Settings)}  # none is left out here
    write_json(tmp_path / "s.json", asdict(ALL), is_exact=True)
    assert repeating.settings_of(json.loads((tmp_path / "s.json").read_text())) == ALL


@pytest.mark.parametrize(
    "path", [(), ("input",), ("flow", "numerics"), ("flow", "blood", "thinning"), ("uncertainty",)]
)
def test_settings_of_another_version_are_refused(path):
    """One more setting anywhere, or one less."""
    for change in (lambda told: told.update(colour="red"), lambda told: told.pop(next(iter(told)))):
        section = told = json.loads(json.dumps(asdict(ALL)))
        for name in path:
            section = section[name]
        change(section)
        with pytest.raises(ValueError, match="settings"):
            repeating.settings_of(told)


@pytest.mark.parametrize(
    ("length_mm", "told"),
    [
        (11.0, "1 of 2 metrics differ, treatments.silk.b_mm most (relative difference 0.091, more than the 0.001"),
        (10.005, "1 of 2 metrics differ, treatments.silk.b_mm most (relative difference 0.0005, within the 0.001"),
        (10.0 + 1e-12, "The metrics agree except for rounding."),
        (10.0, "The metrics are identical to the last bit."),
    ],
)
def test_disagreement_is_told_by_its_worst(length_mm, told, tmp_path):
    for name, b_mm in (("one", 10.0), ("other", length_mm)):
        metrics = {"vessel": {"a_mm": 1.0}, "treatments": {"silk": {"b_mm": b_mm}}}
        write_json(tmp_path / name / "metrics.json", metrics, is_exact=True)
    assert agreement(tmp_path / "one", tmp_path / "other").startswith(told)


@pytest.mark.validation
def test_a_machine_without_wide_and_fused_instructions_agrees_within_what_is_stated(case):
    """The same run by code for the plainest processor of this kind: kernels, linear algebra and array loops."""
    plain = {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(case / "kernels"),
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX",
    }
    command = [sys.executable, "-m", "vstent", "run", str(case / "first" / "run.json"), "--out", str(case / "plain")]
    done = subprocess.run(command, env={**os.environ, **plain}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = agreement(case / "first", case / "plain")
    print(said)  # noqa: T201  # `make validation` shows it
    assert "to the last bit" not in said  # it was another machine indeed
    assert "more than" not in said


def test_an_unfinished_folder_is_no_crate(tmp_path):
    with pytest.raises(ReadError, match="holds no finished case"):
        write_crate(tmp_path, {}, "2026-01-01")
