"""The editor's web server: on this machine alone, for one browser tab at a time.

A page on any web site can send requests to 127.0.0.1, and a name that its owner points there looks to the browser like
the owner's own server. So every request must name this server as its host, must not come from another origin, and must
carry a secret: the page's address a token that works once, every call one that only the page knows, in a header that
other origins cannot set. There are no cookies, and no permission for other origins is ever given.
"""

from __future__ import annotations

import json
import secrets
import sys
import threading
import traceback
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from posegraph_slam.errors import InputError, PosegraphSlamError
from posegraph_slam.report.edit_session import EditSession

HOST = "127.0.0.1"
TOKEN_HEADER = "X-PSG-Token"
BODY_MAX = 4096
"""Bytes of a call's body at most; the largest that the page sends has about 40."""
TARGET_MAX = 512
"""Characters of a request's address at most."""
SECONDS_MAX = 20.0
"""A client that sends nothing for this long is cut off."""

HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
PAGE_POLICY = "frame-ancestors 'none'"
"""In addition to the policy that is in the page."""


class RefusedError(Exception):
    """A request that is not answered, with the status and the reason that are sent."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        self.status, self.reason = status, reason
        super().__init__(reason)


class EditServer(ThreadingHTTPServer):
    """Serves one `EditSession` on 127.0.0.1; `address` is where its page can be opened, once.

    Raises InputError where the port is taken; port 0 takes a free one.
    """

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, session: EditSession, *, port: int = 0) -> None:
        try:
            super().__init__((HOST, port), EditRequest)
        except OSError as error:
            raise InputError(f"port {port}", f"cannot be used ({error.strerror})", "choose another --port") from error
        self.session = session
        self.call_token = secrets.token_urlsafe(32)
        self._page_token = secrets.token_urlsafe(32)
        self._token_lock = threading.Lock()

    @property
    def origin(self) -> str:
        """The origin of the page."""
        return f"http://{HOST}:{self.server_port}"

    @property
    def address(self) -> str:
        """Address of the page; it works once."""
        return f"{self.origin}/?token={self._page_token}"

    def spend(self, token: str) -> str | None:
        """Take the page's token and return the next one, or None where it is wrong."""
        with self._token_lock:
            if not secrets.compare_digest(token.encode(), self._page_token.encode()):
                return None
            self._page_token = secrets.token_urlsafe(32)
            return self._page_token

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep quiet about clients that went away."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


def whole_number(body: dict[str, Any], name: str) -> int:
    """Return a whole number of a call; raise RefusedError for anything else."""
    value = body.get(name)
    if not isinstance(value, int) or isinstance(value, bool):
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"{name} must be a whole number")
    return value


def truth_value(body: dict[str, Any], name: str) -> bool:
    """Return true or false of a call; raise RefusedError for anything else."""
    value = body.get(name)
    if not isinstance(value, bool):
        raise RefusedError(HTTPStatus.BAD_REQUEST, f"{name} must be true or false")
    return value


Call = Callable[[EditSession, dict[str, Any]], dict[str, Any]]
CALLS: dict[str, Call] = {
    "/api/state": lambda session, body: session.state(),
    "/api/switch": lambda session, body: session.switch(
        whole_number(body, "target"), whole_number(body, "source"), on=truth_value(body, "on")
    ),
    "/api/propose": lambda session, body: session.propose(whole_number(body, "target"), whole_number(body, "source")),
    "/api/add": lambda session, body: session.add(),
    "/api/undo": lambda session, body: session.undo(),
    "/api/solve": lambda session, body: session.solve(),
    "/api/save": lambda session, body: session.save(),
}


class EditRequest(BaseHTTPRequestHandler):
    """One request: checked first, then answered; every error is one line of JSON."""

    server: EditServer
    timeout = SECONDS_MAX
    server_version, sys_version = "psg", ""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the name in the base class
        """Stay silent: addresses hold tokens."""

    def do_GET(self) -> None:
        """Answer with the page, for a token that was not used yet."""
        self._answer(self._page)

    def do_POST(self) -> None:
        """Answer a call of the page."""
        self._answer(self._call)

    def _answer(self, respond: Callable[[], tuple[str, bytes]]) -> None:
        status, kind = HTTPStatus.OK, "application/json"
        try:
            self._check_origin()
            kind, content = respond()
        except RefusedError as error:
            status, content = error.status, _line({"error": error.reason})
        except PosegraphSlamError as error:
            status, content = HTTPStatus.UNPROCESSABLE_ENTITY, _line({"error": " ".join(str(error).split())})
        except (ConnectionError, TimeoutError):
            raise
        except Exception:
            traceback.print_exc()
            status, content = HTTPStatus.INTERNAL_SERVER_ERROR, _line({"error": "a bug: the terminal shows where"})
        self._send(status, kind, content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Say on one line of JSON what is wrong with a request that was not even understood."""
        status = HTTPStatus(code)
        self._send(status, "application/json", _line({"error": message or status.phrase}))

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.close_connection = True
        self.send_response(status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Security-Policy", PAGE_POLICY if kind == "text/html" else "default-src 'none'")
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _check_origin(self) -> None:
        """Refuse what names another host or comes from another site."""
        if len(self.path) > TARGET_MAX:
            raise RefusedError(HTTPStatus.REQUEST_URI_TOO_LONG, "the address is too long")
        port = self.server.server_port
        if self.headers.get_all("Host", []) not in ([f"{HOST}:{port}"], [f"localhost:{port}"]):
            raise RefusedError(HTTPStatus.FORBIDDEN, "this server answers to its own address only")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise RefusedError(HTTPStatus.FORBIDDEN, "requests from other sites are refused")
        own = f"http://{self.headers['Host']}"
        if self.headers.get("Origin", own) != own:
            raise RefusedError(HTTPStatus.FORBIDDEN, "requests from other origins are refused")

    def _page(self) -> tuple[str, bytes]:
        address = urlsplit(self.path)
        if address.path != "/":
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is only one page")
        following = self.server.spend((parse_qs(address.query).get("token") or [""])[0])
        if following is None:
            raise RefusedError(HTTPStatus.FORBIDDEN, "this address was used already or is wrong: start psg edit again")
        page = self.server.session.page(token=self.server.call_token, next=following)
        return "text/html", page.encode()

    def _call(self) -> tuple[str, bytes]:
        given = self.headers.get(TOKEN_HEADER, "")
        if not secrets.compare_digest(given.encode(), self.server.call_token.encode()):
            raise RefusedError(HTTPStatus.FORBIDDEN, f"the {TOKEN_HEADER} header is missing or wrong")
        call = CALLS.get(self.path)
        if call is None:
            raise RefusedError(HTTPStatus.NOT_FOUND, "there is no such call")
        return "application/json", _line(call(self.server.session, self._body()))

    def _body(self) -> dict[str, Any]:
        if self.headers.get("Content-Type", "").partition(";")[0].strip() != "application/json":
            raise RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "the body must be application/json")
        length = self.headers.get("Content-Length", "")
        if "Transfer-Encoding" in self.headers or not (length.isascii() and length.isdigit() and len(length) < 12):
            raise RefusedError(HTTPStatus.LENGTH_REQUIRED, "the length of the body must be told")
        if int(length) > BODY_MAX:
            raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"the body is larger than {BODY_MAX} bytes")
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            raise RefusedError(HTTPStatus.BAD_REQUEST, "the body is not JSON") from None
        if not isinstance(body, dict):
            raise RefusedError(HTTPStatus.BAD_REQUEST, "the body is not a JSON object")
        return body


def _line(value: dict[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode() + b"\n"
