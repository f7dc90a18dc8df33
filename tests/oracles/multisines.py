"""Records of a resonance behind a weak cubic nonlinearity, driven by multisines.

The resonance is discretised by SciPy for a held input. A cubic of a normal input u of
variance 1 has the best linear approximation ``1 + 3 cubic`` (Bussgang); a multisine of
random phases with many lines is nearly normal.
"""

import numpy as np
import scipy.signal

DT, PERIOD = 1e-4, 1000
W, ZETA, LINES = 2.0 * np.pi * 700.0, 0.1, np.arange(3, 300)
B, A, _ = scipy.signal.cont2discrete(([W**2], [1.0, 2.0 * ZETA * W, W**2]), DT)
B = B.ravel()


def exact(frequency, cubic=0.0):
    """Return the exact response at ``frequency`` (Hz)."""
    turn = 2.0 * np.pi * frequency * DT
    return (1.0 + 3.0 * cubic) * scipy.signal.freqz(B, A, turn)[1]


def multisine(random):
    """Return one period of a multisine of random phases with rms value 1."""
    spectrum = np.zeros(PERIOD // 2 + 1, complex)
    spectrum[LINES] = np.exp(2j * np.pi * random.uniform(size=LINES.size))
    signal = np.fft.irfft(spectrum, PERIOD)
    return signal / np.std(signal)


def output(input, random, cubic=0.0, noise=0.0):
    """Return the output, at rest before the record."""
    driven = input + cubic * input**3
    clean = scipy.signal.lfilter(B, A, driven)
    return clean + noise * random.standard_normal(input.size)
