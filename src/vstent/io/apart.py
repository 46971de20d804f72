"""Read files in a child process, so that a damaged file cannot crash this process or fill its memory.

The child (`vstent.io.child`) writes its arrays into a temporary folder, from which they are mapped into memory.
"""

import errno
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from vstent import errors
from vstent.children import environment
from vstent.errors import ReadError, VstentError
from vstent.io import child

START_SECONDS: Final = 120.0
"""Wall time in which a child must have loaded its libraries and begun to read, in s."""
SECONDS: Final = 8.0
"""CPU time that a child may use for reading, in s; long enough that a sound file is read on a busy machine too."""
SECONDS_PER_BYTE: Final = 1e-6
"""Additional CPU time per byte of the file, in s."""
MEMORY_BYTES: Final = 4_000_000_000
"""Memory that a child may allocate, in bytes."""
MEMORY_PER_BYTE: Final = 40
"""Additional memory per byte of the file, in bytes."""


@contextmanager
def read_apart(
    what: Literal["scan", "mesh"], path: Path, options: Mapping[str, Any], files: Sequence[Path]
) -> Iterator[child.Content]:
    """Read a file in a child process; the arrays are mapped from files that are removed at the end of the block.

    Errors of the reader are raised here. ReadError is raised too where the child dies or exceeds its limits while it
    reads, and VstentError where it does not get so far: that is no fault of the file.
    """
    size = sum(file.stat().st_size for file in files if file.is_file())
    memory, seconds = MEMORY_BYTES + MEMORY_PER_BYTE * size, SECONDS + SECONDS_PER_BYTE * size
    dead = (
        f"{path.name} is damaged, or it is not what its name says: its reader failed, or needs more than "
        f"{memory / 1e9:.0f} GB of memory or {seconds:.0f} s. Copy or export it again."
    )
    with tempfile.TemporaryDirectory(prefix="vstent-") as folder:
        limits = json.dumps({"memory": memory, "seconds": seconds})
        job = (what, str(path.absolute()), json.dumps(options), folder, limits)
        answer = Path(folder) / child.WORDS
        try:
            done = subprocess.run(
                [sys.executable, "-m", child.__name__, *job],
                env=environment(),
                timeout=START_SECONDS + child.PATIENCE * seconds,
                check=False,
                stdin=subprocess.DEVNULL,
                capture_output=True,
            )
            why = (done.stderr.decode(errors="replace").strip().splitlines() or ["no reason stated"])[-1]
            is_uncaught = done.returncode == 1 and child.LATE not in done.stderr  # a crash has another code
        except subprocess.TimeoutExpired:
            why, is_uncaught = f"it did not start within {START_SECONDS:.0f} s", False
        if not (Path(folder) / child.BEGUN).exists() or (is_uncaught and not answer.exists()):
            raise VstentError(f"The process that reads files failed ({why[:200]}). Check the installation of vstent.")
        if not answer.exists():
            raise ReadError(dead)
        words = json.loads(answer.read_text(encoding="utf-8"))
        match words.get("error"):
            case None:
                pass
            case "MemoryError":
                raise MemoryError
            case "Limit":
                raise ReadError(dead)
            case "OSError":
                raise OSError(words["errno"], os.strerror(words["errno"]), words["file"])
            case kind:
                raise getattr(errors, kind)(words["sentence"])
        # Windows cannot remove mapped files.
        mode: Literal["r"] | None = None if sys.platform == "win32" else "r"
        try:
            arrays = {file.stem: np.load(file, mmap_mode=mode) for file in Path(folder).glob("*.npy")}
        except OSError as error:
            if error.errno == errno.ENOMEM:
                raise MemoryError from error
            raise
        yield arrays, words
