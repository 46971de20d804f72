"""Live flow in its own process: it answers, takes devices, survives being killed, and ends."""

import json
import os
import signal
import time
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace

import pytest

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.app.cases import Cases
from vstent.app.choices import FlowChoice
from vstent.app.jobs import Jobs
from vstent.app.live import BareFlowStore, LiveFlowProcess, _Worker
from vstent.app.workspace import Workspace
from vstent.devices.stent import Stent
from vstent.errors import InputError
from vstent.flow.settings import FlowSettings, Numerics
from vstent.geometry.vessel import Anatomy, Vessel
from vstent.io.archive import save_data
from vstent.study.folder import CACHE

LONGEST_S = 120.0


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=28.0), abscissa_mm=14.0, width_mm=5.0, neck_mm=3.6)
    return restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))


@pytest.fixture(scope="module")
def preview(anatomy: Anatomy):
    found = LiveFlowProcess(
        anatomy, FlowSettings(inflow_mL_s=1.5, numerics=Numerics(cells_per_diameter=13.0, cells_across_neck=0.0))
    )
    yield found
    found.stop()


def manifest(preview: LiveFlowProcess) -> dict:
    """Return the manifest of a message."""
    raw = preview.message()
    length = int.from_bytes(raw[:4], "little")
    return json.loads(raw[4 : 4 + length])


def until(preview: LiveFlowProcess, holds) -> dict:
    """Ask until something holds of the answer."""
    began = time.monotonic()
    while time.monotonic() - began < LONGEST_S:
        told = manifest(preview)
        assert told["error"] == ""
        if holds(told):
            return told
        time.sleep(0.1)
    raise AssertionError(told)


def test_without_a_device_nothing_changes(preview: LiveFlowProcess) -> None:
    told = until(preview, lambda told: told["is_settled"] and told["layers"])
    assert abs(told["reductions"]["neck_inflow_mL_s"]) < 4.0
    (layer,) = told["layers"]
    assert (layer["id"], layer["pane"]) == ("streamlines", "")


def test_a_device_lowers_the_inflow_and_old_values_are_marked(preview: LiveFlowProcess, anatomy: Anatomy) -> None:
    preview.place((vstent.deploy(vstent.find_design("silk"), anatomy).stent,))
    assert manifest(preview)["is_stale"]
    told = until(preview, lambda told: not told["is_stale"] and told["is_settled"])
    assert told["reductions"]["neck_inflow_mL_s"] < -15.0
    assert told["history"][-1] == pytest.approx(told["reductions"]["neck_inflow_mL_s"], abs=2.0)


def test_the_flow_follows_all_devices_of_a_treatment_and_baskets(preview: LiveFlowProcess, anatomy: Anatomy) -> None:
    def settled(*stents: Stent) -> float:
        preview.place(stents)
        told = until(preview, lambda told: not told["is_stale"] and told["is_settled"])
        return float(told["reductions"]["neck_inflow_mL_s"])

    outer = vstent.deploy("silk", anatomy).stent
    inner = vstent.deploy("silk", anatomy, inside=[outer]).stent
    assert settled(outer, inner) < settled(outer) - 10.0
    assert settled(vstent.deploy("web_sl", anatomy).stent) < -30.0


def test_whoever_draws_a_device_does_not_wait_for_the_flow(preview: LiveFlowProcess, anatomy: Anatomy) -> None:
    """Devices are larger than the buffer of the pipe; while the process does not read, only the newest is kept."""
    stent = vstent.deploy(vstent.find_design("silk"), anatomy).stent
    os.kill(preview._process.pid, signal.SIGSTOP)
    try:
        began = time.monotonic()
        for _ in range(20):
            preview.place((stent,))
            assert manifest(preview)["is_stale"]
        assert time.monotonic() - began < 1.0
    finally:
        os.kill(preview._process.pid, signal.SIGCONT)
    began = time.monotonic()
    until(preview, lambda told: not told["is_stale"])
    assert time.monotonic() - began < 30.0  # two devices at most are placed, not twenty


def test_streamlines_that_the_page_has_are_not_sent_again(preview: LiveFlowProcess) -> None:
    preview.place(preview._stents)
    os.kill(preview._process.pid, signal.SIGSTOP)
    try:
        told = manifest(preview)
        assert told["layers"]
        raw = preview.message(told["drawn"])
        assert json.loads(raw[4 : 4 + int.from_bytes(raw[:4], "little")])["layers"] == []
    finally:
        os.kill(preview._process.pid, signal.SIGCONT)


def test_killed_it_begins_again_with_the_same_device(preview: LiveFlowProcess) -> None:
    before = until(preview, lambda told: told["is_settled"])["reductions"]["neck_inflow_mL_s"]
    os.kill(preview._process.pid, signal.SIGKILL)
    preview._process.join(10)
    told = until(preview, lambda told: not told["is_stale"] and told["is_settled"])
    assert told["reductions"]["neck_inflow_mL_s"] == pytest.approx(before, abs=4.0)


def is_at_rest(preview: LiveFlowProcess) -> bool:
    """Return whether the process uses less than a fifth of a core."""
    path = f"/proc/{preview._process.pid}/stat"
    if not os.path.exists(path):
        pytest.skip("needs /proc")

    def ticks() -> int:
        with open(path) as stat:
            return sum(map(int, stat.read().rsplit(")", 1)[1].split()[11:13]))

    first = ticks()
    time.sleep(1.0)
    return ticks() - first < 20  # of 100 a second and core


