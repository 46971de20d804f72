"""Crews: the workers that run the cases: processes of this machine, or the workers of a Dask cluster."""

import multiprocessing
import shutil
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, NamedTuple, final

from vstent.cohort.work import Task, work
from vstent.errors import InputError, VstentError

ATTEMPTS: Final = 2
"""Number of times that a case is tried whose process dies."""
SPARE: Final = 2.0
"""Memory requested for a job of a queue, as a multiple of the estimate; the queue kills a job that exceeds it."""
SCHEDULER_S: Final = 20.0
"""Time after which a scheduler that does not answer is considered lost, s."""


class Ended(NamedTuple):
    """A task that has ended."""

    number: int
    """Index of the task."""
    fault: str
    """Why its process died; empty where it finished."""


class AbstractCrew(ABC):
    """Base class of crews. The workers write the rows, so that rows remain if the main process dies."""

    @abstractmethod
    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run the tasks and yield each when it has ended, in any order."""


@final
@dataclass(frozen=True)
class Processes(AbstractCrew):
    """Processes of this machine, a new one for every case, so that a crash affects one case only."""

    jobs: int
    """How many at once."""
    work: Callable[[Task], None] = work
    """Function that runs one task."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run the tasks and yield each when its process has ended."""
        context = multiprocessing.get_context("spawn")
        waiting = [(number, 1) for number in reversed(range(len(tasks)))]
        running: list[tuple[BaseProcess, int, int]] = []
        try:
            while waiting or running:
                while waiting and len(running) < self.jobs:
                    number, attempt = waiting.pop()
                    process: BaseProcess = context.Process(target=_uninterrupted, args=(self.work, tasks[number]))
                    process.start()
                    running.append((process, number, attempt))
                wait([one.sentinel for one, _, _ in running])
                for ended in [one for one in running if one[0].exitcode is not None]:
                    running.remove(ended)
                    code, number, attempt = ended[0].exitcode, *ended[1:]
                    if code and attempt < ATTEMPTS:
                        waiting.append((number, attempt + 1))
                    else:
                        yield Ended(number, _fault(code))
        finally:
            for one, _, _ in running:
                one.terminate()
                one.join()


def _uninterrupted(work: Callable[[Task], None], task: Task) -> None:
    """Run one task in a process that ignores Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C and ends this one
    work(task)


def _fault(exitcode: int | None) -> str:
    """Return a sentence on how a process died; empty where it finished."""
    if not exitcode:
        return ""
    how = f"was killed by signal {-exitcode}" if exitcode < 0 else f"ended with code {exitcode}"
    said = f"The process of this case {how} {ATTEMPTS} times, perhaps for lack of memory."
    return f"{said} Run the same command with fewer jobs (--jobs)."


@final
@dataclass(frozen=True)
class DaskCluster(AbstractCrew):
    """Workers of a Dask cluster; they need access to the same folders as this machine."""

    address: str
    """Address of the scheduler, such as ``tcp://head:8786``."""
    work: Callable[[Task], None] = work
    """Function that runs one task."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run the tasks and yield each when it has ended; Dask gives the task of a dead worker to another.

        Raises
        ------
        InputError
            Dask is not installed or no scheduler answers.
        VstentError
            The scheduler is lost; finished cases are kept.
        """
        with _client(self.address) as client:
            futures = {client.submit(self.work, task, pure=False): number for number, task in enumerate(tasks)}
            while futures:
                _see_alive(client)
                for future in [future for future in futures if future.done()]:
                    yield Ended(futures.pop(future), _future_fault(future))
                time.sleep(0.1)


@final
@dataclass(frozen=True)
class Slurm(AbstractCrew):
    """Jobs of a Slurm queue, each a Dask worker, started for this cohort and ended with it."""

    jobs: int
    """How many at once."""
    memory_MB: float
    """Estimated memory of one case."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run the tasks and yield each when it has ended.

        Raises
        ------
        InputError
            dask-jobqueue or Slurm is not installed.
        """
        if shutil.which("sbatch") is None:  # dask-jobqueue would try to submit jobs for ever
            raise InputError(
                "Slurm was not found (no `sbatch` on the PATH): run the command on a machine that can submit jobs."
            )
        with self.cluster() as cluster:
            cluster.adapt(minimum_jobs=self.jobs, maximum_jobs=self.jobs)  # ended jobs are submitted again
            yield from DaskCluster(cluster.scheduler_address).do(tasks)

    def cluster(self) -> Any:
        """Start and return the cluster; the configuration file of dask-jobqueue sets queue, account and time limit."""
        try:
            from dask_jobqueue import SLURMCluster
        except ImportError:
            raise _missing("dask-jobqueue") from None
        return SLURMCluster(cores=1, processes=1, memory=f"{SPARE * self.memory_MB:.0f}MB", job_name="vstent")


def _missing(package: str) -> InputError:
    """Return the error for a package that is not installed."""
    return InputError(f"{package} is not installed: run `pip install 'vstent[cluster]'`, or compute on this machine.")


def _client(address: str) -> Any:
    """Return a client of a Dask scheduler."""
    try:
        from distributed import Client
    except ImportError:
        raise _missing("Dask") from None
    try:
        return Client(address, timeout=SCHEDULER_S)
    except (OSError, ValueError) as error:
        raise InputError(f"No Dask scheduler answers at {address}: start one with `dask scheduler`.") from error


def _see_alive(client: Any) -> None:
    """Raise VstentError where the scheduler is lost."""
    if client.status not in ("running", "connecting"):
        raise VstentError(
            "the connection to the Dask scheduler is lost. Finished cases are kept: start it and run the same command."
        )


def _future_fault(future: Any) -> str:
    """Return a sentence on why a task failed; empty where it finished."""
    if future.status == "finished":
        return ""
    if future.status == "error":
        return f"The worker of this case failed: {future.exception()}. See its log, then run the same command again."
    raise VstentError(
        "the connection to the Dask scheduler is lost. Finished cases are kept: start it and run the same command."
    )
