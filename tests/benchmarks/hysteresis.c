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
