"""OpenFOAM itself, a separate program: found on this machine, run in a folder, its failures put into a sentence."""

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
"""Where Debian's package keeps the settings its programs look for."""
INSTALLED: Final = ("/usr/lib/openfoam/openfoam*", "/opt/openfoam*", "/opt/OpenFOAM/OpenFOAM-*")
"""Where the packages of openfoam.com and openfoam.org lie; each has an etc/bashrc."""
MARKS: Final[dict[str, Flavour]] = {"foamRun": "org", FEATURES["com"]: "com"}
"""A program of each one's current releases: those of openfoam.org before 11 have neither, and read other settings."""
INSTALL: Final = "install it (Debian, Ubuntu: sudo apt-get install openfoam), or use the embedded engine"


@dataclass(frozen=True)
class Program:
    """An OpenFOAM found on this machine."""

    flavour: Flavour
    """Whose it is."""
    bashrc: Path | None
    """What to source before its programs run; None where they are on the path."""

    def command(self, *words: str) -> list[str]:
        """Return the command line that runs one of its programs."""
        if self.bashrc is None:
            return list(words)
        return ["bash", "-c", '. "$0" > /dev/null 2>&1; exec "$@"', str(self.bashrc), *words]


def find() -> Program:
    """Find OpenFOAM: on the path, or where its packages install it, the newest of each kind of package first.

    Raises
    ------
    FlowError
        When there is none.
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
    """Whose current programs lie in folders, those of the path without any given; None where none do."""
    path = None if folders is None else os.pathsep.join(map(str, folders))
    return next((flavour for mark, flavour in MARKS.items() if shutil.which(mark, path=path)), None)


def _release(folder: Path) -> int:
    """Number of a release in its folder's name, 0 where it has none: 13 is after 9."""
    return int(re.sub(r"\D", "", folder.name) or 0)


def run(program: Program, folder: Path, words: list[str], *, processes: int = 1) -> str:
    """Run a program of OpenFOAM in a case folder, its output appended to log.NAME; return what it said this time.

    Raises
    ------
    FlowError
        When it fails, with its reason.
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
            raise FlowError(f"{words[0]} was not found beside OpenFOAM: {INSTALL}") from None
    with log.open("rb") as stream:
        stream.seek(before)
        said = stream.read().decode(errors="replace")
    if done.returncode != 0 or "FOAM FATAL" in said:
        raise FlowError(f"{name} failed: {cause(said, done.returncode)} (see {log})")
    return said


def _environment() -> dict[str, str]:
    environment = dict(os.environ)
    if DEBIAN_FOLDER.is_dir():
        environment.setdefault("WM_PROJECT_DIR", str(DEBIAN_FOLDER))
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # in containers; Open MPI refuses root unless told twice
        environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    return environment


def cause(said: str, code: int) -> str:
    """One sentence for what a program of OpenFOAM stopped at.

    Parameters
    ----------
    said : its output.
    code : its exit status.
    """
    if code == -9 or "Killed" in said or "bad_alloc" in said:
        return "it was stopped for lack of memory: use a wider grid spacing or fewer processes"
    if fatal := re.search(
        r"FOAM FATAL(?: IO)? ERROR:?\s*(?:\(openfoam-[^)]*\)\s*)?(.*?)(?:\n\s*\n\s*From|\n\nfile:|\Z)", said, re.DOTALL
    ):
        return " ".join(fatal[1].split())[:300]
    if "sigFpe" in said or "Floating point exception" in said or code == 136:
        return f"the flow diverged, {_divergence(said)}"
    return f"it ended with status {code}; {' '.join(said.splitlines()[-1:])}"


def _divergence(said: str) -> str:
    """Which of the usual three it was: the time step, a backflow at an outlet, or the mesh."""
    courant = [float(number) for number in re.findall(r"Courant Number mean: \S+ max: (\S+)", said)]
    if courant and courant[-1] > 20:
        return f"the time step is too long (Courant number {courant[-1]:.0f}): shorten it or use a finer grid spacing"
    times = re.findall(r"^Time = (\S+?)s?$", said, re.MULTILINE)
    return (
        f"at {times[-1] if times else 'the start'}, because a cell of the mesh is too flat or blood flows back "
        "through an outlet: change the grid spacing a little, use fewer wall layers, or extend the outlets"
    )
