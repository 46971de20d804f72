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
from numpy.typing import NDArray

from vstent import errors
from vstent.children import environment
from vstent.errors import ReadError, VstentError
from vstent.io import child

SECONDS: Final = 8.0
"""CPU time that a child may use, in s; long enough that a sound file is read on a busy machine too."""
SECONDS_PER_BYTE: Final = 1e-6
"""Additional CPU time per byte of the file, in s."""
PATIENCE: Final = 1.0 if sys.platform == "win32" else 10.0
"""Wall time allowed per second of CPU time; Windows limits wall time only."""
MEMORY_BYTES: Final = 4_000_000_000
"""Memory that a child may allocate, in bytes."""
MEMORY_PER_BYTE: Final = 40
"""Additional memory per byte of the file, in bytes."""

Found = tuple[dict[str, NDArray[Any]], dict[str, Any]]
"""Arrays by name, and everything else."""


@contextmanager
def read_apart(
    what: Literal["scan", "mesh"], path: Path, options: Mapping[str, Any], files: Sequence[Path]
) -> Iterator[Found]:
    """Read a file in a child process; the arrays are mapped from files that are removed at the end of the block.

    Raises
    ------
    ReadError
        The file cannot be read, or the child died or exceeded its limits.
    UnitError
        The reader raises it.
    VstentError
        The child did not start.
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
        try:
            done = subprocess.run(
                [sys.executable, "-m", child.__name__, *job],
                env=environment(),
                timeout=PATIENCE * seconds,
                check=False,
                stdin=subprocess.DEVNULL,
                capture_output=True,
            )
        except subprocess.TimeoutExpired:
            raise ReadError(dead) from None
        answer = Path(folder) / child.WORDS
        if not answer.exists() and done.returncode == 1:  # a crash has another code
            why = (done.stderr.decode(errors="replace").strip().splitlines() or ["no reason stated"])[-1]
            raise VstentError(f"The process that reads files failed ({why[:200]}). Check the installation of vstent.")
        if not answer.exists():
            raise ReadError(dead)
        words = json.loads(answer.read_text(encoding="utf-8"))
        _raise(words, dead)
        # Windows cannot remove mapped files.
        mode: Literal["r"] | None = None if sys.platform == "win32" else "r"
        try:
            arrays = {file.stem: np.load(file, mmap_mode=mode) for file in Path(folder).glob("*.npy")}
        except OSError as error:
            if error.errno == errno.ENOMEM:
                raise MemoryError from error
            raise
        yield arrays, words


def _raise(words: Mapping[str, Any], dead: str) -> None:
    """Raise the error that a child reports."""
    kind, sentence = words.get("error"), words.get("sentence", "")
    if kind == "MemoryError":
        raise MemoryError
    if kind == "Limit":
        raise ReadError(dead)
    if kind == "OSError":
        raise OSError(words["errno"], os.strerror(words["errno"]), words["file"])
    if kind is not None:
        raise getattr(errors, kind)(sentence)
