"""An NV200 with values that its file rounds."""

from piezojax.control import NV200

RANGE = {"avmin": -20.0, "avmax": 130.0, "posmin": 0.0, "posmax": 80.0}
JENA = NV200(
    *(0.0204, 70.00049, 3e-3),
    **RANGE,
    **{"scale": 0.9, "pcf_x": 0.5634, "poslpf": 1234.5678, "sr": 8e-7, "poslpon": 1},
    **{"notchf": 811.4, "notchb": 399.6, "notchon": 1, "setlpf": 700.2},
)
