/* The hysteresis models of piezojax in plain C: the yardstick of hysteresis.py.

   A model is two functions on W lanes at once and a line MODEL(name, N, M): its N
   parameters p, in the order of piezojax.paths.parameters, and its M numbers of state s.
   `start` puts it at its rest input, `step` takes x and gives y. MODEL makes of them

     name           mean square of y over a run, [lane]
     name_gradient  its gradient by one-sided differences, N + 1 runs, [N][lane]

   params [block][N][W], steps_of [block][N][W] (of the differences; 0 for no parameter),
   input [block][steps][W]; the last block is filled up with copies of a lane. */

#include <math.h>
#include <stddef.h>
#include <string.h>

#define W 16
#define LANES for (int l = 0; l < W; l++)
#define INLINE static inline __attribute__((always_inline))

typedef double row[W] __attribute__((aligned(64)));

int width(void) { return W; }

#define MODEL(NAME, N, M)                                                           \
    INLINE void NAME##_run(int steps, const row *p, const double *x, double *found) \
    {                                                                               \
        row s[M], y, total = {0};                                                   \
                                                                                    \
        NAME##_start(p, s);                                                         \
        for (int k = 0; k < steps; k++) {                                           \
            NAME##_step(p, s, x + (size_t)k * W, y);                                \
            LANES total[l] += y[l] * y[l];                                          \
        }                                                                           \
        LANES found[l] = total[l] / steps;                                          \
    }                                                                               \
                                                                                    \
    void NAME(int lanes, int steps, const double *params, const double *input,      \
              double *result)                                                       \
    {                                                                               \
        for (int done = 0; done < lanes; done += W) {                               \
            row p[N];                                                               \
                                                                                    \
            memcpy(p, params, sizeof p);                                            \
            NAME##_run(steps, p, input, result);                                    \
            params += (N) * W;                                                      \
            input += (size_t)steps * W;                                             \
            result += W;                                                            \
        }                                                                           \
    }                                                                               \
                                                                                    \
    void NAME##_gradient(int lanes, int steps, const double *params,                \
                         const double *steps_of, const double *input,               \
                         double *result)                                            \
    {                                                                               \
        for (int done = 0; done < lanes; done += W) {                               \
            row p[N], here, there;                                                  \
                                                                                    \
            memcpy(p, params, sizeof p);                                            \
            for (int i = -1; i < (N); i++) {                                        \
                if (i >= 0 && steps_of[i * W] == 0.0) { /* no parameter */          \
                    LANES result[i * W + l] = 0.0;                                  \
                    continue;                                                       \
                }                                                                   \
                if (i >= 0)                                                         \
                    LANES p[i][l] += steps_of[i * W + l];                           \
                NAME##_run(steps, p, input, i < 0 ? here : there);                  \
                if (i < 0)                                                          \
                    continue;                                                       \
                LANES result[i * W + l] = (there[l] - here[l]) / steps_of[i * W + l]; \
                LANES p[i][l] = params[i * W + l];                                  \
            }                                                                       \
            params += (N) * W;                                                      \
            steps_of += (N) * W;                                                    \
            input += (size_t)steps * W;                                             \
            result += (N) * W;                                                      \
        }                                                                           \
    }

/* y' = |x'| (a x + c y) + b x' by the trapezoid rule: a, b, c, rest x, rest y. */

INLINE void coleman_hodgdon_start(const row *p, row *s)
{
    LANES s[0][l] = p[3][l];
    LANES s[1][l] = p[4][l];
}

INLINE void coleman_hodgdon_step(const row *p, row *s, const double *x, double *y)
{
    LANES {
        const double dx = x[l] - s[0][l], size = fabs(dx), half = 0.5 * p[2][l] * size;
        const double force = 0.5 * p[0][l] * (x[l] + s[0][l]) * size + p[1][l] * dx;

        s[1][l] = y[l] = (force + (1.0 + half) * s[1][l]) / (1.0 - half);
        s[0][l] = x[l];
    }
}

MODEL(coleman_hodgdon, 5, 2)

/* The same with p(x) = p0 + p1 x + p2 x^2 + p3 x^3 for a x, g0 + g1 x + g2 x^2 for b:
   p0..p3, g0..g2, c, rest x, rest y. */

INLINE void shaped_coleman_hodgdon_start(const row *p, row *s)
{
    LANES s[0][l] = p[8][l];
    LANES s[1][l] = p[9][l];
}

