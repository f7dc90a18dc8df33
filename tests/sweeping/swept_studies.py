"""A study that compiles and runs quickly, and a grid of its parameters."""

from study_tables import PID_ON_LAG

PARAMETERS = {
    "controller.proportional": {"lower": 0.1, "upper": 5.0, "scale": "log"},
    "controller.integral": {"lower": 100.0, "upper": 2e4, "scale": "log"},
}
GRID = {
    "metrics": ["rms_error", "peak_voltage"],
    "parameters": {
        "controller.proportional": {"values": [0.1, 0.5, 1.0, 2.0, 4.0]},
        "plant.time_constant": {
            "lower": 5e-4,
            "upper": 2e-3,
            "count": 3,
            "scale": "log",
        },
    },
}


def study_of(sweep, **changes):
    """Return a study of a PID on a lag, which compiles quickly and runs in 1 ms."""
    study = (
        PID_ON_LAG
        | {
            "references": {
                "tune": ["SIN50"],
                "unseen": ["SW50"],
                "duration": 0.02,
                "settle": 0.005,
            },
            "parameters": PARAMETERS,
        }
        | changes
    )
    return study | ({} if sweep is None else {"sweep": sweep})
