"""Samples over TCP and UDP, as lines of JSON or CSV.

Who listens for others than this machine asks them for a token: the first line of a connection, or of every datagram, is
then `token` and what was agreed. Messages are bounded in size, and samples in number.
"""

from __future__ import annotations

import hmac
import socket
import time
from dataclasses import dataclass, field

from jaximp.live.clock import NOTHING, Batch
from jaximp.live.lines import MOST_BYTES, Columns, LineReader

MOST_PER_SECOND = 100_000
"""Samples that are taken from the network."""
PATIENCE = 5.0
"""Seconds within which a connection has to show its token."""
LOCAL = ("127.0.0.1", "::1", "localhost")


def check_open(host: str, token: str | None) -> None:
    """**Raises:** `ValueError` for a host that others can reach, without a token."""
    if host not in LOCAL and not token:
        raise ValueError(f"listening on {host} lets others in: give a token with --token, or listen on 127.0.0.1")


@dataclass
class _Allowance:
    """So many samples a second, and as many at once."""

    lost: int = 0
    _left: float = MOST_PER_SECOND
    _at: float = field(default_factory=time.monotonic)

    def of(self, batch: Batch) -> Batch:
        now = time.monotonic()
        self._left, self._at = min(MOST_PER_SECOND, self._left + (now - self._at) * MOST_PER_SECOND), now
        taken = min(len(batch.time), int(self._left))
        self._left -= taken
        self.lost += len(batch.time) - taken
        return batch if taken == len(batch.time) else Batch(*(x[:taken] for x in batch))


def _allowed(line: bytes, token: str | None) -> bool:
    """Whether a line shows the token."""
    return token is None or hmac.compare_digest(line.strip(), b"token " + token.encode())


class TcpSource:
    """Listens; one sender at a time. When it leaves, the next may come."""

    def __init__(self, port: int, host: str = "127.0.0.1", columns: Columns | None = None, token: str | None = None):
        check_open(host, token)
        self._columns, self._token = columns or Columns(), token
        self._server = _listening(socket.SOCK_STREAM, host, port)
        self._server.listen(1)
        self._sender: socket.socket | None = None
        self._allowance, self._unreadable = _Allowance(), 0
        self._begin()

    def _begin(self) -> None:
        self._lines = LineReader(self._columns)
        self._shown, self._first, self._since = self._token is None, b"", time.monotonic()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.getsockname()[1])

    @property
    def lost(self) -> int:
        return self._allowance.lost

    @property
    def unreadable(self) -> int:
        return self._unreadable + self._lines.unreadable

    def read(self, timeout: float) -> Batch | None:
        if self._server.fileno() < 0:
            return None
        if self._sender is None:
            self._server.settimeout(timeout)
            try:
                self._sender = self._server.accept()[0]
            except (TimeoutError, BlockingIOError):
                return NOTHING
            except OSError:
                return None
            self._begin()
        self._sender.settimeout(timeout)
        try:
            data = self._sender.recv(MOST_BYTES)
        except (TimeoutError, BlockingIOError):
            data = None
        except OSError:
            data = b""
        if data is None:
            if not self._shown and time.monotonic() - self._since > PATIENCE:
                self._leave()
            return NOTHING
        return self._allowance.of(self._lines.take(self._after_token(data)) if data else self._leave())

    def _after_token(self, data: bytes) -> bytes:
        """What stands behind the token; nothing from a sender who does not know it, who has to leave."""
        if self._shown:
            return data
        self._first += data
        line, end, rest = self._first.partition(b"\n")
        if not end and len(line) < MOST_BYTES:
            return b""
        if _allowed(line, self._token):
            self._shown = True
            return rest
        self._unreadable += 1
        self._leave()
        return b""

    def _leave(self) -> Batch:
        """The sender goes; what it said last."""
        last = self._lines.finish() if self._shown else NOTHING
        self._unreadable += self._lines.unreadable
        if self._sender is not None:
            self._sender.close()
        self._sender = None
        self._begin()
        return last

    def close(self) -> None:
        self._leave()
        self._server.close()


class UdpSource:
    """Datagrams of one or several lines each."""

    def __init__(self, port: int, host: str = "127.0.0.1", columns: Columns | None = None, token: str | None = None):
        check_open(host, token)
        self._token, self._lines = token, LineReader(columns or Columns())
        self._socket = _listening(socket.SOCK_DGRAM, host, port)
        self._allowance, self._refused = _Allowance(), 0

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    @property
    def lost(self) -> int:
        return self._allowance.lost

    @property
    def unreadable(self) -> int:
        return self._refused + self._lines.unreadable

    def read(self, timeout: float) -> Batch | None:
        if self._socket.fileno() < 0:
            return None
        self._socket.settimeout(timeout)
        try:
            lines = self._socket.recv(MOST_BYTES).split(b"\n")
        except (TimeoutError, BlockingIOError):
            return NOTHING
        except OSError:
            return None
        if self._token is not None:
            if not _allowed(lines[0], self._token):
                self._refused += 1
                return NOTHING
            lines = lines[1:]
        return self._allowance.of(self._lines.samples(lines))

    def close(self) -> None:
        self._socket.close()


def _listening(kind: socket.SocketKind, host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, kind)
    try:
        if kind == socket.SOCK_STREAM:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
    except OSError as error:
        found.close()
        raise ValueError(f"cannot listen on {host}:{port} ({error.strerror or error}): choose another port") from None
    return found