INLINE double primitive(double c0, double c1, double c2, double c3, double x)
{
    return x * (c0 + x * (c1 * 0.5 + x * (c2 * (1.0 / 3.0) + x * c3 * 0.25)));
}

INLINE void shaped_coleman_hodgdon_step(const row *p, row *s, const double *x,
                                        double *y)
{
    LANES {
        const double u = s[0][l], dx = x[l] - u, sign = dx >= 0.0 ? 1.0 : -1.0;
        const double half = 0.5 * sign * p[7][l] * dx;
        const double pull = primitive(p[0][l], p[1][l], p[2][l], p[3][l], x[l])
                            - primitive(p[0][l], p[1][l], p[2][l], p[3][l], u);
        const double slope = primitive(p[4][l], p[5][l], p[6][l], 0.0, x[l])
                             - primitive(p[4][l], p[5][l], p[6][l], 0.0, u);

        s[1][l] = y[l] = (sign * pull + slope + (1.0 + half) * s[1][l]) / (1.0 - half);
        s[0][l] = x[l];
    }
}

MODEL(shaped_coleman_hodgdon, 10, 2)

/* Play operators: polynomial of 3, PLAYS thresholds, PLAYS weights, rest x. */

#define PLAYS 10

INLINE double played(double x, double r, double w)
{
    const double high = x + r, low = x - r, held = high < w ? high : w;

    return low > held ? low : held;
}

INLINE void prandtl_ishlinskii_start(const row *p, row *s)
{
    for (int i = 0; i < PLAYS; i++)
        LANES s[i][l] = p[3 + 2 * PLAYS][l];
}

INLINE void prandtl_ishlinskii_step(const row *p, row *s, const double *x, double *y)
{
    LANES y[l] = x[l] * (p[0][l] + x[l] * (p[1][l] + x[l] * p[2][l]));
    for (int i = 0; i < PLAYS; i++)
        LANES {
            s[i][l] = played(x[l], p[3 + i][l], s[i][l]);
            y[l] += p[3 + PLAYS + i][l] * s[i][l];
        }
}

MODEL(prandtl_ishlinskii, 4 + 2 * PLAYS, PLAYS)

/* The same and PLAYS skew weights, origin, scale before rest x: plays of
   max(x - origin, 0)^2 / (2 scale), too. */

INLINE double one_sided(double x, double origin, double scale)
{
    const double above = x - origin > 0.0 ? x - origin : 0.0;

    return 0.5 * above * above / scale;
}

INLINE void asymmetric_prandtl_ishlinskii_start(const row *p, row *s)
{
    const row *origin = p + 3 + 3 * PLAYS, *scale = origin + 1, *rest = origin + 2;

    for (int i = 0; i < PLAYS; i++)
        LANES {
            s[i][l] = (*rest)[l];
            s[PLAYS + i][l] = one_sided((*rest)[l], (*origin)[l], (*scale)[l]);
        }
}

INLINE void asymmetric_prandtl_ishlinskii_step(const row *p, row *s, const double *x,
                                               double *y)
{
    row q;

    prandtl_ishlinskii_step(p, s, x, y);
    LANES q[l] = one_sided(x[l], p[3 + 3 * PLAYS][l], p[4 + 3 * PLAYS][l]);
    for (int i = 0; i < PLAYS; i++)
        LANES {
            s[PLAYS + i][l] = played(q[l], p[3 + i][l], s[PLAYS + i][l]);
            y[l] += p[3 + 2 * PLAYS + i][l] * s[PLAYS + i][l];
        }
}

MODEL(asymmetric_prandtl_ishlinskii, 6 + 3 * PLAYS, 2 * PLAYS)

/* Stop operators: as plays. What they hold, and the last x. */

INLINE void stop_prandtl_ishlinskii_start(const row *p, row *s)
{
    for (int i = 0; i < PLAYS; i++)
        LANES s[i][l] = 0.0;
    LANES s[PLAYS][l] = p[3 + 2 * PLAYS][l];
}

