"""A case folder on disk: written, meshed, begun from another flow, sent to its next stop, read for its flow rates."""

import hashlib
import re
import shutil
from pathlib import Path
from typing import Final

import numpy as np

from vstent.flow import sampling
from vstent.flow.case import FlowField
from vstent.flow.openfoam import program, results
from vstent.flow.openfoam.case import FoamCase
from vstent.flow.openfoam.setup import FEATURES, FoamSetup
from vstent.io.writers import write_text
from vstent.kernels.arrays import Floats
from vstent.units import M3_PER_ML, M_PER_MM

KEY: Final = "vstent.key"
"""File that names what a folder's run depends on."""
MESHED: Final = "log.meshed"
"""File that says that the mesh is complete."""
BETWEEN_PARTS: Final = re.compile(r"(procBoundary\w*\s*\{[^}]*?)\s*value\s[^;]*;")
"""What a field's file says of a patch between two parts of the mesh, up to its value."""
PRODUCTS: Final = ("constant/polyMesh", "postProcessing", "processor*", "log.*", "[0-9]*", KEY)
"""What a run leaves in a case folder."""


def write(folder: Path, foam: FoamCase) -> None:
    """Write the files of a case, its scripts executable."""
    for name, text in foam.files.items():
        write_text(folder / name, text)
        (folder / name).chmod(0o755 if name in foam.executable else 0o644)


def prepare(folder: Path, foam: FoamCase) -> None:
    """Write a case to be run, unless the same case lies there already; what another run left is taken away."""
    digest = hashlib.sha256("".join(f"{name}\0{text}\0" for name, text in sorted(foam.files.items())).encode())
    key = folder / KEY
    if key.exists() and key.read_text() == digest.hexdigest():
        return
    for path in (found for pattern in PRODUCTS for found in folder.glob(pattern)):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    write(folder, foam)
    write_text(key, digest.hexdigest())


def mesh(found: program.Program, folder: Path, setup: FoamSetup) -> None:
    """Mesh, cut into parts and note the cells' centres, unless that has been done.

    Raises
    ------
    FlowError
        When a program of OpenFOAM fails.
    """
    if (folder / MESHED).exists():
        return
    for words in (
        [FEATURES[found.flavour]],
        ["blockMesh"],
        ["snappyHexMesh", "-overwrite"],
        ["renumberMesh", "-overwrite"],
    ):
        program.run(found, folder, words)
    if setup.processes > 1:
        program.run(found, folder, ["decomposePar", "-force"])
    after = "foamPostProcess" if found.flavour == "org" else "postProcess"
    program.run(found, folder, [after, "-func", "writeCellCentres", "-time", "0"], processes=setup.processes)
    write_text(folder / MESHED, "")


def begin_from(folder: Path, start: FlowField) -> None:
    """Put a flow on any grid into the first velocity and pressure of a meshed case."""
    for part in list(folder.glob("processor[0-9]*")) or [folder]:
        centers_mm = results.read_field(part, "0", "C").inside / M_PER_MM
        velocity_m_s, pressure_Pa = sampling.values_at(start, centers_mm)
        _put(part / "0" / "U", "vector", "(%.7g %.7g %.7g)", velocity_m_s)
        _put(part / "0" / "p", "scalar", "%.7g", pressure_Pa[:, None] / start.blood.density_kg_m3)


def _put(path: Path, kind: str, row: str, values: Floats) -> None:
    """Replace what a uniform field has inside by values (n, d).

    On the faces between parts of a mesh the uniform value would stay, and blood at rest there would dam the flow up:
    it is taken away, and OpenFOAM takes that of the cells beside.
    """
    rows = "\n".join(row % tuple(value) for value in values)
    head, _, tail = path.read_text().partition("internalField")
    rest = BETWEEN_PARTS.sub(r"\1", tail.partition(";")[2])
    write_text(path, f"{head}internalField nonuniform List<{kind}>\n{len(values)}\n(\n{rows}\n)\n;{rest}")


def stop_at(folder: Path, end: float, *, every: int | None) -> None:
    """Let the solver stop, and write, at a time; write `every` so many iterations besides."""
    path = folder / "system" / "controlDict"
    text = re.sub(r"endTime .*;", f"endTime         {end:.9g};", path.read_text())
    if every is not None:
        text = re.sub(r"writeInterval .*;", f"writeInterval   {every};", text, count=1)
    write_text(path, text)


def flow_mL_s(folder: Path, patch: str, time: str) -> float:
    """Flow out through a patch at a time, as the function objects noted it; the last run's, where several did."""
    files = sorted(
        (folder / "postProcessing" / f"flow_{patch}").glob("*/*.dat"), key=lambda path: float(path.parent.name)
    )
    rows = np.concatenate([np.loadtxt(path, usecols=(0, 1), ndmin=2) for path in reversed(files)])
    return float(rows[np.abs(rows[:, 0] - float(time)).argmin(), 1]) / M3_PER_ML


def scale_inflow(folder: Path, inlet: str, factor: float) -> bool:
    """Multiply the mean speed that an inlet is held to; False where it is held to its flow anyway."""
    path = folder / "constant" / "boundaryData" / inlet / "0" / "U"
    if not path.exists():
        return False
    lines = path.read_text().splitlines()
    mean = [factor * float(x) for x in lines[-1].strip("()").split()]
    write_text(path, "\n".join([*lines[:-1], "(" + " ".join(f"{x:.9g}" for x in mean) + ")", ""]))
    return True
