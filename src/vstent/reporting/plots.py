"""Charts that matplotlib draws, as PNG files and as arrays."""

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vstent.reporting.lettering import DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def png_of(figure: "Figure") -> bytes:
    """Return a figure as PNG, at the resolution of all pictures; equal figures give equal files."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def image_of(figure: "Figure") -> NDArray[np.uint8]:
    """Return a figure as an image (height, width, 3), at the resolution of all pictures."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
