"""Restrict access to the server: only this machine's browser, with the token, from the page itself."""

import hmac
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from typing import Final
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page: it runs only its own files and contacts only its own server."""
REPORT_POLICY: Final = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of a report, which contains its scripts.

The policy in the report allows only those exact scripts; this one isolates the report from the page.
"""
LOCKED_POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""Content security policy of the page that asks for the key: it has no script, and its form is sent only here."""
BODY_LIMIT: Final = 1 << 20
"""Largest size of a request other than an upload, in bytes."""
UPLOAD_LIMIT: Final = 2 << 30
"""Largest size of an upload, in bytes."""

_HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
"""Headers added to every response."""


class TooLarge(HTTPException):
    """The body of a request is larger than allowed."""

    def __init__(self) -> None:
        super().__init__(413, "Too large.")


class Guard:
    """Accepts requests only from the page itself, at accepted host names with port, with the secret token.

    It sets the headers of every response.
    """

    def __init__(self, app: ASGIApp, *, token: str, hosts: Iterable[str]) -> None:
        self.app, self.token = app, token
        self.hosts = frozenset(hosts)
        self.cookie = f"vstent-{next(iter(sorted(self.hosts))).rpartition(':')[2]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it to the application."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        is_upload = scope["method"] == "PUT" and scope["path"].endswith("/input")
        limit, length = UPLOAD_LIMIT if is_upload else BODY_LIMIT, headers.get("content-length", "")
        if refusal is None and length.isdigit() and int(length) > limit:
            refusal = PlainTextResponse(f"More than {limit >> 20} MB, which is too much.", 413)
        await (refusal or self.app)(scope, _counted(receive, limit), _with_headers(send))

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> Response | None:
        """Return the response to a request that is not allowed; None where it is allowed."""
        if headers.get("host", "") not in self.hosts:
            return PlainTextResponse("This server answers only to its own address.", 403)
        own = {f"http://{host}" for host in self.hosts}
        # A report is shown in a sandbox with the origin "null"; it needs no requests, so they are refused too.
        if headers.get("origin", next(iter(own))) not in own or headers.get("sec-fetch-site") == "cross-site":
            return PlainTextResponse("Requests from other sites are refused.", 403)
        query = parse_qs(scope["query_string"].decode("latin-1"))
        given = query.get("token", [""])[0].rpartition("token=")[2].strip()  # the key, or the whole printed address
        if scope["path"] == "/" and self._is_right(given):
            welcome = RedirectResponse("/", 303)
            welcome.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            return welcome
        if not self._is_right(_token(headers, self.cookie)):
            if scope["path"] == "/" and "text/html" in headers.get("accept", ""):
                page = files("vstent").joinpath("app", "assets", "locked.html").read_text(encoding="utf-8")
                return HTMLResponse(page, 401, {"content-security-policy": LOCKED_POLICY})
            return PlainTextResponse("Open the address that `vstent app` printed: it contains the key.", 401)
        return None

    def _is_right(self, given: str) -> bool:
        """Return whether a token is right, in constant time."""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())


def _token(headers: dict[str, str], cookie: str) -> str:
    """Return the token of a request: a bearer token, or that of the cookie."""
    kind, _, value = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return value.strip()
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(cookie)
    except CookieError:
        return ""
    return found.value if found else ""


def _counted(receive: Receive, limit: int) -> Receive:
    """Return a receiver that counts the bytes of a request, because its stated length may be missing."""
    so_far = 0

    async def counted() -> Message:
        nonlocal so_far
        message = await receive()
        so_far += len(message.get("body", b""))
        if so_far > limit:
            raise TooLarge
        return message

    return counted


def _with_headers(send: Send) -> Send:
    """Return a sender that adds the headers."""

    async def sender(message: Message) -> None:
        if message["type"] == "http.response.start":
            present = {name.lower() for name, _ in message["headers"]}
            more = [(name, value) for name, value in _HEADERS if name not in present]
            if b"content-security-policy" not in present:
                more.append((b"content-security-policy", POLICY.encode()))
            message["headers"] = [*message["headers"], *more]
        await send(message)

    return sender
