"""Vendors' controllers and a generic servo, with parameters as users type them in."""

from .device_designs import DEVICE_DESIGNS as DEVICE_DESIGNS
from .e727 import E727 as E727
from .nv200 import NV200 as NV200
from .pyrpl import PyRPL as PyRPL
from .servo import Servo as Servo
from .servo_loop import Device as Device
from .stabilizer import Stabilizer as Stabilizer
