"""Stage in another process, reached through a socket."""

import contextlib
import json
import socket
import threading
from typing import Any

import numpy as np
from jaxtyping import Float

from ..identification import Record
from .protocol import Gains, LostError, StageError, StoppedError

TIMEOUT = 60.0
"""Longest wait for an answer, s; four times the duration of a run is added to it."""


class RemoteStage:
    """Stage behind the socket of a StageServer at ``address``, "host:port".

    A request and its answer are one line of JSON each. The server makes the stage safe
    if the connection breaks, but not after ``close``. Raises ValueError for a wrong
    address and LostError if no server answers there.
    """

    def __init__(self, address: str, timeout: float = TIMEOUT):
        host, _, port = address.rpartition(":")
        if not (host and port.isdigit() and int(port) < 1 << 16):
            raise ValueError(
                f"the address of a stage is host:port, as 127.0.0.1:5025, not {address}"
            )
        self._place, self._timeout = (host, int(port)), timeout
        self._one_at_a_time = threading.Lock()
        self._connection = self._connect()
        self.dt = float(self._ask(do="hello")["dt"])

    def run(self, reference: Float[np.ndarray, " samples"], gains: Gains) -> Record:
        """Follow ``reference`` (um) with ``gains``, as ``Stage.run`` describes."""
        reference = np.asarray(reference, dtype=float)
        longest = self._timeout + 4.0 * len(reference) * self.dt
        answer = self._ask(
            longest, do="run", reference=reference.tolist(), gains=dict(gains)
        )
        columns = [np.array(answer[key], dtype=float) for key in _COLUMNS]
        if "stopped" in answer:
            raise StoppedError(answer["stopped"], *columns)
        source = "{}:{}".format(*self._place)
        reference, measured, voltage = columns
        return Record(voltage, measured, self.dt, source=source, reference=reference)

    def apply(self, gains: Gains) -> None:
        """Set ``gains`` and hold the position."""
        self._ask(do="apply", gains=dict(gains))

    def gains(self) -> dict[str, float]:
        """Return the gains that are set."""
        return dict(self._ask(do="gains")["gains"])

    def safe(self) -> None:
        """Stop a run under way, set the safe gains and move to the safe voltage."""
        with self._connect() as connection:
            _exchange(connection, self._timeout, {"do": "safe"})
            # Without a goodbye the server would make the stage safe again, later.
            with contextlib.suppress(LostError):
                _exchange(connection, self._timeout, {"do": "bye"})

    def close(self) -> None:
        """End the connection; the stage keeps its gains and its position.

        Nothing happens if the connection is lost.
        """
        with self._connection, contextlib.suppress(LostError):
            self._ask(do="bye")

    def abandon(self) -> None:
        """End the connection without a goodbye: the stage becomes safe by itself.

        A request under way in another thread ends with LostError.
        """
        with contextlib.suppress(OSError):  # it is lost already
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def _connect(self) -> socket.socket:
        try:
            return socket.create_connection(self._place, self._timeout)
        except OSError as error:
            host, port = self._place
            raise LostError(f"no stage answers at {host}:{port}: {error}") from None

    def _ask(self, timeout: float | None = None, **request: Any) -> dict[str, Any]:
        with self._one_at_a_time:
            try:
                return _exchange(self._connection, timeout or self._timeout, request)
            except LostError:
                self._connection.close()
                raise


_COLUMNS = "reference", "measured", "voltage"


def _exchange(
    connection: socket.socket, timeout: float, request: dict[str, Any]
) -> dict[str, Any]:
    """Send ``request`` and return the answer; raise the error that it contains."""
    try:
        connection.settimeout(timeout)
        connection.sendall(json.dumps(request).encode() + b"\n")
        with connection.makefile("rb") as lines:
            line = lines.readline()
    except OSError as error:
        raise LostError(f"the connection to the stage is lost: {error}") from None
    if not line.endswith(b"\n"):
        raise LostError("the connection to the stage is lost: it was closed")
    answer = json.loads(line)
    if "refused" in answer:
        raise ValueError(answer["refused"])
    if "failed" in answer:
        raise StageError(answer["failed"])
    return answer
