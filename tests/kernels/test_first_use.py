"""What the first use has to compile: it is said once, and what was compiled can be kept anywhere."""

import importlib
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from numba import njit

from vstent.cli import warm
from vstent.flow.problem import vessel_case
from vstent.flow.settings import Numerics
from vstent.kernels import cache
from vstent.kernels.first_use import ensure_cached, reporting_compilation


def test_the_first_compilation_is_told_once_and_a_kept_kernel_is_not():
    @njit
    def double(x):
        return 2 * x

    said = []
    with reporting_compilation(lambda: said.append("compiling")):
        double(1)
        double(1.0)
        assert said == ["compiling"]
    with reporting_compilation(lambda: said.append("again")):
        double(3)
    assert said == ["compiling"]


def test_a_helper_begins_with_the_first_compilation_and_ends_with_the_work(monkeypatch):
    @njit
    def half(x):
        return x / 2

    helper = sys.executable, "-c", "import time; time.sleep(60)"
    started, begin = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(begin(*a, **k)) or started[-1])
    with reporting_compilation(lambda: None, helper=helper):
        assert started == []
        half(1)
        half(1.0)
        assert [helper.poll() for helper in started] == [None]
    assert started[0].poll() is not None


KERNEL = """
from numba import njit

@njit(cache=True)
def third(x):
    return x / 3
"""


def test_what_is_not_kept_another_process_compiles_and_this_one_takes_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "kernel_of_a_test.py").write_text(KERNEL)
    third = importlib.import_module("kernel_of_a_test").third

    def call():
        third(2.0)

    work = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import kernel_of_a_test as k; k.third(2.0)"
    ensure_cached(call, (sys.executable, "-c", work))
    assert third.signatures == []
    said = []
    with reporting_compilation(lambda: said.append("compiling")):
        call()
        ensure_cached(call, ("this", "is", "not", "run"))
    assert said == []
    assert sum(third.stats.cache_hits.values()) == 1


def test_while_one_thread_takes_kernels_from_the_cache_others_may_compile():
    @njit
    def quarter(x):
        return x / 4

    def other():
        thread = threading.Thread(target=quarter, args=(1.0,))
        thread.start()
        thread.join()

    ensure_cached(other, ("this", "is", "not", "run"))
    assert len(quarter.signatures) == 1


@pytest.mark.validation
def test_after_a_bare_installation_the_first_flow_has_the_bits_of_all_later_ones(tmp_path):
    work = (
        "from vstent import phantoms; from vstent.flow.problem import vessel_case;"
        "from vstent.flow.settings import FlowSettings, Numerics; from vstent.flow.simulation import simulate_case;"
        "from vstent.anatomy.trace import trace; from vstent.geometry.vessel import Vessel; import hashlib;"
        "v = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=10.0, radius_mm=2.0), edge_mm=0.5)));"
        "s = FlowSettings(inflow_mL_s=1.0, numerics=Numerics(cell_size_mm=0.4, max_steps=200));"
        "print(hashlib.sha256(simulate_case(vessel_case(v, s)).velocity_m_s.tobytes()).hexdigest())"
    )
    fresh = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "1"}
    first, second = (subprocess.run([sys.executable, "-c", work], env=fresh, capture_output=True) for _ in range(2))
    assert first.returncode == second.returncode == 0
    assert first.stdout == second.stdout


def test_the_set_up_compiles_every_kernel_of_a_deployment():
    from tubes import line, tube

    from vstent.deployment.deploy import deploy
    from vstent.deployment.measure import measure
    from vstent.devices import catalogue
    from vstent.devices.stent import Landing

    warm.warm()
    said = []
    artery = tube(line(30), 1.9, around=40)
    with reporting_compilation(lambda: said.append("compiling")):
        design = catalogue.find_design("silk")
        measure(artery, deploy(design, artery, size=catalogue.find_size(design, diameter_mm=4), landing=Landing(15.0)))
    assert said == []


def test_the_set_up_compiles_what_takes_a_flows_time_so_that_all_processes_run_the_same_code():
    from vstent import phantoms
    from vstent.anatomy.trace import trace
    from vstent.flow.lattice.kernels import d3q19
    from vstent.flow.settings import FlowSettings
    from vstent.flow.simulation import simulate_case
    from vstent.geometry.vessel import Vessel

    warm.warm()
    kernels = d3q19.update, d3q19.defer
    vessel = trace(Vessel(phantoms.phantom_surface(phantoms.tube(length_mm=10.0, radius_mm=2.0), edge_mm=0.5)))
    said = []
    with reporting_compilation(lambda: said.append("compiling")):
        simulate_case(
            vessel_case(vessel, FlowSettings(inflow_mL_s=1.0, numerics=Numerics(cell_size_mm=0.4, max_steps=10)))
        )
    assert said == []
    assert [len(kernel.signatures) for kernel in kernels] == [1, 1]  # no other layout than the set-up's, here or before


def test_a_kernel_is_compiled_anew_when_a_function_in_another_file_that_it_calls_has_changed(tmp_path):
    package = tmp_path / "kernels"
    package.mkdir()
    (package / "outer.py").write_text(
        "from inner import part\nfrom numba import njit\n\n@njit(cache=True)\ndef whole():\n    return part()\n"
    )
    call = (
        f"from vstent.kernels import cache as k; k.forget_outdated(k.Path({str(package)!r}));"
        "import outer; print(outer.whole())"
    )
    own = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    answers = []
    for value in (1, 1, 2):
        (package / "inner.py").write_text(f"from numba import njit\n\n@njit\ndef part():\n    return {value}\n")
        done = subprocess.run(
            [sys.executable, "-c", call],
            env=own | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        answers.append((int(done.stdout), len(list((package / "__pycache__").glob("*.nbc")))))
    assert answers == [(1, 1), (1, 1), (2, 1)]


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """Let no place of numba's be writable, and temporary files lie in a folder of their own."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/none")
    writable = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).is_relative_to(tmp_path) and writable(path, mode))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"vstent-{os.getuid()}"


def test_where_no_cache_can_be_written_kernels_are_kept_in_a_private_folder(nowhere):
    for _ in range(2):
        cache.choose_folder()
        assert os.environ["NUMBA_CACHE_DIR"] == str(nowhere)
        assert nowhere.stat().st_mode & 0o777 == 0o700
        os.environ["NUMBA_CACHE_DIR"] = "/proc/none"


def test_a_folder_that_can_be_written_is_kept(nowhere, monkeypatch):
    for given in (nowhere.parent / "new" / "folder", nowhere.parent):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(given))
        cache.choose_folder()
        assert os.environ["NUMBA_CACHE_DIR"] == str(given)


@pytest.mark.parametrize("trap", ["link", "open to others", "of another user", "file"])
def test_code_that_others_may_have_put_into_a_temporary_folder_is_not_run(nowhere, monkeypatch, trap):
    if trap == "link":
        (nowhere.parent / "theirs").mkdir(mode=0o700)
        nowhere.symlink_to(nowhere.parent / "theirs")
    elif trap == "file":
        nowhere.touch()
    else:
        nowhere.mkdir(mode=0o700)
        nowhere.chmod(0o770 if trap == "open to others" else 0o700)
    if trap == "of another user":
        users = iter([os.geteuid(), os.geteuid() + 1])  # for the name, and for the owner
        monkeypatch.setattr(os, "getuid", lambda: next(users))
    cache.choose_folder()
    chosen = Path(os.environ["NUMBA_CACHE_DIR"])
    assert chosen.parent == nowhere.parent
    assert chosen != nowhere
    assert chosen.stat().st_mode & 0o777 == 0o700
