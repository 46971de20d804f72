"""An OpenFOAM case folder on disk: write, mesh, initialize, set the next stop, read flow rates."""

import hashlib
import re
import shutil
from pathlib import Path
from typing import Final

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowField
from vstent.flow.openfoam import program, results
from vstent.flow.openfoam.case import SCRIPTS, FoamCase
from vstent.flow.openfoam.dictionary import vector
from vstent.flow.openfoam.setup import FoamSetup
from vstent.io.writers import write_text
from vstent.units import M3_PER_ML, M_PER_MM

KEY: Final = "vstent.key"
"""File with a hash of everything that a folder's run depends on."""
MESHED: Final = "log.meshed"
"""File that marks the mesh as complete."""
BETWEEN_PARTS: Final = re.compile(r"(procBoundary\w*\s*\{[^}]*?)\s*value\s[^;]*;")
"""Matches the entry of a patch between two parts of the mesh in a field's file, up to and including its value."""
PRODUCTS: Final = ("constant/polyMesh", "postProcessing", "processor*", "log.*", "[0-9]*", KEY)
"""Files that a run leaves in a case folder."""


def write(folder: Path, foam: FoamCase) -> None:
    """Write the files of a case and make its scripts executable."""
    for name, text in foam.files.items():
        write_text(folder / name, text)
        (folder / name).chmod(0o755 if name in SCRIPTS else 0o644)


def prepare(folder: Path, foam: FoamCase) -> None:
    """Write a case to run, unless the folder already contains the same case; delete what another run left."""
    digest = hashlib.sha256("".join(f"{name}\0{text}\0" for name, text in sorted(foam.files.items())).encode())
    key = folder / KEY
    if key.exists() and key.read_text(encoding="utf-8") == digest.hexdigest():
        return
    for path in (found for pattern in PRODUCTS for found in folder.glob(pattern)):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    write(folder, foam)
    write_text(key, digest.hexdigest())


def mesh(found: program.Program, folder: Path, setup: FoamSetup) -> None:
    """Mesh the case, decompose it and write the cell centres, unless that is already done."""
    if (folder / MESHED).exists():
        return
    commands = [
        [setup.dialect.features],
        ["blockMesh"],
        ["snappyHexMesh", "-overwrite"],
        ["renumberMesh", "-overwrite"],
    ]
    if (folder / "system" / "topoSetDict").exists():
        commands.append(["topoSet"])
    if setup.processes > 1:
        commands.append(["decomposePar", "-force"])
    for words in commands:
        program.run(found, folder, words)
    centres = [setup.dialect.post_process, "-func", "writeCellCentres", "-time", "0"]
    program.run(found, folder, centres, processes=setup.processes)
    write_text(folder / MESHED, "")


def begin_from(folder: Path, start: FlowField) -> None:
    """Write a flow on any grid as the initial velocity and pressure of a meshed case.

    The uniform values on faces between parts of the mesh are removed, so that OpenFOAM uses those of the adjacent
    cells. Kept, they would act as blood at rest there and block the flow.
    """
    for part in list(folder.glob("processor[0-9]*")) or [folder]:
        velocity_m_s, pressure_Pa = sampling.values_at(start, results.read_field(part, "0", "C").inside / M_PER_MM)
        for name, kind, row, values in (
            ("U", "vector", "(%.7g %.7g %.7g)", velocity_m_s),
            ("p", "scalar", "%.7g", pressure_Pa[:, None] / start.blood.density_kg_m3),
        ):
            rows = "\n".join(row % tuple(value) for value in values)
            head, _, tail = (part / "0" / name).read_text(encoding="utf-8").partition("internalField")
            rest = BETWEEN_PARTS.sub(r"\1", tail.partition(";")[2])
            inside = f"internalField nonuniform List<{kind}>\n{len(values)}\n(\n{rows}\n)\n;"
            write_text(part / "0" / name, f"{head}{inside}{rest}")


def stop_at(folder: Path, end: float) -> None:
    """Set the iteration or time at which the solver stops."""
    path = folder / "system" / "controlDict"
    write_text(path, re.sub(r"endTime .*;", f"endTime         {end:.9g};", path.read_text(encoding="utf-8")))


def flow_mL_s(folder: Path, patch: str, time: str) -> float:
    """Return the flow rate out through a patch at a time, from the latest run whose function objects recorded it."""
    files = sorted(
        (folder / "postProcessing" / f"flow_{patch}").glob("*/*.dat"), key=lambda path: float(path.parent.name)
    )
    rows = np.concatenate([np.loadtxt(path, usecols=(0, 1), ndmin=2) for path in reversed(files)])
    return float(rows[np.abs(rows[:, 0] - float(time)).argmin(), 1]) / M3_PER_ML


def scale_inflow(folder: Path, inlet: str, factor: float) -> bool:
    """Multiply the mean speed prescribed at an inlet; return False if the inlet prescribes its flow rate instead."""
    paths = list((folder / "constant" / "boundaryData" / inlet).glob("*/U"))
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        mean = [factor * float(x) for x in lines[-1].strip("()").split()]
        write_text(path, "\n".join([*lines[:-1], vector(mean), ""]))
    return bool(paths)
