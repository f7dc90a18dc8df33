/* Preisach's model in plain C: the yardstick of preisach.py.

   Relays lie on lines of one width; line k has a weight for each of its cells, and is
   up as far as a play operator stands, counted in cells. Both functions step lanes in
   groups that become SIMD, float64, one thread, without a branch:

     preisach_ramps   the output of a line as a sum of clipped ramps, one a cell
     preisach_table   the same from a table of running sums: less arithmetic, but loads
                      that differ from lane to lane
     preisach_gradient  the same sum by ramps, and its gradient by all weights

   weights  [cells (cells + 1) / 2]  um, line by line
   input    [groups][steps][GROUP]   cells from the lowest input
   square   [groups][GROUP]          sum over the steps of output^2, um^2
   gradient [groups][weights][GROUP] of square, um */

#include <math.h>

#define GROUP 8
#define MOST 64
#define LANES for (int l = 0; l < GROUP; l++)

static inline double least(double a, double b) { return a < b ? a : b; }
static inline double most(double a, double b) { return a > b ? a : b; }

void preisach_ramps(int cells, int groups, int steps, const double *weights,
                    const double *input, double *square)
{
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0};
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            const double *w = weights;
            double y[GROUP] = {0.0};
            for (int k = 0; k < cells; k++) {
                double v[GROUP];
                LANES {
                    v[l] = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v[l];
                }
                for (int j = 0; j < cells - k; j++, w++)
                    LANES y[l] += *w * least(most(v[l] - j, 0.0), 1.0);
            }
            LANES sum[l] += y[l] * y[l];
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}

void preisach_table(int cells, int groups, int steps, const double *weights,
                    const double *input, double *square)
{
    /* Weight and running sum of every cell, with none above the last. */
    static double table[MOST][MOST + 1][2];
    const double *w = weights;
    for (int k = 0; k < cells; k++) {
        double below = 0.0;
        for (int j = 0; j <= cells - k; j++) {
            table[k][j][0] = j < cells - k ? *w++ : 0.0;
            table[k][j][1] = below;
            below += table[k][j][0];
        }
    }
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0};
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            double y[GROUP] = {0.0};
            for (int k = 0; k < cells; k++)
                LANES {
                    double v = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v;
                    v = least(most(v, 0.0), cells - k);
                    const int j = (int)v;
                    y[l] += table[k][j][1] + table[k][j][0] * (v - j);
                }
            LANES sum[l] += y[l] * y[l];
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}

void preisach_gradient(int cells, int groups, int steps, const double *weights,
                       const double *input, double *square, double *gradient)
{
    const int count = cells * (cells + 1) / 2;
    static double up[MOST * (MOST + 1) / 2][GROUP];
    for (int g = 0; g < groups; g++) {
        double level[MOST][GROUP] = {{0.0}}, sum[GROUP] = {0.0};
        double *slope = gradient + (long)g * count * GROUP;
        for (int i = 0; i < count * GROUP; i++)
            slope[i] = 0.0;
        for (int t = 0; t < steps; t++) {
            const double *x = input + ((long)g * steps + t) * GROUP;
            double y[GROUP] = {0.0}, twice[GROUP];
            for (int k = 0, i = 0; k < cells; k++) {
                double v[GROUP];
                LANES {
                    v[l] = most(x[l] - k, least(x[l], level[k][l]));
                    level[k][l] = v[l];
                }
                for (int j = 0; j < cells - k; j++, i++)
                    LANES {
                        up[i][l] = least(most(v[l] - j, 0.0), 1.0);
                        y[l] += weights[i] * up[i][l];
                    }
            }
            LANES {
                sum[l] += y[l] * y[l];
                twice[l] = 2.0 * y[l];
            }
            for (int i = 0; i < count; i++)
                LANES slope[i * GROUP + l] += twice[l] * up[i][l];
        }
        LANES square[g * GROUP + l] = sum[l];
    }
}