INLINE void stop_prandtl_ishlinskii_step(const row *p, row *s, const double *x,
                                         double *y)
{
    row dx;

    LANES dx[l] = x[l] - s[PLAYS][l];
    LANES y[l] = x[l] * (p[0][l] + x[l] * (p[1][l] + x[l] * p[2][l]));
    for (int i = 0; i < PLAYS; i++)
        LANES {
            s[i][l] = played(0.0, p[3 + i][l], s[i][l] + dx[l]);
            y[l] -= p[3 + PLAYS + i][l] * s[i][l];
        }
    LANES s[PLAYS][l] = x[l];
}

MODEL(stop_prandtl_ishlinskii, 4 + 2 * PLAYS, PLAYS + 1)

/* Plays with growth |x'| more than their thresholds; growth before rest x. The last x
   and the rate that led there, V/s. */

static const double DT = 5e-5; /* that of hysteresis.py */

INLINE void rate_dependent_prandtl_ishlinskii_start(const row *p, row *s)
{
    for (int i = 0; i <= PLAYS; i++)
        LANES s[i][l] = p[4 + 2 * PLAYS][l];
    LANES s[PLAYS + 1][l] = 0.0;
}

INLINE void rate_dependent_prandtl_ishlinskii_step(const row *p, row *s,
                                                   const double *x, double *y)
{
    row wider;

    LANES wider[l] = p[3 + 2 * PLAYS][l] * fabs(s[PLAYS + 1][l]);
    LANES y[l] = x[l] * (p[0][l] + x[l] * (p[1][l] + x[l] * p[2][l]));
    for (int i = 0; i < PLAYS; i++)
        LANES {
            s[i][l] = played(x[l], p[3 + i][l] + wider[l], s[i][l]);
            y[l] += p[3 + PLAYS + i][l] * s[i][l];
        }
    LANES {
        s[PLAYS + 1][l] = (x[l] - s[PLAYS][l]) / DT;
        s[PLAYS][l] = x[l];
    }
}

MODEL(rate_dependent_prandtl_ishlinskii, 5 + 2 * PLAYS, PLAYS + 2)

/* Neurons over plays and past outputs: 2 past outputs, R linear, NEURONS x R mixing,
   bias, output, thresholds of R - 2 plays, centre, scale, pace, rest x. The state holds
   the plays, 2 past outputs, the last x. */

#define R 7
#define NEURONS 4
#define MIXING (2 + R)
#define BIAS (MIXING + NEURONS * R)
#define OUTPUT (BIAS + NEURONS)
#define THRESHOLDS (OUTPUT + NEURONS)
#define CENTRE (THRESHOLDS + R - 2)

INLINE void driven(const row *p, const row *r, double *y)
{
    LANES y[l] = 0.0;
    for (int j = 0; j < R; j++)
        LANES y[l] += p[2 + j][l] * r[j][l];
    for (int i = 0; i < NEURONS; i++) {
        row a;

        LANES a[l] = p[BIAS + i][l];
        for (int j = 0; j < R; j++)
            LANES a[l] += p[MIXING + i * R + j][l] * r[j][l];
        LANES y[l] += p[OUTPUT + i][l] * tanh(a[l]);
    }
}

INLINE void learned_operator_start(const row *p, row *s)
{
    row r[R], y;

    for (int j = 0; j < R; j++)
        LANES r[j][l] = j == R - 1 ? 0.0
                                   : (p[CENTRE + 3][l] - p[CENTRE][l])
                                         / p[CENTRE + 1][l];
    for (int i = 0; i < R - 2; i++)
        LANES s[i][l] = r[0][l];
    driven(p, r, y);
    LANES s[R - 2][l] = s[R - 1][l] = y[l] / (1.0 - p[0][l] - p[1][l]);
    LANES s[R][l] = p[CENTRE + 3][l];
}

INLINE void learned_operator_step(const row *p, row *s, const double *x, double *y)
{
    row r[R];

    LANES {
        r[0][l] = (x[l] - p[CENTRE][l]) / p[CENTRE + 1][l];
        r[R - 1][l] = (x[l] - s[R][l]) / p[CENTRE + 2][l];
        s[R][l] = x[l];
    }
    for (int i = 0; i < R - 2; i++)
        LANES r[1 + i][l] = s[i][l] = played(r[0][l], p[THRESHOLDS + i][l], s[i][l]);
    driven(p, r, y);
    LANES {
        y[l] += p[0][l] * s[R - 2][l] + p[1][l] * s[R - 1][l];
        s[R - 1][l] = s[R - 2][l];
        s[R - 2][l] = y[l];
    }
}

