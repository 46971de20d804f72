"""Run tasks in processes of this machine, on a Dask cluster, or in a Slurm queue."""

import multiprocessing
import shutil
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, TypeVar, final

from vstent.children import SAFE, spawning
from vstent.errors import InputError, VstentError

Task = TypeVar("Task")

ATTEMPTS: Final = 2
"""Number of times a task is started where its process dies."""
SPARE: Final = 2.0
"""Factor on the estimated memory that a Slurm job requests, because a job that exceeds its request is killed."""
SCHEDULER_S: Final = 20.0
"""Time to wait for a Dask scheduler to answer, in s."""
MISSING: Final = "{} is not installed: run pip install 'vstent[cluster]', or work without the cluster"
"""Message where a package is not installed."""
_ALONE: Final = threading.Lock()
"""Lock for parallel kernels, which allow one caller per process; a Dask worker may have several threads."""


@contextmanager
def alone(threads: int = 1) -> Iterator[None]:
    """Do a task alone in its process, with at most a number of threads, because tasks share the cores."""
    import numba

    with _ALONE:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        yield


Ended = tuple[int, str]
"""Index of a task that has ended, and the reason why its process died; empty where it finished."""


class AbstractWorkers(ABC):
    """Runs tasks in parallel. Every task writes its own results, so that they survive the main process."""

    @abstractmethod
    def do(self, work: Callable[[Task], None], tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run tasks; yield each one when it has ended, in any order. `work` is at the top level of a module."""


@final
@dataclass(frozen=True)
class Processes(AbstractWorkers):
    """Processes of this machine, a new one for every task, so that a crash affects one task only."""

    jobs: int
    """Number of parallel processes."""

    def do(self, work: Callable[[Task], None], tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run tasks; yield each one when its process has ended."""
        context = multiprocessing.get_context("spawn")
        waiting = [(number, 1) for number in reversed(range(len(tasks)))]
        running: list[tuple[BaseProcess, int, int]] = []
        try:
            while waiting or running:
                while waiting and len(running) < self.jobs:
                    number, attempt = waiting.pop()
                    process: BaseProcess = context.Process(target=_uninterrupted, args=(work, tasks[number]))
                    with spawning():
                        process.start()
                    running.append((process, number, attempt))
                wait([process.sentinel for process, _, _ in running])
                for ended in [one for one in running if one[0].exitcode is not None]:
                    running.remove(ended)
                    code, number, attempt = ended[0].exitcode or 0, *ended[1:]
                    how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
                    if code and attempt < ATTEMPTS:
                        waiting.append((number, attempt + 1))
                    elif code:
                        advice = "it may be out of memory. Use fewer jobs and run the same command again."
                        yield number, f"Its process {how} {ATTEMPTS} times; {advice}"
                    else:
                        yield number, ""
        finally:
            for process, _, _ in running:
                process.terminate()
                process.join()


def _uninterrupted(work: Callable[[Task], None], task: Task) -> None:
    """Do a task with Ctrl-C ignored."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C and ends this process
    work(task)


@final
@dataclass(frozen=True)
class DaskCluster(AbstractWorkers):
    """Workers of a Dask cluster; they must have access to the same folders as this machine."""

    address: str
    """Address of the scheduler, such as ``tcp://head:8786``."""

    def do(self, work: Callable[[Task], None], tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run tasks; yield each one when it has ended. Dask gives the task of a worker that died to another worker.

        Raises
        ------
        InputError
            Dask is not installed, or no scheduler answers.
        VstentError
            The connection to the scheduler is lost; finished tasks are kept.
        """
        try:
            from distributed import Client
        except ImportError:
            raise InputError(MISSING.format("Dask")) from None
        try:
            client = Client(self.address, timeout=SCHEDULER_S)
        except (OSError, ValueError) as error:
            raise InputError(f"No Dask scheduler answers at {self.address}: start one with `dask scheduler`") from error
        with client:
            futures = {client.submit(work, task, pure=False): number for number, task in enumerate(tasks)}
            while futures:
                done = [future for future in futures if future.done()]
                is_lost = client.status not in ("running", "connecting")
                if is_lost or any(future.status not in ("finished", "error") for future in done):
                    raise VstentError(
                        "the Dask scheduler was lost; finished results are kept: start it again and give the same "
                        "command"
                    )
                for future in done:
                    fault = ""
                    if future.status == "error":
                        advice = "Check the workers' logs and run the same command again."
                        fault = f"Its worker failed: {future.exception()}. {advice}"
                    yield futures.pop(future), fault
                time.sleep(0.1)


@final
@dataclass(frozen=True)
class Slurm(AbstractWorkers):
    """Jobs of a Slurm queue, each a Dask worker; they are started for these tasks and ended with them."""

    jobs: int
    """Number of parallel jobs."""
    memory_MB: float
    """Estimated memory of one task."""

    def do(self, work: Callable[[Task], None], tasks: Sequence[Task]) -> Iterator[Ended]:
        """Run tasks; yield each one when it has ended; InputError where dask-jobqueue or Slurm is missing."""
        if shutil.which("sbatch") is None:  # dask-jobqueue would try to submit jobs forever
            raise InputError(
                "Slurm was not found (no `sbatch` on the PATH): run the command on a machine that submits jobs"
            )
        with self.cluster() as cluster:
            cluster.adapt(minimum_jobs=self.jobs, maximum_jobs=self.jobs)  # a job that the queue ends is replaced
            yield from DaskCluster(cluster.scheduler_address).do(work, tasks)

    def cluster(self) -> Any:
        """Start the scheduler; dask-jobqueue's configuration file sets queue, account and time limit."""
        try:
            from dask_jobqueue import SLURMCluster
        except ImportError:
            raise InputError(MISSING.format("dask-jobqueue")) from None
        memory, prologue = f"{SPARE * self.memory_MB:.0f}MB", [f"export {name}={value}" for name, value in SAFE.items()]
        options = {"dashboard_address": ":0"}  # any port: another cluster on this machine may have the usual one
        return SLURMCluster(
            cores=1,
            processes=1,
            memory=memory,
            job_name="vstent",
            job_script_prologue=prologue,
            scheduler_options=options,
        )
