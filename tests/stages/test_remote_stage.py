"""A stage behind a socket: the same runs, and a safe end whatever breaks."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest
from small_runs import write_study
from stages.stage_in_tests import DT, LIMITS, REFERENCE, SAFE, served, stage

from piezojax.stages import (
    Fault,
    LostError,
    RemoteStage,
    Stage,
    StoppedError,
    stage_of,
)

CLIENT = """
import json, socket, sys, time
host, port = sys.argv[1].split(":")
connection = socket.create_connection((host, int(port)))
request = {"do": "run", "reference": [1.0] * 60000, "gains": {"integral": 700.0}}
connection.sendall(json.dumps(request).encode() + b"\\n")
print("sent", flush=True)
time.sleep(60.0)
"""


def wait_for(condition):
    for _ in range(600):
        if condition():
            return True
        time.sleep(0.05)
    return False


def is_safe(one):
    return one.gains() | SAFE == one.gains() and abs(one.voltage) < 1e-9


def test_a_run_through_the_socket_is_that_of_the_stage():
    gains = {"proportional": 1.5, "integral": 900.0}
    expected = stage(seed=5).run(REFERENCE, gains)
    with served(stage(seed=5)) as address, closing(RemoteStage(address)) as remote:
        assert isinstance(remote, Stage)
        assert remote.dt == DT
        found = remote.run(REFERENCE, gains)
        assert remote.gains()["proportional"] == 1.5
        remote.apply({"integral": 250.0})
        assert remote.gains()["integral"] == 250.0
    np.testing.assert_array_equal(found.inputs, expected.inputs)
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    np.testing.assert_array_equal(found.reference, expected.reference)


def test_a_goodbye_leaves_the_gains():
    one = stage()
    with served(one) as address:
        remote = RemoteStage(address)
        remote.run(REFERENCE, {"integral": 700.0})
        remote.close()
        time.sleep(0.3)
        assert one.gains()["integral"] == 700.0


def test_a_broken_connection_makes_the_stage_safe():
    one = stage()
    with served(one) as address:
        remote = RemoteStage(address)
        remote.run(REFERENCE, {"integral": 700.0})
        remote._connection.close()
        assert wait_for(lambda: is_safe(one))


def test_a_stop_of_the_guard_and_its_samples_arrive():
    one = stage(faults=[Fault("dropout", 500)])
    with served(one) as address, closing(RemoteStage(address)) as remote:
        with pytest.raises(StoppedError, match="the reading is not a number") as stop:
            remote.run(REFERENCE, {})
        assert 500 < len(stop.value.voltage) <= len(REFERENCE)
        assert np.isnan(stop.value.measured[500])


def test_safe_stops_a_run_through_the_socket():
    with served(stage(speed=1.0)) as address, closing(RemoteStage(address)) as remote:
        asked = threading.Timer(0.6, remote.safe)
        asked.start()
        with pytest.raises(StoppedError, match="it was asked to stop"):
            remote.run(np.tile(REFERENCE, 20), {"integral": 700.0})
        asked.join()
        assert remote.gains()["integral"] == SAFE["integral"]


def test_safe_is_carried_out_once():
    """A second time could come after gains that were applied later."""
    one, calls = stage(), []
    one.safe = lambda: calls.append("safe")
    with served(one) as address, closing(RemoteStage(address)) as remote:
        remote.safe()
        time.sleep(0.3)
        assert calls == ["safe"]


def test_a_killed_client_leaves_a_safe_stage():
    one = stage(speed=1.0)
    one.run(REFERENCE[:50], {})  # compiled
    with served(one) as address:
        command = [sys.executable, "-c", CLIENT, address]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
            assert client.stdout.readline() == "sent\n"
            assert wait_for(lambda: one.gains()["integral"] == 700.0)
            client.send_signal(signal.SIGKILL)
        begin = time.monotonic()
        assert wait_for(lambda: is_safe(one))
        assert time.monotonic() - begin < 20.0  # the run would take 60 s


@pytest.mark.slow
def test_a_killed_stage_is_reported(tmp_path):
    study = write_study(tmp_path)
    command = [sys.executable, "-m", "piezojax.emulate", str(study), "--quiet"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = process.stdout.readline().removeprefix("stage at ").strip()
            remote = RemoteStage(address)
            threading.Timer(0.5, process.kill).start()
            with pytest.raises(LostError, match="the connection to the stage is lost"):
                remote.run(np.zeros(200_000), {})
            assert process.wait() == -signal.SIGKILL
            with pytest.raises(LostError, match=f"no stage answers at {address}"):
                remote.safe()
        finally:
            process.kill()


@pytest.mark.parametrize(
    "line", [b"no json\n", b"[]\n", b'{"do": "dance"}\n', b'{"do": "run"}\n']
)
def test_a_request_that_is_none_is_refused(line):
    with served(stage()) as address:
        host, port = address.split(":")
        with socket.create_connection((host, int(port))) as connection:
            connection.sendall(line)
            with connection.makefile("rb") as lines:
                answer = json.loads(lines.readline())
    assert answer["refused"].startswith("the request is none of hello, gains")


def test_what_the_stage_refuses_is_refused_here():
    with served(stage()) as address, closing(RemoteStage(address)) as remote:
        with pytest.raises(ValueError, match="no parameter 'nothing'"):
            remote.run(REFERENCE, {"nothing": 1.0})
        assert remote.run(REFERENCE, {}).samples == len(REFERENCE)


def test_a_failure_of_the_stage_arrives():
    one = stage()
    one.apply = None  # as of a driver that raises
    with (
        served(one) as address,
        closing(RemoteStage(address)) as remote,
        pytest.raises(ValueError, match="not callable"),
    ):
        remote.apply({})


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stage", "--stage is 'stage'; give host:port"),
        ("host:99999", "the address of a stage is host:port, as 127.0.0.1:5025, not"),
        ("no_such_module:make", "--stage no_such_module:make: No module named"),
        ("json:make", "--stage json:make: module 'json' has no attribute 'make'"),
        ("builtins:dict", "--stage builtins:dict returns a dict, which is no stage"),
    ],
)
def test_names_that_lead_to_no_stage_are_refused(name, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        stage_of(name)


def test_a_stage_of_a_lab_is_called_by_its_function():
    assert stage_of("stages.stage_in_tests:stage").limits == LIMITS


def test_nobody_at_the_address_is_said():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(LostError, match=f"no stage answers at 127.0.0.1:{port}"):
        stage_of(f"127.0.0.1:{port}")


def test_an_abandoned_run_is_lost_and_the_stage_safe():
    one = stage(speed=1.0)
    with served(one) as address:
        remote = RemoteStage(address)
        threading.Timer(0.6, remote.abandon).start()
        with pytest.raises(LostError, match="the connection to the stage is lost"):
            remote.run(np.tile(REFERENCE, 20), {"integral": 700.0})
        assert wait_for(lambda: is_safe(one))
        remote.abandon()  # again, without an effect
