"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

# As the command line has it, and before any test imports numpy: threads of the linear algebra only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Threads of the compiled kernels sleep while they wait: beside other test processes, and on small grids, they would spin
# for half of the time.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@pytest.fixture(scope="session", autouse=True)
def threads_of_kernels() -> None:
    """Let the kernels run on one thread where other test processes use the other cores."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        import numba

        numba.set_num_threads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real cases beside the checkout (never part of the repository)."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real cases (../shared/data) are not on this machine")
    return folder
