"""Drawing of the rule by which a node of the contour moves or terminates (Zhong et al. 2016, fig. 8, eq. 6 and 7)."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from vstent.kernels.arrays import Floats
from vstent.reporting.figures import Picture, image_of
from vstent.reporting.paper import ACCENT, INK, QUIET, WARN

RADIUS: Final = 10.0
"""Radius of the drawn wall; lengths are in units of the drawing."""
OFFSET: Final = 1.6
"""Drawn width of the wire, by which terminated nodes lie off the wall."""
NODES: Final = (
    ("continues", "The way from the center does not cross the wall,\nand the node is more than dd from it.", 0.60),
    (
        "terminates, eq. (6)",
        "The way from the center does not cross the wall,\nand the node is at most dd from it.",
        0.92,
    ),
    ("terminates, eq. (7)", "The way from the center crosses the wall.", 1.22),
)
"""Title, condition, and distance of the drawn node from the center as a fraction of the radius."""
CAPTION: Final = (
    "The rule for a node in each iteration (Zhong et al. 2016, fig. 8): the wall (dark line), its band of one wire "
    "width dd (shaded), the center of the node's row (cross), the node (open circle), and where it is put (full "
    "circle) at the distance dd from the nearest point of the wall. A node that continues is moved by the forces. "
    "Drawing, not to scale."
)
"""Caption of the drawing."""


@dataclass(frozen=True)
class NodeRule:
    """The drawing of the three cases of the rule, to be drawn."""

    def drawn(self) -> Picture:
        """Return the drawing."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10.4, 3.4), facecolor="white")
        angle = np.radians(np.linspace(25, 155, 200))
        way = np.stack([np.cos(angle), np.sin(angle)])
        for axes, (title, condition, distance) in zip(figure.subplots(1, 3), NODES, strict=True):
            axes.set_title(f"Node {title}", fontsize=9, color=INK, loc="left")
            axes.text(0.0, -0.02, condition, transform=axes.transAxes, fontsize=7.5, color=QUIET, va="top")
            axes.fill(*np.concatenate([RADIUS * way, (RADIUS - OFFSET) * way[:, ::-1]], axis=1), color="#dcebee")
            axes.plot(*(RADIUS * way), color=INK, linewidth=2.2)
            axes.plot(0, 0, "x", color=INK, markersize=7, markeredgewidth=1.6)
            node = distance * RADIUS * _direction(75)
            color = WARN if distance > 1 else ACCENT
            axes.plot([0, node[0]], [0, node[1]], color=color, linewidth=1, linestyle="--")
            axes.plot(*node, "o", markerfacecolor="white", markeredgecolor=color, markersize=8)
            if RADIUS - distance * RADIUS > OFFSET:
                arrow = {"arrowstyle": "-|>", "color": ACCENT, "linewidth": 1.6}
                axes.annotate("", 1.32 * node, 1.06 * node, arrowprops=arrow)
            else:
                axes.plot(*placed(node), "o", color=ACCENT, markersize=8)
            middle = (RADIUS - 0.5 * OFFSET) * _direction(112)
            axes.text(*middle, "dd", fontsize=8, color=ACCENT, ha="center", va="center")
            axes.text(-0.86 * RADIUS, 0.62 * RADIUS, "wall", fontsize=8, color=INK, ha="right")
            axes.text(0.5, -0.6, "center of the row", fontsize=7.5, color=QUIET, va="center")
            axes.set(xlim=(-11.5, 11.5), ylim=(-1.2, 12.8), aspect="equal")
            axes.set_axis_off()
        figure.subplots_adjust(left=0.01, right=0.99, top=0.93, bottom=0.13, wspace=0.05)
        return Picture("rule", "The rule for a node of the contour", CAPTION, image_of(figure))


def _direction(angle_deg: float) -> Floats:
    """Return the unit vector (2,) at an angle to the drawing's x axis."""
    return np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])


def placed(node: Floats) -> Floats:
    """Return where the rule puts a node (2,), given from the center: by eq. (6) inside the wall, by eq. (7) outside."""
    distance = float(np.linalg.norm(node))
    wall = RADIUS * node / distance
    sense = 1.0 if distance < RADIUS else -1.0
    found: Floats = wall + sense * OFFSET * (node - wall) / np.linalg.norm(node - wall)
    return found
