"""Parameter file of the NV200, for PiSoWorks and the library nv200 1.6.0."""

import configparser
import io
from collections.abc import Mapping, Sequence

from ..control import NV200
from .device_file import DeviceFile, Value, value_of

SECTION = "Device Parameters"

FIELDS = (
    *("notchf", "notchb", "setlpf", "poslpf", "sr", "kp", "ki", "kd"),
    *("pcf", "setlpon", "poslpon", "notchon"),
)
"""Keys in the order of the file: frequencies before widths, gains before switches."""

FEEDFORWARD = {"pcf_x": 1.0, "pcf_v": 1e4, "pcf_a": 1e4}
"""Largest values of ``pcf``: the first from the manual, the others from PiSoWorks."""

SWITCHES = ("setlpon", "poslpon", "notchon")


def _values(device: NV200) -> list[Value]:
    parts = [
        value_of(device, field, least=0.0, most=most)
        for field, most in FEEDFORWARD.items()
    ]
    texts, units = (",".join(x) for x in zip(*(p[1:3] for p in parts), strict=True))
    meaning = "feedforward of position, velocity and acceleration"
    pcf = Value("pcf", texts, units, meaning)
    return [pcf if name == "pcf" else value_of(device, name) for name in FIELDS]


def _notes(device: NV200, saved: Mapping[str, str]) -> list[str]:
    scale = float(device.scale)
    kept = [key for key in saved if key not in FIELDS]
    off = [name for name in SWITCHES if not getattr(device, name)]
    pcf = [float(getattr(device, name)) for name in FEEDFORWARD]
    return [
        f"Scale of the gains: {scale:.6g} V/um for 1, as entered in the study."
        if scale
        else "Scale of the gains: ASSUMED from the ranges; measure it first.",
        "Options that the manual does not specify, as simulated: "
        f"integration {device.integration}, anti-windup {device.anti_windup}, "
        f"filter of the setpoint {device.setpoint_filter}, "
        f"depth of the notch {float(device.notch_depth):.6g}.",
        "Open the loop (cl,0), load the file, read all values back and compare them. "
        "Then close the loop.",
        "Loading overwrites the memory of the actuator: keep a backup.",
        "In the library nv200 1.6.0: DeviceParamFile.read, then restore_parameters.",
        *([f"PiSoWorks may load 0 as on: check {', '.join(off)}."] if off else []),
        *(
            ["PiSoWorks cuts pcf to whole numbers: send pcf as a command."]
            if any(x % 1.0 for x in pcf)
            else []
        ),
        *([f"Kept from the saved file: {', '.join(kept)}."] if kept else []),
        *(["The kept cl is not 0: it may close the loop."] * _closes(saved)),
    ]


def _closes(saved: Mapping[str, str]) -> bool:
    return saved.get("cl", "0").strip() != "0"


def _parsed(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise ValueError(str(error)) from None
    return parser


def _read(text: str) -> dict[str, str]:
    parser = _parsed(text)
    if SECTION not in parser:
        raise ValueError(f"no parameter file of an NV200: it has no [{SECTION}]")
    return dict(parser[SECTION])


def _body(values: Sequence[Value], saved: str) -> str:
    old, new = _parsed(saved), configparser.ConfigParser(interpolation=None)
    new[SECTION] = {value.parameter: value.value for value in values}
    for section in old.sections():
        if section not in new:
            new.add_section(section)
        for key, text in old[section].items():
            if key not in new[section]:
                new[section][key] = text
    buffer = io.StringIO()
    new.write(buffer)
    return buffer.getvalue().rstrip("\n") + "\n"


NV200_FILE = DeviceFile(".ini", _values, _notes, _read, _body)
