"""References: waveforms of one axis, motions of several, contours in the plane."""

from . import contours as contours
from . import motions as motions
from .contour_error import ContourError as ContourError
from .waveforms import SIGNALS as SIGNALS
from .waveforms import THESIS as THESIS
from .waveforms import Time as Time
from .waveforms import chirp as chirp
from .waveforms import constant as constant
from .waveforms import cosine as cosine
from .waveforms import multisine as multisine
from .waveforms import parse as parse
from .waveforms import piecewise_sine as piecewise_sine
from .waveforms import prbs as prbs
from .waveforms import scan as scan
from .waveforms import signal as signal
from .waveforms import sine as sine
from .waveforms import square as square
from .waveforms import step as step
from .waveforms import superposed_sine as superposed_sine
from .waveforms import time_grid as time_grid
from .waveforms import triangle as triangle
