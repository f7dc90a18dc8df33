"""An NV200 as a stage: the vendor's library against an emulated device.

The library needs Python 3.12 or 3.13.
"""

import asyncio
import threading

import numpy as np
import pytest
from stages.emulated_nv200 import DT, START, EmulatedNV200, Server

from piezojax.stages import (
    LostError,
    Motion,
    NV200Stage,
    Stage,
    StageError,
    StoppedError,
    stage_of,
    trial,
)
from piezojax.stages.nv200_stage import POINTS, SAMPLES

# The vendor's library closes its reader in a way that telnetlib3 deprecates.
pytestmark = pytest.mark.filterwarnings("ignore:close.. is deprecated")

LIBRARY = "the library nv200 needs Python 3.12 or 3.13"
TIME = DT * np.arange(400)
REFERENCE = 40.0 + 2.0 * (1.0 - np.cos(2.0 * np.pi * 50.0 * TIME))


@pytest.fixture
def device():
    pytest.importorskip("nv200", reason=LIBRARY)
    return EmulatedNV200()


@pytest.fixture
def stage(device):
    with Server(device) as server:
        made = NV200Stage("127.0.0.1", server.port)
        yield made
        made.close()
        server.shutdown()


def short(reference, points=20):
    """Return the reference with so many points, because each takes 10 ms to write."""
    return np.repeat(reference[:: len(reference) // points], len(reference) // points)


def test_gains_are_set_and_read_back(device, stage):
    assert isinstance(stage, Stage)
    before = stage.gains()
    assert before == {
        **{name: START[name] for name in ("kp", "ki", "kd", "sr", "setlpf", "poslpf")},
        **{"notchf": 3000.0, "notchb": 600.0, "pcf_x": 0.0, "pcf_v": 0.0, "pcf_a": 0.0},
    }
    wanted = {"kp": 3.5e-3, "ki": 81.23456, "notchf": 200.0, "notchb": 400.0}
    stage.apply(wanted | {"pcf_x": 0.5, "setlpf": 811.6})
    rounded = {"kp": 0.004, "ki": 81.235, "setlpf": 812.0, "pcf_x": 0.5}
    assert stage.gains() == pytest.approx(before | wanted | rounded)
    # The width falls before the frequency, and what is set already is not written.
    assert device.written == [
        *("notchb,400", "notchf,200"),
        *("kp,0.004", "ki,81.235", "setlpf,812", "pcf,0.500,0.000,0.000"),
    ]
    stage.apply({"kp": 0.004, "ki": 81.235, "pcf_v": 0.0})
    assert len(device.written) == 6
    stage.apply({"notchf": 1000.0, "notchb": 1500.0, "sr": 3.5e-5})
    assert device.written[6:] == ["notchf,1000", "notchb,1500", "sr,0.000035"]


def test_a_run_is_that_of_the_device(device, stage):
    reference = short(REFERENCE)
    record = stage.run(reference, {"ki": 90.0})
    assert device.runs == 1
    assert record.dt == DT
    np.testing.assert_allclose(record.reference, reference, atol=1e-4)
    np.testing.assert_allclose(record.outputs[:, 0], device.recorded[0], atol=1e-4)
    np.testing.assert_allclose(record.inputs[:, 0], device.recorded[2], atol=1e-4)
    assert np.ptp(record.output) > 2.0
    # After the run the setpoint stays at the end of the reference.
    assert device.values["modsrc"] == 0
    assert device.values["set"] == pytest.approx(reference[-1], abs=1e-3)
    assert stage.gains()["ki"] == 90.0


def test_long_references_are_held_and_written_once(device, stage, monkeypatch):
    written = []
    answer = device._gbarb
    monkeypatch.setattr(
        device, "_gbarb", lambda *point: (written.append(point), answer(*point))[1]
    )
    monkeypatch.setattr("piezojax.stages.nv200_stage.POINTS", 50)
    record = stage.run(REFERENCE, {})
    assert len(written) == 50
    assert device.values["gtarb"] == 8
    np.testing.assert_allclose(record.reference, short(REFERENCE, 50), atol=1e-4)
    stage.run(REFERENCE, {"ki": 75.0})
    assert len(written) == 50
    assert device.runs == 2


def test_a_trial_keeps_the_gains(stage, tmp_path):
    motion = Motion("scan", short(REFERENCE), promised=1.0)
    report = trial(stage, {"ki": 100.0}, [motion], tmp_path)
    assert report.verdict == "kept"
    assert report.before["ki"] == 70.0
    assert stage.gains()["ki"] == 100.0
    assert [run.share for run in report.runs] == [0.1, 0.3, 1.0]


def test_a_value_that_is_not_kept_is_an_error(device, stage):
    device.deaf = ("ki",)
    with pytest.raises(StageError, match=r"keeps ki at 70\.000 instead of 90\.000"):
        stage.apply({"ki": 90.0})


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"gain": 1.0}, "the NV200 has no gain gain; it has kp, ki, kd, sr"),
        ({"kp": -1.0}, "kp is -1"),
        ({"notchf": 2e4}, "notchf in Hz is 20000"),
        ({"ki": np.nan}, "ki in 1/s is nan"),
    ],
)
def test_other_gains_are_refused(stage, gains, message):
    with pytest.raises(ValueError, match=message):
        stage.run(short(REFERENCE), gains)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (
            np.full(SAMPLES + 1, 40.0),
            "has 6145 samples; the NV200 records 2 to 6144",
        ),
        (np.array([40.0]), "has 1 samples; the NV200 records 2 to 6144"),
        (np.array([40.0, 81.0]), "from 40 to 81 um; the range is 0 to 80 um"),
        (np.array([40.0, np.nan]), "reference must be a row of numbers"),
    ],
)
def test_other_references_are_refused(device, stage, reference, message):
    with pytest.raises(ValueError, match=message):
        stage.run(reference, {"ki": 90.0})
    assert not device.written
    assert POINTS == 1024


