"""Simulate the digital servo loops of piezo controllers, one sample at a time.

The loops are plain float arithmetic: an oracle for tests of other implementations.
Positions are in um, the command in V, frequencies in Hz and times in s.
"""

import math

import numpy as np

OFF_SLEW_NV200 = 2000.0
BUTTERWORTH = math.sqrt(0.5)


class Filter:
    """Run a filter b(z)/a(z) of order 1 or 2 in transposed direct form II."""

    def __init__(self, b, a):
        """Normalise the coefficients by a[0] and pad them to order 2."""
        padding = [0.0] * (3 - len(a))
        self.b = [float(value) / float(a[0]) for value in [*b, *padding]]
        self.a = [float(value) / float(a[0]) for value in [*a, *padding]]
        self.state_1 = self.state_2 = 0.0

    def settle(self, x):
        """Set the states to the steady state of a constant input; return the output."""
        y = x * math.fsum(self.b) / math.fsum(self.a)
        self.state_2 = self.b[2] * x - self.a[2] * y
        self.state_1 = self.b[1] * x - self.a[1] * y + self.state_2
        return y

    def step(self, x):
        """Return the output of this sample."""
        y = self.b[0] * x + self.state_1
        self.state_1 = self.b[1] * x - self.a[1] * y + self.state_2
        self.state_2 = self.b[2] * x - self.a[2] * y
        return y


def low_pass_1(frequency, dt):
    """Return a first-order low-pass, bilinear, prewarped at its frequency."""
    k = math.tan(math.pi * frequency * dt)
    return Filter([k, k], [1.0 + k, k - 1.0])


def low_pass_2(frequency, dt, quality=BUTTERWORTH):
    """Return a second-order low-pass, bilinear, prewarped at its frequency."""
    k = math.tan(math.pi * frequency * dt)
    b = [k * k, 2.0 * k * k, k * k]
    return Filter(
        b, [1.0 + k / quality + k * k, 2.0 * (k * k - 1.0), 1.0 - k / quality + k * k]
    )


def low_pass_4(frequency, dt, kind):
    """Return the sections of a fourth-order low-pass, -3 dB at its frequency."""
    if kind == "butterworth":
        qualities = [0.5 / math.cos(math.pi / 8), 0.5 / math.cos(3 * math.pi / 8)]
        return [low_pass_2(frequency, dt, quality) for quality in qualities]
    if kind == "equal poles":
        k = math.tan(math.pi * frequency * dt) / math.sqrt(2.0**0.25 - 1.0)
        return [Filter([k, k], [1.0 + k, k - 1.0]) for _ in range(4)]
    raise ValueError(f"unknown low-pass {kind!r}")


def notch(frequency, width, depth, dt):
    """Return a notch with centre gain ``depth``, bilinear, prewarped at its centre."""
    k = math.tan(math.pi * frequency * dt)
    damping = k * width / frequency
    b = [
        1.0 + depth * damping + k * k,
        2.0 * (k * k - 1.0),
        1.0 - depth * damping + k * k,
    ]
    return Filter(
        b, [1.0 + damping + k * k, 2.0 * (k * k - 1.0), 1.0 - damping + k * k]
    )


def matrix_exponential(matrix):
    """Return the exponential of a matrix by scaling, Taylor series and squaring."""
    norm = float(np.max(np.sum(np.abs(matrix), axis=1)))
    squarings = max(0, math.ceil(math.log2(norm)) + 3) if norm > 0.0 else 0
    scaled = matrix / 2.0**squarings
    term = np.eye(len(matrix))
    total = term.copy()
    for order in range(1, 20):
        term = term @ scaled / order
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


def notch_zero_order_hold(frequency, rejection, bandwidth, dt):
    """Return the zero-order-hold discretisation of the notch of law 1.

    The notch is 1 + c*x2 with c = 2(r - 1)k and the states x1' = w0*x2,
    x2' = w0*(-x1 - 2k*x2 + u), so x2 = w0*s*u/(s^2 + 2k*w0*s + w0^2).
    """
    block = np.array([[0.0, 1.0, 0.0], [-1.0, -2.0 * bandwidth, 1.0], [0.0, 0.0, 0.0]])
    held = matrix_exponential(2.0 * math.pi * frequency * dt * block)
    (a11, a12, b1), (a21, a22, b2) = held[0].tolist(), held[1].tolist()
    c = 2.0 * (rejection - 1.0) * bandwidth
    a = [1.0, -(a11 + a22), a11 * a22 - a12 * a21]
    b = [1.0, a[1] + c * b2, a[2] + c * (a21 * b1 - a11 * b2)]
    return Filter(b, a)


