"""The input as it was read, to be seen while the vessel in it is sought."""

from pathlib import Path
from typing import Final

from vstent.app.choices import Choices
from vstent.io.surfaces import read_surface
from vstent.reporting.packing import message
from vstent.reporting.scene import FRONTAL, WALL_COLOUR, MeshLayer, view_of
from vstent.reporting.thinning import thin_surface

FACES: Final = 40_000
"""Number of triangles above which the surface is decimated."""


def read_layer(path: Path, choices: Choices) -> bytes:
    """Return a surface file as a message for the page."""
    surface = thin_surface(read_surface(path, units=choices.units, frame=choices.frame)[0], FACES)[0]
    layer = MeshLayer("input", "", WALL_COLOUR, surface)
    return message([layer], views=[view_of("whole", FRONTAL, surface.vertices_mm)])
