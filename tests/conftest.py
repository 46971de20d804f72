"""Fixtures shared by all tests."""

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

# As the command line has it, and before any test imports numpy: threads of the linear algebra only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Threads of the compiled kernels sleep while they wait: beside other test processes they would spin half of the time.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@pytest.fixture(scope="session", autouse=True)
def threads_of_kernels() -> None:
    """Let the kernels run on one thread where other test processes use the other cores."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        import numba

        numba.set_num_threads(1)


READS_APART = {"io", "app", "test_children.py", "test_faults.py", "test_fuzz.py"}
"""Folders and files of tests in which the child process that reads files is a part of what is tested."""


@pytest.fixture(scope="module", autouse=True)
def reading(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let the other tests read files in their own process: starting the child takes longer than most of them."""
    if request.path.relative_to(Path(__file__).parent).parts[0] in READS_APART:
        yield
        return
    from vstent.io import apart, child

    def read(command: Sequence[str], **_: object) -> SimpleNamespace:
        what, path, options, folder, limits = command[3:]
        child.main(what, Path(path), json.loads(options), Path(folder), json.loads(limits))
        return SimpleNamespace(returncode=0, stderr=b"")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child, "limit", lambda **_: False)
        patch.setattr(apart, "subprocess", SimpleNamespace(**{**vars(subprocess), "run": read}))
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real cases beside the checkout (never part of the repository)."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real cases (../shared/data) are not on this machine")
    return folder
