"""Who may ask: this machine's own browser, with the token, from the page itself."""

import hmac
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from typing import Final
from urllib.parse import parse_qs

from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The page runs nothing but its own files and asks nobody but its own server."""
REPORT_POLICY: Final = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""A report holds its scripts; its own policy allows only those very texts, this one keeps it apart from the page."""
BODY_LIMIT: Final = 1 << 20
"""Bytes of any request but an upload."""
UPLOAD_LIMIT: Final = 2 << 30
"""Bytes of an upload."""

_HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)


class TooLarge(HTTPException):
    """A body exceeds what is allowed."""

    def __init__(self) -> None:
        super().__init__(413, "Too large.")


class Guard:
    """Lets a request through only from an own page with the token; sets the headers of every answer."""

    def __init__(self, app: ASGIApp, *, token: str, hosts: Iterable[str]) -> None:
        self.app, self.token = app, token
        self.hosts = frozenset(hosts)
        self.cookie = f"vstent-{next(iter(sorted(self.hosts))).rpartition(':')[2]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        refusal = self._refusal(scope, headers)
        limit = UPLOAD_LIMIT if _is_upload(scope) else BODY_LIMIT
        if refusal is None and _length(headers) > limit:
            refusal = PlainTextResponse(f"More than {limit >> 20} MB, which is too much.", 413)
        sender = _with_headers(send)
        await (refusal or self.app)(scope, _counted(receive, limit), sender)

    def _refusal(self, scope: Scope, headers: dict[str, str]) -> Response | None:
        if headers.get("host", "") not in self.hosts:
            return PlainTextResponse("This server answers only to its own address.", 403)
        own = {f"http://{host}" for host in self.hosts}
        # A report is shown in a sandbox, whose origin is "null": it has nothing to ask for either.
        if headers.get("origin", next(iter(own))) not in own or headers.get("sec-fetch-site") == "cross-site":
            return PlainTextResponse("Requests from other sites are refused.", 403)
        query = parse_qs(scope["query_string"].decode("latin-1"))
        if scope["path"] == "/" and self._is_right(query.get("token", [""])[0]):
            welcome = RedirectResponse("/", 303)
            welcome.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            return welcome
        if not self._is_right(_token(headers, self.cookie)):
            return PlainTextResponse("Open the address that `vstent app` printed: it contains the key.", 401)
        return None

    def _is_right(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())


def _token(headers: dict[str, str], cookie: str) -> str:
    kind, _, value = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return value.strip()
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(cookie)
    except CookieError:
        return ""
    return found.value if found else ""


def _is_upload(scope: Scope) -> bool:
    return scope["method"] == "PUT" and scope["path"].endswith("/input")


def _length(headers: dict[str, str]) -> int:
    text = headers.get("content-length", "0")
    return int(text) if text.isdigit() else 0


def _counted(receive: Receive, limit: int) -> Receive:
    """Count what comes in: a request may not say how long it is."""
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
    async def sender(message: Message) -> None:
        if message["type"] == "http.response.start":
            present = {name.lower() for name, _ in message["headers"]}
            more = [(name, value) for name, value in _HEADERS if name not in present]
            if b"content-security-policy" not in present:
                more.append((b"content-security-policy", POLICY.encode()))
            message["headers"] = [*message["headers"], *more]
        await send(message)

    return sender
