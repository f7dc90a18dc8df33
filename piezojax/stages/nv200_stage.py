"""NV200 of piezosystem jena as a stage, through the vendor's library ``nv200``."""

import asyncio
import contextlib
import importlib
import math
import threading
from collections.abc import Coroutine, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np
from jaxtyping import Float

from ..control import NV200
from ..core.parameter import declarations
from ..identification import Record
from .protocol import Gains, LostError, StageError, StoppedError

LIBRARY = "nv200"

PORT = 23
"""Port of the device for telnet."""

SAMPLE = 5e-5
"""Sample time of loop and recorder, s."""

POINTS, SAMPLES = 1024, 6144
"""Largest number of points of the waveform, and of recorded samples."""

RESOLUTION = 1e-4
"""Step of a point of the waveform, % of the range; the setpoint has 16 bits."""

REST = 0.2
"""Rest at the beginning of a reference, s."""

POLL, MARGIN = 0.02, 5.0
"""Time between two readings of the status during a run, and the time that a run may
take beyond its duration, s."""

PATIENCE = 20
"""Number of samples at a limit of the voltage, or in a row with too large an error,
from which a run counts as stopped."""

SHARE = 0.1
"""Default largest error, as a share of the range of the position."""

DIGITS = 7
"""Significant digits of a value without a declared step."""

SINGLE = ("kp", "ki", "kd", "sr", "setlpf", "poslpf", "notchf", "notchb")
FEEDFORWARD = ("pcf_x", "pcf_v", "pcf_a")
"""Values of the command ``pcf``, in their order."""

NAMES = (*SINGLE, *FEEDFORWARD)
"""Gains of the stage: the fields of ``piezojax.control.NV200`` that can be sent."""

ASKED = "it was asked to stop"

FAULTS = {
    10: "the amplifier is too hot",
    11: "the actuator reports an error",
    12: "the device reports an error",
    13: "the device reports an error of its bus",
}
"""Reasons to stop a run, by bit of the status."""


