"""Words for numbers in sentences."""

from collections.abc import Iterable


def counted(n: int, one: str, many: str = "") -> str:
    """A count with its noun: ``1 hole``, ``2 holes``; `many` where the plural is not `one` and an s."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def place(point_mm: Iterable[float]) -> str:
    """Where a point (3,) is: ``(1.0, -2.5, 30.2) mm``."""
    return f"({', '.join(f'{x:.1f}' for x in point_mm)}) mm"
