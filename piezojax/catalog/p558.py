"""The P-558.TCD stage (Physik Instrumente) with the axes Z (um), Rx and Ry (urad).

Commands have the units of the axes. Every number carries its equation in Y. Cao's
thesis (2013). The models describe the stage with its amplifiers, sampled every 2 ms;
each input channel was identified separately.
"""

import numpy as np

from ..dynamics import StateSpace, stacked

DT = 2e-3
"""Sample time of chapters 6 to 8, s."""

OUTPUTS = ("Z", "Rx", "Ry")
UNITS = ("um", "urad", "urad")

NOISE_RMS = (0.0008, 0.013, 0.013)
"""Sensor noise in um, urad, urad: not printed; the least errors of Tables 7-4, 8-2 and
8-3 are 0.0008 to 0.0009 um and 0.013 to 0.018 urad."""

CHAPTER_6 = (
    {
        "A": (
            (0.9239, -0.1747, 0.0057, -0.0297, -0.0026, -0.0045, -0.0004),
            (0.1757, 0.6973, 0.0604, -0.2463, -0.0262, -0.0333, -0.0031),
            (0.0219, -0.1592, 0.8761, -0.0622, -0.0504, -0.0266, 0.011),
            (-0.0291, 0.2297, 0.4, 0.4512, -0.1, 0.1691, 0.0169),
            (-0.0101, 0.0321, 0.095, -0.1506, 0.9447, 0.1266, 0.0155),
            (-0.0068, 0.0231, 0.0439, -0.3232, -0.1645, 0.6283, -0.0277),
            (-0.0044, 0.0093, 0.116, -0.085, 0.00008, -0.1766, 0.8136),
        ),
        "B": (0.3094, -0.2819, -0.0608, 0.0912, 0.0185, 0.0199, 0.0061),
        "C": (
            (0.3052, 0.2798, -0.0221, 0.0891, 0.0073, 0.0153, 0.0018),
            (0.0134, 0.0259, 0.0453, 0.0533, 0.0381, -0.0397, -0.0108),
            (0.0033, -0.0215, 0.0189, -0.0416, -0.0061, 0.0375, -0.0039),
        ),
    },
    {
        "A": (
            (0.9493, 0.1175, 0.0173, 0.0233),
            (-0.1161, 0.7929, -0.1205, -0.1509),
            (-0.0001, 0.072, 0.9273, -0.2011),
            (0.0238, 0.1573, 0.0285, 0.7314),
        ),
        "B": (0.2595, 0.2232, -0.0325, -0.0693),
        "C": (
            (-0.00002, -0.00001, -0.00002, -0.00024),
            (0.2402, -0.2215, -0.0502, -0.0687),
            (-0.0002, -0.00053, -0.00049, -0.0011),
        ),
    },
    {
        "A": (
            (0.9485, 0.1204, -0.0134, 0.0261),
            (-0.1184, 0.7981, 0.0779, -0.1711),
            (0.003, -0.0094, 0.9656, 0.1719),
            (0.0225, 0.1825, -0.0783, 0.711),
        ),
        "B": (-0.2574, -0.2229, -0.015, 0.0775),
        "C": (
            (-0.00002, -0.00001, -0.0001, -0.00022),
            (0.0043, -0.0018, -0.0031, -0.0028),
            (-0.239, 0.2205, -0.0376, 0.0762),
        ),
    },
)
"""(6.23)-(6.25), with 7, 4 and 4 states."""

CHAPTER_7 = (
    {
        "A": (
            (0.9235, 0.1738, 0.0103),
            (-0.1754, 0.6964, -0.0997),
            (0.024, 0.1912, 0.8276),
        ),
        "B": (-0.3125, -0.2797, 0.0717),
        "C": (
            (-0.308, 0.2794, 0.0363),
            (-0.0151, 0.0273, -0.0456),
            (-0.0028, -0.0224, -0.0224),
        ),
    },
    {
        "A": (
            (0.9739, -0.1057, -0.022),
            (0.2057, 0.7501, -0.1689),
            (0.024, 0.5491, 0.1313),
        ),
        "B": (-0.252, 0.1241, -0.076),
        "C": (
            (0.000057, 0.00011, -0.000004),
            (-0.1988, -0.1714, -0.0701),
            (0.0007, 0.00066, -0.0011),
        ),
    },
    {
        "A": (
            (0.9739, 0.1063, 0.0219),
            (-0.2048, 0.7502, -0.1684),
            (-0.0235, 0.5504, 0.1311),
        ),
        "B": (0.2534, 0.1251, -0.076),
        "C": (
            (-0.00005, 0.0001, 0.00005),
            (-0.0015, 0.0018, 0.00027),
            (0.1988, -0.172, -0.07),
        ),
    },
)
"""(7.53), with 3 states each."""

MODELS = {"6": CHAPTER_6, "7": CHAPTER_7}
"""Printed models by chapter."""


def channels(chapter: str = "7") -> tuple[StateSpace, ...]:
    """Return the models of the three input channels, Z, Rx and Ry.

    Raises ValueError for a chapter without printed models.
    """
    if chapter not in MODELS:
        raise ValueError(
            f"chapter {chapter!r} prints no model; "
            f"it must be one of {', '.join(MODELS)}"
        )
    return tuple(
        StateSpace(
            model["A"],
            np.reshape(model["B"], (-1, 1)),
            model["C"],
            np.zeros((3, 1)),
            DT,
        )
        for model in MODELS[chapter]
    )


def model(chapter: str = "7") -> StateSpace:
    """Return the stacked model with three inputs, ``y(k) = C x(k)``, (6.22), (7.52)."""
    return stacked(channels(chapter))