def settle(filters, value):
    """Settle filters in series at a constant input; return their output."""
    for each in filters:
        value = each.settle(value)
    return value


def run(filters, value):
    """Step filters in series; return their output."""
    for each in filters:
        value = each.step(value)
    return value


class Slew:
    """Limit the change of a signal per sample."""

    def __init__(self, start, largest_change):
        self.value, self.largest_change = start, largest_change

    def step(self, target):
        """Return the limited signal of this sample."""
        change = target - self.value
        if abs(change) <= self.largest_change:
            self.value = target
        else:
            self.value += math.copysign(self.largest_change, change)
        return self.value


class Command:
    """Hold the integral (V), the output filters, the limits and the anti-windup."""

    def __init__(self, applied, direct, filters, lower, upper, anti_windup):
        """Start at rest: ``direct`` plus the integral equals ``applied``."""
        if anti_windup not in ("none", "hold"):
            raise ValueError(f"unknown anti-windup {anti_windup!r}")
        self.integral = applied - direct
        self.filters, self.lower, self.upper = filters, lower, upper
        self.hold = anti_windup == "hold"
        settle(filters, applied)

    def step(self, direct, change):
        """Return the clipped voltage; ``change`` is that of the integral (V)."""
        integral = self.integral + change
        output = run(self.filters, direct + integral)
        winds_up = output > self.upper and change > 0.0
        winds_down = output < self.lower and change < 0.0
        if not (self.hold and (winds_up or winds_down)):
            self.integral = integral
        return min(max(output, self.lower), self.upper)


class NV200:
    """Simulate the closed loop of the NV200 controller at 20 kHz."""

    dt = 50e-6

    def __init__(
        self,
        reference,
        measured,
        applied,
        *,
        kp=0.0,
        ki=0.0,
        kd=0.0,
        pcf_x=0.0,
        pcf_v=0.0,
        pcf_a=0.0,
        sr=OFF_SLEW_NV200,
        setlpon=False,
        setlpf=None,
        poslpon=False,
        poslpf=None,
        notchon=False,
        notchf=None,
        notchb=None,
        scale=1.0,
        stroke=None,
        lower=-math.inf,
        upper=math.inf,
        integration="rectangular",
        low_pass="butterworth",
        depth=0.0,
        anti_windup="none",
    ):
        """Start at rest; ``stroke`` is needed if ``sr`` is below 2000."""
        if integration not in ("rectangular", "trapezoidal", "half"):
            raise ValueError(f"unknown integration {integration!r}")
        dt = self.dt
        self.kp, self.ki, self.kd = scale * kp, scale * ki, scale * kd
        self.pcf_x, self.pcf_v = scale * pcf_x, scale * pcf_v
        self.pcf_a = scale * pcf_a * 1e-6
        self.integration = integration
        off = sr >= OFF_SLEW_NV200
        self.slew = Slew(reference, math.inf if off else sr / 100 * stroke * dt * 1000)
        self.set_filters = low_pass_4(setlpf, dt, low_pass) if setlpon else []
        self.position_filters = [low_pass_1(poslpf, dt)] if poslpon else []
        r = settle(self.set_filters, reference)
        self.last_error = r - settle(self.position_filters, measured)
        self.last_set, self.last_velocity = reference, 0.0
        filters = [notch(notchf, notchb, depth, dt)] if notchon else []
        direct = self.pcf_x * r + self.kp * self.last_error
        self.command = Command(applied, direct, filters, lower, upper, anti_windup)

    def step(self, reference, measured):
        """Return the voltage of this sample."""
        velocity = (reference - self.last_set) / self.dt
        acceleration = (velocity - self.last_velocity) / self.dt
        self.last_set, self.last_velocity = reference, velocity
        r = run(self.set_filters, self.slew.step(reference))
        error = r - run(self.position_filters, measured)
        if self.integration == "rectangular":
            change = self.ki * self.dt * error
        elif self.integration == "trapezoidal":
            change = self.ki * self.dt / 2 * (error + self.last_error)
        else:
            change = self.ki * self.dt / 2 * error
        direct = self.pcf_x * r + self.pcf_v * velocity + self.pcf_a * acceleration
        direct += self.kp * error + self.kd / self.dt * (error - self.last_error)
        self.last_error = error
        return self.command.step(direct, change)


