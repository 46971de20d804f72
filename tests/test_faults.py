"""Bad input and bad machines: one sentence, the right exit code, nothing half-written, nothing lost."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from faults import DONE, FAULTS, Fault, artery, play

from vstent.io.writers import write_stl
from vstent.study.folder import CACHE, INPUT
from vstent.study.repeat import BEGUN

KEPT = {"disk full", "kept stages that unpack to 16 GB"}
"""Faults after which the case folder holds what was finished before."""


def test_the_list_is_long_and_has_no_name_twice() -> None:
    assert len({(fault.group, fault.name) for fault in FAULTS}) == len(FAULTS)
    assert len(FAULTS) >= 60


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, id=f"{fault.group}: {fault.name}", marks=[pytest.mark.validation] if fault.is_heavy else [])
        for fault in FAULTS
    ],
)
def test_a_fault_ends_in_one_sentence_and_leaves_nothing_behind(
    fault: Fault, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    outcome = play(fault, tmp_path)
    assert outcome.code == fault.code, outcome.told
    assert fault.said in " ".join(outcome.told.split())
    assert "Traceback" not in outcome.told
    assert capfd.readouterr() == ("", "")
    if fault.code != DONE:
        sentences = [
            line for line in outcome.told.splitlines() if line.startswith("vstent") and "first use" not in line
        ]
        assert len(sentences) == 1
        assert len(outcome.sentence.split()) >= 8, outcome.sentence
    if fault.name not in KEPT and fault.code != DONE:
        assert not (tmp_path / "out").exists()
    assert not [*tmp_path.rglob(".partial-*"), *tmp_path.rglob("lock")]


KILLED = """
import os, pathlib, signal, sys
from vstent.devices.treatment import with_device
from vstent.flow import engines
from vstent.flow.settings import FlowSettings, Numerics
from vstent.study.pipeline import run
from vstent.study.settings import InputSettings, Settings

moment, path, out = sys.argv[1:]
replace = os.replace

def die(now):
    if now.startswith(moment):
        os.kill(os.getpid(), signal.SIGKILL)

def replacing(source, target):
    die(f"writing {pathlib.Path(target).name}")
    replace(source, target)

os.replace = replacing
engines.SAVE_EVERY_S = 0.0
flow = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.45, max_steps=400))
settings = Settings(InputSettings("mm"), treatments=(with_device("silk"),), flow=flow)
run(pathlib.Path(path), pathlib.Path(out), settings, lambda now: die(f"{now.stage} {now.fraction:.0f}"))
"""
"""A study that kills itself, without a chance to tidy up, at a moment given: a stage's begin (0) or end (1)."""


def killed(moment: str, path: Path, out: Path) -> int:
    """Run it; return how it ended."""
    command = [sys.executable, "-c", KILLED, moment, str(path), str(out)]
    return subprocess.run(command, capture_output=True, timeout=600, check=False).returncode


def written(out: Path) -> dict[str, bytes]:
    """Return what lies in a case folder by now, times taken aside."""
    files = (path for path in out.rglob("*") if path.is_file() and path.name not in ("run.json", "lock"))
    untimed = (path for path in files if path.parent.name != CACHE or path.name in (INPUT, BEGUN))
    return {str(path.relative_to(out)): path.read_bytes() for path in untimed}


BRIEF = [
    "segment 0",
    "writing deploy silk",
    "writing struts.stl",
    "flow bare 1",  # more than half done
    "writing flow bare",
    "measure 0",
]
EVERY = [
    *("trace 0", "restore 0", "writing vessel", "deploy silk 1", "writing vessel.vtp", "struts silk 1"),
    *("writing field.vtu", "flow silk 0", "flow silk 1", "writing flow silk", "writing metrics.json"),
]


@pytest.mark.parametrize(
    "moments",
    [pytest.param(BRIEF, marks=pytest.mark.system), pytest.param(EVERY, marks=pytest.mark.validation)],
    ids=["once", "often"],
)
def test_killed_at_any_stage_the_same_command_goes_on(moments: list[str], tmp_path: Path) -> None:
    write_stl(tmp_path / "artery.stl", artery())
    assert killed("never", tmp_path / "artery.stl", tmp_path / "whole") == 0
    whole, out = written(tmp_path / "whole"), tmp_path / "out"
    for moment in moments:
        assert killed(moment, tmp_path / "artery.stl", out) == -signal.SIGKILL, moment
        left = {name: data for name, data in written(out).items() if ".partial-" not in name}
        assert left.items() <= whole.items(), moment  # whatever is there is complete
    assert killed("never", tmp_path / "artery.stl", out) == 0
    assert written(out) == whole
    assert not [*(out / CACHE).glob("*.running.npz")]
