"""Live flow in its own process: it answers, takes devices, survives being killed, and ends."""

import json
import os
import signal
import time

import pytest

import vstent
from vstent import phantoms
from vstent.anatomy.restore.restore import restore
from vstent.anatomy.trace import trace
from vstent.app.preview import Preview
from vstent.errors import InputError
from vstent.flow.case import FlowSettings
from vstent.geometry.vessel import Anatomy, Vessel

LONGEST_S = 120.0


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    phantom = phantoms.with_sac(phantoms.tube(length_mm=28.0), abscissa_mm=14.0, width_mm=5.0, neck_mm=3.6)
    return restore(trace(Vessel(phantoms.phantom_surface(phantom, edge_mm=0.3))))


@pytest.fixture(scope="module")
def preview(anatomy: Anatomy):
    found = Preview(anatomy, FlowSettings(cells_per_diameter=13.0, inflow_mL_s=1.5))
    yield found
    found.stop()


def manifest(preview: Preview) -> dict:
    """Return the manifest of a message."""
    raw = preview.message()
    length = int.from_bytes(raw[:4], "little")
    return json.loads(raw[4 : 4 + length])


def until(preview: Preview, holds) -> dict:
    """Ask until something holds of the answer."""
    began = time.monotonic()
    while time.monotonic() - began < LONGEST_S:
        told = manifest(preview)
        assert told["error"] == ""
        if holds(told):
            return told
        time.sleep(0.1)
    raise AssertionError(told)


def test_without_a_device_nothing_changes(preview: Preview) -> None:
    told = until(preview, lambda told: told["is_settled"] and told["layers"])
    assert abs(told["reductions"]["neck_inflow_mL_s"]) < 4.0
    (layer,) = told["layers"]
    assert (layer["id"], layer["pane"]) == ("streamlines", "")


def test_a_device_lowers_the_inflow_and_old_values_are_marked(preview: Preview, anatomy: Anatomy) -> None:
    preview.place(vstent.deploy(vstent.find_design("silk"), anatomy).stent)
    assert manifest(preview)["is_stale"]
    told = until(preview, lambda told: not told["is_stale"] and told["is_settled"])
    assert told["reductions"]["neck_inflow_mL_s"] < -15.0
    assert told["history"][-1] == pytest.approx(told["reductions"]["neck_inflow_mL_s"], abs=2.0)


def test_whoever_draws_a_device_does_not_wait_for_the_flow(preview: Preview, anatomy: Anatomy) -> None:
    """Devices are larger than the buffer of the pipe; while the process does not read, only the newest is kept."""
    stent = vstent.deploy(vstent.find_design("silk"), anatomy).stent
    os.kill(preview._process.pid, signal.SIGSTOP)
    try:
        began = time.monotonic()
        for _ in range(20):
            preview.place(stent)
            assert manifest(preview)["is_stale"]
        assert time.monotonic() - began < 1.0
    finally:
        os.kill(preview._process.pid, signal.SIGCONT)
    began = time.monotonic()
    until(preview, lambda told: not told["is_stale"])
    assert time.monotonic() - began < 30.0  # two devices at most are placed, not twenty


def test_streamlines_that_the_page_has_are_not_sent_again(preview: Preview) -> None:
    preview.place(preview._stent)
    os.kill(preview._process.pid, signal.SIGSTOP)
    try:
        told = manifest(preview)
        assert told["layers"]
        raw = preview.message(told["drawn"])
        assert json.loads(raw[4 : 4 + int.from_bytes(raw[:4], "little")])["layers"] == []
    finally:
        os.kill(preview._process.pid, signal.SIGCONT)


def test_killed_it_begins_again_with_the_same_device(preview: Preview) -> None:
    before = manifest(preview)["reductions"]["neck_inflow_mL_s"]
    os.kill(preview._process.pid, signal.SIGKILL)
    preview._process.join(10)
    told = until(preview, lambda told: not told["is_stale"] and told["is_settled"])
    assert told["reductions"]["neck_inflow_mL_s"] == pytest.approx(before, abs=4.0)


def test_unwatched_it_rests(preview: Preview) -> None:
    until(preview, lambda told: told["is_settled"])
    time.sleep(3.0)
    path = f"/proc/{preview._process.pid}/stat"
    if not os.path.exists(path):
        pytest.skip("needs /proc")

    def ticks() -> int:
        with open(path) as stat:
            return sum(map(int, stat.read().rsplit(")", 1)[1].split()[11:13]))

    first = ticks()
    time.sleep(1.0)
    assert ticks() - first < 20  # of 100 a second and core
    until(preview, lambda told: not told["is_stale"])


def test_a_vessel_without_a_sac_has_none() -> None:
    healthy = restore(trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=30.0), edge_mm=0.4))))
    with pytest.raises(InputError, match="needs a sac"):
        Preview(healthy, FlowSettings())
