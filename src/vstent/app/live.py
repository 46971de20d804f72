"""Live flow of a case, in a process of its own that steps while the page watches.

The process first prepares the flow without a device, for a limited time, and stores it in the case folder. After that
it only steps while somebody asks for its numbers. It leaves the processor to everything else that the page does. It
ends when the server does, or when nobody has asked for some minutes.
"""

import os
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Condition, Lock, Thread
from typing import TYPE_CHECKING, Final, Self

from vstent.children import spawning
from vstent.devices.stent import Stent
from vstent.errors import InputError, VstentError
from vstent.flow.case import FlowCase
from vstent.flow.settings import FlowSettings
from vstent.flow.streamlines import neck_seeds_mm
from vstent.geometry.vessel import Anatomy
from vstent.io.archive import DAMAGE
from vstent.reporting.packing import message
from vstent.reporting.scene import LineLayer, scales_of, stream_layer
from vstent.study.keys import key_of
from vstent.study.store import Key, Store

if TYPE_CHECKING:  # imported by the process, so that the server does not wait for it
    from vstent.flow.lattice.live import LiveFlow

Stents = tuple[Stent, ...]
"""Devices of a treatment in the order of their deployment."""

NICE: Final = 10
"""Priority of the process, below that of the server."""
SLICE_S: Final = 0.15
"""Time between two messages of the process, in s."""
LINES_S: Final = 0.5
"""Time between two sets of streamlines, in s; three times as long until a number has a band, which comes sooner so."""
WATCHED_S: Final = 2.0
"""Time after the last request for which the process goes on stepping, in s."""
PREPARED_S: Final = 60.0
"""Longest time for which the flow without a device is computed while nobody watches, in s."""
IDLE_S: Final = 600.0
"""Time without a request after which the process ends and frees its memory, in s."""
FREE_BYTES: Final = 2e9
"""Free memory below which nothing is computed in advance, in bytes; the process of C0038 takes 0.5 GB."""
STORED: Final = "live"
"""Name under which the flow without a device is stored."""
STALE_S: Final = 1.5
"""Age of the last message from which it counts as stale, in s."""
HISTORY: Final = 240
"""Number of readings that the chart shows."""
LINES: Final = 70
"""Number of streamlines through the neck."""
ERROR_POINTS: Final = 8.0
"""Largest difference of a reduction from that of a full computation, once it is averaged long enough, in percentage
points; the largest one measured is 6 (`benchmarks/live.py`)."""
SHOWN_POINTS: Final = 30.0
"""Uncertainty of the averages in percentage points above which a reduction is shown without a band."""
COMPARED: Final = ("neck_inflow_mL_s", "sac_velocity_m_s")
"""Names of the values that the page compares with the flow without a device."""


@dataclass(frozen=True, eq=False)
class Reading:
    """A message of the process."""

    serial: int = 0
    """Number of the device that the numbers belong to; 0: the flow without a device."""
    fraction: float = 0.0
    """Part of the flow without a device that is computed."""
    values: dict[str, float] = field(default_factory=dict)
    """Neck inflow (mL/s) and sac velocity (m/s), without a device and now, and the steps per second; empty as long as
    they are not known well enough to be shown."""
    points: dict[str, float] = field(default_factory=dict)
    """Uncertainty of the averages behind every reduction, in percentage points, where it is known."""
    is_settled: bool = False
    """Whether the last readings agree."""
    is_prepared: bool = False
    """Whether nothing is left to compute in advance."""
    error: str = ""
    """Why it cannot be computed."""
    lines: LineLayer | None = None
    """Streamlines through the neck; None: unchanged."""

    @property
    def reductions(self) -> dict[str, float]:
        """Change of every value against the flow without a device, in percent; empty without values."""
        return {
            key: 100 * (self.values[f"now_{key}"] / max(self.values[f"bare_{key}"], 1e-12) - 1)
            for key in COMPARED
            if f"now_{key}" in self.values
        }


class _Sender:
    """Sends to the process from a thread of its own: the anatomy first, then of what waits only the newest.

    An anatomy or a device is larger than the buffer of a pipe, so sending it takes until the process reads it. Whoever
    draws the device must not wait for that.
    """

    def __init__(self, pipe: Connection, anatomy: Anatomy) -> None:
        self._pipe, self._ready, self._anatomy = pipe, Condition(), anatomy
        self._device: tuple[int, Stents] | None = None
        self._is_asked = self._is_over = False
        Thread(target=self._run, daemon=True).start()

    def send(self, device: tuple[int, Stents] | None) -> None:
        """Send the devices with their number, or None as a request to go on, as soon as the process reads."""
        with self._ready:
            self._device, self._is_asked = device or self._device, True
            self._ready.notify()

    def end(self) -> None:
        """Close the pipe."""
        with self._ready:
            self._is_over = True
            self._ready.notify()

    def _run(self) -> None:
        """Send until the end, or until the process has ended."""
        with suppress(OSError):
            self._pipe.send(self._anatomy)
            while True:
                with self._ready:
                    self._ready.wait_for(lambda: self._is_asked or self._is_over)
                    if self._is_over:
                        break
                    device, self._device, self._is_asked = self._device, None, False
                self._pipe.send(device)
        self._pipe.close()


