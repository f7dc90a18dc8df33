"""Functions in C that compilers can compute for many lanes at once.

Those of libm take one number, which keeps a loop over lanes from becoming SIMD. The
functions here have no branches and no tables. Compilers that know the attribute
``simd`` write a version of each for vectors; others call the function for each lane. A
run of one lane calls libm, which is faster there.
"""

import math
from collections.abc import Iterable
from string import Template

FORMS = {
    "exp": "lane_exp({a})",
    "expm1": "lane_expm1({a})",
    "log": "lane_log({a})",
    "log1p": "lane_log1p({a})",
    "logistic": "1.0 / (1.0 + lane_exp(-{a}))",
    "pow": "lane_pow({a}, {b})",
    "tanh": "lane_tanh({a})",
}
"""Expressions of operations: operands a and b."""


def _series(at: str, denominators: Iterable[int]) -> str:
    """Return C for 1/d + at/d' + at^2/d'' ... with ``denominators`` d, last first."""
    first, *others = denominators
    return "\n".join(
        [
            f"    double series = 1.0 / {first}.0;",
            *(f"    series = series * {at} + 1.0 / {each}.0;" for each in others),
        ]
    )


# expm1(r) = r + r^2/2! + ... for |r| <= ln(2)/2, and for |f| <= sqrt(2) - 1
# log(1+f) = 2 artanh(s) with s = f/(2+f), artanh(s) = s + s^3/3 + ... Both end where
# their next term is below the rounding error. ln(2) is a sum of two numbers; the first
# has 11 zeros at its end, so that its products with exponents are exact.
SOURCE = Template("""
#if WIDTH == 1
INLINE double lane_exp(double x) { return exp(x); }
INLINE double lane_expm1(double x) { return expm1(x); }
INLINE double lane_log(double x) { return log(x); }
INLINE double lane_log1p(double x) { return log1p(x); }
INLINE double lane_tanh(double x) { return tanh(x); }
INLINE double lane_pow(double x, double y) { return pow(x, y); }
#else
#include <string.h>

#define FUNCTION static __attribute__((noinline, const, simd("notinbranch"))) double

INLINE uint64_t bits_of(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

INLINE double real_of(uint64_t bits)
{
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* exp(x) is the power of two times one plus the returned value. */
INLINE double divided(double x, double *power)
{
    /* The sum with 1.5 * 2^52 has the nearest integer in its last bits. */
    const double sum = x * 0x1.71547652b82fep0 + 0x1.8p52;
    const double n = sum - 0x1.8p52;
    const double r = (x - n * 0x1.62e42fefa38p-1) - n * 0x1.ef35793c7673p-45;
$expm1_series
    *power = real_of((bits_of(sum) + 1023) << 52);
    return series * r * r + r;
}

/* Half of an argument; the exponential of all of it may overflow, that of half not. */
INLINE double half_of(double x)
{
    const double most = x > 1400.0 ? 1400.0 : x;
    return 0.5 * (most < -1400.0 ? -1400.0 : most);
}

INLINE double exp_of(double x)
{
    double power;
    const double root = divided(half_of(x), &power) * power + power;
    return root * root;
}

INLINE double expm1_of(double x)
{
    double power;
    const double half = divided(half_of(x), &power) * power + (power - 1.0);
    return half * (half + 2.0);
}

INLINE double log_of(double x)
{
    const uint64_t bits = bits_of(x);
    /* x = 2^n (1 + f), with sqrt(1/2) <= 1 + f < sqrt(2). */
    const uint64_t exponent = (bits + (0x3ff0000000000000 - 0x3fe6a09e667f3bcd)) >> 52;
    const double n = real_of(exponent | 0x4330000000000000) - (0x1p52 + 1023.0);
    const double f = real_of(bits - (exponent << 52) + 0x3ff0000000000000) - 1.0;
    const double s = f / (f + 2.0), square = s * s;
$artanh_series
    /* 2 s = f - s f, and f is exact. */
    const double small = f - s * (f - 2.0 * square * series);
    const double found = n * 0x1.62e42fefa38p-1 + (small + n * 0x1.ef35793c7673p-45);
    const double edge = x == 0.0 ? -INFINITY : (x < 0.0 ? NAN : x);
    return (x > 0.0) & (x < INFINITY) ? found : edge;
}

FUNCTION lane_exp(double x)
{
    return exp_of(x);
}

FUNCTION lane_expm1(double x)
{
    return expm1_of(x);
}

FUNCTION lane_log(double x)
{
    return log_of(x);
}

FUNCTION lane_log1p(double x)
{
    const double sum = 1.0 + x;
    const double found = log_of(sum) + (x - (sum - 1.0)) / sum;
    const double edge = x == -1.0 ? -INFINITY : (x < -1.0 ? NAN : x);
    return (x > -1.0) & (x < INFINITY) ? found : edge;
}

FUNCTION lane_pow(double x, double y)
{
    const double size = exp_of(y * log_of(x < 0.0 ? -x : x));
    const bool whole = floor(y) == y, odd = floor(0.5 * y) != 0.5 * y;
    const double found = x < 0.0 ? (!whole ? NAN : (odd ? -size : size)) : size;
    return (y == 0.0) | (x == 1.0) ? 1.0 : found;
}

FUNCTION lane_tanh(double x)
{
    const double t = expm1_of(x < 0.0 ? 2.0 * x : -2.0 * x);
    const double size = -t / (t + 2.0);
    return x < 0.0 ? -size : size;
}
#endif
""").substitute(
    expm1_series=_series("r", map(math.factorial, range(13, 1, -1))),
    artanh_series=_series("square", range(21, 1, -2)),
)
"""Source of the functions, after the macros and headers of ``native_templates``.

Subnormal numbers count as 0: XLA lets the processor flush them."""