class E727:
    """Simulate the closed loop of the E-727 controller at 20 kHz."""

    dt = 50e-6

    def __init__(
        self,
        reference,
        measured,
        applied,
        *,
        P=0.0,
        I=0.0,  # noqa: E741
        D=0.0,
        scale=1.0,
        structure="series",
        notch_frequency_1=None,
        notch_rejection_1=1.0,
        notch_bandwidth_1=1.0,
        notch_frequency_2=None,
        notch_rejection_2=1.0,
        notch_bandwidth_2=1.0,
        method=0,
        law=1,
        filter_type=0,
        filter_frequency=None,
        slew=math.inf,
        lower=-math.inf,
        upper=math.inf,
        anti_windup="none",
    ):
        """Start at rest; a rejection of 1 switches a notch off."""
        if structure not in ("series", "parallel"):
            raise ValueError(f"unknown structure {structure!r}")
        if method not in (0, 1) or law != 1 or filter_type not in (0, 1):
            raise ValueError("only methods 0 and 1, law 1 and filter types 0 and 1")
        dt = self.dt
        outer = scale * P if structure == "series" else scale
        self.proportional = scale * P
        self.change_per_error = outer * dt / I if I != 0.0 else 0.0
        self.derivative = outer * D / dt
        self.slew = Slew(reference, slew * dt)
        measured_filters = [low_pass_2(filter_frequency, dt)] if filter_type else []
        self.position_filters = measured_filters
        self.last_error = reference - settle(measured_filters, measured)
        filters = []
        for f0, r, k in (
            (notch_frequency_1, notch_rejection_1, notch_bandwidth_1),
            (notch_frequency_2, notch_rejection_2, notch_bandwidth_2),
        ):
            if r != 1.0 and method == 0:
                filters.append(notch(f0, 2.0 * k * f0, r, dt))
            elif r != 1.0:
                filters.append(notch_zero_order_hold(f0, r, k, dt))
        direct = self.proportional * self.last_error
        self.command = Command(applied, direct, filters, lower, upper, anti_windup)

    def step(self, reference, measured):
        """Return the voltage of this sample."""
        error = self.slew.step(reference) - run(self.position_filters, measured)
        direct = self.proportional * error
        direct += self.derivative * (error - self.last_error)
        self.last_error = error
        return self.command.step(direct, self.change_per_error * error)


class GenericServo:
    """Simulate a digital PID servo with feedforward, notches and a low-pass."""

    def __init__(
        self,
        reference,
        measured,
        applied,
        *,
        dt,
        form="parallel",
        kp=0.0,
        ki=0.0,
        kd=0.0,
        gain=0.0,
        ti=None,
        td=0.0,
        feedforward=0.0,
        slew=math.inf,
        notch_frequency_1=None,
        notch_width_1=None,
        notch_depth_1=0.0,
        notch_frequency_2=None,
        notch_width_2=None,
        notch_depth_2=0.0,
        low_pass_frequency=None,
        low_pass_order=2,
        lower=-math.inf,
        upper=math.inf,
        anti_windup="none",
    ):
        """Start at rest; ``ti`` of None, 0 or infinity switches the integral off."""
        if form not in ("parallel", "standard") or low_pass_order not in (1, 2):
            raise ValueError(f"unknown form {form!r} or low-pass order")
        if form == "standard":
            kp, ki, kd = gain, (gain / ti if ti else 0.0), gain * td
        self.dt, self.kp, self.ki, self.kd = dt, kp, ki, kd
        self.feedforward = feedforward
        self.slew = Slew(reference, slew * dt)
        self.last_error = reference - measured
        filters = []
        if notch_frequency_1 is not None:
            filters.append(notch(notch_frequency_1, notch_width_1, notch_depth_1, dt))
        if notch_frequency_2 is not None:
            filters.append(notch(notch_frequency_2, notch_width_2, notch_depth_2, dt))
        if low_pass_frequency is not None:
            make = low_pass_1 if low_pass_order == 1 else low_pass_2
            filters.append(make(low_pass_frequency, dt))
        direct = feedforward * reference + kp * self.last_error
        self.command = Command(applied, direct, filters, lower, upper, anti_windup)

    def step(self, reference, measured):
        """Return the voltage of this sample."""
        target = self.slew.step(reference)
        error = target - measured
        direct = self.feedforward * target + self.kp * error
        direct += self.kd / self.dt * (error - self.last_error)
        self.last_error = error
        return self.command.step(direct, self.ki * self.dt * error)


