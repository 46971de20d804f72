"""What a release holds: one version everywhere, requirements stated once, and a package that runs on other systems."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA_NAMES = {"matplotlib": "matplotlib-base", "simpleitk": "simpleitk", "vtk": "vtk-base"}
"""Names of packages that conda-forge calls otherwise."""

AS_ON_WINDOWS = r"""
import os, signal, sys, warnings

warnings.filterwarnings("error", category=EncodingWarning, module=r"vstent\.")
for module in ("fcntl", "resource", "grp", "pwd", "termios"):
    sys.modules[module] = None
for name in ("fork", "getuid", "killpg", "nice", "sched_getaffinity", "setsid"):
    delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGPIPE"):
    delattr(signal, name)
"""
"""Run by every Python at its start: takes away what Windows lacks; a text file of no stated encoding is an error."""


def test_one_version_everywhere():
    citation = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    recipe = re.search(r"^  version: (.+)$", (ROOT / "packaging/recipe.yaml").read_text(encoding="utf-8"), re.MULTILINE)
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert {found[1] for found in (citation, recipe, newest) if found} == {PROJECT["version"]}
    assert None not in (citation, recipe, newest)


def test_the_conda_recipe_requires_what_the_package_requires():
    """With the page, which is an extra for pip only."""
    recipe = (ROOT / "packaging/recipe.yaml").read_text(encoding="utf-8")
    stated = re.search(r"^  run:\n((?:    - .+\n)+)", recipe, re.MULTILINE)
    wanted = {f"python {PROJECT['requires-python']}"}
    for line in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["app"]):
        name, least = line.lower().split(">=")
        wanted.add(f"{CONDA_NAMES.get(name, name)} >={least}")
    assert stated is not None
    assert set(re.findall(r"- (.+)", stated[1])) == wanted


@pytest.mark.system
def test_a_study_runs_without_what_other_systems_lack(tmp_path):
    """From the scan to the report with a flow, the processes that it starts included."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(AS_ON_WINDOWS, encoding="utf-8")
    paths = [str(tmp_path / "site"), str(ROOT / "src")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONWARNDEFAULTENCODING": "1"}
    check = [sys.executable, "-c", "import os; os.fork"]
    assert b"no attribute 'fork'" in subprocess.run(check, env=environment, capture_output=True, check=False).stderr
    study = ["demo", "--grid-spacing", "0.5", "--device", "silk", "--out", str(tmp_path / "demo")]
    done = subprocess.run(
        [sys.executable, "-m", "vstent", *study], env=environment, capture_output=True, check=False, encoding="utf-8"
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "report.html").stat().st_size > 100_000
