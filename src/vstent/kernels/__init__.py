"""Compiled loops that several packages share; arguments and results are arrays.

Open ``triangles.py`` or ``curves.py`` first. ``cache.py`` manages the compiled code that numba keeps between runs.
"""

from pathlib import Path

from vstent.kernels import cache

cache.choose_folder()
cache.forget_outdated(Path(__file__).parent)
