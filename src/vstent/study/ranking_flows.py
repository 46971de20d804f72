"""Store the flows of a ranking, and compute them in parallel: in processes, on a Dask cluster, or in a Slurm queue."""

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

from vstent.devices.treatment import BARE
from vstent.flow.memory import free_memory_bytes
from vstent.flow.problem import flow_case
from vstent.flow.settings import FlowSettings
from vstent.flow.simulation import memory_bytes
from vstent.geometry.vessel import Anatomy
from vstent.io.files import write_bytes
from vstent.plan.rank import Candidate
from vstent.plan.rank_flow import coverage_of, flow_with, is_finished, nearest, stent_of, with_screens
from vstent.study.folder import CACHE
from vstent.study.keys import key_of
from vstent.study.store import Key, Store
from vstent.study.workers import AbstractWorkers, alone
from vstent.units import BYTES_PER_MB

COMMON: Final = "common"
"""File of what all flows need."""
FIELD: Final = ".flow"
"""Suffix of the file of a finished flow, from which others start."""
RESULT: Final = ".result"
"""Suffix of the file of what the ranking needs of a flow."""


class FlowStore:
    """Results of flows by candidate (None: without a device), in the store of a case folder.

    `anatomy` is the key of the artery. With them an interrupted ranking resumes.
    """

    def __init__(self, out: Path, anatomy: Key, settings: FlowSettings) -> None:
        self.folder = out / CACHE
        self._store, self._anatomy, self._settings = Store(self.folder), anatomy, settings
        self._lost: dict[str, Any] = {}

    def get(self, candidate: Candidate | None) -> Mapping[str, Any] | None:
        """Return the result with a candidate, or None if there is none of these numbers."""
        name, key = self._place(candidate)
        return self._lost.get(name, self._store.record(name, key).get("values"))

    def __setitem__(self, candidate: Candidate | None, result: Mapping[str, Any]) -> None:
        self._store.write(*self._place(candidate), {}, values=dict(result))

    def lose(self, candidate: Candidate, why: str) -> None:
        """Remember, for this run only, that a flow was lost with the process that computed it."""
        self._lost[self._place(candidate)[0]] = {"error": why}

    def _place(self, candidate: Candidate | None) -> tuple[str, Key]:
        """Return the name of a result in the store and its key."""
        name, device = f"rank flow {BARE}", None
        if candidate is not None:
            name = f"rank flow {candidate.design.key} {candidate.size.label} {candidate.shift_mm:+g}"
            device = replace(candidate.design, facts=(), ranges=()), candidate.size, candidate.shift_mm
        return name, key_of("vstent.plan.rank_flow", self._anatomy, self._settings, device)


class FlowTask(NamedTuple):
    """The flow with one candidate."""

    folder: Path
    """Folder that all workers reach, with what all flows need and the finished flows."""
    number: int
    """Index of the candidate."""


def compute_missing(
    anatomy: Anatomy,
    chosen: Sequence[Candidate],
    settings: FlowSettings,
    stored: FlowStore,
    workers: AbstractWorkers,
    *,
    has_contrast: bool = False,
    threads: int = 1,
    progress: Callable[[int, int, str], None],
) -> None:
    """Compute the missing flows of a ranking in parallel and store their results for `rank_flows`.

    The artery has a sac, and the candidates are those of `chosen_of`. Every flow starts from the most similar one that
    is finished when it begins, as in `rank_flows`; the one without a device is computed here. `progress` gets the
    number of finished flows, the number of all, and the name of the last.

    FlowError is raised where the flow without a device cannot be computed. Other errors are those of the workers;
    finished flows are kept.
    """
    wanted = tuple(one for one in chosen if not is_finished(stored.get(one), has_contrast))
    if not wanted:
        return
    total = 1 + len(chosen)  # with the flow without a device
    before = total - len(wanted)
    progress(before - 1, total, "no device")
    bare, measured = flow_with(anatomy, None, settings, start=None, similar=None, has_contrast=has_contrast)
    stored[None] = measured()
    assert bare is not None  # without a device it would have been raised
    progress(before, total, f"{len(wanted)} devices in parallel")
    with TemporaryDirectory(prefix="rank-flow-", dir=stored.folder) as name:
        folder = Path(name)
        write_pickle(folder / COMMON, (anatomy, settings, wanted, bare, has_contrast, threads))
        tasks = [FlowTask(folder, number) for number in range(len(wanted))]
        for done, (number, fault) in enumerate(workers.do(work, tasks), start=1):
            candidate = wanted[number]
            if fault:
                stored.lose(candidate, fault)
            else:
                stored[candidate] = _read_pickle(folder / f"{number}{RESULT}")
            progress(before + done, total, candidate.label)


def work(task: FlowTask) -> None:
    """Compute the flow with one candidate, and write it and its result into the folder of the task."""
    anatomy, settings, candidates, bare, has_contrast, threads = _read_pickle(task.folder / COMMON)
    with alone(threads):
        candidate = candidates[task.number]
        paths = ((coverage_of(one), task.folder / f"{n}{FIELD}") for n, one in enumerate(candidates))
        path = nearest(coverage_of(candidate), [one for one in paths if one[1].exists()])
        similar = None if path is None else _read_pickle(path)
        starts = {"start": bare, "similar": similar, "has_contrast": has_contrast}
        field, measured = flow_with(anatomy, candidate, settings, **starts)
        if field is not None:
            write_pickle(task.folder / f"{task.number}{FIELD}", field)
        write_pickle(task.folder / f"{task.number}{RESULT}", measured())


def parallel_flows(
    anatomy: Anatomy, chosen: Sequence[Candidate], settings: FlowSettings, jobs: int
) -> tuple[int, float]:
    """Return how many flows fit in memory at once on this machine, at most `jobs`, and the memory of one, in MB.

    One at a time where they run on a GPU, or where the memory of a flow is unknown (0 is returned for it).
    """
    needed = 0.0
    if chosen and anatomy.aneurysms:
        stents = (stent_of(anatomy, chosen[0]),)
        needed = memory_bytes(flow_case(anatomy, stents, with_screens(settings))) or 0.0
    if settings.numerics.device_gpu or not needed:
        return 1, needed / BYTES_PER_MB
    fitting = min(jobs // settings.numerics.processes, free_memory_bytes() // needed)
    return max(1, int(fitting)), needed / BYTES_PER_MB


def write_pickle(path: Path, what: Any) -> None:
    """Write an object, so that a file of this name is always whole."""
    write_bytes(path, pickle.dumps(what))


def _read_pickle(path: Path) -> Any:
    """Return an object that this module has written."""
    return pickle.loads(path.read_bytes())
