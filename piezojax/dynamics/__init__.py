"""Dynamics: linear ones that follow the hysteresis, and those that contain it."""

from .arma import ARMA as ARMA
from .arma import scaled_to_dc as scaled_to_dc
from .hysteretic_oscillator import HystereticOscillator as HystereticOscillator
from .lag import FirstOrderLag as FirstOrderLag
from .neural_state_space import NeuralStateSpace as NeuralStateSpace
