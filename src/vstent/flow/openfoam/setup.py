"""Settings of an OpenFOAM case."""

import math
from dataclasses import dataclass

from vstent.deployment.struts import thickness_mm
from vstent.flow.openfoam.dialects import DIALECTS, Dialect, Flavour
from vstent.geometry.surface import Surface

BASE_LEVEL = 2
"""Number of times that snappyHexMesh halves the background cells to reach the grid spacing in the vessel."""
ACROSS = 2.0
"""Minimum number of cells across a strut. With one instead of two, a braid let 19 % more blood through the demo's
neck."""
ITERATIONS = 1000
"""Maximum number of iterations of a steady flow."""
CHECK_ITERATIONS = 50
"""Number of iterations of a steady flow between checks, at which its fields are written."""


@dataclass(frozen=True, eq=False)
class FoamSetup:
    """Mesh, parallel processes and OpenFOAM flavour of a case."""

    cell_size_mm: float
    """Grid spacing in the vessel."""
    flavour: Flavour = "com"
    """OpenFOAM flavour that the case is written for."""
    layers: int = 2
    """Number of flat cell layers along the wall."""
    processes: int = 1
    """Number of parts of the decomposed mesh, one for each process."""
    struts: Surface | None = None
    """Closed solids of the device, in mm, all of which are meshed; None: no device."""

    @property
    def dialect(self) -> Dialect:
        """Names and syntax of the flavour."""
        return DIALECTS[self.flavour]

    @property
    def levels_at_struts(self) -> int:
        """Number of times that cells at the struts are halved, until at least `ACROSS` are across a strut."""
        if self.struts is None:
            return 0
        return max(0, math.ceil(math.log2(ACROSS * self.cell_size_mm / thickness_mm(self.struts))))
