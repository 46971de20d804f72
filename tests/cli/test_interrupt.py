"""Ctrl-C at the command line: where it is answered, and where it waits."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from vstent.cli import devices, main


@pytest.fixture(autouse=True)
def _answered() -> Iterator[None]:
    """Have Ctrl-C answered as Python does it: in a job that a script has put into the background it is ignored."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


def _interrupted(package: str, done: list[str]) -> Callable[[object], int]:
    """A command that calls code of `package`, within which Ctrl-C comes, and then goes on."""
    code = (
        "def inner():\n"
        "    signal.raise_signal(signal.SIGINT); end = time.monotonic() + 0.2\n"
        "    while time.monotonic() < end: pass\n"
        "    done.append('inner')\n"
    )
    there: dict[str, Any] = {"__name__": package, "signal": signal, "time": time, "done": done}
    exec(code, there)

    def command(arguments: object) -> int:
        there["inner"]()
        end = time.monotonic() + 5.0
        while time.monotonic() < end:  # the interrupt comes back, and ends this
            time.sleep(0.01)
        done.append("outer")
        return 0

    return command


@pytest.mark.parametrize(
    ("package", "expected"),
    [
        ("numba.core.dispatcher", ["inner"]),
        ("llvmlite.binding", ["inner"]),
        ("vtkmodules.util", ["inner"]),
        ("importlib._bootstrap", ["inner"]),
        ("numba.cuda.cudadrv.driver", []),
        ("numbat", []),
        ("vstent.anatomy.trace", []),
    ],
)
def test_ctrl_c_waits_for_code_that_cannot_bear_it(
    package: str, expected: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(devices, "_devices", _interrupted(package, done))
    assert main(["devices"]) == 130
    assert "stopped" in capsys.readouterr().err
    assert done == expected
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_is_over_is_not_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(arguments: object) -> int:
        there: dict[str, Any] = {"__name__": "numba", "signal": signal}
        exec("signal.raise_signal(signal.SIGINT)", there)
        return 0

    monkeypatch.setattr(devices, "_devices", late)
    assert main(["devices"]) == 0
    time.sleep(0.2)


def test_who_ignores_ctrl_c_goes_on_ignoring_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_devices", lambda arguments: signal.raise_signal(signal.SIGINT) or 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    assert main(["devices"]) == 0
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_off_the_main_thread_no_handler_is_set() -> None:
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(main(["devices"])))
    thread.start()
    thread.join()
    assert codes == [0]
