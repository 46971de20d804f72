"""Reading in the process of the test, which is ten times faster than in a child; test_apart.py tests the child."""

from contextlib import contextmanager

import pytest

from vstent.io.child import READERS


@contextmanager
def read_here(what, path, options, files):
    yield READERS[what](path, options)


@pytest.fixture(autouse=True)
def here(request, monkeypatch):
    if request.path.name != "test_apart.py":
        for module in ("images", "surfaces"):
            monkeypatch.setattr(f"vstent.io.{module}.read_apart", read_here)
