"""Flow computation: `simulate` an anatomy with and without devices, or `simulate_case` for a single flow."""

from collections.abc import Callable, Hashable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from vstent import plugins
from vstent.devices.stent import Coils, Deployment
from vstent.errors import InputError, PluginError
from vstent.flow import sampling
from vstent.flow.background import BackgroundWork
from vstent.flow.case import FlowCase, FlowField, Level, Phase
from vstent.flow.domain import MIN_CELLS, CoarseGridError, default_cell_size_mm
from vstent.flow.engines import AbstractEngine, DivergenceError, Progress, Saved, run
from vstent.flow.lattice import calibration
from vstent.flow.lattice.cost import estimate, fits
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.lattice.gpu import require_gpu
from vstent.flow.measured import MeasuredProfile
from vstent.flow.memory import free_memory_bytes
from vstent.flow.openfoam import program
from vstent.flow.openfoam.engine import OpenFoam
from vstent.flow.problem import flow_case
from vstent.flow.settings import LATTICE, OPENFOAM, RESISTING, FlowSettings, Numerics, Wires
from vstent.geometry.vessel import Anatomy
from vstent.units import duration

SCREEN_SHARE = 0.15
"""Share of the run time of the flow with a screen, from which one with resolved wires begins (T 0.07, beta 0.2)."""
ROUND_SHARE = 0.6
"""Assumed share of the run time of the flow in a round of a calibration; the rest is that of the tile."""
COARSE_SHARE = 0.12
"""Assumed share of the run time of each coarse run, for the progress."""

QUICK_S = 600.0
"""Expected run time up to which wires are resolved or calibrated where that is left to the program."""
USUAL_PART = 1 / 2
"""Usual part of the most that a flow may take: flows with walls took 0.3 (demo, tee) to 0.95 of it (beta)."""

CALMER_TRIES = 3
"""Maximum number of retries of a diverged run, each with a shorter time step."""

_BARE_GUESSES: WeakKeyDictionary[FlowField, dict[Hashable, FlowField]] = WeakKeyDictionary()
"""Coarse-grid flows without a device, by the fine flow they start from: computed once and shared by all devices."""

OnProgress = Callable[[Progress], None]
"""Callback that receives the progress."""
Guess = Callable[[], FlowField | None]
"""Function that returns a first guess, or None."""
Part = tuple[float, float] | None
"""Begin and end of a run as fractions of a whole flow; None: its progress is not reported."""


class Checkpoint(Protocol):
    """Storage for the unfinished runs of one flow, each under its name."""

    def load(self, run: str) -> Saved | None:
        """Return the last saved state of a run; None if there is none or it is damaged."""

    def save(self, run: str, saved: Saved) -> None:
        """Store the state of a run in place of the previous one."""


def simulate(
    anatomy: Anatomy,
    deployments: Sequence[Deployment | None],
    settings: FlowSettings | None = None,
    *,
    progress: OnProgress | None = None,
) -> tuple[FlowField, ...]:
    """Compute the flow, steady or pulsatile, without a device and with each of several deployed devices.

    Parameters
    ----------
    anatomy : Anatomy
        The patient's vessel and aneurysms.
    deployments : sequence of Deployment or None
        Deployed devices, each alone in the vessel; None stands for the vessel without a device.
    settings : FlowSettings, optional
        Settings of the computation.
    progress : callable, optional
        Called at every check of every flow.

    Returns
    -------
    tuple of FlowField
        One field per deployment, in order. Flows with a device start from the first one without, if that comes before.

    Raises
    ------
    FlowError
        The vessel cannot be discretized, or the computation diverges.
    """
    fields: list[FlowField] = []
    bare: FlowField | None = None
    for deployment in deployments:
        case = flow_case(anatomy, () if deployment is None else (deployment.stent,), settings)
        field = simulate_case(case, start=bare, progress=progress)
        if deployment is None and bare is None:
            bare = field
        fields.append(field)
    return tuple(fields)


