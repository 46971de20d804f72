"""A result is computed again when its code or what it uses has changed, and only then."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import vstent
from vstent import phantoms
from vstent.io.writers import write_stl

RUN = """
import json, pathlib, sys
from vstent.devices.treatment import with_device
from vstent.flow.settings import FlowSettings, Numerics
from vstent.reporting import write
from vstent.study.pipeline import run
from vstent.study.settings import InputSettings, Settings

path, out = map(pathlib.Path, sys.argv[1:])
computed, told = [], []

def progress(now):
    if now.stage == "stored results":
        told.append(now.detail)
    elif now.fraction == 1.0 and now.detail != "already done":
        computed.append(now.stage)

write._write = lambda *_: computed.append("report") or ""
flow = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.5, max_steps=20))
settings = Settings(InputSettings("mm"), treatments=(with_device("silk"),), flow=flow)
case = run(path, out, settings, progress)
write.write_report(case, out)
print(json.dumps({"computed": computed, "told": told}))
"""
"""A study with a coarse flow and its report; it prints what was computed and what was said of other code."""
OF_DEVICE = ["deploy silk", "struts silk", "flow silk", "measure", "report"]
"""What follows from a deployment."""


def study(package: Path, folder: Path) -> dict[str, list[str]]:
    """Run the study with a copy of the package."""
    command = [sys.executable, "-W", "ignore", "-c", RUN, str(folder / "artery.stl"), str(folder / "out")]
    environment = os.environ | {"PYTHONPATH": str(package)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def alter(file: Path, before: str, after: str) -> None:
    """Replace text that is in a file once."""
    text = file.read_text()
    assert text.count(before) == 1
    file.write_text(text.replace(before, after))


@pytest.mark.system
def test_a_changed_line_computes_what_depends_on_it_and_nothing_else(tmp_path: Path) -> None:
    package = tmp_path / "package" / "vstent"
    shutil.copytree(Path(vstent.__file__).parent, package)
    (package / "__pycache__" / "vstent.code.json").unlink(missing_ok=True)
    artery = phantoms.with_sac(phantoms.tube(length_mm=24.0), abscissa_mm=12.0, width_mm=5.0, neck_mm=3.5)
    write_stl(tmp_path / "artery.stl", phantoms.phantom_surface(artery, edge_mm=0.6))
    first = study(package.parent, tmp_path)
    assert {"segment", "restore", "flow bare", *OF_DEVICE} <= {*first["computed"]}
    assert first["told"] == []
    numbers = (tmp_path / "out" / "metrics.json").read_bytes()

    for file in package.rglob("*.py"):  # as an installation does
        os.utime(file, (1.0e9, 1.0e9))
    alter(package / "flow" / "simulation.py", '"""Compute one flow: steady', '"""Find one flow: steady')
    alter(package / "deployment" / "deploy.py", "\ndef deploy(", "\n# The only public function.\ndef deploy(")
    alter(package / "study" / "store.py", "self._deferred.clear()", "self._deferred = {}")
    alter(package / "flow" / "settings.py", '"mean inflow of all inlets, such as', '"inflow of all inlets, such as')
    alter(package / "fields.py", "is not yes or no", "is neither yes nor no")
    assert study(package.parent, tmp_path) == {"computed": [], "told": []}

    alter(package / "reporting" / "page.py", "\ndef as_html(", "\n_NEW = 1\n\n\ndef as_html(")
    assert study(package.parent, tmp_path) == {"computed": ["report"], "told": []}

    alter(package / "deployment" / "deploy.py", "# The only public function.", "_NEW = 1")
    again = study(package.parent, tmp_path)
    assert again["computed"] == OF_DEVICE
    (told,) = again["told"]
    assert re.fullmatch(
        r"computed with other code: deploy silk, flow silk; computing them again takes about \d+ s, "
        r"and they are kept until then\.",
        told,
    )
    assert (tmp_path / "out" / "metrics.json").read_bytes() == numbers
    kept = {file.name.partition("-")[0] for file in (tmp_path / "out" / ".vstent").glob("*-*-*.*")}
    assert len([*(tmp_path / "out" / ".vstent").glob("*-*-*.json")]) == len(kept)  # one result of each name
