"""`vstent app`: serve the page in the browser."""

import argparse
import importlib.util
import secrets
import socket
import webbrowser
from pathlib import Path
from typing import Final

from vstent.cli import options

LAST_PORT: Final = 65535
"""Largest port number."""


def add(commands: options.Commands) -> None:
    """Add the command."""
    parser = options.add_command(commands, "app", "Plan a stent on a page in the browser.", "app scan/")
    text = "scan, surface or case folder (default: drop one on the page)"
    parser.add_argument("input", type=Path, nargs="?", help=text)
    text = "folder of the cases (default: vstent-cases)"
    parser.add_argument("--cases", type=Path, default=Path("vstent-cases"), metavar="DIR", help=text)
    text = "address of the server (default: 127.0.0.1, this machine only)"
    parser.add_argument("--host", default="127.0.0.1", help=text)
    parser.add_argument("--port", type=_port, default=0, help="port of the server (default: a free one)")
    options.add_flag(parser, "no-browser", "print the address of the page without opening it")
    parser.set_defaults(command=_app)


def _port(text: str) -> int:
    """Return a port number read from text."""
    if not text.isdecimal() or int(text) > LAST_PORT:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port: give 0 to {LAST_PORT}")
    return int(text)


def _app(arguments: argparse.Namespace) -> int:
    """Serve the page until it is interrupted; return the exit code."""
    from vstent.errors import InputError

    if importlib.util.find_spec("fastapi") is None or importlib.util.find_spec("uvicorn") is None:
        raise InputError("The page needs two more packages: run `pip install 'vstent[app]'`, then try again.")
    import uvicorn

    from vstent.app.cases import Cases
    from vstent.app.server import create
    from vstent.app.workspace import Workspace

    workspace = Workspace(Cases(arguments.cases.resolve()))
    if arguments.input is not None:
        workspace.open(arguments.input.resolve())
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind((arguments.host, arguments.port))
    listener.listen(128)  # it listens already, so that the printed address answers at once
    port = listener.getsockname()[1]
    token = secrets.token_urlsafe(24)
    hosts = tuple(dict.fromkeys(f"{name}:{port}" for name in (arguments.host, "127.0.0.1", "localhost")))
    guard = create(workspace, token=token, hosts=hosts)
    url = f"http://{arguments.host}:{port}/?token={token}"
    config = uvicorn.Config(guard, log_level="warning", timeout_graceful_shutdown=1, access_log=False)
    print(f"vstent is at  {url}\nStop it with Ctrl-C. Research use only.", flush=True)
    if not arguments.no_browser:
        webbrowser.open(url)
    uvicorn.Server(config).run(sockets=[listener])
    return 0