MODEL(learned_operator, CENTRE + 4, R + 1)

/* w' = rho (x' - sigma |x'| |w|^(n-1) w + (sigma - 1) x' |w|^n), y = k_x x + k_w w, a
   Runge-Kutta step along x: k_x, k_w, rho, sigma, n, rest x. */

INLINE double bouc_wen_rate(double rho, double sigma, double n, double dx, double w)
{
    const double power = n == 1.0 ? fabs(w) : pow(fabs(w), n);

    return rho * (dx - (sigma * fabs(dx) * copysign(1.0, w) + (1.0 - sigma) * dx) * power);
}

INLINE void normalised_bouc_wen_start(const row *p, row *s)
{
    LANES s[0][l] = p[5][l];
    LANES s[1][l] = 0.0;
}

INLINE void normalised_bouc_wen_step(const row *p, row *s, const double *x, double *y)
{
    LANES {
        const double dx = x[l] - s[0][l], w = s[1][l];
        const double rho = p[2][l], sigma = p[3][l], n = p[4][l];
        const double a = bouc_wen_rate(rho, sigma, n, dx, w);
        const double b = bouc_wen_rate(rho, sigma, n, dx, w + 0.5 * a);
        const double c = bouc_wen_rate(rho, sigma, n, dx, w + 0.5 * b);
        const double d = bouc_wen_rate(rho, sigma, n, dx, w + c);

        s[1][l] = w + (a + 2.0 * (b + c) + d) / 6.0;
        s[0][l] = x[l];
        y[l] = p[0][l] * x[l] + p[1][l] * s[1][l];
    }
}

MODEL(normalised_bouc_wen, 6, 2)

/* P(u), u = x less heights times Dahl frictions f, with |1 - f sign(x')|^(1-n) growing
   along x: the two numbers of P, heights, rates, exponents n, rest x. */

enum { FRICTIONS = 3 };

INLINE void dahl_frictions_start(const row *p, row *s)
{
    for (int i = 0; i < FRICTIONS; i++)
        LANES s[i][l] = 0.0;
    LANES s[FRICTIONS][l] = p[2 + 3 * FRICTIONS][l];
}

INLINE void dahl_frictions_step(const row *p, row *s, const double *x, double *y)
{
    LANES {
        const double dx = x[l] - s[FRICTIONS][l], way = dx >= 0.0 ? 1.0 : -1.0;
        double u = x[l];

        for (int i = 0; i < FRICTIONS; i++) {
            const double height = p[2 + i][l], rate = p[2 + FRICTIONS + i][l];
            const double n = p[2 + 2 * FRICTIONS + i][l], path = rate * fabs(dx);
            const double left = 1.0 - way * s[i][l];
            const double grown = pow(left, 1.0 - n) + (n - 1.0) * path;
            const double now = n == 1.0 ? left * exp(-path)
                               : grown > 0.0 ? pow(grown, 1.0 / (1.0 - n)) : 0.0;

            s[i][l] = way * (1.0 - now);
            u -= height * s[i][l];
        }
        s[FRICTIONS][l] = x[l];
        y[l] = u * (p[0][l] + u * p[1][l]);
    }
}

MODEL(dahl_frictions, 12, FRICTIONS + 1)

/* z' = alpha y' - beta_gamma |y'| |z|^(nu-1) z - beta_delta y' |z|^nu, a Runge-Kutta step
   along y, the input: alpha, beta_gamma, beta_delta, nu. Without force at y = 0. */

INLINE double force_rate(const row *p, int l, double dy, double z)
{
    const double power = p[3][l] == 1.0 ? fabs(z) : pow(fabs(z), p[3][l]);
    const double bend = p[1][l] * fabs(dy) * copysign(1.0, z) + p[2][l] * dy;

    return p[0][l] * dy - bend * power;
}

INLINE void bouc_wen_start(const row *p, row *s)
{
    (void)p;
    LANES s[0][l] = s[1][l] = 0.0;
}

INLINE void bouc_wen_step(const row *p, row *s, const double *x, double *y)
{
    LANES {
        const double dy = x[l] - s[0][l], z = s[1][l];
        const double a = force_rate(p, l, dy, z);
        const double b = force_rate(p, l, dy, z + 0.5 * a);
        const double c = force_rate(p, l, dy, z + 0.5 * b);
        const double d = force_rate(p, l, dy, z + c);

        s[1][l] = y[l] = z + (a + 2.0 * (b + c) + d) / 6.0;
        s[0][l] = x[l];
    }
}

