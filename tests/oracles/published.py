"""Numbers printed in thesis Chapter 5, for a P-753 actuator at 20 kHz."""

RATE = 20000.0  # Hz
LIMITS = (-20.0, 120.0)  # V; the actuator's range, not in the thesis

HYSTERESIS = (0.0077, 0.1167, -0.0487)  # a, b, c
KE = 0.1347  # um/V

# (5.33): force to displacement (DC gain 0.729). (5.34): voltage to
# displacement. In the form y(k) = a1 y(k-1) + a2 y(k-2) + b0 u(k) + ...
MODEL_533_A = (1.6035, -0.61995)
MODEL_533_B = (0.0050811, -0.0036354, 0.010553)
MODEL_534_A = (1.6076, -0.61956)
MODEL_534_B = (0.00071058, -0.00047055, 0.0012609)

M = 18000.0  # S = [m, 1], 1/s
ALPHA = 0.1
BETA = 1e-4
CUTOFF = 500.0  # rad/s

# Table 5-2: one set for all three controllers.
GAINS_5_2 = {"P": 0.01, "I": 30.0, "D": 1e-6, "Q": 1.0, "R": 100.0}

# Table 5-4: one set for each.
GAINS_5_4 = {
    "smc": {"P": 0.01, "I": 60.0, "D": 1e-6, "Q": 1.0, "R": 100.0},
    "inversion": {"P": 0.001, "I": 10.0, "D": 1e-6, "Q": 1.0, "R": 100.0},
    "dob": {"P": 0.05, "I": 12.0, "D": 1e-6, "Q": 1.0, "R": 100.0},
}


def unit_dc(a, b):
    """Return the numerator b scaled so that sum(b) = 1 - sum(a): unit DC gain."""
    scale = (1.0 - sum(a)) / sum(b)
    return tuple(scale * value for value in b)


# T2: the assumed true dynamics behind the hysteresis.
T2_P = MODEL_533_A
T2_G = unit_dc(MODEL_533_A, MODEL_533_B)


def plant_t2(step="exact", delay=0):
    """Return the plant dictionary of T2 for `loop.closed_loop`."""
    return {
        "hysteresis": HYSTERESIS,
        "step": step,
        "p": T2_P,
        "g": T2_G,
        "delay": delay,
    }


def smc_gains(kind, table):
    """Return the gains of kind "smc", "inversion", "dob" for table "5-3" or "5-5".

    Table 5-3 was run with the gains of Table 5-2, Table 5-5 with those of
    Table 5-4. The nominal controller is built on (5.34), the others on (5.33).
    """
    printed = {"5-3": GAINS_5_2, "5-5": GAINS_5_4[kind]}[table]
    gains = dict(printed)
    gains.update(m=M, alpha=ALPHA, beta=BETA, cutoff=CUTOFF, Ke=KE)
    gains.update(hysteresis=HYSTERESIS)
    if kind == "smc":
        gains.update(model_a=MODEL_534_A, model_b=MODEL_534_B)
    else:
        gains.update(model_a=MODEL_533_A, model_b=MODEL_533_B)
    return gains


def table_duration(name):
    """Return the length (s) of the run of a cell; half has whole periods of SIN, SW.

    It is not in the thesis. SW10 repeats after 2 s, SW30 after 0.67 s.
    """
    return 4.0 if name == "SW10" else 2.0