def test_unwatched_it_rests(preview: LiveFlowProcess) -> None:
    until(preview, lambda told: told["is_settled"])
    time.sleep(3.0)
    assert is_at_rest(preview)
    until(preview, lambda told: not told["is_stale"])


def in_time(holds) -> bool:
    """Return whether something holds before long."""
    began = time.monotonic()
    while not holds() and time.monotonic() - began < LONGEST_S:
        time.sleep(0.05)
    return bool(holds())


def test_what_is_prepared_is_stored_and_continued(anatomy: Anatomy, tmp_path: Path) -> None:
    settings = FlowSettings(inflow_mL_s=1.5, numerics=Numerics(cells_per_diameter=13.0, cells_across_neck=0.0))
    store, bare = BareFlowStore.of(tmp_path, "anatomy", settings), []
    stent = vstent.deploy(vstent.find_design("silk"), anatomy).stent
    for damage in (None, None, slice(0, 1000)):
        (kept,) = [*tmp_path.glob("live-*.npz")] or [tmp_path / "none"]
        if damage is not None:
            kept.write_bytes(kept.read_bytes()[damage])
        written = kept.stat().st_mtime_ns if kept.exists() else 0
        preview = LiveFlowProcess(anatomy, settings, store)
        try:
            assert in_time(lambda preview=preview: not preview.is_preparing)
            assert damage or written or is_at_rest(preview)
            assert preview._reading.values == {}
            (kept,) = tmp_path.glob("live-*.npz")
            assert (kept.stat().st_mtime_ns == written) is (damage is None and written > 0)
            preview.place((stent,))
            assert preview._sent == 0  # a device that nobody watches costs nothing
            told = until(preview, lambda told: not told["is_stale"] and "neck_inflow_mL_s" in told["error_points"])
            assert told["reductions"]["neck_inflow_mL_s"] < -15.0
            bare.append(told["values"]["bare_neck_inflow_mL_s"])
        finally:
            preview.stop()
    assert bare[0] == bare[1]
    assert bare[2] == pytest.approx(bare[0], rel=0.01)


def test_a_process_that_nobody_asks_ends(anatomy: Anatomy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vstent.app.live.IDLE_S", 0.1)
    flow, kept = SimpleNamespace(is_prepared=False), []
    flow.prepare = lambda _: setattr(flow, "is_prepared", True)
    store = SimpleNamespace(load=lambda *_: flow, save=kept.append)
    ours, theirs = Pipe()
    _Worker(theirs, anatomy, FlowSettings(), store).run()
    assert kept == [flow]
    assert [ours.recv().is_prepared for _ in range(2)] == [False, True]


def test_a_vessel_without_a_sac_has_none() -> None:
    healthy = restore(trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=30.0), edge_mm=0.4))))
    with pytest.raises(InputError, match="needs a sac"):
        LiveFlowProcess(healthy, FlowSettings())


class Idle:
    """A live flow without a process."""

    def __init__(self, anatomy: Anatomy, settings: FlowSettings, store: BareFlowStore) -> None:
        self.store, self.is_watched, self.is_preparing, self.is_stopped = store, False, True, False

    def place(self, stents: tuple[Stent, ...]) -> None:
        """Do nothing."""

    def stop(self) -> None:
        self.is_stopped = True


@pytest.fixture
def workspace(anatomy: Anatomy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Two cases with an anatomy, and live flows without a process."""
    workspace = Workspace(Cases(tmp_path))
    for name in ("one", "two"):
        case = workspace.cases.create(name, anatomy="of " + name, input="scan")
        (case.folder / "scan").touch()
        save_data(case.folder / CACHE / f"anatomy-of {name}.npz", anatomy)
    monkeypatch.setattr("vstent.app.live.LiveFlowProcess", Idle)
    monkeypatch.setattr(Jobs, "start", lambda *_: None)
    return workspace


def test_a_job_ends_what_is_prepared_and_nothing_else(workspace: Workspace) -> None:
    one = workspace.cases.get("one")
    for is_watched, is_preparing in ((True, False), (False, False), (False, True)):
        assert workspace.prepare_live_flow(one)
        preview = workspace.live_flow(one)
        preview.is_watched, preview.is_preparing = is_watched, is_preparing
        workspace.start(one, "anatomy")
        assert preview.is_stopped is is_preparing
        preview.is_watched = False
    workspace.jobs._jobs["two"] = SimpleNamespace(is_alive=True)
    assert not workspace.prepare_live_flow(one)
    assert workspace._live_flows == {}


def test_nothing_is_prepared_beside_a_watched_flow_or_without_memory(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (workspace.cases.get(name) for name in ("one", "two"))
    watched = workspace.live_flow(one)
    watched.is_watched = True
    assert not workspace.prepare_live_flow(two)
    watched.is_watched = False
    monkeypatch.setattr("vstent.flow.memory.free_memory_bytes", lambda: 1e9)
    assert not workspace.prepare_live_flow(two)
    monkeypatch.undo()
    monkeypatch.setattr("vstent.app.live.LiveFlowProcess", Idle)
    assert workspace.prepare_live_flow(two)
    assert watched.is_stopped


def test_a_pulse_keeps_what_is_prepared_and_another_inflow_does_not(workspace: Workspace) -> None:
    one = workspace.cases.get("one")
    first = workspace.live_flow(one)
    for number, (flow, is_same) in enumerate(
        ((FlowChoice(is_pulsatile=True), True), (FlowChoice(inflow_mL_s=2), False))
    ):
        one.change(number, one.state.choices.model_copy(update={"flow": flow}))
        assert (workspace.live_flow(one) is first) is is_same
    assert first.is_stopped
