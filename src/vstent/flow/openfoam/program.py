"""The OpenFOAM installation: find it, run its programs, and summarize their failures."""

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vstent.errors import FlowError
from vstent.flow.openfoam.dialects import DIALECTS, Flavour

DEBIAN_FOLDER: Final = Path("/usr/share/openfoam")
"""Folder with the settings that the programs of Debian's package look for."""
INSTALLED: Final = ("/usr/lib/openfoam/openfoam*", "/opt/openfoam*", "/opt/OpenFOAM/OpenFOAM-*")
"""Folders where the packages of openfoam.com and openfoam.org install; each has an etc/bashrc."""
INSTALL: Final = "install it (Debian, Ubuntu: sudo apt-get install openfoam), or choose the embedded engine"
"""Advice when OpenFOAM is missing."""


@dataclass(frozen=True)
class Program:
    """An OpenFOAM installation on this machine."""

    flavour: Flavour
    """Which OpenFOAM it is."""
    bashrc: Path | None
    """File to source before running its programs; None where they are on the path."""


def find() -> Program:
    """Find OpenFOAM on the path or in its install folders, the newest release of each kind of package first."""
    places: list[tuple[str | None, Path | None]] = [(None, None)]  # the path
    for pattern in INSTALLED:
        # Releases are compared as numbers, because 13 is after 9; a folder without one comes last.
        folders = sorted(Path("/").glob(pattern[1:]), key=lambda folder: int(re.sub(r"\D", "", folder.name) or 0))
        for folder in reversed(folders):
            places.append((os.pathsep.join(map(str, folder.glob("platforms/*/bin"))), folder / "etc" / "bashrc"))
    for path, bashrc in places:
        for flavour, dialect in DIALECTS.items():
            if shutil.which(dialect.mark, path=path) and (bashrc is None or bashrc.exists()):
                return Program(flavour, bashrc)
    raise FlowError(f"OpenFOAM was not found: {INSTALL}")


def run(program: Program, folder: Path, words: list[str], *, processes: int = 1) -> str:
    """Run a program of OpenFOAM in a case folder, append its output to log.NAME, and return the new output."""
    name = words[0]
    if processes > 1:
        words = ["mpirun", "-np", str(processes), *words, "-parallel"]
    environment = dict(os.environ)
    if DEBIAN_FOLDER.is_dir():
        environment.setdefault("WM_PROJECT_DIR", str(DEBIAN_FOLDER))
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # in containers: Open MPI refuses root without both variables
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    command = list(words)
    if program.bashrc is not None:
        command = ["bash", "-c", '. "$0" > /dev/null 2>&1; exec "$@"', str(program.bashrc), *words]
    log = folder / f"log.{name}"
    before = log.stat().st_size if log.exists() else 0
    with log.open("ab") as output:
        try:
            done = subprocess.run(
                command,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
            )
        except FileNotFoundError:
            raise FlowError(f"the program {words[0]} was not found in the OpenFOAM installation: {INSTALL}") from None
    with log.open("rb") as stream:
        stream.seek(before)
        said = stream.read().decode(errors="replace")
    if done.returncode != 0 or "FOAM FATAL" in said:
        raise FlowError(f"{name} failed: {cause(said, done.returncode)} (full output: {log})")
    return said


def cause(said: str, code: int) -> str:
    """Return a phrase on why a program of OpenFOAM failed, from its output and exit status."""
    if code == -9 or "Killed" in said or "bad_alloc" in said:
        return "the memory was not sufficient; use a coarser grid spacing or fewer processes"
    if fatal := re.search(
        r"FOAM FATAL(?: IO)? ERROR:?\s*(?:\(openfoam-[^)]*\)\s*)?(.*?)(?:\n\s*\n\s*From|\n\nfile:|\Z)", said, re.DOTALL
    ):
        return " ".join(fatal[1].split())[:300]
    if "sigFpe" not in said and "Floating point exception" not in said and code != 136:
        return f"exit status {code}; {' '.join(said.splitlines()[-1:])}"
    courant = [float(number) for number in re.findall(r"Courant Number mean: \S+ max: (\S+)", said)]
    if courant and courant[-1] > 20:
        return (
            f"the flow diverged, the time step is too long (Courant number {courant[-1]:.0f}); "
            "reduce it or use a finer grid spacing"
        )
    times = re.findall(r"^Time = (\S+?)s?$", said, re.MULTILINE)
    return (
        f"the flow diverged, at {times[-1] if times else 'the start'}: a cell of the mesh is too flat, or there is "
        "strong backflow at an outlet; change the grid spacing slightly, use fewer wall layers, or lengthen the outlets"
    )