@dataclass(frozen=True)
class BareFlowStore:
    """Where the flow without a device is stored; a file that cannot be read or written only costs run time."""

    folder: Path
    """Cache folder of the case."""
    key: Key
    """Key of the flow."""

    @classmethod
    def of(cls, folder: Path, anatomy: str, settings: FlowSettings) -> Self:
        """Return where it is stored for an anatomy of this key and settings of the flow."""
        return cls(folder, key_of("vstent.flow.lattice.live", anatomy, settings, without=("vstent.deployment",)))

    def load(self, case: FlowCase) -> "LiveFlow | None":
        """Return the live flow of a case continued from the stored one; None where there is none."""
        from vstent.flow.lattice.live import BareFlow, LiveFlow

        stored = Store(self.folder).load(STORED, self.key, BareFlow)
        if stored is not None:
            with suppress(*DAMAGE):
                return LiveFlow(case, stored=stored)
        return None

    def save(self, live: "LiveFlow") -> None:
        """Store the flow without a device."""
        with suppress(OSError):
            Store(self.folder).save(STORED, self.key, live.stored())


class LiveFlowProcess:
    """Live flow of one anatomy, steady; without a store the flow without a device is stored nowhere.

    Raises InputError: the vessel has no sac.
    """

    def __init__(self, anatomy: Anatomy, settings: FlowSettings, store: BareFlowStore | None = None) -> None:
        if not anatomy.aneurysms:
            raise InputError("Live flow needs a sac, and none was found. Choose one in the step Sac and parent.")
        self.anatomy, self.settings, self.store = anatomy, settings, store
        self._lock, self._serial = Lock(), 0
        self._stents: Stents | None = None
        self._watched_s = -WATCHED_S
        self._begin()

    def _begin(self) -> None:
        """Start the process."""
        self._reading, self._at_s, self._sent = Reading(), time.monotonic(), 0
        self._lines: LineLayer | None = None
        self._drawn = 0
        self._history: deque[float] = deque(maxlen=HISTORY)
        context = get_context("spawn")
        pipe, theirs = context.Pipe()
        self._process = context.Process(target=work, args=(theirs, self.settings, self.store), daemon=True)
        with spawning():
            self._process.start()
        theirs.close()
        self._sender = _Sender(pipe, self.anatomy)
        Thread(target=self._follow, args=(pipe,), daemon=True).start()

    def _follow(self, pipe: Connection) -> None:
        """Note the last message of the process until it ends."""
        with suppress(EOFError, OSError):
            while True:
                reading = pipe.recv()
                with self._lock:
                    self._reading, self._at_s = reading, time.monotonic()
                    if reading.lines is not None:
                        self._lines, self._drawn = reading.lines, self._drawn + 1
                    if reading.values:
                        self._history.append(reading.reductions["neck_inflow_mL_s"])

    @property
    def is_watched(self) -> bool:
        """Whether somebody has asked for the numbers a short time ago."""
        return time.monotonic() - self._watched_s < WATCHED_S

    @property
    def is_preparing(self) -> bool:
        """Whether the process computes although nobody watches."""
        return not self.is_watched and not self._reading.is_prepared and self._process.is_alive()

    def place(self, stents: Stents) -> None:
        """Put the devices of a treatment into the flow in place of the last ones; unwatched they are only noted."""
        with self._lock:
            self._serial += 1
            self._stents = stents
        if self.is_watched:
            self._send()

    def _send(self) -> None:
        """Send the devices where the process does not have them, else the request to go on."""
        with self._lock:
            is_new, self._sent = self._sent != self._serial, self._serial
            device = (self._serial, self._stents) if is_new and self._stents is not None else None
        self._sender.send(device)

    def message(self, seen: int = 0) -> bytes:
        """Return the numbers as a message for the page, and streamlines of another number than it has seen.

        The process continues for a while.
        """
        if not self._process.is_alive() and not self._reading.error:
            if self._reading.fraction >= 1.0:  # it had begun to step
                self._sender.end()
                self._begin()
            else:
                error = "The live flow ended unexpectedly. Switch it on again, or run the step Flow instead."
                self._reading = Reading(error=error)
        self._watched_s = time.monotonic()
        self._send()
        with self._lock:
            reading, age_s, lines, drawn = self._reading, time.monotonic() - self._at_s, self._lines, self._drawn
            history = list(self._history)
        layers = [] if lines is None or drawn == seen else [lines]
        return message(
            layers,
            scales_of(layers, self.anatomy),
            drawn=drawn,
            fraction=reading.fraction,
            error=reading.error,
            is_settled=reading.is_settled,
            is_stale=reading.serial != self._serial or age_s > STALE_S,
            values=reading.values,
            reductions=reading.reductions,
            history=history,
            error_points={key: ERROR_POINTS + points for key, points in reading.points.items()},
        )

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._sender.end()


