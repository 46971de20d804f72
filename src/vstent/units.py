"""Conversions between units (mm for geometry, SI for flow, radians for angles), bytes, and numbers in sentences."""

from collections.abc import Iterable
from typing import Final

M_PER_MM: Final = 1e-3
"""Meters in a millimeter."""
MM_PER_UM: Final = 1e-3
"""Millimeters in a micrometer."""
M3_PER_ML: Final = 1e-6
"""Cubic meters in a milliliter."""
PA_PER_MMHG: Final = 133.322
"""Pascals in a millimeter of mercury."""
BYTES_PER_MB: Final = 1e6
"""Bytes in a megabyte."""
MM_PER: Final = {"m": 1e3, "cm": 10.0, "mm": 1.0}
"""Millimeters in each length unit that a surface file may have."""


def counted(n: int, one: str, many: str = "") -> str:
    """Return a count with the word for what is counted: ``1 hole``, ``2 holes``; an empty plural is `one` + s."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def duration(seconds: float) -> str:
    """Return a time as text: ``9 s``, ``16 min``."""
    return f"{max(seconds, 1):.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def place(point_mm: Iterable[float]) -> str:
    """Return a point (3,) as text: ``(1.0, -2.5, 30.2) mm``."""
    return f"({', '.join(f'{x:z.1f}' for x in point_mm)}) mm"
