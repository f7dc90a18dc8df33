"""Server that answers a RemoteStage; a broken connection makes the stage safe."""

import contextlib
import json
import socket
import socketserver
import threading
from typing import Any

import numpy as np

from .protocol import Stage, StoppedError

LONGEST_LINE = 1 << 26
"""Longest request, bytes: about three million samples."""

SILENCE = 10
"""Time without data after which a connection is probed, and between two probes, s."""


class StageServer(socketserver.ThreadingTCPServer):
    """Server of ``stage`` at a ``port`` of this machine, 0 for any free one.

    Whenever a connection ends without a goodbye, for example because the client was
    killed, the stage is made safe. ``serve_forever`` answers until ``shutdown``. The
    socket is reachable from this machine only.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, stage: Stage, port: int = 0):
        self.stage = stage
        super().__init__(("127.0.0.1", port), _Connection)

    @property
    def address(self) -> str:
        """Address, host:port, for a RemoteStage."""
        host, port = self.server_address[:2]
        return f"{host!s}:{port}"


class _Connection(socketserver.StreamRequestHandler):
    """Connection to one client.

    Requests are answered in other threads, so that the end of the connection is noticed
    during a run.
    """

    @property
    def _stage(self) -> Stage:
        assert isinstance(self.server, StageServer)
        return self.server.stage

    def handle(self) -> None:
        self._keep_alive()
        while True:
            try:
                line = self.rfile.readline(LONGEST_LINE)
            except OSError:
                line = b""
            if not line.endswith(b"\n"):
                break
            request = _parsed(line)
            if request.get("do") == "bye":
                self._send({})
                return
            threading.Thread(target=self._answer, args=(request,), daemon=True).start()
        self._stage.safe()

    def _keep_alive(self) -> None:
        """Notice a connection whose other end has vanished."""
        connection = self.connection
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name in ("TCP_KEEPIDLE", "TCP_KEEPINTVL"):
            if hasattr(socket, name):
                option = getattr(socket, name)
                connection.setsockopt(socket.IPPROTO_TCP, option, SILENCE)

    def _answer(self, request: dict[str, Any]) -> None:
        try:
            answer = _done(self._stage, request)
        except (ValueError, TypeError, KeyError) as error:
            answer = {"refused": str(error)}
        except Exception as error:
            answer = {"failed": f"{type(error).__name__}: {error}"}
        self._send(answer)

    def _send(self, answer: dict[str, Any]) -> None:
        # ``handle`` notices the end of the connection.
        with contextlib.suppress(OSError):
            self.wfile.write(json.dumps(answer).encode() + b"\n")


def _parsed(line: bytes) -> dict[str, Any]:
    try:
        request = json.loads(line)
    except ValueError:
        return {}
    return request if isinstance(request, dict) else {}


def _done(stage: Stage, request: dict[str, Any]) -> dict[str, Any]:
    """Carry out ``request`` on ``stage``; return the answer."""
    match request:
        case {"do": "hello"}:
            return {"dt": stage.dt}
        case {"do": "gains"}:
            return {"gains": stage.gains()}
        case {"do": "apply", "gains": gains}:
            stage.apply(gains)
        case {"do": "safe"}:
            stage.safe()
        case {"do": "run", "reference": reference, "gains": gains}:
            try:
                record = stage.run(np.array(reference, dtype=float), gains)
            except StoppedError as stop:
                columns = stop.reference, stop.measured, stop.voltage
                return {"stopped": stop.reason} | _columns(*columns)
            assert record.reference is not None
            return _columns(record.reference, record.output, record.input)
        case _:
            raise ValueError("the request is none of hello, gains, apply, safe, run")
    return {}


def _columns(
    reference: np.ndarray, measured: np.ndarray, voltage: np.ndarray
) -> dict[str, list[float]]:
    return {
        "reference": reference.tolist(),
        "measured": measured.tolist(),
        "voltage": voltage.tolist(),
    }
