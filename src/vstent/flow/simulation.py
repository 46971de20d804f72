"""Blood flow, before and after: `simulate` an anatomy with and without stents, or one case at a time."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from vstent import plugins
from vstent.deployment.struts import over_restored
from vstent.devices.stent import Stent
from vstent.errors import InputError
from vstent.flow import sampling
from vstent.flow.case import LATTICE, OPENFOAM, FlowCase, FlowField, FlowSettings, Phase
from vstent.flow.domain import MIN_CELLS, CoarseGridError, default_cell_size_mm
from vstent.flow.engines import AbstractEngine, Bookmark, DivergenceError, Progress, Saved, run
from vstent.flow.lattice.close_up import SHARE_AROUND, WIDTH, require_sac
from vstent.flow.ostium import ostium
from vstent.flow.screen import screen
from vstent.geometry.vessel import Anatomy
from vstent.kernels.arrays import Floats

COARSE_SHARE = 0.12
"""Part of the whole time that each coarse run takes, for the progress."""

OUTER_SHARE = 0.35
"""Part of the whole time that the flow around a close-up takes, for the progress."""

CALMER_TRIES = 3
"""Times that a run which diverged is tried again with a shorter time step."""

_BARE_GUESSES: WeakKeyDictionary[FlowField, dict[tuple[float, FlowSettings], FlowField]] = WeakKeyDictionary()
"""Bare flows on wide cells, by the flow that they begin from: what every device's guess is compared with is computed
once, for the first."""

OnProgress = Callable[[Progress], None]
Guess = Callable[[], FlowField | None]


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
        field = simulate_case(flow_case(anatomy, stent, settings), start=bare, progress=progress)
        if stent is None and bare is None:
            bare = field
        fields.append(field)
    return tuple(fields)


def flow_case(anatomy: Anatomy, stent: Stent | None, settings: FlowSettings | None = None) -> FlowCase:
    """State the flow problem: the patient's lumen, its largest sac, a stent as a screen or None."""
    settings = settings or FlowSettings()
    largest = anatomy.aneurysms[0] if anatomy.aneurysms else None
    return FlowCase(
        vessel=anatomy.vessel,
        sac=None if largest is None else largest.sac,
        ostium=None if largest is None else ostium(largest, anatomy.vessel.lumen),
        screen=None if stent is None else screen(stent, settings.blood),
        stent=None if stent is None else over_restored(stent, anatomy),
        settings=settings,
    )


def simulate_case(
    case: FlowCase,
    *,
    start: FlowField | None = None,
    folder: Path | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
) -> FlowField:
    """Compute one flow: steady, or pulsatile where the settings have a waveform.

    Parameters
    ----------
    start : a flow in the same vessel without a stent, to start from.
    folder : where an engine that works with files keeps them, and finds them again; None: they are not kept.
    progress : called at every check; what it raises ends the run.
    checkpoint : keeps what is under way; the same flow goes on from there, and its result is the same to the last bit.

    Raises
    ------
    FlowError
        When the vessel cannot be put on a grid, or the computation diverges.
    """
    with nullcontext(folder) if folder is not None else TemporaryDirectory(prefix="vstent-") as own:
        return _Runs(engine_class(case.settings), Path(own), progress, checkpoint).answer(case, start)


def foretell_cost(case: FlowCase) -> str:
    """Say in a sentence what a flow will cost.

    Raises
    ------
    FlowError
        When it does not fit in the free memory.
    """
    return engine_class(case.settings)(default_cell_size_mm(case)).cost(case)


def engine_class(settings: FlowSettings) -> type[AbstractEngine[Any]]:
    """Return the engine of this name: one of vstent's own, or a plug-in's.

    Raises
    ------
    PluginError
        When there is none.
    InputError
        When it is to run on a GPU or in a close-up and does not.
    """
    engine = _engine_of(settings)
    if settings.close_up and not engine.closes_up:
        raise InputError(
            f"the engine {settings.engine} cannot refine the grid in the sac: switch that off (--refine-sac), "
            f"or use {LATTICE}"
        )
    if settings.device_gpu and not engine.runs_on_gpu:
        raise InputError(
            f"the engine {settings.engine} does not run on a GPU: switch that off (--gpu), or use {LATTICE}"
        )
    return engine


