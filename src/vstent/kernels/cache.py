"""Location of numba's compiled kernels, and their removal when the sources have changed."""

import os
import tempfile
from hashlib import sha1, sha256
from pathlib import Path

# A waiting thread polls about as long as waking it takes (50 microseconds) and then sleeps. Polling for longer is ten
# times slower on a machine that is busy with other work; sleeping at once is 10 % slower on an idle one.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ |= {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}

STAMP = "vstent.sources"
"""Name of the file beside the compiled kernels that holds the hash of their sources."""


def _user_cache() -> Path:
    """Return the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def choose_folder() -> None:
    """Let numba keep compiled kernels in a temporary folder where no other place is writable.

    Numba uses the folder of the source or the user's cache, and fails where it can write to neither.
    """
    if not hasattr(os, "getuid"):
        return
    places = Path(__file__).parent, _user_cache(), Path.home()
    if not any(place.is_dir() and os.access(place, os.W_OK) for place in places):
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"vstent-{os.getuid()}"))


def kept_in(sources: Path) -> Path:
    """Return the folder where numba keeps what it compiles from a source folder; it is writable."""
    name = f"{sources.name}_{sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given) / name
    return sources / "__pycache__" if os.access(sources, os.W_OK) else _user_cache() / "numba" / name


def forget_outdated(sources: Path, *also: Path) -> None:
    """Remove compiled kernels whose sources have changed.

    Numba checks only a kernel's own file, not those of the functions compiled into it. After an upgrade that changes
    only these, it would use outdated code.

    Parameters
    ----------
    sources : Path
        Folder of the kernels.
    also : Path
        Further folders with functions that they call.
    """
    place = kept_in(sources)
    files = [file for folder in (sources, *also) for file in sorted(folder.glob("*.py"))]
    digest = sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    try:
        if not (place / STAMP).exists() or (place / STAMP).read_text() != digest:
            place.mkdir(parents=True, exist_ok=True)
            for index in place.glob("*.nbi"):
                index.unlink(missing_ok=True)
            (place / STAMP).write_text(digest)
    except OSError:  # the folder is not writable, so that nothing is compiled into it
        return
