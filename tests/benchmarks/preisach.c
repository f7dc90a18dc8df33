/* Preisach's model in plain C, and the rate-dependent one: the references of preisach.py.

   Relays lie on lines of one width; line k has a weight for each of its cells, and is
   up as far as a play operator stands, counted in cells. A rate-dependent model blends
   two densities on the same relays. All functions step lanes in groups that become
   SIMD, float64, one thread, without a branch:

     NAME_ramps   the output of a line as a sum of clipped ramps, one a cell
     NAME_table   the same from a table of running sums: less arithmetic, but loads
                  that differ from lane to lane
     NAME_gradient  the same sum by ramps, and its gradient by all weights, then by
                  half_way; each share of a weight's slope is summed on its own

   with NAME preisach or rate_dependent.

   weights  [densities][cells (cells + 1) / 2]  um, line by line
   half_way cells a sample at which both densities count alike; unused with one
   input    [groups][steps][GROUP]   cells from the lowest input
   square   [groups][GROUP]          sum over the steps of output^2, um^2
   gradient [groups][unknowns][GROUP] of square; unknowns as above */

#include <math.h>

#define GROUP 8
#define MOST 64
#define LANES for (int l = 0; l < GROUP; l++)
#define DENSITIES for (int d = 0; d < densities; d++)
#define INLINE static inline __attribute__((always_inline))

INLINE double least(double a, double b) { return a < b ? a : b; }
INLINE double most(double a, double b) { return a > b ? a : b; }

/* How far the density is the fast one: r^2 / (1 + r^2). */
INLINE double fast_share(double moved, double half_way)
{
    const double square = moved * moved / (half_way * half_way);
    return square / (1.0 + square);
}

INLINE double blended(int densities, double y[2][GROUP], double share, int l)
{
    return densities == 1 ? y[0][l] : y[0][l] + share * (y[1][l] - y[0][l]);
}

INLINE void ramps(const int densities, int cells, int groups, int steps,
                  const double *weights, double half_way, const double *input,
                  double *square)
{
    const int count = cells * (cells + 1) / 2;
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0}, share[GROUP] = {0.0};
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            const double *w = weights;
            double y[2][GROUP] = {{0.0}};
            if (densities > 1)
                LANES share[l] = fast_share(x[l] - level[0][l], half_way);
            for (int k = 0; k < cells; k++) {
                double v[GROUP];
                LANES {
                    v[l] = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v[l];
                }
                for (int j = 0; j < cells - k; j++, w++)
                    LANES {
                        const double up = least(most(v[l] - j, 0.0), 1.0);
                        DENSITIES y[d][l] += w[d * count] * up;
                    }
            }
            LANES {
                const double out = blended(densities, y, share[l], l);
                sum[l] += out * out;
            }
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}

INLINE void table(const int densities, int cells, int groups, int steps,
                  const double *weights, double half_way, const double *input,
                  double *square)
{
    /* Weight and running sum of every cell, with none above the last. */
    static double tables[MOST][MOST + 1][2][2];
    const int count = cells * (cells + 1) / 2;
    const double *w = weights;
    for (int k = 0; k < cells; k++) {
        double below[2] = {0.0};
        for (int j = 0; j <= cells - k; j++) {
            DENSITIES {
                tables[k][j][d][0] = j < cells - k ? w[d * count] : 0.0;
                tables[k][j][d][1] = below[d];
                below[d] += tables[k][j][d][0];
            }
            w += j < cells - k;
        }
    }
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0}, share[GROUP] = {0.0};
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            double y[2][GROUP] = {{0.0}};
            if (densities > 1)
                LANES share[l] = fast_share(x[l] - level[0][l], half_way);
            for (int k = 0; k < cells; k++)
                LANES {
                    double v = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v;
                    v = least(most(v, 0.0), cells - k);
                    const int j = (int)v;
                    DENSITIES y[d][l] +=
                        tables[k][j][d][1] + tables[k][j][d][0] * (v - j);
                }
            LANES {
                const double out = blended(densities, y, share[l], l);
                sum[l] += out * out;
            }
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}

INLINE void gradient(const int densities, int cells, int groups, int steps,
                     const double *weights, double half_way, const double *input,
                     double *square, double *slopes)
{
    const int count = cells * (cells + 1) / 2;
    const int unknowns = densities * count + (densities > 1);
    static double up[MOST * (MOST + 1) / 2][GROUP];
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0}, share[GROUP] = {0.0};
        double *slope = slopes + (long)g * unknowns * GROUP;
        for (int i = 0; i < unknowns * GROUP; i++)
            slope[i] = 0.0;
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            double y[2][GROUP] = {{0.0}}, twice[2][GROUP];
            if (densities > 1)
                LANES share[l] = fast_share(x[l] - level[0][l], half_way);
            for (int k = 0, i = 0; k < cells; k++) {
                double v[GROUP];
                LANES {
                    v[l] = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v[l];
                }
                for (int j = 0; j < cells - k; j++, i++)
                    LANES {
                        up[i][l] = least(most(v[l] - j, 0.0), 1.0);
                        DENSITIES y[d][l] += weights[d * count + i] * up[i][l];
                    }
            }
            LANES {
                const double out = blended(densities, y, share[l], l);
                sum[l] += out * out;
                twice[0][l] = 2.0 * out * (1.0 - share[l]);
                twice[1][l] = 2.0 * out * share[l];
                /* share (1 - share) = r^2 / (1 + r^2)^2 */
                if (densities > 1)
                    slope[densities * count * GROUP + l] -=
                        2.0 * twice[0][l] * share[l] * (y[1][l] - y[0][l]) / half_way;
            }
            DENSITIES
                for (int i = 0; i < count; i++)
                    LANES slope[(d * count + i) * GROUP + l] += twice[d][l] * up[i][l];
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}

#define FORWARD(name, function, densities)                                             \
    void name(int cells, int groups, int steps, const double *weights,                 \
              double half_way, const double *input, double *square)                    \
    {                                                                                  \
        function(densities, cells, groups, steps, weights, half_way, input, square);   \
    }

FORWARD(preisach_ramps, ramps, 1)
FORWARD(preisach_table, table, 1)
FORWARD(rate_dependent_ramps, ramps, 2)
FORWARD(rate_dependent_table, table, 2)

#define BACKWARD(name, densities)                                                      \
    void name(int cells, int groups, int steps, const double *weights,                 \
              double half_way, const double *input, double *square, double *slopes)    \
    {                                                                                  \
        gradient(densities, cells, groups, steps, weights, half_way, input, square,    \
                 slopes);                                                              \
    }

BACKWARD(preisach_gradient, 1)
BACKWARD(rate_dependent_gradient, 2)
