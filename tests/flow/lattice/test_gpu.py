"""The flow on a GPU: on numba's simulator, where there is none, as on the processor; and refused in words."""

import json
import os
import pickle
import re
import runpy
import subprocess
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere
from tubes import line, tube

from vstent.cli import main
from vstent.errors import FlowError, InputError
from vstent.flow import domain
from vstent.flow.case import FlowCase, Sheet, Target
from vstent.flow.domain import Domain
from vstent.flow.lattice import gpu as gpus, levels, state as lattice_state, stepping
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.cost import GPU_BYTES_PER_CELL, estimate, refuse_too_large
from vstent.flow.lattice.engine import LatticeBoltzmann, PulsatileLatticeBoltzmann
from vstent.flow.lattice.kernels import d3q19, exchange, warm
from vstent.flow.lattice.recording import SEQUENCES, NotRecordedError, Pairs, plan, recorded
from vstent.flow.lattice.setup import Grid
from vstent.flow.problem import vessel_case
from vstent.flow.settings import Blood, CarreauYasuda, FlowSettings, Numerics, Waveform
from vstent.flow.simulation import engine_class, foretell_cost, simulate_case
from vstent.geometry.surface import Surface
from vstent.kernels.arrays import Bools
from vstent.kernels.directions import VELOCITIES
from vstent.study import repeat
from vstent.study.repeat import provenance
from vstent.study.settings import Settings

CELL_MM, RADIUS_MM, LENGTH_MM = 0.4, 0.7, 0.8
SETTLED_PAIRS = 3 * lattice_state.DEFER_PAIRS
"""What is deferred and balanced changes in the first of the pairs compared."""
ROUNDING = 2e-6
"""Of the largest of its kind: some dozens of float32 roundings."""

ON_GPU = """
import pickle, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.stepping import read_here, advance, step

state, twin = (pickle.loads(Path(sys.argv[1]).read_bytes()) for _ in range(2))
assert "vstent.flow.lattice.kernels.gpu" not in sys.modules  # who did not ask for a GPU does not load what it takes
for one in (state, twin):
    one.case = replace(state.case, numerics=replace(state.case.numerics, device_gpu=True))
    advance(one, 4)
for (name, one), other in zip(pack(state).items(), pack(twin).values()):
    assert name == "loop_seconds" or one.tobytes() == other.tobytes()  # sums do not depend on the order of threads
step(state)
assert state.device.how == "one by one, because numba simulates the GPU"
saved = pack(state)
assert state.device is not None  # the next steps are longer: it has converted what it holds
advance(state, 0)
saved_again = pack(state)
for found, wanted in zip(state.device.read()[:2], read_here(state)[:2]):
    np.testing.assert_array_equal(found, wanted)
for name in saved:
    np.testing.assert_array_equal(saved_again[name], saved[name])
np.savez(sys.argv[2], **saved)
"""

AHEAD = """
import pickle, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.recording import SEQUENCES
from vstent.flow.lattice.stepping import advance, step

waits, ahead = (pickle.loads(Path(sys.argv[1]).read_bytes()) for _ in range(2))
for one in (waits, ahead):
    one.case = replace(one.case, numerics=replace(one.case.numerics, device_gpu=True))
    one.pace, one.check_s, one.since_check = np.array([4, 2]), 4 * one.scales.step_s, 0
    step(one)
device = ahead.device
device._replay = {one: lambda one=one: device.make(*one) for one in SEQUENCES}
for one in (waits, ahead):
    step(one)
assert waits.begun_s is None
assert device._begun == 2
assert ahead.since_check == 0
assert ahead.steps == waits.steps
for name in ("velocity", "density", "outflow"):
    one, other = (getattr(state.snapshots[-1], name) for state in (waits, ahead))
    assert one.any() and one.tobytes() == other.tobytes()
assert np.array(waits.history).tobytes() == np.array(ahead.history).tobytes()
saved = pack(ahead)
assert saved["steps"] == waits.steps + 4
advance(waits, 4)
for (name, one), other in zip(saved.items(), pack(waits).values()):
    assert name == "loop_seconds" or one.tobytes() == other.tobytes()
for one in (waits, waits, ahead, ahead):
    step(one)
assert np.array(waits.history).tobytes() == np.array(ahead.history).tobytes()
assert ahead.begun_s is not None
for name in ("built", "links"):  # the force on wires is read from the populations of the last check
    links = replace(ahead.built[0] if name == "built" else ahead.links, of_wires=np.zeros(1, np.int32))
    setattr(ahead, name, (links, ahead.built[1]) if name == "built" else links)
step(ahead)
assert ahead.begun_s is None
"""


