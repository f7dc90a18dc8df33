"""Studies as tables: a small one, and copies with some of their values changed."""

import copy

PID_ON_LAG = {
    "title": "a PID on a lag",
    "rate": 20_000.0,
    "seed": 3,
    "plant": {"type": "FirstOrderLag", "time_constant": 1e-3, "dt": 5e-5},
    "actuator": {"lower": -20.0, "upper": 120.0},
    "sensor": {"noise_rms": 0.012},
    "controller": {"catalog": "p753_pid"},
}
"""Loop of a study that compiles quickly; it lacks references and parameters."""

GONE = object()
"""Value that removes its key."""


def with_values(tables, changes):
    """Return a copy of ``tables`` with ``{"table/key": value}``; GONE removes a key."""
    found = copy.deepcopy(tables)
    for place, value in changes.items():
        *names, key = place.split("/")
        table = found
        for name in names:
            table = table.setdefault(name, {})
        if value is GONE:
            del table[key]
        else:
            table[key] = value
    return found
