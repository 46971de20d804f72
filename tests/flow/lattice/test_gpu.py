"""The flow on a GPU: on numba's simulator, where there is none, as on the processor; and refused in words."""

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tubes import line, tube

from vstent.cli import main
from vstent.errors import FlowError, InputError
from vstent.flow import domain
from vstent.flow.case import Blood, CarreauYasuda, FlowCase, FlowSettings, Screen, Waveform
from vstent.flow.lattice import gpu as gpus
from vstent.flow.lattice import state as lattice_state
from vstent.flow.lattice import stepping
from vstent.flow.lattice.checkpoint import pack
from vstent.flow.lattice.cost import GPU_BYTES_PER_CELL, estimate, refuse_too_large
from vstent.flow.lattice.kernels import d3q19
from vstent.flow.lattice.pulse import PulsatileLatticeBoltzmann
from vstent.flow.lattice.setup import build_bands
from vstent.flow.simulation import engine_class, foretell_cost, simulate_case
from vstent.study import repeat
from vstent.study.provenance import machine, provenance
from vstent.study.types import Settings

CELL_MM, RADIUS_MM, LENGTH_MM = 0.4, 0.8, 2.4
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
from vstent.flow.lattice.stepping import _read_here, advance, step

state = pickle.loads(Path(sys.argv[1]).read_bytes())
assert "vstent.flow.lattice.kernels.gpu" not in sys.modules  # who did not ask for a GPU does not load what it takes
state.case = replace(state.case, settings=replace(state.case.settings, device_gpu=True))
step(state)
saved = pack(state)
assert state.device is None  # the next steps are longer: what is there was fetched
advance(state, 0)
saved_again = pack(state)
np.testing.assert_array_equal(state.device.read()[0], _read_here(state)[0])
for name in saved:
    np.testing.assert_array_equal(saved_again[name], saved[name])
np.savez(sys.argv[2], **saved)
"""


def screen() -> Screen:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-1.0, 1.0, 0.1), np.arange(-1.0, 1.0, 0.1)))
    n = len(x)
    points, normals = np.stack([x, y, np.full(n, 0.5 * LENGTH_MM)], axis=1), np.tile([0.0, 0.6, 0.8], (n, 1))
    one = np.ones(n)
    return Screen(points, normals, 0.01 * one, 300 * one, 150 * one, 0.5 * one, one, one)


def everything() -> lattice_state.State:
    """A run with all that kernels know: pulse, moments, screen, thinning, thickened blood, each kind of opening, septa.

    The outlet's links are shared by a pressure and an outflow; populations are swapped at places of no meaning.
    """
    settings = FlowSettings(
        inflow_mL_s=0.3,
        cell_size_mm=CELL_MM,
        blood=Blood(viscosity_Pa_s=0.00345, thinning=CarreauYasuda()),
        waveform=Waveform(0.05, (0.5,), (0.2,)),
        lattice_speed=0.05,
    )
    vessel = tube(line(LENGTH_MM), RADIUS_MM, around=32).vessel
    case = FlowCase(vessel, screen=screen(), settings=settings)
    state = PulsatileLatticeBoltzmann(CELL_MM).init(case, None)
    links, a = state.links, state.addressing
    openings = links.openings[[0, 1, 1]]
    openings[2, :2], openings[1:, 7] = (d3q19.OUTFLOW, -0.5 * openings[0, 1]), 0.5 * openings[1, 7]
    start = np.array([*links.start[:2], links.start[1:].mean(), links.start[2]], np.int32)
    swing = np.array([1.0, 0.8, 1.2])  # what a close-up imposes in the course of a cycle
    wanted = openings[:, 1].copy()
    course = 0.1 * swing[:, None] * np.abs(wanted).max() * [1.0, 0.0, 1.0]
    shape = swing[:, None, None] * links.shape
    state.links = replace(links, openings=openings, start=start, wanted=wanted, course=course, shape=shape)
    somewhere = np.arange(0, len(a.place), 40)
    septa = np.stack([3 * a.stride + a.place[somewhere], 4 * a.stride + a.place[somewhere]])
    state.addressing = replace(a, septa=septa, septum_cell=somewhere)
    state.bands = build_bands(state.domain, state.addressing, state.links)
    state.limit[::2] = 1.0
    state.pace = np.array([2 * SETTLED_PAIRS + 4, 2 * SETTLED_PAIRS + 2])
    state.check_s = state.scales.step_s * int(state.pace[0])
    state.built = state.links, state.screen
    return state


def test_a_gpu_makes_the_steps_that_a_processor_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain, "MIN_CELLS", 50)
    state = everything()
    stepping.advance(state, 2 * SETTLED_PAIRS)
    (tmp_path / "state").write_bytes(pickle.dumps(state))
    simulated = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-W", "error", "-c", ON_GPU, str(tmp_path / "state"), str(tmp_path / "found.npz")]
    ran = subprocess.run(command, env=simulated, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    stepping.step(state)
    wanted = pack(state)
    with np.load(tmp_path / "found.npz") as archive:
        found = dict(archive)
    assert found["steps"] == wanted["steps"] == state.pace[0]
    for saved in (found, wanted):  # an opening's columns are of different sizes
        saved |= {f"opening's {k}": column for k, column in enumerate(saved.pop("openings").T)}
    for name in wanted.keys() - {"loop_seconds"}:
        most = np.abs(wanted[name]).max(initial=0.0)
        np.testing.assert_allclose(found[name], wanted[name], rtol=0, atol=ROUNDING * most, err_msg=name)


ASKED = FlowSettings(cell_size_mm=0.2, device_gpu=True)


def case_of(settings: FlowSettings = ASKED) -> FlowCase:
    return FlowCase(tube(line(8.0), 2.0).vessel, settings=settings)


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
    for command in ("run", "flow", "batch"):
        assert main([command, str(tmp_path), "--out", str(tmp_path / "out"), "--gpu"]) == 1
        assert "numba-cuda is not installed" in " ".join(capsys.readouterr().err.split())


def test_an_engine_that_knows_no_gpu_is_not_asked_to_use_one() -> None:
    with pytest.raises(InputError, match="the engine openfoam does not support a GPU"):
        engine_class(replace(ASKED, engine="openfoam"))


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
    gpu_bytes = 0.5 * GPU_BYTES_PER_CELL * estimate(replace(case_of(), settings=replace(ASKED, device_gpu=False))).cells
    with pytest.raises(FlowError, match="GB of the GPU's memory are free: use a grid spacing of") as refusal:
        refuse_too_large(case_of(), 1e12, gpu_bytes)
    fitting_mm = float(str(refusal.value).split("use a grid spacing of ")[1].split(" mm")[0])
    assert 0.2 * 2 ** (1 / 3) <= fitting_mm < 0.2 * 2 ** (1 / 3) * 1.08
    refuse_too_large(case_of(), 1e12, 2.1 * gpu_bytes)


def test_a_record_keeps_that_a_run_was_on_a_gpu_and_on_which(monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["vstent.study.provenance"]  # its function goes by the same name
    with monkeypatch.context() as on_gpu:
        on_gpu.setattr(module, "gpu_name", lambda: "A100")
        told = provenance(Path("a.stl"), "0", Settings(flow=ASKED))
    assert told["machine"]["gpu"] == "A100"
    again = repeat.settings_of(json.loads(json.dumps(told["settings"])))
    assert again.flow is not None
    assert again.flow.device_gpu
    monkeypatch.setattr(gpus, "find_spec", lambda name: None)
    assert "gpu (machine): A100 before, none now" in repeat._differences(told, again)
    assert "gpu" not in machine(Settings())