NESTED = """
import pickle, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.stepping import advance, step, twin

state, same = (pickle.loads(Path(sys.argv[1]).read_bytes()) for _ in range(2))
is_whole = len(state.levels) == 2
for one in (state, same)[: 1 + is_whole]:
    one.case = replace(state.case, numerics=replace(state.case.numerics, device_gpu=True))
    advance(one, 2)
if is_whole:
    for (name, one), other in zip(pack(state).items(), pack(same).values()):
        assert name == "loop_seconds" or one.tobytes() == other.tobytes()
    step(state)
    assert [level.device is not None for level in state.levels] == [True, True]  # the next steps are longer
    other = twin(state)
    assert other.device is None
    for one in (state, other):
        advance(one, 2)
    for (name, one), other in zip(pack(state).items(), pack(other).values()):
        assert name == "loop_seconds" or one.tobytes() == other.tobytes()
np.savez(sys.argv[2], **pack(state))
"""


def screen(middle_mm: float = 0.5 * LENGTH_MM) -> Sheet:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-1.0, 1.0, 0.1), np.arange(-1.0, 1.0, 0.1)))
    n = len(x)
    points, normals = np.stack([x, y, np.full(n, middle_mm)], axis=1), np.tile([0.0, 0.6, 0.8], (n, 1))
    one = np.ones(n)
    return Sheet(points, normals, 0.01 * one, 300 * one, 150 * one, 0.5 * one, one, one)


def septa_away_from_links(state: lattice_state.State) -> tuple[np.ndarray, np.ndarray]:
    """Some septa, across z, where neither population that they exchange concerns a link."""
    a, domain_, q = state.addressing, state.domain, 5
    ahead = domain_.index[tuple((domain_.cells + VELOCITIES[q]).T)]
    pairs = np.stack([d3q19.OPPOSITE[q] * a.stride + a.place, q * a.stride + a.place[ahead]])
    cell = np.flatnonzero((ahead >= 0) & ~np.isin(pairs, state.links.address).any(axis=0))[::4]
    assert len(cell) > 1
    return pairs[:, cell].astype(np.int32), cell


def everything() -> lattice_state.State:
    """A run with all that kernels know: pulse, moments, screen, thinning, thickened blood, each kind of opening, septa.

    The outlet's links are shared by a pressure and an outflow.
    """
    settings = FlowSettings(
        inflow_mL_s=0.3,
        blood=Blood(viscosity_Pa_s=0.00345, thinning=CarreauYasuda()),
        waveform=Waveform(0.05, (0.5,), (0.2,)),
        numerics=Numerics(cell_size_mm=CELL_MM, lattice_speed=0.05),
    )
    vessel = tube(line(LENGTH_MM), RADIUS_MM, around=32).vessel
    case = vessel_case(vessel, settings, media=(screen(),))
    state = PulsatileLatticeBoltzmann(CELL_MM).init(case, None)
    links, a = state.links, state.addressing
    openings = links.openings[[0, 1, 1]]
    openings[2, [d3q19.KIND, d3q19.WANTED]] = d3q19.OUTFLOW, -0.5 * openings[0, d3q19.WANTED]
    openings[1:, d3q19.AREA] *= 0.5
    start = np.array([*links.start[:2], links.start[1:].mean(), links.start[2]], np.int32)
    swing = np.array([1.0, 0.8, 1.2])  # what a refined part imposes in the course of a cycle
    wanted = openings[:, d3q19.WANTED].copy()
    course = 0.1 * swing[:, None] * np.abs(wanted).max() * [1.0, 0.0, 1.0]
    shape = swing[:, None, None] * links.shape
    state.links = replace(links, openings=openings, start=start, wanted=wanted, course=course, shape=shape)
    septa, cell = septa_away_from_links(state)
    state.addressing = replace(a, septa=np.ascontiguousarray(septa), septum_cell=cell)
    state.bands = Grid(state.domain, state.limit, state.addressing).bands
    state.limit[::2] = 1.0
    state.pace = np.array([2 * SETTLED_PAIRS + 20, 2 * SETTLED_PAIRS + 18])
    state.check_s = state.scales.step_s * int(state.pace[0])
    state.built = state.links, state.screen
    return state


