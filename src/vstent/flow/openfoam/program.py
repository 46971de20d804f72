"""The OpenFOAM installation: find it, run its programs, and summarize their failures."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vstent.errors import FlowError
from vstent.flow.openfoam.setup import FEATURES, Flavour

DEBIAN_FOLDER: Final = Path("/usr/share/openfoam")
"""Folder with the settings that the programs of Debian's package look for."""
INSTALLED: Final = ("/usr/lib/openfoam/openfoam*", "/opt/openfoam*", "/opt/OpenFOAM/OpenFOAM-*")
"""Folders where the packages of openfoam.com and openfoam.org install; each has an etc/bashrc."""
MARKS: Final[dict[str, Flavour]] = {"foamRun": "org", FEATURES["com"]: "com"}
"""A program found only in current releases of each flavour. Releases of openfoam.org before 11 have neither of them
and use other settings."""
INSTALL: Final = "install it (Debian, Ubuntu: sudo apt-get install openfoam), or choose the embedded engine"
"""Advice when OpenFOAM is missing."""


@dataclass(frozen=True)
class Program:
    """An OpenFOAM installation on this machine."""

    flavour: Flavour
    """Which OpenFOAM it is."""
    bashrc: Path | None
    """File to source before running its programs; None where they are on the path."""

    def command(self, *words: str) -> list[str]:
        """Return the command line that runs one of its programs."""
        if self.bashrc is None:
            return list(words)
        return ["bash", "-c", '. "$0" > /dev/null 2>&1; exec "$@"', str(self.bashrc), *words]


def find() -> Program:
    """Find OpenFOAM on the path or in its install folders, the newest release of each kind of package first.

    Raises
    ------
    FlowError
        OpenFOAM is not found.
    """
    if flavour := _flavour(None):
        return Program(flavour, None)
    for pattern in INSTALLED:
        for folder in sorted(Path("/").glob(pattern[1:]), key=_release, reverse=True):
            flavour, bashrc = _flavour(folder.glob("platforms/*/bin")), folder / "etc" / "bashrc"
            if flavour and bashrc.exists():
                return Program(flavour, bashrc)
    raise FlowError(f"OpenFOAM was not found: {INSTALL}")


def _flavour(folders: Iterable[Path] | None) -> Flavour | None:
    """Return the flavour whose programs are in the folders (default: the path), or None."""
    path = None if folders is None else os.pathsep.join(map(str, folders))
    return next((flavour for mark, flavour in MARKS.items() if shutil.which(mark, path=path)), None)


def _release(folder: Path) -> int:
    """Return the release number in a folder's name, 0 without one; compared as a number, because 13 is after 9."""
    return int(re.sub(r"\D", "", folder.name) or 0)


def run(program: Program, folder: Path, words: list[str], *, processes: int = 1) -> str:
    """Run a program of OpenFOAM in a case folder, append its output to log.NAME, and return the new output.

    Parameters
    ----------
    program : Program
        The installation.
    folder : Path
        The case folder.
    words : list of str
        Name of the program and its arguments.
    processes : int
        Number of MPI processes.

    Raises
    ------
    FlowError
        The program fails; the message gives the reason.
    """
    name = words[0]
    if processes > 1:
        words = ["mpirun", "-np", str(processes), *words, "-parallel"]
    log = folder / f"log.{name}"
    before = log.stat().st_size if log.exists() else 0
    with log.open("ab") as output:
        try:
            done = subprocess.run(
                program.command(*words),
                cwd=folder,
                env=_environment(),
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


def _environment() -> dict[str, str]:
    """Return the environment variables for a program of OpenFOAM."""
    environment = dict(os.environ)
    if DEBIAN_FOLDER.is_dir():
        environment.setdefault("WM_PROJECT_DIR", str(DEBIAN_FOLDER))
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # in containers: Open MPI refuses root without both variables
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return environment


def cause(said: str, code: int) -> str:
    """Return a phrase on why a program of OpenFOAM failed.

    Parameters
    ----------
    said : output of the program.
    code : exit status.
    """
    if code == -9 or "Killed" in said or "bad_alloc" in said:
        return "the memory was not sufficient; use a coarser grid spacing or fewer processes"
    if fatal := re.search(
        r"FOAM FATAL(?: IO)? ERROR:?\s*(?:\(openfoam-[^)]*\)\s*)?(.*?)(?:\n\s*\n\s*From|\n\nfile:|\Z)", said, re.DOTALL
    ):
        return " ".join(fatal[1].split())[:300]
    if "sigFpe" in said or "Floating point exception" in said or code == 136:
        return f"the flow diverged, {_divergence(said)}"
    return f"exit status {code}; {' '.join(said.splitlines()[-1:])}"


def _divergence(said: str) -> str:
    """Return the likely cause of divergence: the time step, backflow at an outlet, or the mesh."""
    courant = [float(number) for number in re.findall(r"Courant Number mean: \S+ max: (\S+)", said)]
    if courant and courant[-1] > 20:
        return f"the time step is too long (Courant number {courant[-1]:.0f}); reduce it or use a finer grid spacing"
    times = re.findall(r"^Time = (\S+?)s?$", said, re.MULTILINE)
    return (
        f"at {times[-1] if times else 'the start'}: a cell of the mesh is too flat, or there is strong backflow at an "
        "outlet; change the grid spacing slightly, use fewer wall layers, or lengthen the outlets"
    )