class NV200Stage:
    """NV200 at ``host``, whose loop is closed already.

    The gains are the values of its commands, with the names and units of
    ``piezojax.control.NV200``; a value that the device does not keep is an error. A
    reference of at most 307 ms is written into the waveform generator as at most 1024
    points; position and voltage are recorded at 20 kHz. Writing takes about 10 ms a
    point, and is left out for a reference that the generator holds already.

    The safe gains and the safe position are those at the beginning. The device itself
    enforces only its voltage limits. Its status is read during a run; voltage and
    error are judged afterwards, from the record. After a lost connection the device
    keeps the gains that are set. ``largest_error`` (um) is by default a tenth of the
    range.

    Needs the library ``nv200`` (Python 3.12 or 3.13). Raises ValueError without it,
    and for a loop that is open or a position that is not in um; StageError for a
    device that refuses a value, LostError without a connection.
    """

    dt = SAMPLE

    def __init__(
        self, host: str, port: int = PORT, *, largest_error: float | None = None
    ):
        self._name = f"NV200 at {host}"
        self._asked, self._one_request = False, threading.Lock()
        self._setting = asyncio.Lock()
        self._written: tuple[float, ...] = ()
        transport = _library("telnet_protocol").TelnetProtocol(host, port)
        self._device = _library("nv200_device").NV200Device(transport)
        self._generator = _library("waveform_generator").WaveformGenerator(self._device)
        self._recorder = _library("data_recorder").DataRecorder(self._device)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._do(self._begin(largest_error))
        except BaseException:
            self.close()
            raise

    def run(self, reference: Float[np.ndarray, " samples"], gains: Gains) -> Record:
        """Follow ``reference`` (um) with ``gains``, as ``Stage.run`` describes.

        Each point is held for the fewest samples with which 1024 points suffice. Raises
        ValueError for fewer than 2 or more than 6144 samples, and for a reference
        outside the range.
        """
        reference = np.asarray(reference, dtype=float)
        if reference.ndim != 1 or not np.all(np.isfinite(reference)):
            raise ValueError("reference must be a row of numbers, in um")
        if not 2 <= reference.size <= SAMPLES:
            raise ValueError(
                f"the reference has {reference.size} samples; the NV200 records 2 to "
                f"{SAMPLES} ({1e3 * SAMPLES * SAMPLE:g} ms)"
            )
        low, high = self._range
        if np.min(reference) < low or np.max(reference) > high:
            raise ValueError(
                f"the reference goes from {np.min(reference):.6g} to "
                f"{np.max(reference):.6g} um; the range is {low:g} to {high:g} um"
            )
        with self._one_request:  # a later request stops the run, even in ``apply``
            self._asked = False
        self.apply(gains)
        return self._do(self._follow(reference))

    def apply(self, gains: Gains) -> None:
        """Set ``gains``; values that the device has already are not written again."""
        self._do(self._set(_texts(gains)))

    def gains(self) -> dict[str, float]:
        """Return the gains that are set."""
        return _numbers(self._do(self._values()))

    def safe(self) -> None:
        """Stop a run under way, set the safe gains and move to the safe position."""
        with self._one_request:
            self._asked = True
            self._do(self._retreat())

    def close(self) -> None:
        """End the connection; the stage keeps its gains."""
        if not self._loop.is_running():
            return
        with contextlib.suppress(StageError):
            self._do(self._device.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def abandon(self) -> None:
        """Make the stage safe, if it can be reached, and end the connection."""
        with contextlib.suppress(StageError):
            self.safe()
        self.close()

    def _do(self, work: Coroutine) -> Any:
        """Run ``work`` in the thread of the connection, and return its result."""
        if not self._loop.is_running():
            work.close()
            raise LostError(f"{self._name}: the connection is closed")
        waiting: Future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return waiting.result()
        except (OSError, EOFError, AttributeError) as error:
            # AttributeError: after a lost connection the library has no reader.
            why = str(error) or type(error).__name__
            raise LostError(f"{self._name}: no connection: {why}") from error
        except _library("shared_types").DeviceError as error:
            raise StageError(f"{self._name}: {error}") from error
        except KeyboardInterrupt:
            waiting.cancel()
            raise

    async def _begin(self, largest_error: float | None) -> None:
        await self._device.connect(auto_adjust_comm_params=False)
        if not await self._device.pid.is_closed_loop():
            raise ValueError(
                f"{self._name}: the loop is open; close it with gains that hold "
                "(cl,1), then connect"
            )
        unit = await self._device.get_position_unit()
        if unit.replace("µ", "u").replace("μ", "u").strip() != "um":
            raise ValueError(f"{self._name}: the position is in {unit}, not in um")
        self._range = await self._device.get_position_range()
        self._voltages = await self._device.get_voltage_range()
        self._largest = largest_error or SHARE * float(np.ptp(self._range))
        self._safe_gains = _numbers(await self._values())
        self._safe_position = await self._device.get_setpoint()

    async def _values(self) -> dict[str, str]:
        """Return the values as the device prints them now."""
        single = [(await self._device.read_values(name))[0] for name in SINGLE]
        feedforward = await self._device.read_values("pcf")
        return dict(zip(NAMES, [*single, *feedforward], strict=True))

    async def _set(self, texts: Mapping[str, str]) -> None:
        """Send the values that differ, and check that the device keeps them."""
        async with self._setting:
            await self._send(texts)

    async def _send(self, texts: Mapping[str, str]) -> None:
        now = _numbers(await self._values())
        changed = {
            name: text
            for name, text in texts.items()
            if not math.isclose(now[name], float(text), rel_tol=1e-6, abs_tol=1e-12)
        }
        feedforward = [changed.pop(name, "") for name in FEEDFORWARD]
        # The device limits the width of the notch to twice its frequency.
        wider = "notchb" in changed and float(changed["notchb"]) > now["notchb"]
        first, last = ("notchf", "notchb") if wider else ("notchb", "notchf")
        for name in (first, last, *changed):
            if name in changed:
                await self._device.write(f"{name},{changed.pop(name)}")
        if any(feedforward):
            known = [_text(name, now[name]) for name in FEEDFORWARD]
            sent = [new or old for new, old in zip(feedforward, known, strict=True)]
            await self._device.write(f"pcf,{','.join(sent)}")
        kept = await self._values()
        for name, text in texts.items():
            printed = 10.0 ** -len(kept[name].strip().partition(".")[2])
            if abs(float(kept[name]) - float(text)) > 0.501 * printed:
                raise StageError(
                    f"{self._name} keeps {name} at {kept[name].strip()} instead of "
                    f"{text}"
                )

    async def _move(self, position: float) -> None:
        # The setpoint takes effect with modsrc: the other order would move twice.
        await self._device.write(f"set,{position:.4f}")
        await self._device.write("modsrc,0")

    async def _retreat(self) -> None:
        await self._generator.stop()
        await self._set({n: _text(n, value) for n, value in self._safe_gains.items()})
        await self._move(self._safe_position)

    async def _stop_if_asked(self) -> None:
        """Raise StoppedError without samples before a run, if ``safe`` was called."""
        if self._asked:
            await self._retreat()
            raise StoppedError(ASKED, *np.zeros((3, 0)))

    async def _follow(self, reference: np.ndarray) -> Record:
        await self._stop_if_asked()
        hold = math.ceil(reference.size / POINTS)
        low, high = self._range
        percent = 100.0 * (reference[::hold] - low) / (high - low)
        points = np.round(np.round(percent / RESOLUTION) * RESOLUTION, 4)
        await self._move(reference[0])
        await self._write_points(tuple(points.tolist()), hold)
        await asyncio.sleep(REST)
        await self._start_recorder(reference.size)
        await self._stop_if_asked()
        await self._generator.start(cycles=1)
        reason = await self._watched(reference.size * SAMPLE)
        if not self._asked:  # else the stage moves to its safe position
            await self._move(reference[-1])
        await self._recorder.stop_recording()
        columns = await self._recorder.read_recorded_data()
        measured, voltage = (np.array(column.values) for column in columns)
        samples = min(len(measured), len(voltage), reference.size)
        measured, voltage = measured[:samples], voltage[:samples]
        held = np.repeat(low + points * (high - low) / 100.0, hold)[:samples]
        asked = ASKED if self._asked else ""
        reason = reason or asked or self._judged(held, measured, voltage)
        if reason:
            # Also if ``safe`` does it: its commands may have come before those above.
            await self._retreat()
            raise StoppedError(reason, held, measured, voltage)
        about = {"source": self._name, "reference": held}
        return Record(voltage, measured, SAMPLE, **about)

    async def _write_points(self, points: tuple[float, ...], hold: int) -> None:
        if (*points, hold) == self._written:
            return
        self._written = ()
        data = self._generator.WaveformData(list(points), 1e3 * SAMPLE * hold)
        await self._generator.set_waveform(data)
        self._written = (*points, hold)

    async def _start_recorder(self, samples: int) -> None:
        recorder, known = self._recorder, _library("data_recorder")
        sources, modes = known.DataRecorderSource, known.RecorderAutoStartMode
        await recorder.set_data_source(0, sources.PIEZO_POSITION)
        await recorder.set_data_source(1, sources.PIEZO_VOLTAGE)
        await recorder.set_autostart_mode(modes.START_ON_WAVEFORM_GEN_RUN)
        await recorder.set_recorder_stride(1)
        await recorder.set_sample_buffer_size(samples)

    async def _watched(self, duration: float) -> str:
        """Wait until the run ends; return the reason if it was stopped."""
        end = self._loop.time() + duration + MARGIN
        while await self._generator.is_running():
            if self._asked:
                await self._generator.stop()
                return ASKED
            status = await self._device.read_int_value("stat")
            reasons = [why for bit, why in FAULTS.items() if status & (1 << bit)]
            if reasons or self._loop.time() > end:
                await self._generator.stop()
                return reasons[0] if reasons else "the run does not end"
            await asyncio.sleep(POLL)
        return ""

    def _judged(
        self, reference: np.ndarray, measured: np.ndarray, voltage: np.ndarray
    ) -> str:
        """Return why a guard would have stopped the run, "" if it would not."""
        low, high = self._voltages
        slack = 1e-3 * (high - low)
        at_limit = (voltage <= low + slack) | (voltage >= high - slack)
        if np.sum(at_limit) >= PATIENCE:
            return "the voltage is at a limit"
        large = np.abs(reference - measured) > self._largest
        ends = np.flatnonzero(np.diff(np.r_[0, large.astype(int), 0]))
        if np.max(ends[1::2] - ends[::2], initial=0) >= PATIENCE:
            return "the tracking error is too large"
        return ""


def _library(module: str) -> Any:
    try:
        return importlib.import_module(f"{LIBRARY}.{module}")
    except ImportError as error:
        raise ValueError(
            f"a stage nv200 needs the vendor's library: pip install {LIBRARY} "
            f"(Python 3.12 or 3.13); {error}"
        ) from None


def _numbers(texts: Mapping[str, str]) -> dict[str, float]:
    return {name: float(text) for name, text in texts.items()}


_DECLARED = dict(declarations(NV200))


def _texts(gains: Gains) -> dict[str, str]:
    """Return ``gains`` as the texts of their commands.

    Raises ValueError for an unknown name or a value out of range.
    """
    found = {}
    for name, value in gains.items():
        if name not in NAMES:
            raise ValueError(f"the NV200 has no gain {name}; it has {', '.join(NAMES)}")
        _DECLARED[name].check(name, float(value))
        found[name] = _text(name, float(value))
    return found


def _text(name: str, value: float) -> str:
    """Return ``value`` without an exponent, which the device may not read."""
    step = _DECLARED[name].step
    if step is None:
        return np.format_float_positional(
            value, precision=DIGITS, fractional=False, trim="-"
        )
    return f"{value:.{max(0, -math.floor(math.log10(step)))}f}"


def nv200_stage(address: str) -> NV200Stage:
    """Return the stage at ``address``, "host" or "host:port"."""
    host, _, port = address.partition(":")
    if not host or (port and not port.isdigit()):
        raise ValueError(f"--stage nv200:{address}: give nv200:host or nv200:host:port")
    return NV200Stage(host, int(port or PORT))
