"""Bare arrays in, bare arrays out, compiled where it pays."""

import os
import tempfile
from pathlib import Path

# Threads that wait must sleep, not spin: on a machine that is busy otherwise, spinning costs a factor of ten.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _keep_compiled() -> None:
    """Let what is compiled be kept where neither the package nor the user's own cache can be written.

    Numba keeps it beside the source or else in the user's cache, and refuses to work where it can do neither.
    """
    places = Path(__file__).parent, Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"), Path.home()
    if not any(place.is_dir() and os.access(place, os.W_OK) for place in places):
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"vstent-{os.getuid()}"))


if hasattr(os, "getuid"):
    _keep_compiled()
