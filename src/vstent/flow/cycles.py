"""Cycle-to-cycle convergence of pulsatile flow."""

from typing import Final

import numpy as np

from vstent.errors import FlowError
from vstent.flow.case import PHASES, FlowCase
from vstent.flow.waveform import Waveform
from vstent.kernels.arrays import Floats

STALLED: Final = 0.8
"""If a cycle's change is more than this fraction of the previous one's, further cycles are not expected to converge."""


def cycle_change(history: Floats) -> float:
    """Return the largest relative change of any monitored quantity between the last two cycles.

    Shapes: `history` (phases, quantities).
    """
    if not np.isfinite(history[-1]).all():
        return float("nan")
    cycles, rest = divmod(len(history), PHASES)
    if rest or cycles < 2:
        return float("inf")
    before, last = history[-2 * PHASES : -PHASES], history[-PHASES:]
    scale = np.maximum(np.sqrt((last**2).mean(axis=0)), 1e-12)
    return float((np.sqrt(((last - before) ** 2).mean(axis=0)) / scale).max())


def cycles_advice(changes: Floats, cycles: int, *, is_converged: bool) -> str:
    """Describe the convergence of the cycles and what to do about it.

    Shapes: `changes` (c,).
    """
    if len(changes) == 0:
        return "Only a single cycle was computed: allow at least two to check that the flow is periodic."
    said = f"Cycle {cycles} differs from the previous one by {100 * changes[-1]:.1f} %"
    if is_converged:
        return f"{said}: the flow has converged to a periodic state."
    if len(changes) > 1 and changes[-1] > STALLED * changes[-2]:
        return (
            f"{said}, hardly less than the change before ({100 * changes[-2]:.1f} %): the vortices differ from cycle "
            "to cycle, and more cycles will not reduce the difference."
        )
    return f"{said}, more than the tolerance: allow more cycles, or accept this difference."


def pulse_of(case: FlowCase) -> Waveform:
    """Return the waveform of a case.

    Raises
    ------
    FlowError
        The case has no waveform.
    """
    if case.waveform is None:
        raise FlowError("pulsatile flow needs an inflow waveform: set one, or compute steady flow")
    return case.waveform