def test_safe_stops_a_run(device, stage):
    stage.apply({"ki": 75.0})
    long = short(np.full(6000, 41.0), 10)
    started = threading.Event()
    simulate = device._simulate

    def begin():
        simulate()
        device.ends += 10.0
        started.set()

    device._simulate = begin
    caught = []

    def run():
        try:
            stage.run(long, {})
        except StoppedError as error:
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    assert started.wait(20.0)
    stage.safe()
    thread.join(20.0)
    assert caught[0].reason == "it was asked to stop"
    assert stage.gains()["ki"] == 70.0
    assert device.values["set"] == pytest.approx(40.0)
    assert not device.running


@pytest.mark.parametrize("moment", ["_set", "_start_recorder"])
def test_safe_stops_a_run_that_is_about_to_begin(device, stage, monkeypatch, moment):
    """While gains are set, or the waveform is written."""
    whole, asked = getattr(stage, moment), threading.Thread(target=stage.safe)

    async def ask(*arguments):
        monkeypatch.setattr(stage, moment, whole)
        asked.start()
        while not stage._asked:
            await asyncio.sleep(0.01)
        return await whole(*arguments)

    monkeypatch.setattr(stage, moment, ask)
    with pytest.raises(StoppedError, match="it was asked to stop") as stop:
        stage.run(short(REFERENCE), {"ki": 75.0})
    asked.join(20.0)
    assert stop.value.measured.size == 0
    assert device.runs == 0
    assert stage.gains()["ki"] == 70.0
    assert device.values["set"] == pytest.approx(40.0)
    assert stage.run(short(REFERENCE), {}).samples == 400


@pytest.mark.parametrize(
    ("gains", "reference", "reason"),
    [
        ({"kp": 300.0}, REFERENCE, "the voltage is at a limit"),
        (
            {"ki": 0.1},
            40.0 + 5.0 * (REFERENCE - 40.0),
            "the tracking error is too large",
        ),
    ],
)
def test_bad_gains_are_stopped(device, stage, gains, reference, reason):
    with pytest.raises(StoppedError, match=reason) as caught:
        stage.run(short(reference), gains)
    assert len(caught.value.measured) == 400
    assert stage.gains()["ki"] == 70.0
    assert stage.gains()["kp"] == 0.0
    assert device.values["set"] == pytest.approx(40.0)


def test_a_fault_of_the_amplifier_stops_a_run(device, stage):
    device.status = 1 << 10
    with pytest.raises(StoppedError, match="the amplifier is too hot"):
        stage.run(short(np.full(6000, 41.0), 10), {})


def test_a_lost_connection_is_reported(device, stage):
    device.lost = True
    with pytest.raises(LostError, match=r"NV200 at 127\.0\.0\.1: no connection"):
        stage.gains()
    with pytest.raises(LostError):
        stage.safe()
    stage.abandon()
    with pytest.raises(LostError, match="the connection is closed"):
        stage.apply({"ki": 80.0})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"cl": 0}, "the loop is open; close it with gains that hold"),
        ({"unitcl": "mrad"}, "the position is in mrad, not in um"),
    ],
)
def test_another_device_is_refused(changed, message):
    pytest.importorskip("nv200", reason=LIBRARY)
    with (
        Server(EmulatedNV200(**changed)) as server,
        pytest.raises(ValueError, match=message),
    ):
        stage_of(f"nv200:127.0.0.1:{server.port}")


def test_no_device_at_the_address():
    pytest.importorskip("nv200", reason=LIBRARY)
    with pytest.raises(LostError, match="no connection"):
        stage_of("nv200:127.0.0.1:9")


def test_the_name_of_a_device_has_an_address():
    for name in ("nv200:", "nv200:host:there"):
        with pytest.raises(ValueError, match=r"give nv200:host or nv200:host:port"):
            stage_of(name)


def test_the_library_is_named_if_it_is_missing(monkeypatch):
    monkeypatch.setattr("piezojax.stages.nv200_stage.LIBRARY", "no_nv200")
    with pytest.raises(ValueError, match="needs the vendor's library: pip install"):
        stage_of("nv200:127.0.0.1")
