"""Compute blood flow with and without a stent: from a `FlowCase` to a `FlowField` and its hemodynamic indices.

Start reading in ``simulation.py``. The two engines are in the packages ``lattice`` and ``openfoam``.
"""

from vstent.flow.case import Blood, FlowCase, FlowField, FlowSettings, Screen
from vstent.flow.engines import Progress
from vstent.flow.indices import Change, compare, indices
from vstent.flow.ostium import ostium
from vstent.flow.screen import screen
from vstent.flow.simulation import Checkpoint, flow_case, foretell_cost, simulate, simulate_case
from vstent.flow.streamlines import Streamlines, streamlines

__all__ = [
    "Blood",
    "Change",
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