def simulate(script: str, folder: Path, state: lattice_state.State) -> None:
    """Run a script on numba's simulator, with the path of a state and a path for results as arguments."""
    (folder / "state").write_bytes(pickle.dumps(state))
    simulated = os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}
    often = "import sys; sys.setswitchinterval(5e-4)\n"  # the simulator's threads wait for each other
    command = [sys.executable, "-W", "error", "-c", often + script, str(folder / "state"), str(folder / "found.npz")]
    ran = subprocess.run(command, env=simulated, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_a_gpu_makes_the_steps_that_a_processor_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain, "MIN_CELLS", 30)
    state = everything()
    stepping.advance(state, 2 * SETTLED_PAIRS)
    simulate(ON_GPU, tmp_path, state)
    stepping.step(state)
    wanted = pack(state)
    assert wanted["steps"] == state.pace[0]
    agree(tmp_path, wanted)


def agree(folder: Path, wanted: dict[str, np.ndarray]) -> None:
    """Compare what a script has saved with what is wanted."""
    with np.load(folder / "found.npz") as archive:
        found = dict(archive)
    assert found["steps"] == wanted["steps"]
    for saved in (found, wanted):  # an opening's columns are of different sizes
        saved |= {f"opening's {k}": column for k, column in enumerate(saved.pop("0 openings").T)}
    for name in wanted.keys() - {"loop_seconds"}:
        of_kind = name.replace("refill", "populations")  # whose differences it holds
        most = np.abs(wanted[of_kind]).max(initial=0.0)
        np.testing.assert_allclose(found[name], wanted[name], rtol=0, atol=ROUNDING * most, err_msg=name)


def nested(
    levels_wanted: int, length_mm: float, reach_mm: float, monkeypatch: pytest.MonkeyPatch
) -> lattice_state.State:
    """A pulse of shear-thinning blood in a thin tube on two or three levels, with a screen across a border of them."""

    def within(reach_mm: float, grid: Domain) -> Bools:
        return np.abs(grid.centers_mm[:, 2] - 0.5 * length_mm) < reach_mm

    monkeypatch.setattr(domain, "MIN_CELLS", 30)
    monkeypatch.setattr(levels, "near_sac", lambda _, grid: within(reach_mm, grid))
    if levels_wanted == 3:
        monkeypatch.setattr(levels, "near_wires", lambda _, grid, __: within(0.1, grid))
        monkeypatch.setattr(levels, "around_wires_mm", lambda _: 0.25 * CELL_MM)
    settings = FlowSettings(
        inflow_mL_s=0.3,
        blood=Blood(viscosity_Pa_s=0.00345, thinning=CarreauYasuda()),
        waveform=Waveform(0.05, (0.5,), (0.2,)),
        numerics=Numerics(cell_size_mm=0.5 * CELL_MM, lattice_speed=0.05, refine=("sac",)),
    )
    ball = Surface(sphere(0.3).vertices_mm + np.array([0, 0, 0.5 * length_mm]), sphere(0.3).faces)
    media = (screen(0.5 * length_mm - reach_mm),)
    case = vessel_case(tube(line(length_mm), 0.5, around=32).vessel, settings, target=Target(ball, None), media=media)
    state = PulsatileLatticeBoltzmann(0.5 * CELL_MM).init(case, None)
    pace, check_s = np.array([54, 48]), 54 * state.scales.step_s
    for depth, level in enumerate(state.levels):
        level.pace, level.check_s = 2**depth * pace, check_s
    assert len(state.levels) == levels_wanted
    assert all(len(level.screen.cell) > 2 for level in state.levels[:2])
    stepping.advance(state, 46 if levels_wanted == 2 else 40)
    assert all(np.abs(level.interface.push).min() > 1e-4 for level in state.levels[:-1])
    assert all(np.abs(level.interface.lack).min() > 1e-4 for level in state.levels[:-1])
    return state


