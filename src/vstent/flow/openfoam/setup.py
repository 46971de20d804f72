"""How an OpenFOAM case is to be set up."""

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from vstent.geometry.surface import Surface

Flavour: TypeAlias = Literal["com", "org"]
"""openfoam.com (Debian's 1912 and later) or openfoam.org (11 and later): their dictionaries differ in a few names."""

FEATURES: Final[dict[Flavour, str]] = {"com": "surfaceFeatureExtract", "org": "surfaceFeatures"}
"""Each one's program that finds sharp rims."""

BASE_LEVEL = 2
"""Times that snappyHexMesh halves the background's cells to the vessel's: the background is this much coarser."""
ACROSS = 2.0
"""Cells across a strut. With one, a braid let 19 % more blood through the demo's neck than with two."""


@dataclass(frozen=True, eq=False)
class FoamSetup:
    """Mesh, machine and dialect of a case."""

    cell_size_mm: float
    """Edge of a cell in the vessel."""
    flavour: Flavour = "com"
    """Whose OpenFOAM is to read it."""
    layers: int = 2
    """Layers of flat cells along the wall."""
    neck_levels: int = 1
    """Times that cells near the neck are halved."""
    strut_levels: int | None = None
    """Times that cells at the struts are halved; None: until at least `ACROSS` lie across one."""
    processes: int = 1
    """Parts that the mesh is cut into, each for a process of its own."""
    iterations: int = 1000
    """Most iterations of a steady flow."""
    struts: Surface | None = None
    """The device's solids (closed, in mm), all meshed; None: the bare vessel."""

    @property
    def levels_at_struts(self) -> int:
        """Times that cells at the struts are halved."""
        if self.strut_levels is not None or self.struts is None:
            return self.strut_levels or 0
        return max(0, math.ceil(math.log2(ACROSS * self.cell_size_mm / self.strut_thickness_mm)))

    @property
    def strut_thickness_mm(self) -> float:
        """Mean thickness of the struts, 0 without any: a long solid's is four times its volume over its area."""
        return 0.0 if self.struts is None else 4 * abs(self.struts.volume_mm3) / self.struts.area_mm2