MODEL(bouc_wen, 4, 2)

/* x' = F u' + G |u'| with F = g0 + g1 u + g2 u^2, G = p0 + ... + p3 u^3 + c x and
   y = h0 + h1 x, a Runge-Kutta step along u: g, p, c, h, rest u, rest x. */

INLINE double duhem_rate(const row *p, int l, double x, double u, double du)
{
    const double rising = p[0][l] + u * (p[1][l] + u * p[2][l]);
    const double pull = p[3][l] + u * (p[4][l] + u * (p[5][l] + u * p[6][l]));

    return rising * du + (pull + p[7][l] * x) * fabs(du);
}

INLINE void duhem_start(const row *p, row *s)
{
    LANES s[0][l] = p[10][l];
    LANES s[1][l] = p[11][l];
}

INLINE void duhem_step(const row *p, row *s, const double *input, double *y)
{
    LANES {
        const double u = s[0][l], du = input[l] - u, x = s[1][l];
        const double a = duhem_rate(p, l, x, u, du);
        const double b = duhem_rate(p, l, x + 0.5 * a, u + 0.5 * du, du);
        const double c = duhem_rate(p, l, x + 0.5 * b, u + 0.5 * du, du);
        const double d = duhem_rate(p, l, x + c, u + du, du);

        s[1][l] = x + (a + 2.0 * (b + c) + d) / 6.0;
        s[0][l] = input[l];
        y[l] = p[8][l] + p[9][l] * s[1][l];
    }
}

MODEL(duhem, 12, 2)

/* Exponential curves between remembered turning points, a stack of them: lower x, y,
   upper x, y, rising alpha, tau, falling alpha, tau. The last x and y, the count, the
   direction, the points; it starts rising from the lower end, at x = 0. */

#define POINTS 10

INLINE double bent(double alpha, double tau, double distance)
{
    return (1.0 + alpha * exp(-tau * fabs(distance))) * distance;
}

INLINE double curve(const row *p, int l, const row *s, double x)
{
    const int count = (int)s[2][l], side = s[3][l] > 0.0 ? 4 : 6;
    const double alpha = p[side][l], tau = p[side + 1][l];
    const double x1 = s[3 + count][l], y1 = s[3 + POINTS + count][l];
    const double x2 = s[2 + count][l], y2 = s[2 + POINTS + count][l];

    return y1 + (y2 - y1) * bent(alpha, tau, x - x1) / bent(alpha, tau, x2 - x1);
}

INLINE void bashash_jalili_start(const row *p, row *s)
{
    LANES {
        s[0][l] = 0.0;
        s[2][l] = 2.0;
        s[3][l] = 1.0;
        s[4][l] = p[2][l];
        s[5][l] = p[0][l];
        s[4 + POINTS][l] = p[3][l];
        s[5 + POINTS][l] = p[1][l];
        s[1][l] = curve(p, l, s, 0.0);
    }
}

INLINE void bashash_jalili_step(const row *p, row *s, const double *x, double *y)
{
    LANES {
        const double moved = x[l] - s[0][l];
        const double way = moved > 0.0 ? 1.0 : moved < 0.0 ? -1.0 : s[3][l];
        int count = (int)s[2][l], follows = 1;

        if (way != s[3][l] && count < POINTS) {
            s[4 + count][l] = s[0][l];
            s[4 + POINTS + count][l] = s[1][l];
            count++;
        } else if (way != s[3][l]) {
            follows = way * (x[l] - s[3 + POINTS][l]) >= 0.0;
            count -= follows;
        }
        if (follows) {
            s[3][l] = way;
            while (count > 2 && way * (x[l] - s[2 + count][l]) >= 0.0)
                count -= 2;
        }
        if (count < 2) {
            for (int i = 4; i <= 4 + POINTS; i += POINTS) {
                const double first = s[i][l];

                s[i][l] = s[i + 1][l];
                s[i + 1][l] = first;
            }
            count = 2;
        }
        s[2][l] = count;
        s[1][l] = y[l] = curve(p, l, s, x[l]);
        s[0][l] = x[l];
    }
}

MODEL(bashash_jalili, 8, 4 + 2 * POINTS)
