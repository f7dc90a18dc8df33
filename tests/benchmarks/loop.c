/* The loop "dob_pid_smc" in plain C: the reference of throughput.py.

   Equations, units and readings: engines.py. This is the same step, written for
   speed: float64, one thread, no allocation, no branch in a step, no division in a
   step but the one of the hysteresis.

   Lanes are simulated in blocks. Each quantity of a block is a small array over its
   lanes, and the inner `for l` loops become SIMD. Data lie as the loop walks them:

     gains      [block][8][width]          P, I, D, m, R, alpha, beta, cutoff
     reference  [block][steps + 1][width]  um
     noise      [block][steps][width]      um
     rms        [block][width]             um

   with width = dob_pid_smc_width(lanes) and ceil(lanes / width) blocks, the last one
   filled up with copies of any lane. Alignment to 64 bytes is faster, not required. */

#include <math.h>
#include <stddef.h>

#define GROUP 8
#define LANES for (int l = 0; l < width; l++)
#define INLINE static inline __attribute__((always_inline))

/* engines.py holds the same numbers; test_engines.py compares the results. */
static const double T = 5e-5;
static const double HYS_A = 0.0077, HYS_B = 0.1167, HYS_C = -0.0487;
static const double A1 = 1.6035, A2 = -0.61995;
static const double B0 = 0.0050811, B1 = -0.0036354, B2 = 0.010553;
static const double KE = 0.1347, Q = 1.0;
static const double U_MIN = -20.0, U_MAX = 120.0;

typedef double lanes_t[GROUP] __attribute__((aligned(64)));

struct group {
    /* Worked out once from the gains. */
    lanes_t kp, ki, kd, slope, soft, alpha, beta, eq1, eq2, inv_c0, in_z, c1, c2;
    /* Plant, filter, controller, observer, reference; 1, 2, 3 = samples ago. */
    lanes_t y, y1, h, h1;
    lanes_t yh, vh;
    lanes_t s_sum, s1, f1, f2;
    lanes_t z1, z2, qy1, qy2, qu1, qu2, u1, u2, u3;
    lanes_t r, r1, sum;
};

int dob_pid_smc_width(int lanes)
{
    return lanes == 1 ? 1 : lanes <= GROUP ? GROUP : 2 * GROUP;
}

INLINE void start(struct group *g, const int width, int stride, const double *gains,
                  const double *reference)
{
    const double sum_b = B0 + B1 + B2;
    const double a11 = A1 + A2, a12 = -A2 * T, a21 = (A1 + A2 - 1.0) / T, a22 = -A2;

    LANES {
        const double m = gains[3 * stride + l], x = 1.0 / (gains[7 * stride + l] * T);
        const double k_eq = 1.0 / (m * B0 + B0 / T);

        g->kp[l] = gains[l];
        g->ki[l] = gains[stride + l] * T;
        g->kd[l] = gains[2 * stride + l] / T;
        g->slope[l] = m;
        g->soft[l] = Q / (Q + gains[4 * stride + l]);
        g->alpha[l] = gains[5 * stride + l];
        g->beta[l] = gains[6 * stride + l] / T;
        g->eq1[l] = (m * a11 + a21) * k_eq;
        g->eq2[l] = (m * a12 + a22) * k_eq;
        g->inv_c0[l] = 1.0 / ((0.25 + x * x + x) * sum_b);
        g->in_z[l] = g->inv_c0[l] / KE;
        g->c1[l] = (0.5 - 2.0 * x * x) * sum_b * g->inv_c0[l];
        g->c2[l] = (0.25 + x * x - x) * sum_b * g->inv_c0[l];

        g->y[l] = g->y1[l] = g->h[l] = g->h1[l] = g->yh[l] = g->vh[l] = 0.0;
        g->s_sum[l] = g->s1[l] = g->f1[l] = g->f2[l] = g->z1[l] = g->z2[l] = 0.0;
        g->qy1[l] = g->qy2[l] = g->qu1[l] = g->qu2[l] = 0.0;
        g->u1[l] = g->u2[l] = g->u3[l] = g->sum[l] = 0.0;
        g->r[l] = g->r1[l] = reference[l];
    }
}

/* Sums are ordered so that the term that comes last from the measurement enters
   last: the time of a step is the length of that chain. */
