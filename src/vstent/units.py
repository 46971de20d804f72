"""Conversions between units (mm for geometry, SI for flow, radians for angles), and numbers in sentences."""

from collections.abc import Iterable
from typing import Final

M_PER_MM: Final = 1e-3
MM_PER_UM: Final = 1e-3
M3_PER_ML: Final = 1e-6

MM_PER: Final = {"m": 1e3, "cm": 10.0, "mm": 1.0}
"""Length units a surface file may be in -> mm."""


def counted(n: int, one: str, many: str = "") -> str:
    """A count with its noun: ``1 hole``, ``2 holes``; `many` where the plural is not `one` and an s."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def place(point_mm: Iterable[float]) -> str:
    """Where a point (3,) is: ``(1.0, -2.5, 30.2) mm``."""
    return f"({', '.join(f'{x:.1f}' for x in point_mm)}) mm"
