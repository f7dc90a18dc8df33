"""SPA commands of the E-727, in the General Command Set of PI (GCS 2.0)."""

import re
from collections.abc import Mapping, Sequence

from ..control import E727
from ..control.devices.e727 import UNKNOWN
from ..control.devices.servo_loop import NO_SLEW
from .device_file import DeviceFile, Value, value_of

IDS = {
    "notch_method": 0x08000600,
    "notch_frequency_1": 0x08000100,
    "notch_rejection_1": 0x08000200,
    "notch_bandwidth_1": 0x08000300,
    "notch_frequency_2": 0x08000101,
    "notch_rejection_2": 0x08000201,
    "notch_bandwidth_2": 0x08000301,
    "filter_type": 0x05000000,
    "filter_frequency": 0x05000001,
    "slew_rate": 0x07000200,
    "proportional": 0x07000300,
    "integral_time": 0x07000301,
    "derivative_time": 0x07000302,
}
"""Numbers of the parameters, in the order in which they are written."""

_TRIPLE = re.compile(r"(\d+)\s+(0[xX][0-9a-fA-F]+|\d{5,})[\s=]+([^\s=]+)")


def _key(number: int, item: str = "1") -> str:
    return f"{item} 0x{number:08X}"


def _values(device: E727) -> list[Value]:
    return [
        value_of(device, name, _key(number))
        for name, number in IDS.items()
        if (name != "slew_rate" or device.slew_rate < NO_SLEW)
        and (name != "filter_frequency" or device.filter_type)
    ]


def _notes(device: E727, saved: Mapping[str, str]) -> list[str]:
    slew = float(device.slew_rate) < NO_SLEW
    return [
        f"Scale: {float(device.scale):.6g} V/um for P = 1, as entered in the study.",
        "Structure of the PID: ASSUMED, P multiplies all terms; measure it first."
        if device.structure == UNKNOWN
        else f"Structure of the PID: {device.structure}, as in the study.",
        "Options that the manual does not specify, as simulated: "
        f"anti-windup {device.anti_windup}, "
        "the transfer function of a notch with a bandwidth other than 1.",
        "Item 1 is the axis; for 0x05000000 and 0x05000001 it is the input channel. "
        "Change it for other axes and channels.",
        "Switch the servo off. Send the lines that begin with SPA, each followed by "
        "ERR?. Read all values back with SPA? and compare them. Then close the loop.",
        "SPA writes to volatile memory. HPA? lists the command levels and the types; "
        "the ranges and digits of the device are unknown.",
        "The control mode 0x07030100 must be 1 (PID), and the servo update time "
        "0x0E000200 must be 5e-05 s.",
        "The unit of the slew rate is not in the manual; um/s is assumed."
        if slew
        else "The slew rate 0x07000200 is not written: the simulation had no limit.",
        *(
            []
            if device.derivative_time > 0.0
            else ["The manual asks for D > 0, but D is off: check that it reads 0."]
        ),
    ]


def _read(text: str) -> dict[str, str]:
    lines = (re.sub(r"^SPA\s+", "", line.strip()) for line in text.splitlines())
    found = {
        _key(int(number, 0), item): value
        for line in lines
        if re.match(r"\d", line)
        for item, number, value in _TRIPLE.findall(line)
    }
    if not found:
        raise ValueError("no parameters of an E-727, such as '1 0x07000300=0.02'")
    return found


def _body(values: Sequence[Value], saved: str) -> str:
    return "".join(f"SPA {value.parameter} {value.value}\n" for value in values)


E727_FILE = DeviceFile(".txt", _values, _notes, _read, _body)
