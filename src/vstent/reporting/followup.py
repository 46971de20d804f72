"""Picture of an artery before and after a treatment."""

from pathlib import Path

import numpy as np

from vstent.geometry.vessel import Anatomy
from vstent.io.files import atomic
from vstent.study.followup import Followup


def draw_followup(path: Path, anatomy: Anatomy, found: Followup) -> None:
    """Write the picture, a PNG: both walls and axes in the frame of the follow-up, seen across the bend."""
    from matplotlib.figure import Figure

    axes_mm = found.pose.of(anatomy.parent.axis.points_mm), found.anatomy.parent.axis.points_mm
    flat = np.linalg.svd(axes_mm[0] - axes_mm[0].mean(axis=0), full_matrices=False)[2][:2]
    figure = Figure(figsize=(7, 7), layout="constrained")
    plot = figure.add_subplot(aspect="equal", xlabel="mm", ylabel="mm")
    walls_mm = found.pose.of(anatomy.vessel.lumen.vertices_mm), found.anatomy.vessel.lumen.vertices_mm
    for title, color, wall_mm, axis_mm in zip(
        ("as scanned", "after treatment"), ("0.6", "C3"), walls_mm, axes_mm, strict=True
    ):
        plot.plot(*(wall_mm @ flat.T).T, ".", color=color, markersize=0.5, alpha=0.4)
        plot.plot(*(axis_mm @ flat.T).T, color=color, label=title)
    plot.legend()
    with atomic(path) as partial:
        figure.savefig(partial, format="png", dpi=150)
