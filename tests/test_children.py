"""No child process runs code of the folder that the user stands in, nor the user's script a second time."""

import operator
import os
import subprocess
import sys
from pathlib import Path

import pytest
from faults import artery

from vstent.children import environment
from vstent.flow.lattice.kernels import warm
from vstent.io.surfaces import read_surface
from vstent.io.writers import write_stl
from vstent.kernels.first_use import ensure_cached
from vstent.plan.workers import spread
from vstent.study.workers import Processes

SOURCES = Path(warm.__file__).parents[3]
NAMES = ("random", "pickle", "struct", "multiprocessing", "numpy", "secrets", "runpy", "logging", "vstent")
RAN = "import os, pathlib\npathlib.Path({!r}).touch()\nos._exit(3)\n"
"""Leaves a mark and ends the process."""


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """Stand in a folder with files named like modules; afterwards none of them has run."""
    folder, mark = tmp_path / "trap", tmp_path / "ran"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(RAN.format(str(mark)))
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", str(SOURCES.parent)]))  # an empty entry is this folder
    yield folder
    assert not mark.exists()


def test_the_trap_works(trap, tmp_path):
    """Without our environment the files run."""
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    assert subprocess.run([sys.executable, "-c", "import random"], env=plain, check=False).returncode == 3
    (tmp_path / "ran").unlink()
    assert subprocess.run([sys.executable, "-c", "import random"], env=environment(), check=False).returncode == 0


def test_files_are_read_and_kernels_compiled_in_a_folder_of_namesakes(trap, tmp_path):
    write_stl(tmp_path / "a.stl", artery())
    assert len(read_surface(tmp_path / "a.stl", units="mm")[0].faces) == len(artery().faces)
    ensure_cached(lambda: None, (sys.executable, "-c", "import random, vstent.cli"))


def test_workers_start_in_a_folder_of_namesakes(trap):
    assert list(spread(operator.mul, 3, [1, 2], jobs=2)) == [3, 6]
    assert list(Processes(1).do(operator.neg, [1])) == [(0, "")]


def test_the_command_line_as_a_module_skips_the_folder(trap, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(SOURCES.parent))
    command = [sys.executable, "-m", "vstent", "trace", "no.docx", "--out", "out"]
    os.unlink(trap / "vstent.py")  # Python itself looks for the module to run in this folder
    os.unlink(trap / "runpy.py")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, "does not exist" in done.stderr) == (2, True), done.stderr


PLAIN = "import operator\nfrom vstent.plan.workers import spread\nprint(sum(spread(operator.mul, 3, [1, 2], jobs=2)))\n"


@pytest.mark.parametrize("is_piped", [False, True])
def test_a_script_without_a_main_guard_has_workers(tmp_path, is_piped):
    (tmp_path / "plain.py").write_text(PLAIN)
    command = [sys.executable, "-" if is_piped else str(tmp_path / "plain.py")]
    done = subprocess.run(command, env=environment(), input=PLAIN, capture_output=True, text=True, check=True)
    assert done.stdout == "9\n"


def test_no_process_is_started_without_these_precautions():
    starts = ("subprocess.run(", "subprocess.Popen(", "get_context(")
    careless = [
        file.name
        for file in SOURCES.rglob("*.py")
        if file.parent.name != "openfoam"  # its processes run no Python
        and any(word in (text := file.read_text(encoding="utf-8")) for word in starts)
        and not any(word in text for word in ("environment()", "spawning()"))
    ]
    assert careless == []