def _engine_of(settings: FlowSettings) -> type[AbstractEngine[Any]]:
    from vstent.flow.lattice.engine import LatticeBoltzmann
    from vstent.flow.lattice.pulse import PulsatileLatticeBoltzmann
    from vstent.flow.openfoam.engine import OpenFoam

    lattice = LatticeBoltzmann if settings.waveform is None else PulsatileLatticeBoltzmann
    built_in: dict[str, type[AbstractEngine[Any]]] = {LATTICE: lattice, OPENFOAM: OpenFoam}
    if settings.engine in built_in:
        return built_in[settings.engine]
    found: type[AbstractEngine[Any]] = plugins.load("vstent.engines", settings.engine, built_in=", ".join(built_in))
    return found


@dataclass(frozen=True, eq=False)
class _Runs:
    """The runs of one engine that make up a flow: guesses on a coarse grid, where it wants them, and the answer."""

    engine: type[AbstractEngine[Any]]
    folder: Path
    progress: OnProgress | None
    checkpoint: Checkpoint | None

    def answer(self, case: FlowCase, start: FlowField | None) -> FlowField:
        """Compute a flow, from a guess unless it is under way, or the coarse grid is too coarse for one."""
        cell_size_mm = default_cell_size_mm(case)
        if case.settings.close_up:
            return self._close_up(case, start, cell_size_mm)
        progress = self._part(_coarse_runs(self.engine, case, start) * COARSE_SHARE, 1.0)
        engine = self.engine(cell_size_mm, self.folder)
        return self._run(
            engine, case, lambda: self._guess(case, start, cell_size_mm), progress, self._bookmark("answer")
        )

    def _close_up(self, case: FlowCase, start: FlowField | None, cell_size_mm: float) -> FlowField:
        """Compute the vessel on wide cells, and then the sac and its neck on fine ones in it."""
        require_sac(case)
        steps = int(SHARE_AROUND * case.settings.max_steps)
        # Without its ostium, steady or in a pulse: what swings at the neck takes most of the steps, and is done anew.
        around = replace(case, ostium=None, settings=replace(case.settings, max_steps=steps))
        outer = self._coarse(around, WIDTH * cell_size_mm, start, "outer", self._part(0.0, OUTER_SHARE))
        engine = self.engine(cell_size_mm, self.folder, outer)
        return self._run(engine, case, lambda: outer, self._part(OUTER_SHARE, 1.0), self._bookmark("answer"))

    def _guess(self, case: FlowCase, start: FlowField | None, cell_size_mm: float, depth: int = 0) -> FlowField | None:
        """First guess for a grid, from coarser ones; only `start` where the next is too coarse, or diverges.

        Where a bare flow is known, the coarse grid only has to say what the screen changes (the correction scheme of
        multigrid, Brandt 1977, Math. Comput. 31, 333). What the grids differ by in the bare flow is scaled by what the
        screen leaves of the speed: in a sac nearly at rest it would be more than the flow itself.
        """
        if self.engine.coarsening is None:
            return start
        coarse_mm = self.engine.coarsening * cell_size_mm
        is_tiny = abs(case.vessel.closed.volume_mm3) < 4 * MIN_CELLS * coarse_mm**3
        if is_tiny or (start is not None and case.screen is None):
            return start
        first, second = (
            self._part(rank * COARSE_SHARE, (rank + 1) * COARSE_SHARE) if depth == 0 else None for rank in range(2)
        )
        with suppress(DivergenceError, CoarseGridError):
            if start is None:
                return self._coarse(case, coarse_mm, None, "guess", first, depth)
            bare = self._bare_guess(case, start, coarse_mm, first, depth)
            return _corrected(start, bare, self._coarse(case, coarse_mm, bare, "stented guess", second, depth))
        return start

    def _bare_guess(
        self, case: FlowCase, start: FlowField, coarse_mm: float, progress: OnProgress | None, depth: int
    ) -> FlowField:
        """Compute the bare flow on wide cells from the one on the cells wanted, unless that has been done."""
        done, key = _BARE_GUESSES.setdefault(start, {}), (coarse_mm, case.settings)
        if key not in done:
            bare = replace(case, screen=None, stent=None)
            done[key] = self._coarse(bare, coarse_mm, start, "bare guess", progress, depth)
        return done[key]

    def _coarse(
        self,
        case: FlowCase,
        cell_size_mm: float,
        start: FlowField | None,
        name: str,
        progress: OnProgress | None,
        depth: int = 0,
    ) -> FlowField:
        """Compute a flow on wider cells, itself from a guess; one deeper than the first takes no time to speak of."""
        name = depth * "coarser " + name
        engine = engine_class(case.settings)(cell_size_mm, self.folder / name)
        return self._run(
            engine, case, lambda: self._guess(case, start, cell_size_mm, depth + 1), progress, self._bookmark(name)
        )

    def _run(
        self,
        engine: AbstractEngine[Any],
        case: FlowCase,
        guess: Guess,
        progress: OnProgress | None,
        bookmark: Bookmark | None,
    ) -> FlowField:
        """Drive an engine from a guess, made once, or from where it left off; what diverges begins anew, calmer."""
        guess = cache(guess)

        def attempt() -> FlowField:
            is_under_way = bookmark is not None and bookmark.saved is not None
            return run(engine, case, start=None if is_under_way else guess(), progress=progress, bookmark=bookmark)

        for _ in range(CALMER_TRIES):
            try:
                return attempt()
            except DivergenceError:
                calmer = engine.calmer(case)
                if calmer is None:
                    raise
                case, bookmark = calmer, None if bookmark is None else replace(bookmark, saved=None)
        return attempt()

    def _bookmark(self, name: str) -> Bookmark | None:
        checkpoint = self.checkpoint
        if checkpoint is None:
            return None
        return Bookmark(checkpoint.load(name), lambda saved: checkpoint.save(name, saved))

    def _part(self, begin: float, end: float) -> OnProgress | None:
        """Progress of one run among several: its part of the whole."""
        whole = self.progress
        if whole is None:
            return None

        def report(now: Progress) -> None:
            fraction = begin + (end - begin) * now.fraction
            beyond = (1 - end) / (end - begin)
            seconds_left = now.seconds_left * (1 + beyond / max(1 - now.fraction, 0.05))
            whole(Progress(fraction, now.residual, seconds_left))

        return report


