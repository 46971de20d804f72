"""OpenFOAM: a flow as a case folder that its users know, and its results read back.

`foam_case` states a `FlowCase` as text files in OpenFOAM's own syntax. Only `folder` writes them, `program` runs
OpenFOAM there, and `results` and `bridge` read what it wrote.
"""

from vstent.flow.openfoam.case import FoamCase, foam_case
from vstent.flow.openfoam.patches import Patch, named_patches, stl_text
from vstent.flow.openfoam.setup import Flavour, FoamSetup

__all__ = ["Flavour", "FoamCase", "FoamSetup", "Patch", "foam_case", "named_patches", "stl_text"]