def simulate_case(
    case: FlowCase,
    *,
    start: FlowField | None = None,
    similar: FlowField | None = None,
    folder: Path | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
) -> FlowField:
    """Compute one flow: steady, or pulsatile if the settings contain a waveform.

    It starts from that in the same vessel without a stent, or from one with a similar stent, if that is steady in a
    refined sac too; no first guess is then computed. An engine that works with files resumes from those in its folder;
    without one they are deleted. `progress` is called at every check; an exception that it raises ends the run. From
    a checkpoint the same flow resumes with an identical result to the last bit. Resistances at the outlets that are
    not known follow from the flow without a stent, which must then be given.
    """
    if case.media or case.solids:
        case = _resisted(case, start)
    case, remark = _decided(case, start)
    with nullcontext(folder) if folder is not None else TemporaryDirectory(prefix="vstent-") as own:
        field = _Runs(_engine_of(case), Path(own), progress, checkpoint, similar).answer(case, start)
    return replace(field, advice=field.advice + remark) if remark else field


def _with_wires(case: FlowCase, wires: Wires) -> FlowCase:
    """Return a case that takes its wires in this way."""
    return replace(case, numerics=replace(case.numerics, wires=wires))


def _decided(case: FlowCase, start: FlowField | None = None) -> tuple[FlowCase, str]:
    """Return a case with its wires as walls or as a screen where that is open, and a sentence with the reason.

    Where the flow to start from is unsteady, averages need all the time steps.
    """
    are_coils = any(isinstance(one, Coils) for one in case.solids)  # their indices are those of a porous region
    if case.numerics.wires == "resolved" and case.numerics.engine == LATTICE and case.wires is None and case.media:
        return case, " The wires are a screen: none of them lies over a neck or a branch."
    if case.numerics.wires != "auto" or case.numerics.engine != LATTICE or case.wires is None or are_coils:
        return (_with_wires(case, "screen") if case.numerics.wires == "auto" else case), ""
    if case.numerics.device_gpu:
        require_gpu()
    resolved, screen = _with_wires(case, "resolved"), _with_wires(case, "screen")
    usual_part = USUAL_PART if start is None or start.finest.mean_speed_m_s is None else 1.0
    cost = estimate(resolved)
    how = f"resolving them would take about {duration(usual_part * cost.seconds)} and {cost.memory_bytes / 1e9:.2g} GB."
    if usual_part * cost.seconds < QUICK_S and fits(resolved):
        return resolved, ""
    if calibration.suits(case):
        of_tiles_s, of_tile_bytes = calibration.cost(case)
        seconds = of_tiles_s + calibration.ROUNDS * usual_part * estimate(screen).seconds
        if seconds < QUICK_S and of_tile_bytes < free_memory_bytes():
            return _with_wires(case, "calibrated"), f" The wires are a calibrated screen: {how}"
        how += f" Calibrating them would take about {duration(seconds)}."
    return screen, f" The wires are a screen: {how}"


def _resisted(case: FlowCase, bare: FlowField | None) -> FlowCase:
    """Return a case with resistances that follow from the flow without a device; InputError where that is missing."""
    if all(end.resistance_Pa_s_mL is not None for end in case.resistances):
        return case
    if bare is None:
        raise InputError(
            "the resistances at the outlets follow from the flow without a device: compute that first and start from it"
        )
    return case.resisted_as(bare)


def foretell_cost(case: FlowCase) -> str:
    """Return a sentence on the expected run time and memory of a flow; one that does not fit is refused."""
    case, remark = _decided(case)
    sentence = _engine_of(case)(default_cell_size_mm(case)).cost(case)
    if _is_calibrated(case):
        of_tiles_s, of_tile_bytes = calibration.cost(case)
        sentence += (
            f" Calibrating the screen takes {calibration.ROUNDS} more such flows, {duration(of_tiles_s)} for wires as "
            f"walls in pieces of the neck, and {of_tile_bytes / 1e9:.2g} GB."
        )
    return sentence + remark


def memory_bytes(case: FlowCase) -> float | None:
    """Return the expected peak memory of a flow; None where its engine does not estimate it."""
    case, _ = _decided(case)
    own = _engine_of(case)(default_cell_size_mm(case)).memory_bytes(case)
    return max(own or 0.0, calibration.cost(case)[1]) if _is_calibrated(case) else own


def _is_calibrated(case: FlowCase) -> bool:
    """Return whether the screen of a case is calibrated."""
    return case.numerics.wires == "calibrated" and _engine_of(case).has_levels and calibration.suits(case)


