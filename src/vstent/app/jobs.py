"""Jobs: the long stages of a case, run in a separate process so that the page stays responsive and can stop them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any, Final

from vstent.app.cases import Case, dependencies
from vstent.children import environment

KINDS: Final = {
    "anatomy": ("image", "vessel", "sac"),
    "rank": ("device",),
    "place": ("device", "deploy"),
    "flow": ("device", "deploy", "flow", "report"),
    "angiogram": ("flow", "report"),
}
"""Steps that each kind of job completes."""
FIRST: Final = {"anatomy": "image", "rank": "device", "place": "deploy", "flow": "flow", "angiogram": "flow"}
"""Step that each kind of job shows before its first progress message."""
STAGES: Final = {
    **dict.fromkeys(("scan", "segment"), "image"),
    **dict.fromkeys(("vessel", "trace", "trim"), "vessel"),
    **dict.fromkeys(("anatomy", "restore"), "sac"),
    **dict.fromkeys(("rank", "rank_flow"), "device"),
    **dict.fromkeys(("deploy", "struts"), "deploy"),
    **dict.fromkeys(("plan", "flow", "angiogram"), "flow"),
    **dict.fromkeys(("film", "measure", "vary", "report"), "report"),
}
"""Step of the page for the first word of a study's stage."""
STOPPED: Final = "Stopped. Finished results are kept."
"""Message of a step that the user stopped."""
LAST_WORDS: Final = ".worker.log"
"""File of a case folder with the output of a job that ended unexpectedly."""
POINTS_KEPT: Final = 600
"""Number of residuals kept for the convergence plot."""
RANKING: Final = "ranking.json"
"""File of a case folder with the ranking."""


