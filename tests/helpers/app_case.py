"""A real server for the tests of the page, on a port of its own, and a client that is let in."""

import json
import socket
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import httpx
import numpy as np
import uvicorn

from vstent import phantoms
from vstent.app.cases import Cases
from vstent.app.server import create
from vstent.app.workspace import Workspace

TOKEN = "the-token-of-the-tests"


@contextmanager
def served(workspace, path=None):
    """A client that is let in; the server ends with the block."""
    listener = socket.create_server(("127.0.0.1", 0))
    host = f"127.0.0.1:{listener.getsockname()[1]}"
    work = Workspace(Cases(workspace))
    if path is not None:
        work.open(path)
    guard = create(work, token=TOKEN, hosts=(host,))
    server = uvicorn.Server(uvicorn.Config(guard, log_level="error", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        headers = {"authorization": f"Bearer {TOKEN}"}
        with httpx.Client(base_url=f"http://{host}", headers=headers, timeout=60) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()


@cache
def phantom_surface():
    return phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.5)


@cache
def two_sacs_surface():
    """The demo with a smaller sac further downstream."""
    demo = phantoms.demo_phantom()
    second = phantoms.with_sac(demo, abscissa_mm=40.0, width_mm=5.0, neck_mm=3.5).sac
    return phantoms.phantom_surface(replace(demo, blebs=(second,)), edge_mm=0.35)


def wait(client, case, seconds=300):
    """Wait until nothing is at work on a case; return how it stands."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        view = client.get(f"/api/cases/{case}").json()
        if view["job"] is None:
            return view
        time.sleep(0.1)
    raise AssertionError(f"still at work after {seconds} s: {view['job']}")


def until(is_so, seconds=60):
    """Wait until it is so."""
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, f"not so after {seconds} s"
        time.sleep(0.02)


def opened(answer):
    """Manifest and bytes of a binary answer."""
    data = answer.content
    length = int.from_bytes(data[:4], "little")
    return json.loads(data[4 : 4 + length]), data[4 + length :]


def numbers(block, data):
    """The numbers of a quantised block, (n, components)."""
    raw = np.frombuffer(data, dtype=f"<{block['type']}".replace("u8", "u1").replace("u16", "u2").replace("u32", "u4"),
                        count=block["length"], offset=block["offset"])  # fmt: skip
    low, step = np.array(block["low"]), np.array(block["step"])
    return low + step * raw.reshape(-1, len(low))
