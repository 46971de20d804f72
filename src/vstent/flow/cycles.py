"""Pulsatile flow: the waveform of a case, and whether its cycles repeat."""

from typing import Final

import numpy as np

from vstent.errors import FlowError
from vstent.flow.case import PHASES, FlowCase, Waveform
from vstent.kernels.arrays import Floats

STALLED: Final = 0.8
"""Where a cycle's change is more than this part of the last one's, further cycles will not become alike."""


def cycle_change(history: Floats) -> float:
    """Largest root-mean-square change of any column of a history (phases, quantities) between its last two cycles.

    Relative to the quantity's root mean square; inf where no cycle ends or no two are complete; nan where the history
    is not finite.
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
    """Say what the changes (c,) from cycle to cycle, as fractions, mean for the result."""
    if len(changes) == 0:
        return "One cycle was computed. Allow two to see whether it repeats."
    said = f"Cycle {cycles} differs from the one before by {100 * changes[-1]:.1f} %"
    if is_converged:
        return f"{said}: the flow is periodic."
    if len(changes) > 1 and changes[-1] > STALLED * changes[-2]:
        return (
            f"{said}, no less than that one did ({100 * changes[-2]:.1f} %): vortices differ from cycle to "
            "cycle, and more cycles will not change that."
        )
    return f"{said}, more than the tolerance. Allow more cycles, or accept this result."


def pulse_of(case: FlowCase) -> Waveform:
    """Return the pulse of a case.

    Raises
    ------
    FlowError
        When it has none.
    """
    if case.settings.waveform is None:
        raise FlowError("pulsatile flow needs a waveform: give one, or compute the steady flow")
    return case.settings.waveform
