"""How quick the page is, through its real HTTP interface: first page, dragging a handle, letting go, bytes sent.

    python benchmarks/app.py [SURFACE OR SCAN] [--device silk] [--sketches 60]

Without a file it takes a phantom. The goals: a first page under 3 s, 10 redraws a second, numbers within 1 s, 8 MB.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vstent import phantoms
from vstent.io.writers import write_stl

FILES = ("viewer.js", "app.js", "app.css", "viewer.css")
"""What the browser loads for the page."""
START = "import sys; from vstent.cli import main; sys.exit(main(sys.argv[1:]))"


class Client:
    """Asks the server with the token."""

    def __init__(self, url: str) -> None:
        self.host = urlsplit(url).netloc
        self.connection = HTTPConnection(self.host, timeout=600)
        self.headers = {"authorization": f"Bearer {url.partition('token=')[2]}", "content-type": "application/json"}

    def ask(self, method: str, path: str, body: Any = None) -> bytes:
        content = None if body is None else json.dumps(body)
        self.connection.request(method, path, content, self.headers)
        answer = self.connection.getresponse()
        data = answer.read()
        if answer.status >= 400:
            raise SystemExit(f"{method} {path}: {answer.status} {data.decode(errors='replace')}")
        return data

    def get(self, path: str) -> Any:
        return json.loads(self.ask("GET", path))


def manifest(message: bytes) -> dict[str, Any]:
    length = int.from_bytes(message[:4], "little")
    found: dict[str, Any] = json.loads(message[4 : 4 + length])
    return found


def phantom(folder: Path) -> Path:
    path = folder / "phantom.stl"
    write_stl(path, phantoms.phantom_surface(phantoms.demo_phantom(), edge_mm=0.35))
    return path


def start(path: Path, folder: Path) -> tuple[subprocess.Popen[str], Client, float]:
    """Start the server; return it, who asks it, and the time until the page was there."""
    began = time.perf_counter()
    command = [sys.executable, "-c", START, "app", str(path), "--no-browser", "--cases", str(folder / "cases")]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    client = Client(server.stdout.readline().split()[-1])
    client.ask("GET", "/")
    for file in FILES:
        client.ask("GET", f"/assets/{file}")
    return server, client, time.perf_counter() - began


def wait(client: Client, case: str) -> None:
    while not client.get(case)["has_anatomy"] or client.get(case)["job"] is not None:
        time.sleep(0.25)


def alone(device: str, **given: Any) -> dict[str, Any]:
    """Return what is asked of a treatment of one device."""
    treatment = {"name": device, "implants": [{"id": device, "device": device, **given}]}
    return {"treatment": treatment, "implant": device}


def drag(client: Client, case: str, device: str, count: int) -> tuple[list[float], list[int]]:
    """Slide the device to and fro; return seconds and bytes of every redraw."""
    seconds, sizes = [], []
    middle = center_mm(client, case, alone(device))
    for i in range(count):
        wanted = {**alone(device), "abscissa_mm": middle + 1.5 * (i % 20 - 10) / 10}
        began = time.perf_counter()
        message = client.ask("POST", f"{case}/sketch", wanted)
        seconds.append(time.perf_counter() - began)
        sizes.append(len(message))
    return seconds, sizes


def let_go(client: Client, case: str, name: str, count: int) -> list[float]:
    """Choose other places; return the seconds until the full numbers are there."""
    seconds = []
    for i in range(count):
        view = client.get(case)
        before = next(one for one in view["choices"]["treatments"] if one["name"] == name)
        now_mm = center_mm(client, case, {"treatment": before, "implant": name})
        chosen = alone(name, placing={"position_mm": now_mm + (0.1 if i % 8 < 4 else -0.13)})
        treatments = [chosen["treatment"] if one is before else one for one in view["choices"]["treatments"]]
        began = time.perf_counter()
        change = {"revision": view["revision"], "choices": {**view["choices"], "treatments": treatments}}
        client.ask("PUT", f"{case}/choices", change)
        found = manifest(client.ask("POST", f"{case}/deployment", chosen))
        assert found["measures"][0]["rows"]
        seconds.append(time.perf_counter() - began)
    return seconds


def pull(client: Client, case: str, count: int) -> list[float]:
    """Pull a point of the neck to and fro; return seconds of every redraw."""
    curve = manifest(client.ask("GET", f"{case}/anatomy"))["drawn"]["curve_mm"]
    seconds = []
    for i in range(count):
        to_mm = [x + 0.05 * (i % 10 - 5) for x in curve[0]]
        began = time.perf_counter()
        client.ask("POST", f"{case}/neck", {"curve_mm": curve, "handle": 0, "to_mm": to_mm})
        seconds.append(time.perf_counter() - began)
    return seconds


def center_mm(client: Client, case: str, wanted: dict[str, Any]) -> float:
    return float(manifest(client.ask("POST", f"{case}/sketch", wanted))["center_mm"])


def processor_s(pid: int) -> float:
    """Seconds of processor that the server and its finished jobs have used; other systems than Linux do not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return math.nan
    return sum(int(field) for field in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def said(title: str, seconds: list[float], used_s: float) -> None:
    """Print how long answers took, and what one cost the server on the mean."""
    high = statistics.quantiles(seconds, n=20)[-1]
    wall = f"median {1e3 * statistics.median(seconds):6.0f} ms, 95 % {1e3 * high:6.0f} ms"
    print(f"{title:44} {wall}, processor {1e3 * used_s / len(seconds):6.0f} ms")


def spent(title: str, began: float, used_s: float) -> None:
    print(f"{title:44} {time.perf_counter() - began:6.2f} s, processor {used_s:6.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path, nargs="?")
    parser.add_argument("--device", default="silk")
    parser.add_argument("--sketches", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        server, client, first = start((arguments.path or phantom(folder)).resolve(), folder)
        try:
            print(f"{'first page after the command':44} {first:6.2f} s, processor {processor_s(server.pid):6.2f} s")
            case = f"/api/cases/{client.get('/api/cases')['opened']}"
            began = time.perf_counter()
            wait(client, case)
            spent("vessel, sac and parent artery", began, processor_s(server.pid))
            client.ask("POST", f"{case}/jobs/rank")
            wait(client, case)
            spent("from the file to the ranked list", began, processor_s(server.pid))
            drag(client, case, arguments.device, 3)  # the wall is measured once, kernels are loaded
            used = processor_s(server.pid)
            seconds, sizes = drag(client, case, arguments.device, arguments.sketches)
            said(f"a redraw of {arguments.device} while dragged", seconds, processor_s(server.pid) - used)
            let_go(client, case, arguments.device, 1)
            used = processor_s(server.pid)
            seconds = let_go(client, case, arguments.device, 8)
            said("deployed, with all numbers, after letting go", seconds, processor_s(server.pid) - used)
            used = processor_s(server.pid)
            seconds = pull(client, case, arguments.sketches)
            said("a point of the neck while pulled", seconds, processor_s(server.pid) - used)
            deployed = client.ask("POST", f"{case}/deployment", alone(arguments.device))
            scene = [client.ask("GET", f"{case}/anatomy"), deployed]
            page = sum(len(client.ask("GET", f"/assets/{file}")) for file in FILES)
            print(f"{'a redraw':44} {statistics.median(sizes) / 1e6:6.2f} MB")
            print(f"{'page, anatomy and a deployed device':44} {(page + sum(map(len, scene))) / 1e6:6.2f} MB")
        finally:
            server.terminate()
            server.wait(20)


if __name__ == "__main__":
    main()