@pytest.mark.parametrize(("levels_wanted", "length_mm", "reach_mm"), [(2, 4.0, 0.3), (3, 8.0, 2.3)])
def test_levels_exchange_on_a_gpu_as_on_a_processor(
    levels_wanted: int, length_mm: float, reach_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warm.flow()
    state = nested(levels_wanted, length_mm, reach_mm, monkeypatch)
    exchanges = exchange.take, exchange.add_crossed, exchange.jumps, exchange.answer, exchange.carry
    assert [len(kernel.signatures) for kernel in exchanges] == 5 * [1]  # all have been compiled ahead
    simulate(NESTED, tmp_path, state)
    stepping.advance(state, 2)
    if levels_wanted == 2:
        stepping.step(state)
        stepping.advance(state, 2)
    agree(tmp_path, pack(state))


def test_a_gpu_goes_on_while_the_host_judges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain, "MIN_CELLS", 30)
    simulate(AHEAD, tmp_path, everything())


def test_the_next_flow_of_a_vessel_has_the_numbering_of_the_first() -> None:
    from vstent.flow.lattice.gpu_tables import layout_of

    vessel = tube(line(8.0), 2.0).vessel
    bare = vessel_case(vessel, FlowSettings(inflow_mL_s=0.3))
    stented = vessel_case(vessel, FlowSettings(inflow_mL_s=0.5, outlets="murray"), media=(screen(),))
    first, second = (LatticeBoltzmann(CELL_MM).init(case, None) for case in (bare, stented))
    assert second.refill.groups is first.refill.groups
    assert second.bands is first.bands
    shared = layout_of(first)
    assert layout_of(second) is shared
    alone = layout_of(pickle.loads(pickle.dumps(second)))
    assert alone is not shared
    found, wanted = (vars(layout) | layout.tables for layout in (alone, shared))
    assert found.keys() == wanted.keys()
    for name in found.keys() - {"tables"}:
        np.testing.assert_array_equal(found[name], wanted[name], err_msg=str(name))


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 100])
@pytest.mark.parametrize("first_pair", [0, 1, 7, 8, 13])
def test_sequences_make_every_pair_once_and_end_at_home(first_pair: int, count: int) -> None:
    made: list[tuple[Pairs, int]] = []
    for pairs, number in plan(first_pair, count):
        assert (pairs, number) in SEQUENCES
        made += [(Pairs.PLAIN, k) for k in range(8)] if pairs is Pairs.ROUND else [(pairs, number)]
    assert [number for _, number in made] == [pair % 8 for pair in range(first_pair, first_pair + count)]
    assert [pairs for pairs, _ in made] == [*(count - 1) * [Pairs.PLAIN], Pairs.LAST]


