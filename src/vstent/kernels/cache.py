"""Location of numba's compiled kernels, and their removal when the sources have changed."""

import atexit
import os
import shutil
import stat
import tempfile
from contextlib import suppress
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
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def choose_folder() -> None:
    """Let numba keep compiled kernels in a private temporary folder where no other place is writable.

    Numba uses ``NUMBA_CACHE_DIR``, the folder of the source or the user's cache, and fails where it can write to none.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    places = [Path(given)] if given else []
    if hasattr(os, "getuid") and not any(map(_is_writable, [*places, Path(__file__).parent, _user_cache()])):
        os.environ["NUMBA_CACHE_DIR"] = str(_private_folder())


def _is_writable(place: Path) -> bool:
    """Return whether a folder is writable, or can be made."""
    there = next((one for one in (place, *place.parents) if one.exists()), place)
    return place.is_absolute() and there.is_dir() and os.access(there, os.W_OK)


def _private_folder() -> Path:
    """Return a temporary folder that no other user can write to, because numba runs the code that it finds there."""
    shared = Path(tempfile.gettempdir()) / f"vstent-{os.getuid()}"
    with suppress(OSError):
        shared.mkdir(mode=0o700, exist_ok=True)
        state = shared.lstat()
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077:
            return shared
    own = tempfile.mkdtemp(prefix="vstent-")
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return Path(own)


def cache_folder(sources: Path) -> Path:
    """Return the folder where numba keeps what it compiles from a source folder; it is writable."""
    name = f"{sources.name}_{sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and _is_writable(Path(given)):
        return Path(given) / name
    return sources / "__pycache__" if os.access(sources, os.W_OK) else _user_cache() / "numba" / name


def forget_outdated(sources: Path, *also: Path) -> None:
    """Remove compiled kernels whose sources, or those in further folders that they call, have changed.

    Numba checks only a kernel's own file, not those of the functions compiled into it. After an upgrade that changes
    only these, it would use outdated code.
    """
    place = cache_folder(sources)
    files = [file for folder in (sources, *also) for file in sorted(folder.glob("*.py"))]
    digest = sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    try:
        if not (place / STAMP).exists() or (place / STAMP).read_text(encoding="utf-8") != digest:
            place.mkdir(parents=True, exist_ok=True)
            for index in place.glob("*.nbi"):
                index.unlink(missing_ok=True)
            (place / STAMP).write_text(digest, encoding="utf-8")
    except OSError:
        return  # the folder is not writable, so that nothing is compiled into it
