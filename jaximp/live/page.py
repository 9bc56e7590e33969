"""The live page: parameters with their bands over the last minute, the verdict in words, which motion is missing.

A small server for one browser or a few, on this machine unless somebody says otherwise. Whoever asks for anything has
to know the token in its address, so that no other page in the browser can; a browser that reads too slowly misses
updates.
"""

from __future__ import annotations

import hmac
import json
import queue
import secrets
from collections import deque
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from time import sleep
from typing import Any
from urllib.parse import parse_qs, urlsplit

from jaximp.live.monitor import Update

TEMPLATE = Path(__file__).with_name("page.html")
RECENT, MOST_WAITING, MOST_VIEWERS, MOST_BODY = 600, 1000, 8, 4096
"""Updates that a new browser is told first, those that wait for one, browsers, and bytes of what one asks for."""
LINGER, MOST_TRIES = 1.0, 50
"""Seconds that browsers have to hear the end, and how often it is looked whether they have."""
PATIENCE = 5.0
"""Seconds after which a browser that is told nothing is told that there is nothing."""

Do = Callable[[str, str], dict[str, Any]]
"""An action and its text; the answer to the page."""


class Page:
    """A sink that shows updates in browsers."""

    def __init__(
        self,
        do: Do,
        port: int = 0,
        host: str = "127.0.0.1",
        token: str | None = None,
        enough: float = 5.0,
        about: Callable[[], dict[str, Any]] = dict,
    ):
        """**Arguments:** `do` what a button asks for; `enough` excitation for a parameter; `about` what goes with every
        update.

        **Raises:** `ValueError` for a port that is taken.
        """
        self.token, self.dropped = token or secrets.token_urlsafe(16), 0
        self._do, self._enough, self._about = do, enough, about
        self._viewers: list[queue.Queue[bytes | None]] = []
        self._recent: deque[bytes] = deque(maxlen=RECENT)
        self._lock = Lock()
        try:
            self._server = ThreadingHTTPServer((host, port), _handler(self))
        except OSError as error:
            raise ValueError(
                f"the page cannot be at {host}:{port} ({error.strerror or error}): choose another port"
            ) from None
        self._server.daemon_threads = True
        self.host, self.port = host, int(self._server.server_address[1])
        Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()

    @property
    def address(self) -> str:
        """To be opened in a browser."""
        return f"http://{self.host}:{self.port}/?token={self.token}"

    def write(self, update: Update) -> None:
        """Show it."""
        self._tell("message", update.as_json() | self._about())

    def mark(self, time: float, text: str) -> None:
        """Something that happened."""
        self._tell("mark", {"time": time, "text": text})

    def end(self, said: str) -> None:
        """The last that is shown."""
        self._tell("end", {"said": said})

    def _tell(self, kind: str, what: dict[str, Any]) -> None:
        message = f"event: {kind}\ndata: {json.dumps(what)}\n\n".encode()
        with self._lock:
            self._recent.append(message)
            for viewer in self._viewers:
                try:
                    viewer.put_nowait(message)
                except queue.Full:
                    self.dropped += 1

    def close(self) -> None:
        """Viewers are told, and sent away."""
        self.end("the monitor has ended")
        with self._lock:
            for viewer in self._viewers:
                if viewer.full():
                    viewer.get_nowait()
                viewer.put_nowait(None)
        for _ in range(MOST_TRIES):
            if not self._viewers:
                break
            sleep(LINGER / MOST_TRIES)
        self._server.shutdown()
        self._server.server_close()

    def _join(self) -> queue.Queue[bytes | None] | None:
        with self._lock:
            if len(self._viewers) >= MOST_VIEWERS:
                return None
            viewer: queue.Queue[bytes | None] = queue.Queue(MOST_WAITING)
            for message in self._recent:
                viewer.put_nowait(message)
            self._viewers.append(viewer)
            return viewer

    def _leave(self, viewer: queue.Queue[bytes | None]) -> None:
        with self._lock:
            self._viewers.remove(viewer)

    def html(self, nonce: str) -> bytes:
        """The page."""
        text = TEMPLATE.read_text(encoding="utf-8")
        return text.replace("{{nonce}}", nonce).replace("{{enough}}", repr(self._enough)).encode()


def _handler(page: Page) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 30

        def log_message(self, *_: Any) -> None:
            """Nobody wants to read who asked for what."""

        def do_GET(self) -> None:
            path = self._allowed()
            if path == "/":
                nonce = secrets.token_urlsafe(12)
                policy = (
                    f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self'; "
                    "style-src-attr 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
                    "frame-ancestors 'none'"
                )
                self._answer(200, "text/html; charset=utf-8", page.html(nonce), policy)
            elif path == "/events":
                self._stream()
            elif path is not None:
                self._answer(404, "text/plain", b"not here")

        def do_POST(self) -> None:
            path = self._allowed()
            if path is None:
                return
            length = self.headers.get("Content-Length", "")
            if path != "/do" or not length.isdigit() or int(length) > MOST_BODY:
                self._answer(400, "text/plain", b"not understood")
                return
            try:
                asked = json.loads(self.rfile.read(int(length)))
                found = page._do(str(asked["action"]), str(asked.get("text", "")))
            except (ValueError, KeyError, TypeError, AttributeError):
                self._answer(400, "text/plain", b"not understood")
                return
            self._answer(200, "application/json", json.dumps(found).encode())

        def _allowed(self) -> str | None:
            """The path that is asked for, by somebody who knows the token."""
            parts = urlsplit(self.path)
            shown = parse_qs(parts.query).get("token", [""])[0]
            if not hmac.compare_digest(shown.encode(), page.token.encode()):
                self._answer(403, "text/plain", b"the address needs its token")
                return None
            return parts.path

        def _answer(self, status: int, kind: str, body: bytes, policy: str = "default-src 'none'") -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def _stream(self) -> None:
            viewer = page._join()
            if viewer is None:
                self._answer(503, "text/plain", b"too many pages are open")
                return
            try:
                self.send_response(200)
                self.send_header("Content-Type", "text/event-stream")
                self.send_header("Cache-Control", "no-store")
                self.send_header("Connection", "close")
                self.end_headers()
                self.close_connection = True
                self.wfile.write(b": welcome\n\n")
                while True:
                    try:
                        message = viewer.get(timeout=PATIENCE)
                    except queue.Empty:
                        message = b": nothing\n\n"
                    if message is None:
                        break
                    self.wfile.write(message)
            except OSError:
                pass  # the browser has gone
            finally:
                page._leave(viewer)

    return Handler