class Driver:
    """Substitute for the recording functions of CUDA's driver. It counts calls and fails in the one it is given."""

    CUstream = staticmethod(int)

    class CUstreamCaptureMode:
        CU_STREAM_CAPTURE_MODE_RELAXED = 2

    def __init__(self, failing: str = "") -> None:
        self.failing, self.calls = failing, []

    def __getattr__(self, name: str) -> object:
        def call(*arguments: object) -> tuple[object, ...]:
            self.calls.append((name, *arguments))
            values = {"cuStreamEndCapture": ("graph",), "cuGraphInstantiate": ("program",)}.get(name, ())
            return 901 if name == self.failing else 0, *values

        return call


def record(driver: Driver, monkeypatch: pytest.MonkeyPatch, launches: Callable[[], None]) -> Callable[[], None]:
    module = types.ModuleType("cuda.bindings")
    module.driver = driver
    monkeypatch.setitem(sys.modules, "cuda", types.ModuleType("cuda"))
    monkeypatch.setitem(sys.modules, "cuda.bindings", module)
    return recorded(launches, types.SimpleNamespace(handle=7))


def test_launches_are_recorded_once_and_replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver()
    replay = record(driver, monkeypatch, lambda: driver.calls.append("kernels"))
    names = [call if isinstance(call, str) else call[0] for call in driver.calls]
    assert names == ["cuStreamBeginCapture", "kernels", "cuStreamEndCapture", "cuGraphInstantiate", "cuGraphDestroy"]
    del driver.calls[:]
    for _ in range(2):
        replay()
    assert driver.calls == 2 * [("cuGraphLaunch", "program", 7)]
    del replay
    assert driver.calls[-1] == ("cuGraphExecDestroy", "program")