def _corrected(start: FlowField, bare: FlowField, stented: FlowField) -> FlowField:
    """A bare flow, changed by what a screen changes on a coarser grid; of a pulse, its mean and its end."""
    fields = start, bare, stented
    velocity_m_s, pressure_Pa = _changed(*fields)
    phases: tuple[Phase, ...] = ()
    if all(field.phases for field in fields):
        end_m_s, end_Pa = _changed(*(field.at_phase(field.phases[-1]) for field in fields))
        phases = (replace(start.phases[-1], velocity_m_s=end_m_s, pressure_Pa=end_Pa),)
    return replace(
        start,
        velocity_m_s=velocity_m_s,
        pressure_Pa=pressure_Pa,
        phases=phases,
        swing=None,
        neck_inflow_mL_s=None,
    )


def _changed(start: FlowField, bare: FlowField, stented: FlowField) -> tuple[Floats, Floats]:
    """Velocity and pressure of a flow, changed by what differs between two on a coarser grid."""
    before, after = (sampling.values_at(field, start.centers_mm) for field in (bare, stented))
    speed_before, speed_after = (np.linalg.norm(values[0], axis=1, keepdims=True) for values in (before, after))
    left = np.clip(speed_after / np.maximum(speed_before, 1e-9), 0.0, 1.0)
    velocity_m_s = after[0] + left * (start.velocity_m_s - before[0])
    return velocity_m_s, start.pressure_Pa + after[1] - before[1]


def _coarse_runs(engine: type[AbstractEngine[Any]], case: FlowCase, start: FlowField | None) -> int:
    if engine.coarsening is None:
        return 0
    if start is None:
        return 1
    return 0 if case.screen is None else 2