class Job:
    """A process that works on a case: a job of a kind of `KINDS`."""

    def __init__(self, case: Case, kind: str) -> None:
        self.case, self.kind = case, kind
        self.began = time.time()
        self.now: dict[str, Any] = {"stage": "", "fraction": 0.0, "detail": "", "residual": None, "seconds_left": None}
        self.finished: list[dict[str, Any]] = []
        self.residuals: deque[tuple[float, float]] = deque(maxlen=POINTS_KEPT)
        self._given = case.state
        keys = dependencies(self._given)
        self._has_anatomy = all(self._given.done.get(step) == keys[step] for step in KINDS["anatomy"])
        self._is_stopped = self._is_abandoned = False
        command = [sys.executable, "-m", "vstent.app.worker", kind, str(case.folder)]
        with (case.folder / LAST_WORDS).open("w", encoding="utf-8") as last_words:
            self._process = subprocess.Popen(
                command,
                env=environment(),
                stdin=subprocess.PIPE,  # it closes when the server ends for any reason, and the job ends then
                stdout=subprocess.PIPE,
                stderr=last_words,
                text=True,
                bufsize=1,
                start_new_session=True,  # the job's own processes end with it
            )
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def step(self) -> str:
        """Current step of the page; empty when all are finished."""
        if self._process.poll() is not None and not self._thread.is_alive():
            return ""
        step = STAGES.get(self.now["stage"].partition(" ")[0], FIRST[self.kind])
        is_past = self._has_anatomy and step not in KINDS[self.kind]  # the stored anatomy is being loaded
        return FIRST[self.kind] if is_past else step

    @property
    def is_alive(self) -> bool:
        """Whether the process is running."""
        return self._thread.is_alive()

    def told(self) -> dict[str, Any]:
        """Return the progress as clients read it."""
        seconds, residuals = time.time() - self.began, list(self.residuals)
        return {"kind": self.kind, "seconds": seconds, "finished": self.finished, "residuals": residuals} | self.now

    def stop(self) -> None:
        """Stop at once; finished results are kept."""
        self._is_stopped = True
        self._kill()
        self._thread.join(5.0)

    def abandon(self) -> None:
        """Stop because the server ends; the stored state still names the job, so that it is resumed."""
        self._is_abandoned = True
        self._kill()

    def _kill(self) -> None:
        """Kill the process and its children."""
        with suppress(ProcessLookupError):
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()

    def _follow(self) -> None:
        """Read the messages of the process until it ends."""
        assert self._process.stdout is not None
        assert self._process.stdin is not None
        failure = ""
        with suppress(BrokenPipeError):  # it has ended already, as reported below
            self._process.stdin.write(self._given.model_dump_json(exclude={"undo", "redo"}) + "\n")
        for line in self._process.stdout:
            told = json.loads(line)
            if self._is_abandoned:
                continue
            if "error" in told:
                failure = told["error"]
            elif "anatomy" in told:
                self._take_anatomy(told["anatomy"])
            else:
                self._take(told)
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        code = self._process.wait()
        if self._is_abandoned:
            return
        if self._is_stopped:
            failure = STOPPED
        elif code and not failure:
            failure = (
                f"The computation ended unexpectedly (its last words: {LAST_WORDS}). Finished results are "
                "kept; start it again."
            )
        steps, keys, state = KINDS[self.kind], dependencies(self._given), self.case.state
        failed = {step: why for step, why in state.failed.items() if step not in steps}
        if failure:
            step = self.step or steps[0]
            failed |= {step: failure}
            self.case.update(failed=failed, failed_with=state.failed_with | {step: keys[steps[-1]]}, job="")
        else:
            self.case.update(failed=failed, done=state.done | {step: keys[step] for step in steps}, job="")

    def _take_anatomy(self, key: str) -> None:
        """Store the key of the anatomy that the job found, and mark its steps as finished."""
        self._has_anatomy = True
        steps, keys, state = KINDS["anatomy"], dependencies(self._given), self.case.state
        failed = {step: why for step, why in state.failed.items() if step not in steps}
        self.case.update(anatomy=key, done=state.done | {step: keys[step] for step in steps}, failed=failed)

    def _take(self, now: dict[str, Any]) -> None:
        """Record the progress of a stage, mark the steps before the current one as finished, and notify the clients."""
        if now["stage"] != self.now["stage"]:
            self.residuals.clear()
        self.now = now
        if now["residual"] is not None:
            self.residuals.append((now["fraction"], now["residual"]))
        if now["fraction"] >= 1.0:
            self.finished.append({"stage": now["stage"], "detail": now["detail"]})
        steps, keys, done = KINDS[self.kind], dependencies(self._given), self.case.state.done
        passed = steps[: steps.index(self.step)] if self.step in steps else ()
        if any(done.get(step) != keys[step] for step in passed):
            self.case.update(done=done | {step: keys[step] for step in passed})
        self.case.tell()


class Jobs:
    """The running jobs, at most one per case."""

    def __init__(self) -> None:
        self._jobs: dict[str, Job] = {}
        self._lock = threading.Lock()

    def has(self, case: Case) -> bool:
        """Whether a job of a case runs or has run."""
        return case.id in self._jobs

    def running(self, case: Case) -> Job | None:
        """Return the running job of a case; None where none runs."""
        job = self._jobs.get(case.id)
        return job if job is not None and job.is_alive else None

    @property
    def are_running(self) -> bool:
        """Whether a job runs on any case."""
        return any(job.is_alive for job in tuple(self._jobs.values()))

    def start(self, case: Case, kind: str) -> None:
        """Start a job; a running one is stopped first."""
        with self._lock:
            self.stop(case)
            failed = {step: why for step, why in case.state.failed.items() if step not in KINDS[kind]}
            case.update(job=kind, failed=failed)
            self._jobs[case.id] = Job(case, kind)

    def stop(self, case: Case) -> None:
        """Stop the job of a case."""
        if job := self.running(case):
            job.stop()

    def abandon(self) -> None:
        """Stop all jobs because the server ends; they resume when it starts again."""
        for job in self._jobs.values():
            if job.is_alive:
                job.abandon()
