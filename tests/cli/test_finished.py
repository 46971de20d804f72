"""A finished command answers at once, and runs in full as soon as anything that it depends on has changed."""

import os
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from vstent.cli import finished
from vstent.study import folder

PRINTED = "Neck inflow  −51 %\n"


@pytest.fixture
def command(tmp_path: Path) -> Namespace:
    """A finished command on a scan of two files, with a waveform in a file."""
    case, scan = tmp_path / "case", tmp_path / "scan"
    for file in (scan / "IM1.dcm", scan / "IM2.dcm", case / "report.html", case / finished.CACHE / "anatomy.npz"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("content")
    (tmp_path / "flow.csv").write_text("0,1")
    given = Namespace(out=case, input=scan, device=["silk"], pulsatile=str(tmp_path / "flow.csv"), command=print)
    finished.remember(given, scan, PRINTED)
    return given


def test_what_was_printed_is_printed_again(command: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    assert finished.CACHE == folder.CACHE
    for _ in range(2):
        assert finished.answered(command)
        assert capsys.readouterr().out == PRINTED


@pytest.mark.parametrize(
    "name", ["scan/IM2.dcm", "case/report.html", "case/.vstent/anatomy.npz", "flow.csv", "case/.vstent/finished.json"]
)
@pytest.mark.parametrize("is_deleted", [True, False])
def test_a_changed_file_is_noticed(command: Namespace, tmp_path: Path, name: str, is_deleted: bool) -> None:
    file = tmp_path / name
    file.unlink() if is_deleted else file.write_text("another")
    assert not finished.answered(command)


def test_another_command_program_terminal_or_process_is_noticed(
    command: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not finished.answered(Namespace(**vars(command) | {"device": ["silk", "lvis"]}))
    with monkeypatch.context() as patch:
        patch.setattr(finished, "program_states", lambda: {"vstent.py": [1, 2]})
        assert not finished.answered(command)
    with monkeypatch.context() as patch:
        patch.setenv("COLUMNS", "57")
        assert not finished.answered(command)
    (command.out / finished.CACHE / finished.LOCK).touch()
    assert not finished.answered(command)


@pytest.mark.parametrize("option", finished.DEPENDENT)
def test_a_command_that_depends_on_more_is_not_remembered(command: Namespace, option: str) -> None:
    (command.out / finished.CACHE / finished.RECORD).unlink()
    finished.remember(Namespace(**vars(command) | {option: True}), command.input, PRINTED)
    assert not (command.out / finished.CACHE / finished.RECORD).exists()


def test_the_answer_needs_none_of_the_computations() -> None:
    code = "import sys, vstent.cli.finished, vstent.cli; print({'numpy', 'numba', 'rich'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], env=os.environ, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
