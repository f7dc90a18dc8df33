"""An NV200 in this process: its text protocol, waveform, recorder and loop.

The loop is that of the oracle, on a stage that is a lag. Commands, replies, buffers and
errors are those of the manual (N18, N21, N24) and of the vendor's client.
"""

import socketserver
import threading
import time

import numpy as np
from oracles import vendor_loops

DT = 5e-5
LAG, GAIN = 2e-3, 0.5
"""Time constant (s) and gain (um/V) of the stage."""

RANGES = {"posmin": 0.0, "posmax": 80.0, "avmin": -20.0, "avmax": 150.0}
SCALE = (RANGES["avmax"] - RANGES["avmin"]) / (RANGES["posmax"] - RANGES["posmin"])
LIMITS = {
    **dict.fromkeys(("kp", "ki", "kd"), (0.0, 1e4)),
    **dict.fromkeys(("setlpf", "poslpf", "notchf"), (1.0, 1e4)),
    **{"notchb": (1.0, 2e4), "sr": (8e-7, 2000.0)},
}
FLOATS = ("kp", "ki", "kd", "sr", "poslpf", "set", *RANGES)
START = {
    **{"kp": 0.0, "ki": 70.0, "kd": 0.0, "sr": 2000.0, "poslpf": 1000.0, "set": 40.0},
    **{
        "setlpf": 2000,
        "setlpon": 0,
        "poslpon": 0,
        "cl": 1,
        "modsrc": 0,
        "unitcl": "um",
    },
    **{"notchf": 3000, "notchb": 600, "notchon": 0, "pcf": "0.000,0.000,0.000"},
    **{"recstr": 1, "reclen": 6144, "recast": 0, "gtarb": 1, "gcarb": 0},
    **{"gsarb": 0, "goarb": 0, "gearb": 1023},
    **RANGES,
}
NOT_PERMITTED, UNKNOWN, RANGE = 6, 2, 4


class EmulatedNV200:
    """Device with its values, buffers and stage; ``deaf`` values are never kept."""

    def __init__(self, **changed):
        self.values = START | changed
        self.points = np.zeros(1024)
        self.sources = [0, 0]
        self.recorded = {0: np.zeros(0), 1: np.zeros(0), 2: np.zeros(0)}
        self.ends = 0.0
        self.status, self.deaf, self.written, self.lost = 0, (), [], False
        self.runs = 0

    @property
    def running(self):
        """Whether the waveform generator runs."""
        return time.monotonic() < self.ends

    def text(self, name):
        """Return a value as the device prints it."""
        value = self.values[name]
        return f"{value:.3f}" if name in FLOATS else str(value)

    def answer(self, line):
        """Return the reply to a line, None for a write."""
        name, *given = line.split(",")
        if name in ("gbarb", "recsrc", "recoutf", "grun", "recrun", "stat"):
            return getattr(self, f"_{name}")(*given)
        if name not in self.values:
            return f"error,{UNKNOWN}"
        if not given:
            return f"{name},{self.text(name)}"
        if name in RANGES or name == "unitcl":
            return f"error,{NOT_PERMITTED}"
        low, high = LIMITS.get(name, (-np.inf, np.inf))
        if name != "pcf" and not low <= float(given[0]) <= high:
            return f"error,{RANGE}"
        if name in ("notchf", "notchb"):
            wanted = {**self.values, name: int(given[0])}
            if wanted["notchb"] > 2 * wanted["notchf"]:
                return f"error,{RANGE}"
        self.written.append(line)
        if name not in self.deaf:
            kind = type(START[name])
            self.values[name] = ",".join(given) if name == "pcf" else kind(given[0])
        return None

    def _gbarb(self, index, percent):
        self.points[int(index)] = float(percent)

    def _recsrc(self, channel, source=None):
        if source is None:
            return f"recsrc,{channel},{self.sources[int(channel)]}"
        self.sources[int(channel)] = int(source)
        return None

    def _recoutf(self, channel):
        values = self.recorded[self.sources[int(channel)]][: self.values["reclen"]]
        return ",".join([f"recoutf,{channel}", *(f"{value:.4f}" for value in values)])

    def _stat(self):
        return f"stat,{self.status}"

    def _recrun(self, run=None):
        return f"recrun,{int(self.running)}" if run is None else None

    def _grun(self, run=None):
        if run is None:
            return f"grun,{int(self.running)}"
        self.ends = 0.0
        if int(run):
            self._simulate()
        return None

    def _simulate(self):
        values, low, high = self.values, RANGES["posmin"], RANGES["posmax"]
        points = self.points[values["gsarb"] : values["gearb"] + 1]
        setpoint = low + np.repeat(points, values["gtarb"]) * (high - low) / 100.0
        filters = ("sr", "setlpf", "poslpf", "notchf", "notchb", "kp", "ki", "kd")
        switches = ("setlpon", "poslpon", "notchon")
        feedforward = (float(x) for x in values["pcf"].split(","))
        position = values["set"]
        voltage = position / GAIN
        loop = vendor_loops.NV200(
            *(values["set"], position, voltage),
            **{name: values[name] for name in (*filters, *switches)},
            **dict(zip(("pcf_x", "pcf_v", "pcf_a"), feedforward, strict=True)),
            **{"scale": SCALE, "stroke": high - low},
            **{"lower": RANGES["avmin"], "upper": RANGES["avmax"]},
        )
        decay = np.exp(-DT / LAG)
        log = np.zeros((len(setpoint), 2))
        for k, wanted in enumerate(setpoint):
            voltage = loop.step(wanted, position)
            log[k] = position, voltage
            position = decay * position + (1.0 - decay) * GAIN * voltage
        self.recorded = {0: log[:, 0], 1: setpoint, 2: log[:, 1]}
        self.ends = time.monotonic() + len(setpoint) * DT
        self.runs += 1


class Connection(socketserver.StreamRequestHandler):
    """One client; a bare line is answered with the name of the device."""

    def handle(self):
        """Answer lines until the client leaves, or the connection is to be lost."""
        device = self.server.device
        for raw in self.rfile:
            if device.lost:
                return
            line = raw.decode("latin-1").strip()
            reply = device.answer(line) if line else "NV200/D_NET>"
            text = "" if reply is None else f"{reply}\r\n"
            self.wfile.write(f"\x13{text}\x11".encode("latin-1"))


class Server(socketserver.ThreadingTCPServer):
    """Server of one device on a free port."""

    daemon_threads = True

    def __init__(self, device):
        super().__init__(("127.0.0.1", 0), Connection)
        self.device = device
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def port(self):
        """Port that clients connect to."""
        return self.server_address[1]
