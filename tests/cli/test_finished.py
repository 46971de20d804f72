"""A finished command answers at once, and runs in full as soon as anything that it depends on has changed."""

import json
import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from vstent.cli import finished
from vstent.study.folder import CACHE, LAYOUT, LOCK, claimed

PRINTED = "Neck inflow  −51 %\n"


TOLD = {"layout": LAYOUT, "input": {"sha256": "1"}, "settings": {}, "seconds": {"trace": 1.0}}


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Namespace:
    """A command on a scan of two files, with a waveform in a file and a device of the user's own."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    case, scan, devices = tmp_path / "case", tmp_path / "scan", tmp_path / "config" / "vstent" / "devices"
    own = case / "report.html", case / CACHE / "anatomy.npz"
    for file in (scan / "IM1.dcm", scan / "IM2.dcm", devices / "mine.toml", *own):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("content")
    (case / "run.json").write_text(json.dumps(TOLD | {"seconds": {"trace": 2.0}}))
    (tmp_path / "flow.csv").write_text("0,1")
    return Namespace(out=case, input=scan, device=["silk"], pulsatile=str(tmp_path / "flow.csv"), command=print)


def remembered(command: Namespace) -> list[Path]:
    """Return the records of finished commands."""
    return [*(command.out / CACHE).glob(f"{finished.RECORD}-*")]


@pytest.fixture
def done(command: Namespace) -> Namespace:
    """The same command, finished."""
    finished.remember(command, finished.begun(command, command.input), TOLD, PRINTED)
    return command


def test_what_was_printed_is_printed_again(done: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert finished.answered(done)
        assert capsys.readouterr().out == PRINTED


FILES = (
    "scan/IM2.dcm",
    "case/report.html",
    "case/.vstent/anatomy.npz",
    "flow.csv",
    "config/vstent/devices/mine.toml",
    "case/.vstent/finished-*.json",
)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("is_deleted", [True, False])
def test_a_changed_file_is_noticed(done: Namespace, tmp_path: Path, name: str, is_deleted: bool) -> None:
    (file,) = tmp_path.glob(name)
    file.unlink() if is_deleted else file.write_text("another")
    assert not finished.answered(done)


@pytest.mark.parametrize("name", ["scan/IM3.dcm", "config/vstent/devices/other.toml"])
def test_a_new_file_is_noticed(done: Namespace, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("content")
    assert not finished.answered(done)


@pytest.mark.parametrize("name", ["scan/IM2.dcm", "flow.csv", "config/vstent/devices/mine.toml"])
def test_a_file_that_changes_while_the_command_runs_is_noticed(command: Namespace, tmp_path: Path, name: str) -> None:
    before = finished.begun(command, command.input)
    (tmp_path / name).write_text("another")
    finished.remember(command, before, TOLD, PRINTED)
    assert not finished.answered(command)


def test_a_folder_that_another_process_uses_or_has_changed_is_not_remembered(command: Namespace) -> None:
    before = finished.begun(command, command.input)
    with claimed(command.out):
        finished.remember(command, before, TOLD, PRINTED)
    assert remembered(command) == []
    finished.remember(command, before, TOLD | {"input": {"sha256": "2"}}, PRINTED)
    assert remembered(command) == []


def test_another_command_program_terminal_or_process_is_noticed(
    done: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = done
    assert not finished.answered(Namespace(**vars(command) | {"device": ["silk", "lvis"]}))
    with monkeypatch.context() as patch:
        patch.setattr(finished, "program_states", lambda: {"vstent.py": [1, 2]})
        assert not finished.answered(command)
    with monkeypatch.context() as patch:
        patch.setenv("COLUMNS", "57")
        assert not finished.answered(command)
    (command.out / CACHE / LOCK).touch()
    assert not finished.answered(command)


@pytest.mark.parametrize("option", finished.DEPENDENT)
def test_a_command_that_depends_on_more_is_not_remembered(command: Namespace, option: str) -> None:
    asked = Namespace(**vars(command) | {option: True})
    finished.remember(asked, finished.begun(asked, asked.input), TOLD, PRINTED)
    assert remembered(command) == []


def test_the_answer_needs_none_of_the_computations() -> None:
    code = (
        "import sys, vstent.cli.finished, vstent.cli; print({'numpy', 'numba', 'rich', 'pydantic'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