def engine_class(numerics: Numerics, *, is_pulsatile: bool) -> type[AbstractEngine[Any]]:
    """Return the engine that the settings name: one of vstent's own or a plug-in; unsupported settings are refused."""
    lattice = PulsatileLatticeBoltzmann if is_pulsatile else LatticeBoltzmann
    built_in: dict[str, type[AbstractEngine[Any]]] = {LATTICE: lattice, OPENFOAM: OpenFoam}
    engine = built_in.get(numerics.engine) or plugins.load(
        "vstent.engines", numerics.engine, built_in=", ".join(built_in)
    )
    missing = getattr(engine, "__abstractmethods__", ("AbstractEngine as its base class",))
    if missing:
        raise PluginError(
            f"The engine {numerics.engine} is incomplete: it lacks {', '.join(sorted(missing))}. Complete its package, "
            f"or choose the engine {LATTICE}."
        )
    asked = {"--refine": numerics.refine, "--wires calibrated": numerics.wires == "calibrated"}
    if any(asked.values()) and not engine.has_levels:
        unsupported = " and ".join(option for option, is_asked in asked.items() if is_asked)
        raise InputError(
            f"the engine {numerics.engine} does not support a finer grid in a part of the vessel: leave out "
            f"{unsupported}, or choose the engine {LATTICE}"
        )
    if numerics.device_gpu and not engine.runs_on_gpu:
        raise InputError(
            f"the engine {numerics.engine} does not support a GPU: compute on the CPU (without --gpu), or choose the "
            f"engine {LATTICE}"
        )
    return engine


def check_engine(flow: FlowSettings | None, *, runs_here: bool = True) -> None:
    """Check that the engine of a flow, if there is one, supports its settings, and that its program and a GPU are here.

    FlowError is raised where a flow that runs here needs a program that is not installed.
    """
    if flow is not None:
        engine = engine_class(flow.numerics, is_pulsatile=flow.waveform is not None)
        wanted = [f"--outlets {flow.outlets}"] if flow.outlets in RESISTING else []
        if isinstance(flow.profile, MeasuredProfile) or (flow.profile == "womersley" and flow.waveform is not None):
            wanted.append(f"--inlet-profile {flow.profile if isinstance(flow.profile, str) else 'FILE'}")
        if wanted and not engine.has_all_ends:
            raise InputError(
                f"the engine {flow.numerics.engine} does not support {' and '.join(wanted)}: give fixed shares "
                f"(--outlets split or murray) and a developed or plug profile, or choose the engine {LATTICE}"
            )
        if flow.numerics.engine == OPENFOAM and runs_here:
            program.find()
        if flow.numerics.device_gpu:
            require_gpu()


def _engine_of(case: FlowCase) -> type[AbstractEngine[Any]]:
    """Return the engine that computes a case."""
    return engine_class(case.numerics, is_pulsatile=case.waveform is not None)