@pytest.mark.parametrize("failing", ["cuStreamBeginCapture", "cuStreamEndCapture", "cuGraphInstantiate", "kernels"])
def test_a_driver_that_does_not_record_is_no_error_of_the_run(failing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(failing)

    def launches() -> None:
        if failing == "kernels":
            raise RuntimeError("not permitted while a stream is recorded")

    with pytest.raises(NotRecordedError):
        record(driver, monkeypatch, launches)
    begun, ended = (
        any(call[0] == name for call in driver.calls) for name in ("cuStreamBeginCapture", "cuStreamEndCapture")
    )
    assert begun
    assert ended == (failing != "cuStreamBeginCapture")


def benchmark(*words: str, **environment: str) -> str:
    script = Path(__file__).parents[3] / "benchmarks" / "gpu.py"
    command = [sys.executable, "-W", "error", str(script), *words]
    ran = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.system
def test_the_benchmark_runs_through_on_the_simulator() -> None:
    said = benchmark("--tiny", NUMBA_ENABLE_CUDASIM="1")
    for part in ("| even_step |", "| drive |", "launched one by one", "whole flows", "bytes per cell", "Measured in"):
        assert part in said
    goals = said[said.index("| goal") :]
    assert "| two runs, bit for bit | same | same | yes |" in goals
    assert re.search(r"against the processor \| 0\.001 \| \d\.\de-\d\d \| yes \|", goals)
    assert goals.count("not measured") == 5


def test_a_part_of_the_benchmark_that_fails_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    script = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks" / "gpu.py"))

    def fails() -> float:
        raise RuntimeError("CUDA_ERROR_LAUNCH_FAILED\nand more")

    assert script["part"]("whole flows", fails, 7.0) == 7.0
    assert "Failed: whole flows: RuntimeError: CUDA_ERROR_LAUNCH_FAILED\n" in capsys.readouterr().out
    script["goals"](script["Found"]())
    assert capsys.readouterr().out.count("not measured") == 7


@pytest.mark.skipif(gpus.gpu_name() != "none", reason="there is a GPU, so it measures")
def test_the_benchmark_says_why_it_measures_nothing() -> None:
    assert benchmark("--tiny").startswith("Not measured: the flow cannot be computed on a GPU, because")


ASKED = FlowSettings(numerics=Numerics(cell_size_mm=0.2, device_gpu=True))


def case_of(settings: FlowSettings = ASKED) -> FlowCase:
    return vessel_case(tube(line(8.0), 2.0).vessel, settings)


@pytest.mark.parametrize(
    ("is_installed", "complaint", "said"),
    [
        (False, None, "numba-cuda is not installed: run pip install 'vstent[gpu]'"),
        (True, "CUDA_ERROR_NO_DEVICE", "no NVIDIA GPU with its driver was found: check the list of nvidia-smi"),
        (True, None, "CUDA's compiler is not installed: run pip install 'numba-cuda[cu12]'"),
    ],
)
def test_what_a_gpu_lacks_is_said_with_what_to_do(
    is_installed: bool, complaint: str | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from numba import cuda

    monkeypatch.setattr(gpus, "find_spec", lambda name: object() if is_installed else None)
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    monkeypatch.setattr(cuda, "cuda_error", lambda: complaint)
    for compute in (foretell_cost, simulate_case):
        with pytest.raises(FlowError) as refusal:
            compute(case_of())
        assert said in str(refusal.value)
        assert str(refusal.value).endswith("or compute on the processor (without --gpu)")


def test_the_command_line_says_so_before_it_reads_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gpus, "find_spec", lambda name: None)
    (tmp_path / "a.stl").touch()
    for command in ("run", "flow", "batch"):
        assert main([command, str(tmp_path), "--out", str(tmp_path / "out"), "--gpu"]) == 1
        assert "numba-cuda is not installed" in " ".join(capsys.readouterr().err.split())


def test_an_engine_that_knows_no_gpu_is_not_asked_to_use_one() -> None:
    with pytest.raises(InputError, match="the engine openfoam does not support a GPU"):
        engine_class(Numerics(engine="openfoam", device_gpu=True), is_pulsatile=False)


def test_what_a_gpu_refuses_is_a_sentence() -> None:
    with pytest.raises(FlowError, match=r"failed to compute the flow \(CUDA_ERROR_OUT_OF_MEMORY\): check") as refusal:
        with gpus.told():
            raise RuntimeError("CUDA_ERROR_OUT_OF_MEMORY\nand more")
    assert isinstance(refusal.value.__cause__, RuntimeError)


def test_what_the_compiler_refuses_is_not_blamed_on_the_gpu() -> None:
    with pytest.raises(FlowError, match=r"failed to compile the flow for the GPU \(module 'numpy' has no attribute"):
        with gpus.told():
            np.row_stack_of_another_version  # noqa: B018 as numba-cuda 0.30.4 does beside numpy 2.5


def test_what_does_not_fit_in_the_gpus_memory_is_refused_with_the_cell_size_that_does() -> None:
    on_cpu = replace(case_of(), numerics=replace(ASKED.numerics, device_gpu=False))
    gpu_bytes = 0.5 * GPU_BYTES_PER_CELL * estimate(on_cpu).cells
    with pytest.raises(FlowError, match="GB of the GPU's memory are free: use a grid spacing of") as refusal:
        refuse_too_large(case_of(), 1e12, gpu_bytes)
    fitting_mm = float(str(refusal.value).split("use a grid spacing of ")[1].split(" mm")[0])
    assert 0.2 * 2 ** (1 / 3) <= fitting_mm < 0.2 * 2 ** (1 / 3) * 1.08
    refuse_too_large(case_of(), 1e12, 2.1 * gpu_bytes)


def test_a_record_keeps_that_a_run_was_on_a_gpu_and_on_which(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as on_gpu:
        on_gpu.setattr(repeat, "gpu_name", lambda: "A100")
        told = provenance(Path("a.stl"), "0", Settings(flow=ASKED))
    assert told["machine"]["gpu"] == "A100"
    again = repeat.settings_of(json.loads(json.dumps(told["settings"])))
    assert again.flow is not None
    assert again.flow.numerics.device_gpu
    monkeypatch.setattr(gpus, "find_spec", lambda name: None)
    assert "gpu (machine): A100 before, none now" in repeat.differences(told, again)
    assert "gpu" not in provenance(Path("a.stl"), "0", Settings())["machine"]
