"""A Hub on loopback: what ``huggingface_hub`` asks of huggingface.co to push and pull, and nothing more.

Uploads go through the LFS protocol (batch, basic upload, verify): set HF_HUB_DISABLE_XET=1, the other one is closed.
"""

import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

from helpers.hub_routes import ROUTES, Answer
from helpers.hub_store import HubError, Repo


@dataclass
class Fault:
    """Connections of uploads from the ``first`` one on (counted from 0) break after ``after`` bytes."""

    first: int
    after: int = 0


class Hub:
    """The state of a Hub and its address.

    Args:
        users: by access token.
    """

    def __init__(self, users: dict[str, str]) -> None:
        self.users, self.repos = users, dict[tuple[str, str], Repo]()
        self.begun: list[str] = []
        """SHA-256 of every large file whose upload was begun, in order."""
        self.fault: Fault | None = None
        self.requests: list[str] = []
        self.lock = threading.RLock()
        self.url = self.storage = ""
        """Addresses of the Hub and of its large file storage, which is another host: it must see no token."""

    def repo(self, kind: str, name: str) -> Repo:
        return self.repos[kind, name]

    def breaks(self, oid: str) -> int | None:
        """After how many bytes the upload of ``oid`` breaks off, if it does."""
        with self.lock:
            self.begun.append(oid)
            fault = self.fault
            return fault.after if fault is not None and len(self.begun) > fault.first else None


@contextmanager
def serve(**users: str) -> Iterator[Hub]:
    """A running Hub; ``users`` are access tokens by user name."""
    hub = Hub({token: name for name, token in users.items()})
    server = ThreadingHTTPServer(("127.0.0.1", 0), lambda *arguments: Handler(hub, *arguments))
    server.daemon_threads = True
    hub.url, hub.storage = (f"http://{host}:{server.server_port}" for host in ("127.0.0.1", "localhost"))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@dataclass
class Request:
    """What a route needs of a request."""

    hub: Hub
    method: str
    headers: Message
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def user(self) -> str | None:
        """Who asks; None without a token."""
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if token and token not in self.hub.users:
            raise HubError(401, "Invalid credentials in Authorization header")
        return self.hub.users.get(token)

    def readable(self, kind: str, name: str) -> Repo:
        """The repository; who may not see it learns no more than if it were missing."""
        repo = self.hub.repos.get((kind, name))
        if repo is None or (repo.private and self.user != repo.owner):
            if self.user is None:
                raise HubError(401, "Invalid username or password.")
            raise HubError(404, "Repository not found", "RepoNotFound")
        return repo

    def writable(self, kind: str, name: str) -> Repo:
        repo = self.readable(kind, name)
        self.must_be(repo.owner)
        return repo

    def must_be(self, owner: str) -> None:
        if self.user is None:
            raise HubError(401, "Invalid username or password.")
        if self.user != owner:
            raise HubError(403, f'You don\'t have the rights to write under the namespace "{owner}"')


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    close_connection: bool

    def __init__(self, hub: Hub, *arguments: Any) -> None:
        self.hub = hub
        super().__init__(*arguments)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Tests read ``Hub.requests`` instead."""

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except ConnectionError:
            self.close_connection = True

    def answer(self) -> None:
        path = unquote(urlsplit(self.path).path)
        self.hub.requests.append(f"{self.command} {path}")
        if self.command == "PUT" and (broken := self.hub.breaks(path.rpartition("/")[2])) is not None:
            self.rfile.read(broken)
            self.close_connection = True
            return
        request = Request(self.hub, self.command, self.headers, self.read_body())
        try:
            with self.hub.lock:
                answer = self.route(path)(request)
        except HubError as error:
            headers = {"X-Error-Message": error.message} | ({"X-Error-Code": error.code} if error.code else {})
            answer = Answer(error.status, json.dumps({"error": error.message}).encode(), headers)
        self.send(answer)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = answer  # noqa: N815

    def route(self, path: str) -> Callable[[Request], Answer]:
        for method, pattern, function in ROUTES:
            if self.command in method.split() and (match := re.fullmatch(pattern, path)):
                return lambda request: function(request, **match.groupdict())
        raise HubError(404, f"no such page: {self.command} {path}")

    def read_body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        chunks = []
        while size := int(self.rfile.readline(), 16):
            chunks.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(chunks)

    def send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        for name, value in ({"Content-Length": str(len(answer.body))} | answer.headers).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)