@dataclass(frozen=True, eq=False)
class _Runs:
    """The runs that make up one flow: first guesses on coarse grids, if the engine uses them, and the result."""

    engine: type[AbstractEngine[Any]]
    folder: Path
    progress: OnProgress | None
    checkpoint: Checkpoint | None
    similar: FlowField | None = None
    """Flow with a similar stent, from which the whole vessel starts."""
    prefix: str = ""
    """Begin of the names of runs that must not be continued as those with the screen as it is."""

    def answer(self, case: FlowCase, start: FlowField | None) -> FlowField:
        """Compute a flow from a first guess on coarser grids, each of which starts from the next coarser one.

        Every run is begun only where a finer one needs its result; a finer one that is resumed does not. If the flow
        without a device is known, a coarse grid only provides the change due to the screen (see `_guess`).
        """
        if case.numerics.wires == "calibrated" and self.engine.has_levels:
            return self._calibrated(case, start)
        if case.walls is not None and self.engine.has_levels:
            as_screen = replace(self, prefix="screen ", progress=self._part(0.0, SCREEN_SHARE))
            screen = replace(case, numerics=replace(case.numerics, wires="screen", cells_across_neck=0.0))
            begun = partial(as_screen.answer, screen, start)
            return self._run("resolved", case, default_cell_size_mm(case), begun, (SCREEN_SHARE, 1.0))
        sizes_mm, coarsening = [default_cell_size_mm(case)], self.engine.coarsening
        one_level = replace(case.numerics, refine=(), cells_across_neck=0.0)
        whole = replace(case, numerics=one_level)  # a guess
        if coarsening is not None and self.similar is None and (start is None or case.media):
            volume_mm3 = abs(case.vessel.closed.volume_mm3)
            while volume_mm3 >= 4 * MIN_CELLS * (coarsening * sizes_mm[-1]) ** 3:
                sizes_mm.append(coarsening * sizes_mm[-1])
        start = start if self.similar is None else self.similar
        share, runs = COARSE_SHARE, 0 if len(sizes_mm) == 1 else 1 if start is None else 2
        bare: list[Guess] = [lambda: start]
        for depth, coarse_mm in enumerate(sizes_mm[1:], start=1):
            part = (0.0, share) if depth == 1 else None
            bare.append(cache(partial(self._bare, f"bare {depth}", whole, coarse_mm, bare[-1], part)))
        guess = bare[-1]
        for depth in range(len(sizes_mm) - 1, 0, -1):
            part = ((runs - 1) * share, runs * share) if depth == 1 else None
            run_ = partial(self._run, f"guess {depth}", whole, sizes_mm[depth], guess, part)
            guess = cache(partial(_guess, bare[depth - 1], bare[depth], run_))
        return self._run("answer", case, sizes_mm[0], guess, (runs * share, 1.0))

    def _calibrated(self, case: FlowCase, start: FlowField | None) -> FlowField:
        """Compute the flow with a screen that is calibrated in steady flows; what cannot be calibrated stays."""
        case, runs = _with_wires(case, "screen"), calibration.ROUNDS + 1
        if not calibration.suits(case):
            field = self.answer(case, start)
            why = " The screen is not calibrated: no wires over the neck, wires 0.4 mm apart or more, or coils."
            return replace(field, advice=field.advice + why) if case.media else field
        similar, factor = self.similar, 1.0
        rounds: list[tuple[float, float, float]] = []
        for number in range(runs - 1):
            steady = replace(calibration.scaled(case, factor), waveform=None)
            progress = self._part(number / runs, (number + ROUND_SHARE) / runs)
            now = replace(self, engine=_engine_of(steady), prefix=f"round {number} ", progress=progress)
            similar = replace(now, similar=similar).answer(steady, start)
            if not rounds:
                center_mm = calibration.strongest_mm(steady, similar)
                walls = calibration.tile(steady, center_mm)
            told = partial(_of_tile, self._part((number + ROUND_SHARE) / runs, (number + 1) / runs), perf_counter())
            rounds.append((factor, *calibration.read_off(steady, walls, similar, center_mm, told)))
            factor = calibration.next_factor(rounds)
        if case.waveform is not None:  # a pulse begins with a phase of the one before, and converges in fewer cycles
            similar = self.similar
        last = replace(self, prefix="calibrated ", progress=self._part(1 - 1 / runs, 1.0), similar=similar)
        remark = "not calibrated: the force on its wires is not proportional to the flow through them."
        if calibration.is_known(rounds):
            case, remark = calibration.scaled(case, factor), f"calibrated: it resists {factor:.3g} times as much."
        field = last.answer(case, start)
        return replace(field, advice=f"{field.advice} The screen is {remark}")

    def _bare(self, name: str, case: FlowCase, size_mm: float, finer: Guess, part: Part) -> FlowField | None:
        """Return the flow without a device on a coarse grid, from a finer one and computed only once; None without."""
        start = finer()
        if start is None:
            return None
        key = size_mm, case.ends, case.blood, case.waveform, case.numerics
        done = _BARE_GUESSES.setdefault(start, {})
        if key not in done:
            done[key] = self._run(name, replace(case, media=(), solids=()), size_mm, finer, part)
        return done[key]

    def _run(self, name: str, case: FlowCase, size_mm: float, guess: Guess, part: Part) -> FlowField:
        """Run an engine from a guess or a saved state; after divergence start again with the engine's calmer case."""
        name = self.prefix + name
        engine = self.engine(size_mm, self.folder if name == "answer" else self.folder / name)
        guess, checkpoint = cache(partial(_guessed, engine, case, guess)), self.checkpoint
        saved = None if checkpoint is None else checkpoint.load(name)
        save = None if checkpoint is None else partial(checkpoint.save, name)
        progress = None if part is None else self._part(*part)
        tries = 0
        while True:
            start = guess() if saved is None else None
            try:
                return run(engine, case, start=start, progress=progress, saved=saved, save=save)
            except DivergenceError:
                calmer = engine.calmer(case)
                if calmer is None or tries == CALMER_TRIES:
                    raise
                case, saved, tries = calmer, None, tries + 1

    def _part(self, begin: float, end: float) -> OnProgress | None:
        """Return a progress callback for one run among several, from `begin` to `end` of the whole."""
        whole = self.progress
        if whole is None:
            return None

        def report(now: Progress) -> None:
            fraction = begin + (end - begin) * now.fraction
            beyond = (1 - end) / (end - begin)
            seconds_left = now.seconds_left * (1 + beyond / max(1 - now.fraction, 0.05))
            whole(Progress(fraction, now.residual, seconds_left))

        return report


