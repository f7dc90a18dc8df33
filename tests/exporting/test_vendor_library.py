"""The vendor's own library loads an NV200 file into a device and reads it back.

The library needs Python 3.12; its device is emulated as the manual describes: a command
alone asks for values, a command with values sets them.
"""

import asyncio

import pytest
from vendor_devices import JENA

import piezojax as pj

pytest.importorskip("nv200", reason="the library nv200 needs Python 3.12 or 3.13")

from nv200.nv200_device import NV200Device
from nv200.shared_types import TransportProtocolInfo, TransportType
from nv200.transport_protocol import TransportProtocol
from nv200.utils import DeviceParamFile


class Memory(TransportProtocol):
    """A device that keeps the texts of the values that it is sent."""

    def __init__(self):
        super().__init__()
        self.values = {}
        self.asked = ""

    async def connect(self, auto_adjust_comm_params=True, device=None):
        """There is nothing to open."""

    async def write(self, cmd):
        self.asked, *values = cmd.strip("\r\n").split(",")
        if values:
            self.values[self.asked] = ",".join(values)

    async def read_until(self, expected=TransportProtocol.XON, timeout=0.6):
        return f"{self.asked},{self.values[self.asked]}\r\n"

    async def flush_input(self):
        """Nothing waits to be read."""

    async def close(self):
        """There is nothing to close."""

    def get_info(self):
        return TransportProtocolInfo(TransportType.SERIAL, "emulated")


@pytest.fixture
def loaded(tmp_path):
    """Return a device, and the texts of the file that the library loaded into it."""
    about = pj.About(study="a study", judged=["tuned loop: sensitivity peak 1.5"])
    paths = pj.export(JENA, tmp_path / "x", to="vendor", about=about)
    (path,) = (path for path in paths if path.suffix == ".ini")
    parameters = DeviceParamFile.read(path).parameters
    device = NV200Device(Memory())
    asyncio.run(device.restore_parameters(parameters))
    return device, parameters


def test_the_device_returns_what_the_file_holds(loaded):
    device, parameters = loaded
    assert asyncio.run(device.backup_parameters(list(parameters))) == parameters
    assert len(parameters) == 12


def test_the_library_reads_the_values_that_were_simulated(loaded):
    device, _ = loaded

    async def read():
        gains = await device.pid.get_pid_gains()
        feedforward = await device.pid.get_pcf_gains()
        setpoint, position = device.setpoint_lpf, device.position_lpf
        return {
            **{"kp": gains.kp, "ki": gains.ki, "kd": gains.kd},
            **{"pcf_x": feedforward.position, "pcf_v": feedforward.velocity},
            "pcf_a": feedforward.acceleration,
            "notchf": await device.notch_filter.get_frequency(),
            "notchb": await device.notch_filter.get_bandwidth(),
            "notchon": await device.notch_filter.is_enabled(),
            "setlpf": await setpoint.get_cutoff(),
            "setlpon": await setpoint.is_enabled(),
            "poslpf": await position.get_cutoff(),
            "poslpon": await position.is_enabled(),
            "sr": await device.get_slew_rate(),
        }

    typed = JENA.typed()
    found = asyncio.run(read())
    assert found == pytest.approx({k: float(getattr(typed, k)) for k in found})