INLINE void step(struct group *g, const int width, const double *next,
                 const double *draw)
{
    const double unit_dc = (1.0 - A1 - A2) / (B0 + B1 + B2);
    const double g0 = unit_dc * B0, g1 = unit_dc * B1, g2 = unit_dc * B2;
    const double inv_b0 = 1.0 / B0, r_b1 = B1 / B0, r_b2 = B2 / B0;
    const double inv_ke = 1.0 / KE, inv_t = 1.0 / T;

    LANES {
        const double y = g->y[l], h = g->h[l], r = g->r[l], r1 = g->r1[l];
        const double miss = y - r;
        g->sum[l] += miss * miss;

        const double z = y + draw[l];
        const double ahead = g->yh[l] + T * g->vh[l], res = z - ahead;
        const double yh = ahead + g->alpha[l] * res;
        const double vh = g->vh[l] + g->beta[l] * res;

        const double e1 = yh - r, e2 = vh - (r - r1) * inv_t;
        const double s = g->slope[l] * e1 + e2;
        const double s_sum = g->s_sum[l] + s;
        const double past = (next[l] - A1 * r - A2 * r1) * inv_b0 - r_b1 * g->f1[l]
                            - r_b2 * g->f2[l];
        const double pd = g->kp[l] * s + g->kd[l] * (s - g->s1[l]);
        const double f = g->soft[l] * (past - g->eq1[l] * e1 - g->eq2[l] * e2
                                       - g->ki[l] * s_sum - pd);

        const double qy = (z - A1 * g->z1[l] - A2 * g->z2[l]) * g->in_z[l]
                          - g->c1[l] * g->qy1[l] - g->c2[l] * g->qy2[l];
        const double qu = (B0 * g->u1[l] + B1 * g->u2[l] + B2 * g->u3[l])
                          * g->inv_c0[l]
                          - g->c1[l] * g->qu1[l] - g->c2[l] * g->qu2[l];
        double u = f * inv_ke - (qy - qu);
        u = u < U_MIN ? U_MIN : u;
        u = u > U_MAX ? U_MAX : u;

        const double du = u - g->u1[l], size = fabs(du);
        const double hk = (2.0 * HYS_B * du + (2.0 + HYS_C * size) * h
                           + HYS_A * size * (u + g->u1[l])) / (2.0 - HYS_C * size);
        g->y[l] = A1 * y + A2 * g->y1[l] + g1 * h + g2 * g->h1[l] + g0 * hk;

        g->y1[l] = y;
        g->h1[l] = h; g->h[l] = hk;
        g->yh[l] = yh; g->vh[l] = vh;
        g->s_sum[l] = s_sum; g->s1[l] = s;
        g->f2[l] = g->f1[l]; g->f1[l] = f;
        g->z2[l] = g->z1[l]; g->z1[l] = z;
        g->qy2[l] = g->qy1[l]; g->qy1[l] = qy;
        g->qu2[l] = g->qu1[l]; g->qu1[l] = qu;
        g->u3[l] = g->u2[l]; g->u2[l] = g->u1[l]; g->u1[l] = u;
        g->r1[l] = r; g->r[l] = next[l];
    }
}

/* Two groups in turn: one alone waits for its own chain most of the time. `width`
   and `groups` are literals in every call, so each pair gets its own code. */
INLINE void block(const int groups, const int width, int steps, const double *gains,
                  const double *reference, const double *noise, double *rms)
{
    const int stride = groups * width, half = steps / 2;
    struct group a, b;

    start(&a, width, stride, gains, reference);
    if (groups > 1)
        start(&b, width, stride, gains + width, reference + width);
    for (int k = 0; k < steps; k++) {
        reference += stride;
        if (k == half) {                     /* only the second half counts */
            LANES a.sum[l] = 0.0;
            if (groups > 1)
                LANES b.sum[l] = 0.0;
        }
        step(&a, width, reference, noise);
        if (groups > 1)
            step(&b, width, reference + width, noise + width);
        noise += stride;
    }
    LANES rms[l] = sqrt(a.sum[l] / (steps - half));
    if (groups > 1)
        LANES rms[width + l] = sqrt(b.sum[l] / (steps - half));
}

void dob_pid_smc(int lanes, int steps, const double *gains, const double *reference,
                 const double *noise, double *rms)
{
    const int width = dob_pid_smc_width(lanes);

    for (int done = 0; done < lanes; done += width) {
        if (width == 1)
            block(1, 1, steps, gains, reference, noise, rms);
        else if (width == GROUP)
            block(2, GROUP / 2, steps, gains, reference, noise, rms);
        else
            block(2, GROUP, steps, gains, reference, noise, rms);
        gains += 8 * width;
        reference += (size_t)(steps + 1) * width;
        noise += (size_t)steps * width;
        rms += width;
    }
}
