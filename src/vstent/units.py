"""Conversions between the units of the house: mm for geometry, SI for flow, radians for angles."""

from typing import Final

M_PER_MM: Final = 1e-3
MM_PER_UM: Final = 1e-3
M3_PER_ML: Final = 1e-6

MM_PER: Final = {"m": 1e3, "cm": 10.0, "mm": 1.0}
"""Length units a surface file may be in -> mm."""