class Stabilizer:
    """Simulate one channel of a Stabilizer: a biquad in single precision.

    The gains are those of its PID representation of order I, the signals in V at the
    converters; 1 V of the output gives ``volts`` at the piezo.
    """

    CODES = np.float32(3200.0)

    def __init__(
        self,
        reference,
        measured,
        applied,
        *,
        p,
        i,
        d=0.0,
        limit_i=math.inf,
        limit_d=math.inf,
        minimum=-10.0,
        maximum=10.0,
        sensor,
        volts,
        offset=0.0,
        dt=1.28e-6,
    ):
        """Begin at rest."""
        one, tick = np.float32(1.0), np.float32(dt)
        sign = np.copysign(1.0, p)
        power = one / tick
        gain_d = np.float32(sign * d) * power
        loss_d = gain_d / np.float32(sign * limit_d)
        power = power * tick
        gain_p, loss_p = np.float32(p) * power, one
        power = power * tick
        gain_i = np.float32(sign * i) * power
        loss_i = gain_i / np.float32(sign * limit_i)
        share = one / (loss_i + loss_p + loss_d)
        gain_i, gain_p, gain_d = gain_i * share, gain_p * share, gain_d * share
        loss_p, loss_d = loss_p * share, loss_d * share
        self.b = [gain_i + gain_p + gain_d, -gain_p - gain_d - gain_d, gain_d]
        self.a = [loss_p + loss_d + loss_d, -loss_d]
        self.sensor, self.volts, self.offset = sensor, volts, offset
        self.ends = self.CODES * np.float32(minimum), self.CODES * np.float32(maximum)
        self.x = [np.float32(3200.0 * sensor * measured)] * 2
        self.y = [np.float32((applied - offset) / (volts / 3200.0))] * 2
        assert all(c.dtype == np.float32 for c in (*self.b, *self.a, *self.x, *self.y))

    def step(self, reference, measured):
        """Return the voltage of this sample."""
        x = np.float32(3200.0 * self.sensor * measured)
        (b0, b1, b2), (a1, a2) = self.b, self.a
        y = b0 * x + b1 * self.x[0] + b2 * self.x[1]
        y = y + a1 * self.y[0] + a2 * self.y[1]
        y = y - np.float32(3200.0 * self.sensor * reference) * (b0 + b1 + b2)
        y = min(max(y, self.ends[0]), self.ends[1])
        assert y.dtype == np.float32
        self.x, self.y = [x, self.x[0]], [y, self.y[0]]
        return self.offset + self.volts / 3200.0 * float(y)


class RedPitaya:
    """Simulate the PID module of PyRPL, sampled slowly, with its registers."""

    CLOCK = 8e-9

    def __init__(
        self,
        reference,
        measured,
        applied,
        *,
        p,
        i,
        sensor,
        volts,
        offset=0.0,
        cutoffs=(),
        minimum=-1.0,
        maximum=1.0,
        dt,
    ):
        """Begin at rest."""
        self.p = round(p * 2**12) / 2**12
        register = round(i * 2**32 * 2.0 * math.pi * self.CLOCK)
        # In a cycle the integral grows by the error times register / 2^32.
        self.rise = register / 2**32 * (dt / self.CLOCK)
        base = 1.0 / (2.0 * math.pi * self.CLOCK)
        self.filters = [
            low_pass_1(base / 2 ** round(math.log2(base / cutoff)), dt)
            for cutoff in cutoffs
        ]
        for each in self.filters:
            each.settle(sensor * measured)
        self.sensor, self.volts, self.offset = sensor, volts, offset
        self.ends = minimum, maximum
        error = sensor * (measured - reference)
        self.sum = (applied - offset) / volts - self.p * error

    def step(self, reference, measured):
        """Return the voltage of this sample."""
        found = self.sensor * measured
        for each in self.filters:
            found = each.step(found)
        error = found - self.sensor * reference
        self.sum = min(max(self.sum + self.rise * error, -4.0), 4.0)
        output = min(max(self.p * error + self.sum, self.ends[0]), self.ends[1])
        return self.offset + self.volts * output
