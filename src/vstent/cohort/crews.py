"""Crews: who does the cases: processes of this machine, or the workers of a Dask cluster."""

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
"""A case whose process dies is tried so often."""
SPARE: Final = 2.0
"""A job of a queue asks for so many times the memory foreseen: beyond it, it is killed."""
SCHEDULER_S: Final = 20.0
"""A scheduler that does not answer for so long is lost."""


class Ended(NamedTuple):
    """A task that has come to an end."""

    number: int
    """Which."""
    fault: str
    """Why its process died; empty where it did its work."""


class AbstractCrew(ABC):
    """Does tasks. Rows are written by whoever does them, so that they outlive the one who gave the order."""

    @abstractmethod
    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Yield every task when it has ended, in any order."""


@final
@dataclass(frozen=True)
class Processes(AbstractCrew):
    """Processes of this machine, a fresh one for every case: what dies takes nothing with it."""

    jobs: int
    """How many at once."""
    work: Callable[[Task], None] = work
    """What each does."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Yield every task when its process has ended."""
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the first process's to answer, which ends this one
    work(task)


def _fault(exitcode: int | None) -> str:
    if not exitcode:
        return ""
    how = f"was killed by signal {-exitcode}" if exitcode < 0 else f"ended with code {exitcode}"
    return (
        f"Its process {how} {ATTEMPTS} times; it may be out of memory. Use fewer jobs and run the same command again."
    )


@final
@dataclass(frozen=True)
class DaskCluster(AbstractCrew):
    """Workers of a Dask cluster; they must see the same folders as this machine."""

    address: str
    """Of the scheduler, such as tcp://head:8786."""
    work: Callable[[Task], None] = work
    """What each worker does."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Yield every task when its future has ended; a worker's death makes Dask give its task to another.

        Raises
        ------
        InputError
            When Dask is missing or no scheduler answers.
        VstentError
            When the scheduler is lost: what was finished is kept.
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
    """What one case is foreseen to need."""

    def do(self, tasks: Sequence[Task]) -> Iterator[Ended]:
        """Yield every task when it has ended.

        Raises
        ------
        InputError
            When dask-jobqueue or Slurm is missing.
        """
        if shutil.which("sbatch") is None:  # dask-jobqueue would try to send jobs for ever
            raise InputError(
                "Slurm was not found (no `sbatch` on the PATH): run the command on a machine that submits jobs"
            )
        with self.cluster() as cluster:
            cluster.adapt(minimum_jobs=self.jobs, maximum_jobs=self.jobs)  # a job that the queue ends is asked for anew
            yield from DaskCluster(cluster.scheduler_address).do(tasks)

    def cluster(self) -> Any:
        """Start the scheduler; queue, account and time limit come from dask-jobqueue's own configuration file."""
        try:
            from dask_jobqueue import SLURMCluster
        except ImportError:
            raise _missing("dask-jobqueue") from None
        return SLURMCluster(cores=1, processes=1, memory=f"{SPARE * self.memory_MB:.0f}MB", job_name="vstent")


def _missing(package: str) -> InputError:
    return InputError(f"{package} is not installed: run pip install 'vstent[cluster]', or work without the cluster")


def _client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise _missing("Dask") from None
    try:
        return Client(address, timeout=SCHEDULER_S)
    except (OSError, ValueError) as error:
        raise InputError(f"No Dask scheduler answers at {address}: start one with `dask scheduler`") from error


def _see_alive(client: Any) -> None:
    if client.status not in ("running", "connecting"):
        raise VstentError(
            "the Dask scheduler was lost; finished cases are kept: start it again and give the same command"
        )


def _future_fault(future: Any) -> str:
    if future.status == "finished":
        return ""
    if future.status == "error":
        return f"Its worker failed: {future.exception()}. Check the workers' logs and run the same command again."
    raise VstentError("the Dask scheduler was lost; finished cases are kept: start it again and give the same command")
