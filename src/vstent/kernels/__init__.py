"""Compiled loops that several packages share: arrays in, arrays out. Open ``triangles.py`` or ``curves.py`` first.

What numba compiles is kept between runs; ``cache.py`` sees to it.
"""

from pathlib import Path

from vstent.kernels import cache

cache.choose_folder()
cache.forget_outdated(Path(__file__).parent)
