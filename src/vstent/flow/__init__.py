"""Blood flow with and without a stent: a `FlowCase` in, a `FlowField` and its hemodynamic indices out.

Open ``simulation.py`` first; the two engines live in ``lattice`` and ``openfoam``.
"""

from vstent.flow.case import Blood, FlowCase, FlowField, FlowSettings, Screen
from vstent.flow.engines import Progress
from vstent.flow.indices import compare, indices
from vstent.flow.ostium import ostium
from vstent.flow.screen import screen
from vstent.flow.simulation import Checkpoint, flow_case, foretell_cost, simulate, simulate_case
from vstent.flow.streamlines import Streamlines, streamlines

__all__ = [
    "Blood",
    "Checkpoint",
    "FlowCase",
    "FlowField",
    "FlowSettings",
    "Progress",
    "Screen",
    "Streamlines",
    "compare",
    "flow_case",
    "foretell_cost",
    "indices",
    "ostium",
    "screen",
    "simulate",
    "simulate_case",
    "streamlines",
]