def _of_tile(progress: OnProgress | None, began: float, fraction: float) -> None:
    """Report the progress of a tile that began at a time."""
    if progress is not None:
        progress(Progress(fraction, inf, (perf_counter() - began) * (1 / fraction - 1)))


def _guessed(engine: AbstractEngine[Any], case: FlowCase, guess: Guess) -> FlowField | None:
    """Return a first guess; while a GPU computes it, what the engine needs next is built."""
    if not case.numerics.device_gpu:
        return guess()
    with BackgroundWork(case.numerics) as background:
        prepared = background.begin(partial(engine.prepare, case))
        first = guess()
        prepared()
    return first


def _guess(start: Guess, bare: Guess, stented: Callable[[], FlowField]) -> FlowField | None:
    """Return a first guess from a coarser grid, or the start if that grid is too coarse or its flow diverges.

    If the flow without a device is known, the coarse grid only provides the change due to the screen (the correction
    scheme of multigrid, Brandt 1977, Math. Comput. 31, 333). The difference between the grids in the flow without a
    device is scaled by the ratio of speeds with and without the screen; otherwise it would exceed the flow itself in a
    sac nearly at rest.
    """
    fine = start()
    with suppress(DivergenceError, CoarseGridError):
        coarse = bare()
        return stented() if fine is None or coarse is None else _corrected(fine, coarse, stented())
    return fine


def _corrected(start: FlowField, bare: FlowField, stented: FlowField) -> FlowField:
    """Return a bare flow plus the change due to a screen on a coarser grid; if pulsatile, mean and last phase."""
    levels = _changed(start, bare, stented)
    phases: tuple[Phase, ...] = ()
    if start.phases and bare.phases and stented.phases:
        end = _changed(*(field.at_phase(field.phases[-1]) for field in (start, bare, stented)))
        values = tuple(one.velocity_m_s for one in end), tuple(one.pressure_Pa for one in end)
        phases = (replace(start.phases[-1], velocity_m_s=values[0], pressure_Pa=values[1]),)
    return replace(start, levels=levels, phases=phases, mean_shear_Pa=None, neck_inflow_mL_s=None)


def _changed(start: FlowField, bare: FlowField, stented: FlowField) -> tuple[Level, ...]:
    """Return the levels of a flow plus the difference between two flows on a coarser grid."""
    levels = []
    for grid in start.levels:
        before, after = (sampling.values_at(field, grid.centers_mm) for field in (bare, stented))
        speed_before, speed_after = (np.linalg.norm(values[0], axis=1, keepdims=True) for values in (before, after))
        left = np.clip(speed_after / np.maximum(speed_before, 1e-9), 0.0, 1.0)
        velocity_m_s = after[0] + left * (grid.velocity_m_s - before[0])
        pressure_Pa = grid.pressure_Pa + after[1] - before[1]
        levels.append(replace(grid, velocity_m_s=velocity_m_s, pressure_Pa=pressure_Pa, mean_speed_m_s=None))
    return tuple(levels)
