"""Blood flow, before and after: `simulate` an anatomy with and without stents, or one case at a time."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from vstent import plugins
from vstent.errors import FlowError
from vstent.flow import sampling
from vstent.flow.domain import MIN_CELLS, default_cell_size_mm
from vstent.flow.engines import AbstractEngine, Bookmark, Progress, Saved, run
from vstent.flow.indices import compare, indices
from vstent.flow.ostium import ostium
from vstent.flow.screen import screen
from vstent.flow.streamlines import Streamlines, streamlines
from vstent.flow.types import LATTICE, OPENFOAM, Blood, FlowCase, FlowField, FlowSettings, Screen
from vstent.stent import Stent
from vstent.vessel import Anatomy

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
    "indices",
    "ostium",
    "screen",
    "simulate",
    "simulate_case",
    "streamlines",
]

COARSENING = 2.0
"""Cells of the first guess, over those of the answer: it costs a sixteenth per second of flow."""
COARSE_SHARE = 0.12
"""Part of the whole time that each coarse run takes, for the progress."""

OnProgress = Callable[[Progress], None]


class Checkpoint(Protocol):
    """Keeps the runs of one flow while they are under way, each by its name."""

    def load(self, run: str) -> Saved | None:
        """Return what was saved of a run last; None where nothing was, or it is damaged."""

    def save(self, run: str, saved: Saved) -> None:
        """Keep the state of a run instead of the one before."""


def simulate(
    anatomy: Anatomy,
    stents: Sequence[Stent | None],
    settings: FlowSettings | None = None,
    *,
    blood: Blood | None = None,
    progress: OnProgress | None = None,
) -> tuple[FlowField, ...]:
    """Compute the flow, steady or pulsatile, for every stent, None standing for the bare vessel.

    Returns
    -------
    One field per stent, in order; stented flows start from the first bare one.

    Raises
    ------
    FlowError
        When the vessel cannot be put on a grid, or the computation diverges.
    """
    fields: list[FlowField] = []
    bare: FlowField | None = None
    for stent in stents:
        field = simulate_case(flow_case(anatomy, stent, settings, blood=blood), start=bare, progress=progress)
        if stent is None and bare is None:
            bare = field
        fields.append(field)
    return tuple(fields)


def flow_case(
    anatomy: Anatomy, stent: Stent | None, settings: FlowSettings | None = None, *, blood: Blood | None = None
) -> FlowCase:
    """State the flow problem: the patient's lumen, its largest sac, a stent as a screen or None."""
    blood = blood or Blood()
    largest = anatomy.aneurysms[0] if anatomy.aneurysms else None
    return FlowCase(
        vessel=anatomy.vessel,
        sac=None if largest is None else largest.sac,
        ostium=None if largest is None else ostium(largest, anatomy.vessel.lumen),
        screen=None if stent is None else screen(stent, blood),
        blood=blood,
        settings=settings or FlowSettings(),
    )


def simulate_case(
    case: FlowCase,
    *,
    start: FlowField | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
) -> FlowField:
    """Compute one flow: steady, or pulsatile where the settings have a waveform.

    Parameters
    ----------
    start : a flow in the same vessel without a screen, to start from.
    progress : called at every check; what it raises ends the run.
    checkpoint : keeps what is under way; the same flow goes on from there, and its result is the same to the last bit.

    Raises
    ------
    FlowError
        When the vessel cannot be put on a grid, or the computation diverges.
    """
    cell_size_mm = default_cell_size_mm(case)
    answer = _bookmark(checkpoint, "answer")
    steady = replace(case, settings=replace(case.settings, waveform=None))
    is_begun = answer is not None and answer.saved is not None
    guess = None if is_begun else _guess(steady, start, COARSENING * cell_size_mm, progress, checkpoint)
    return _run(case, cell_size_mm, guess, _stage(progress, _coarse_runs(case, start) * COARSE_SHARE, 1.0), answer)


def _bookmark(checkpoint: Checkpoint | None, name: str) -> Bookmark | None:
    if checkpoint is None:
        return None
    return Bookmark(checkpoint.load(name), lambda saved: checkpoint.save(name, saved))


def _coarse_runs(case: FlowCase, start: FlowField | None) -> int:
    if start is None:
        return 1
    return 0 if case.screen is None else 2


def _guess(
    case: FlowCase,
    start: FlowField | None,
    cell_size_mm: float,
    progress: OnProgress | None,
    checkpoint: Checkpoint | None,
) -> FlowField | None:
    """First guess for the fine grid, from coarse ones; only `start` where the coarse grid would be too coarse.

    Where a bare flow is known, the coarse grid only has to say what the screen changes (the correction scheme of
    multigrid, Brandt 1977, Math. Comput. 31, 333).
    """
    is_tiny = abs(case.vessel.closed.volume_mm3) < 4 * MIN_CELLS * cell_size_mm**3
    if is_tiny or (start is not None and case.screen is None):
        return start
    if start is None:
        first = _bookmark(checkpoint, "guess")
        return _run(case, cell_size_mm, None, _stage(progress, 0.0, COARSE_SHARE), first)
    first, second = _bookmark(checkpoint, "bare guess"), _bookmark(checkpoint, "stented guess")
    bare = _run(replace(case, screen=None), cell_size_mm, start, _stage(progress, 0.0, COARSE_SHARE), first)
    stented = _run(case, cell_size_mm, bare, _stage(progress, COARSE_SHARE, 2 * COARSE_SHARE), second)
    before, after = (sampling.values_at(field, start.centers_mm) for field in (bare, stented))
    return replace(
        start,
        velocity_m_s=start.velocity_m_s + after[0] - before[0],
        pressure_Pa=start.pressure_Pa + after[1] - before[1],
    )


def _run(
    case: FlowCase,
    cell_size_mm: float,
    start: FlowField | None,
    progress: OnProgress | None,
    bookmark: Bookmark | None,
) -> FlowField:
    engine = _engine(case.settings)
    return run(engine(cell_size_mm), case, start=start, progress=progress, bookmark=bookmark)


def _engine(settings: FlowSettings) -> Callable[[float], AbstractEngine[Any]]:
    from vstent.flow.engines.lattice_boltzmann import LatticeBoltzmann
    from vstent.flow.engines.lattice_pulse import PulsatileLatticeBoltzmann

    if settings.engine == OPENFOAM:
        raise FlowError("OpenFOAM needs a folder to work in: call flow.engines.openfoam.simulate_in, or vstent flow")
    if settings.engine != LATTICE:
        found: Callable[[float], AbstractEngine[Any]] = plugins.load(
            "vstent.engines", settings.engine, built_in=LATTICE
        )
        return found
    return LatticeBoltzmann if settings.waveform is None else PulsatileLatticeBoltzmann


def _stage(progress: OnProgress | None, begin: float, end: float) -> OnProgress | None:
    """Progress of one run among several: its part of the whole."""
    if progress is None:
        return None

    def report(now: Progress) -> None:
        fraction = begin + (end - begin) * now.fraction
        beyond = (1 - end) / (end - begin)
        seconds_left = now.seconds_left * (1 + beyond / max(1 - now.fraction, 0.05))
        progress(Progress(fraction, now.residual, seconds_left))

    return report
