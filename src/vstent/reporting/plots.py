"""PNG files of charts that matplotlib draws."""

import io
from typing import TYPE_CHECKING

from vstent.reporting.lettering import DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def png_of(figure: "Figure") -> bytes:
    """Return a figure as PNG, at the resolution of all pictures; equal figures give equal files."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()
