"""A flow stopped at any moment goes on as if it had not been."""

import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere

from vstent import phantoms
from vstent.anatomy.trace import trace
from vstent.flow import engines
from vstent.flow.case import FlowCase, FlowField, Sheet, Target
from vstent.flow.lattice import stepping
from vstent.flow.problem import vessel_case
from vstent.flow.settings import FlowSettings, Numerics, Waveform
from vstent.flow.simulation import simulate_case
from vstent.geometry.surface import Surface
from vstent.geometry.vessel import Vessel
from vstent.study.store import Unfinished

SETTINGS = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.3, max_steps=800))
PULSE = FlowSettings(
    inflow_mL_s=1.0,
    waveform=Waveform(0.05, (0.5,), (0.0,)),
    numerics=Numerics(cell_size_mm=0.4, max_cycles=2, lattice_speed=0.2),
)


@cache
def vessel() -> Vessel:
    return trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=10.0, radius_mm=2.0), edge_mm=0.4)))


@cache
def fork() -> Vessel:
    straight = phantoms.tube(length_mm=10.0, radius_mm=2.0)
    branched = phantoms.with_branch(straight, abscissa_mm=4.0, direction=[1, 0, 1], radius_mm=1.2, length_mm=6.0)
    return trace(Vessel(phantoms.phantom_surface(branched, edge_mm=0.4)))


def screen() -> Sheet:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-2.2, 2.2, 0.1), np.arange(-2.2, 2.2, 0.1)))
    n = len(x)
    points = np.stack([x, y, np.full(n, 5.0)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (n, 1))
    one = np.ones(n)
    return Sheet(points, normals, 0.01 * one, 300 * one, 150 * one, 0 * one, one, one)


class Stopping(Unfinished):
    """Stops the run right after it has been saved for the `last` time."""

    last = 3

    def save(self, run: str, saved: engines.Saved) -> None:
        super().save(run, saved)
        self.last -= 1
        if self.last == 0:
            raise KeyboardInterrupt


@cache
def computed(kind: str) -> tuple[FlowCase, FlowField | None, FlowField]:
    """A case, the flow from which it starts, and its own flow in one go."""
    settings = PULSE if "pulsatile" in kind else SETTINGS
    if "windkessel" in kind:
        settings = replace(settings, outlets="windkessel")
    case = vessel_case(fork() if "windkessel" in kind else vessel(), settings)
    start = None
    if kind == "stented":
        start = simulate_case(case)
        case = replace(case, media=(screen(),))
    if "refined" in kind:
        sac = Surface(sphere(1.0).vertices_mm + np.array([0.0, 0.0, 5.0]), sphere(1.0).faces)
        numerics = replace(settings.numerics, cell_size_mm=0.2, refine=("sac",))
        case = replace(case, target=Target(sac, None), numerics=numerics)
    return case, start, simulate_case(case, start=start)


@pytest.mark.parametrize(
    "kind", ["steady", "pulsatile", "stented", "refined", "pulsatile refined", "windkessel", "pulsatile windkessel"]
)
@pytest.mark.parametrize("saves", [2, 9])
def test_a_stopped_flow_goes_on_to_the_same_bits(
    kind: str, saves: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engines, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(engines, "SAVE_SHARE", np.inf)
    monkeypatch.setattr(stepping, "SLICE_UPDATES", 5e5)  # stops between checks too
    case, start, whole = computed(kind)
    stopping = Stopping(tmp_path, "flow-key")
    stopping.last = saves
    with pytest.raises(KeyboardInterrupt):
        simulate_case(case, start=start, checkpoint=stopping)
    resumed = simulate_case(case, start=start, checkpoint=Unfinished(tmp_path, "flow-key"))
    assert_same(resumed, whole)


def assert_same(a: FlowField, b: FlowField) -> None:
    np.testing.assert_array_equal(a.velocity_m_s, b.velocity_m_s)
    np.testing.assert_array_equal(a.pressure_Pa, b.pressure_Pa)
    np.testing.assert_array_equal(a.speed_m_s, b.speed_m_s)
    np.testing.assert_array_equal(a.shear_Pa, b.shear_Pa)
    np.testing.assert_array_equal(a.residual, b.residual)
    assert (a.steps, a.advice, len(a.phases)) == (b.steps, b.advice, len(b.phases))
    for one, other in zip(a.phases, b.phases, strict=True):
        for first, second in zip(one.velocity_m_s, other.velocity_m_s, strict=True):
            np.testing.assert_array_equal(first, second)


KILLED = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[2] / "helpers")!r})
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_checkpoint as here
here.engines.SAVE_EVERY_S = 0.05
case = here.vessel_case(here.vessel(), here.LONG)
here.simulate_case(case, checkpoint=here.Unfinished(Path(sys.argv[1]), "flow-key"))
"""
LONG = FlowSettings(inflow_mL_s=2.0, numerics=Numerics(cell_size_mm=0.3, max_steps=1600, tolerance=1e-9))


def test_a_killed_flow_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)])
    try:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("flow-key-answer.running.npz")):
            assert process.poll() is None, "it ended before anything was saved"
            assert time.monotonic() < deadline
            time.sleep(0.02)
        time.sleep(0.2)
    finally:
        process.kill()
        process.wait()
    case = vessel_case(vessel(), LONG)
    resumed = simulate_case(case, checkpoint=Unfinished(tmp_path, "flow-key"))
    assert_same(resumed, simulate_case(case))


def test_what_is_damaged_or_was_never_saved_is_begun_anew(tmp_path: Path) -> None:
    kept = Unfinished(tmp_path, "flow-key")
    assert kept.load("answer") is None
    kept.save("answer", {"steps": np.array(7)})
    assert kept.load("answer") == {"steps": 7}
    file = next(tmp_path.iterdir())
    file.write_bytes(file.read_bytes()[:-40])
    assert kept.load("answer") is None
    assert Unfinished(tmp_path, "flow-other").load("answer") is None
