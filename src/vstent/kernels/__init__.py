"""Bare arrays in, bare arrays out, compiled where it pays."""

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


def _keep_compiled() -> None:
    """Let what is compiled be kept where neither the package nor the user's own cache can be written.

    Numba keeps it beside the source or else in the user's cache, and refuses to work where it can do neither.
    """
    places = Path(__file__).parent, _user_cache(), Path.home()
    if not any(place.is_dir() and os.access(place, os.W_OK) for place in places):
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"vstent-{os.getuid()}"))


def _kept_in(sources: Path) -> Path:
    """Where numba keeps what it compiles from a folder."""
    name = f"{sources.name}_{sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given) / name
    return sources / "__pycache__" if os.access(sources, os.W_OK) else _user_cache() / "numba" / name


def _forget_outdated(sources: Path) -> None:
    """Take away what was compiled from other sources.

    Numba looks at a kernel's own file alone, not at those of the functions that are compiled into it: after an upgrade
    that changes only these it would go on with the former ones.
    """
    place = _kept_in(sources)
    digest = sha256(b"".join(path.read_bytes() for path in sorted(sources.glob("*.py")))).hexdigest()
    try:
        if not (place / STAMP).exists() or (place / STAMP).read_text() != digest:
            place.mkdir(parents=True, exist_ok=True)
            for index in place.glob("*.nbi"):
                index.unlink(missing_ok=True)
            (place / STAMP).write_text(digest)
    except OSError:  # it cannot be written, so nobody compiles into it either
        return


if hasattr(os, "getuid"):
    _keep_compiled()
_forget_outdated(Path(__file__).parent)
