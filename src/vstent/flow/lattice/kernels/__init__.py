"""Compiled loops of the lattice-Boltzmann engine; arguments and results are arrays. Open ``d3q19.py`` first."""

from pathlib import Path

from vstent import kernels
from vstent.kernels import cache

cache.forget_outdated(Path(__file__).parent, Path(kernels.__file__).parent)