def work(pipe: Connection, settings: FlowSettings, store: BareFlowStore | None) -> None:
    """Step the flow until the server ends; the body of the process.

    The pipe receives the anatomy, then (number, stents) for new devices and None for a request; it sends `Reading`.
    """
    with suppress(OSError, AttributeError):
        os.nice(NICE)
    with suppress(EOFError, BrokenPipeError, OSError, KeyboardInterrupt):
        try:
            _Worker(pipe, pipe.recv(), settings, store).run()
        except VstentError as error:
            pipe.send(Reading(error=str(error), is_prepared=True))
            pipe.poll(IDLE_S)


class _Worker:
    """The flow and the last message about it."""

    def __init__(self, pipe: Connection, anatomy: Anatomy, settings: FlowSettings, store: BareFlowStore | None) -> None:
        from vstent.flow.lattice.live import LiveFlow
        from vstent.flow.problem import flow_case

        self.pipe, self.anatomy, self.settings, self.store = pipe, anatomy, settings, store
        self.serial, self.watched_s, self.drawn_s = 0, -WATCHED_S, 0.0
        self.left_s, self.reading = PREPARED_S, Reading(fraction=1.0)
        case = flow_case(anatomy, (), settings)
        continued = None if store is None else store.load(case)
        self.is_stored = continued is not None and continued.is_prepared
        self.live = continued or LiveFlow(case, lambda done: pipe.send(Reading(fraction=done)))
        pipe.send(self.reading)

    def run(self) -> None:
        """Step and report while somebody watches; else prepare the flow without a device, store it once, and rest."""
        while True:
            newest = None
            while self.pipe.poll():
                newest = self.pipe.recv() or newest
                self.watched_s = time.monotonic()
            if newest is not None:
                from vstent.flow.media import media

                self.serial, stents = newest
                self.live.place(tuple(medium for stent in stents for medium in media(stent, self.settings.blood)))
            began = time.perf_counter()
            if time.monotonic() - self.watched_s < WATCHED_S:
                steps = self.live.advance(SLICE_S)
                self._report(steps / (time.perf_counter() - began))
            elif self.left_s > 0 and not self.live.is_prepared:
                self.live.prepare(SLICE_S)
                self.left_s -= time.perf_counter() - began
            else:
                if self.store is not None and not self.is_stored:
                    self.is_stored = True
                    self.store.save(self.live)
                self.pipe.send(replace(self.reading, is_prepared=True))
                if not self.pipe.poll(IDLE_S):
                    return
                self.drawn_s = time.monotonic()

    def _report(self, steps_per_s: float) -> None:
        """Send the present numbers, and from time to time streamlines after them."""
        bare, now = self.live.bare, self.live.read()
        if 100 * min(bare.error.values()) > SHOWN_POINTS:
            self.reading = Reading(self.serial, 1.0)
            self.pipe.send(self.reading)
            return
        points = {key: self.live.change(key)[1] for key in COMPARED}
        points = {key: value for key, value in points.items() if value < SHOWN_POINTS}
        values = {
            "bare_neck_inflow_mL_s": bare.neck_inflow_mL_s,
            "bare_sac_velocity_m_s": bare.sac_velocity_m_s,
            "now_neck_inflow_mL_s": now.neck_inflow_mL_s,
            "now_sac_velocity_m_s": now.sac_velocity_m_s,
            "grid_spacing_mm": self.live.cell_size_mm,
            "steps_per_s": steps_per_s,
        }
        self.reading = Reading(self.serial, 1.0, values, points, now.is_settled, self.live.is_prepared)
        self.pipe.send(self.reading)
        if time.monotonic() - self.drawn_s > (LINES_S if points else 3 * LINES_S):
            flow, self.drawn_s = self.live.field(), time.monotonic()
            seeds_mm = neck_seeds_mm(flow, self.anatomy.aneurysms[0].neck, LINES)
            self.pipe.send(replace(self.reading, lines=stream_layer("", flow, seeds_mm)))
