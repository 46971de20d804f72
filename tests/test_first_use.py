"""What the first use has to compile: it is said once, and what was compiled can be kept anywhere."""

import os
import subprocess
import sys

import pytest
from numba import njit

from vstent import kernels
from vstent.kernels import first_use, warm
from vstent.kernels.first_use import telling


def test_the_first_compilation_is_told_once_and_a_kept_kernel_is_not():
    @njit
    def double(x):
        return 2 * x

    said = []
    with telling(lambda: said.append("compiling")):
        double(1)
        double(1.0)
        assert said == ["compiling"]
    with telling(lambda: said.append("again")):
        double(3)
    assert said == ["compiling"]


def test_a_helper_begins_with_the_first_compilation_and_ends_with_the_work(monkeypatch):
    @njit
    def half(x):
        return x / 2

    monkeypatch.setattr(first_use, "HELP", (sys.executable, "-c", "import time; time.sleep(60)"))
    started, begin = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(begin(*a, **k)) or started[-1])
    with telling(lambda: None, helped=True):
        assert started == []
        half(1)
        half(1.0)
        assert [helper.poll() for helper in started] == [None]
    assert started[0].poll() is not None


def test_the_set_up_compiles_every_kernel_of_a_deployment():
    from tubes import line, tube
    from vstent import device
    from vstent.deploy import deploy
    from vstent.measure import measure
    from vstent.stent import Landing

    warm.warm()
    said = []
    artery = tube(line(30), 1.9, around=40)
    with telling(lambda: said.append("compiling")):
        design = device.find_design("silk")
        measure(artery, deploy(design, artery, size=device.find_size(design, diameter_mm=4), landing=Landing(15.0)))
    assert said == []


def test_the_set_up_compiles_what_takes_a_flows_time_so_that_all_processes_run_the_same_code():
    from vstent import phantoms
    from vstent.flow import FlowCase, FlowSettings, simulate_case
    from vstent.kernels import lattice
    from vstent.trace import trace
    from vstent.vessel import Vessel

    warm.warm()
    (ready,) = lattice.update.signatures
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=10.0, radius_mm=2.0), edge_mm=0.5)))
    simulate_case(FlowCase(vessel, settings=FlowSettings(inflow_mL_s=1.0, cell_size_mm=0.4, max_steps=10)))
    assert lattice.update.signatures == [ready]


@pytest.mark.parametrize(("writable", "is_moved"), [(True, False), (False, True)])
def test_where_no_cache_can_be_written_kernels_are_kept_with_temporary_files(monkeypatch, writable, is_moved):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, mode: writable)
    kernels._keep_compiled()
    assert ("NUMBA_CACHE_DIR" in os.environ) == is_moved
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
