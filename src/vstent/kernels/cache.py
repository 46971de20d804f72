"""Where compiled kernels are kept between runs, and when they are compiled anew."""

import os
import tempfile
from hashlib import sha1, sha256
from pathlib import Path

# A thread that waits looks for its turn about as long as waking it takes (some 50 microseconds), and then sleeps. To
# look on costs a factor of ten on a machine that is busy otherwise; to sleep at once, a tenth on one that is not.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ |= {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "1000"}

STAMP = "vstent.sources"
"""File beside the kernels kept compiled that says of which sources they are."""


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def choose_folder() -> None:
    """Let what is compiled be kept where neither the package nor the user's own cache can be written.

    Numba keeps it beside the source or else in the user's cache, and refuses to work where it can do neither.
    """
    if not hasattr(os, "getuid"):
        return
    places = Path(__file__).parent, _user_cache(), Path.home()
    if not any(place.is_dir() and os.access(place, os.W_OK) for place in places):
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"vstent-{os.getuid()}"))


def _kept_in(sources: Path) -> Path:
    """Where numba keeps what it compiles from a folder."""
    name = f"{sources.name}_{sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given) / name
    return sources / "__pycache__" if os.access(sources, os.W_OK) else _user_cache() / "numba" / name


def forget_outdated(sources: Path, *also: Path) -> None:
    """Take away what was compiled from other sources than those of a folder, and of further ones it calls.

    Numba looks at a kernel's own file alone, not at those of the functions that are compiled into it: after an upgrade
    that changes only these it would go on with the former ones.
    """
    place = _kept_in(sources)
    files = [file for folder in (sources, *also) for file in sorted(folder.glob("*.py"))]
    digest = sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    try:
        if not (place / STAMP).exists() or (place / STAMP).read_text() != digest:
            place.mkdir(parents=True, exist_ok=True)
            for index in place.glob("*.nbi"):
                index.unlink(missing_ok=True)
            (place / STAMP).write_text(digest)
    except OSError:  # it cannot be written, so nobody compiles into it either
        return
