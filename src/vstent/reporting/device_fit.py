"""Picture of a fitted device: measured and fitted values, and the residuals."""

import io
from typing import Final

import numpy as np

from vstent.devices.fit import Fitted, labels, predict
from vstent.reporting.lettering import DPI
from vstent.units import MM_PER_UM

INCHES: Final = (9.0, 4.2)
"""Width and height of the picture, in inches."""
BAND: Final = 2.0
"""Standard errors that the error bars and the gray band of the residuals show."""
NARROWEST: Final = 0.5
"""Smallest tube that the curve shows, as a fraction of the free diameter."""


def picture(fitted: Fitted, title: str) -> bytes:
    """Return the picture of a fit as PNG, under the name of the device; equal fits give equal files.

    On the left: lengths against the diameter of the tube, measured with two standard errors, and the fitted curve of
    each specimen. On the right: residuals of all measurements, in standard errors.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=INCHES, facecolor="white", layout="constrained")
    lengths, residuals = figure.subplots(1, 2, width_ratios=(3, 2))
    offset_mm = 2 * fitted.design.wall_offset_um * MM_PER_UM
    for number, label in enumerate(labels(fitted.measurements)):
        size, color = fitted.size_of(label), f"C{number}"
        outer_mm = size.free_diameter_mm + offset_mm
        tubes_mm = np.linspace(NARROWEST * outer_mm, outer_mm, 200)
        curve_mm = [predict(fitted.design, size, "length_mm", float(tube_mm)) for tube_mm in tubes_mm]
        lengths.plot(tubes_mm, curve_mm, color=color, label=f"{label[0]:g} x {label[1]:g} mm, fitted")
        shown = [one for one in fitted.measurements if one.name == "length_mm" and one.label_mm == label]
        at_mm = [outer_mm if one.tube_mm is None else one.tube_mm for one in shown]
        bars_mm = [BAND * one.error for one in shown]
        lengths.errorbar(at_mm, [one.value for one in shown], bars_mm, fmt="o", color=color, capsize=3, markersize=4)
    lengths.set_xlabel("inner diameter of the tube, mm (rightmost: free)")
    lengths.set_ylabel("length, mm")
    lengths.legend(frameon=False, fontsize=8)
    lengths.grid(visible=True, alpha=0.25)

    places = np.arange(len(fitted.measurements))
    residuals.axvspan(-BAND, BAND, color="0.92")
    residuals.axvline(0.0, color="0.5", linewidth=0.8)
    residuals.plot(fitted.residuals, places, "o", color="C0", markersize=4)
    names = [
        f"{one.name}, {'free' if one.tube_mm is None else f'{one.tube_mm:g} mm'} (row {one.row})"
        for one in fitted.measurements
    ]
    residuals.set_yticks(places, names, fontsize=7)
    residuals.invert_yaxis()
    residuals.set_xlabel("residual, standard errors")
    reach = max(3.0, 1.1 * float(np.abs(fitted.residuals).max(initial=0.0)))
    residuals.set_xlim(-reach, reach)
    figure.suptitle(f"{title}: fit to {len(fitted.measurements)} measurements", fontsize=11)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()
