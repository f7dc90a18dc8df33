/* The loop "three_dof_pid_smc" in plain C: the reference for the 3-DOF stage.

   Equations, units and readings: loop_three_dof.py, which also works out the
   matrices. This is the same step, written for speed: float64, one thread, no
   allocation, no branch and no division in a step.

   A value is a vector over the lanes of a block, one SIMD register wide. Data lie as
   the loop walks them, aligned to 64 bytes:

     gains      [block][9][width]             P, I, D of Z, Rx, Ry
     reference  [block][steps + 1][3][width]  um, urad, urad
     noise      [block][steps][3][width]
     rms        [block][3][width]

   with width = three_dof_pid_smc_width(lanes) and ceil(lanes / width) blocks, the
   last one filled up with copies of any lane. Two blocks in turn, as in loop.c, gain
   nothing: a step has enough to do that does not wait for its measurement. */

#include <math.h>
#include <stddef.h>

/* Given as 4 for 4 lanes or fewer: a shorter register is faster by itself. */
#ifndef GROUP
#ifdef __AVX512F__
#define GROUP 8
#else
#define GROUP 4
#endif
#endif
#define AXES for (int i = 0; i < 3; i++)
#define INLINE static inline __attribute__((always_inline))

typedef double lanes_t __attribute__((vector_size(8 * GROUP)));
typedef double matrix[3][3];

/* As loop_three_dof.py lays it out. */
struct design {
    double T, alpha, beta;      /* beta over T */
    double yd[4];               /* yd(k+1) from yd(k), yd(k-1), r(k), r(k-1) */
    matrix A[3], C[3];          /* by channel; C [axis][state] */
    double B[3][3];             /* by channel */
    matrix F[4], K;             /* u1 from yd(k+1) to yd(k-2) and from older u1 */
    matrix s_e, s_q;            /* s, beside p */
    matrix u_e, u_q, u_p;       /* u2, beside the PID */
    matrix p_e, p_u, q_e, q_u;  /* p(k+1), and q(k+1) beside p(k) */
};

struct state {
    lanes_t kp[3], ki[3], kd[3];
    lanes_t x[3][3];
    lanes_t yh[3], vh[3];
    lanes_t r1[3], yd[3], yd1[3], yd2[3], older[3], u1[3];
    lanes_t q[3], p[3], s_sum[3], s1[3];
    lanes_t sum[3];
};

int three_dof_pid_smc_width(int lanes)
{
    (void)lanes;
    return GROUP;
}

/* A row of a matrix times a vector, added to a sum: three fused operations. */
INLINE lanes_t add(lanes_t sum, const double m[3], const lanes_t v[3])
{
    return sum + m[0] * v[0] + m[1] * v[1] + m[2] * v[2];
}

/* From rest: the weights of the sum before, of s(k-1) and of s(k). */
INLINE void start(struct state *g, const struct design *d, const lanes_t *gains)
{
    *g = (struct state){0};
    AXES {
        g->ki[i] = gains[3 + i] * d->T;
        g->kd[i] = gains[6 + i] / d->T;
        g->kp[i] = gains[i] + g->ki[i] + g->kd[i];
    }
}

/* What does not depend on this measurement comes first. */
INLINE void step(struct state *g, const struct design *d, const lanes_t r[3],
                 const lanes_t noise[3])
{
    lanes_t y[3], e[3], u[3], u1[3], u2[3], next[3], rest[3], s_rest[3], q[3];

    AXES next[i] = d->yd[0] * g->yd[i] + d->yd[1] * g->yd1[i]
                   + d->yd[2] * r[i] + d->yd[3] * g->r1[i];
    AXES {
        u1[i] = add((lanes_t){0}, d->F[0][i], next);
        u1[i] = add(u1[i], d->F[1][i], g->yd);
        u1[i] = add(u1[i], d->F[2][i], g->yd1);
        u1[i] = add(u1[i], d->F[3][i], g->yd2);
        for (int j = 0; j <= i; j++)
            u1[i] -= d->K[i][j] * g->older[j];
    }
    AXES s_rest[i] = add(g->p[i], d->s_q[i], g->q);
    AXES {
        rest[i] = g->kd[i] * g->s1[i] - g->ki[i] * g->s_sum[i];
        rest[i] = add(add(rest[i], d->u_q[i], g->q), d->u_p[i], g->p);
    }

    AXES {
        y[i] = add((lanes_t){0}, d->C[0][i], g->x[0]);
        y[i] = add(add(y[i], d->C[1][i], g->x[1]), d->C[2][i], g->x[2]);
    }
    AXES {
        const lanes_t miss = y[i] - r[i];
        const lanes_t z = y[i] + noise[i];
        const lanes_t ahead = g->yh[i] + d->T * g->vh[i], res = z - ahead;
        g->sum[i] += miss * miss;
        g->yh[i] = ahead + d->alpha * res;
        g->vh[i] += d->beta * res;
        e[i] = g->yh[i] - g->yd[i];
    }
    AXES {
        const lanes_t s = add(s_rest[i], d->s_e[i], e);
        u2[i] = add(rest[i], d->u_e[i], e) - g->kp[i] * s;
        u[i] = u1[i] + u2[i];
        g->s_sum[i] += s;
        g->s1[i] = s;
    }

    AXES q[i] = add(add(g->p[i], d->q_e[i], e), d->q_u[i], u2);
    AXES g->p[i] = add(add((lanes_t){0}, d->p_e[i], e), d->p_u[i], u2);
    AXES g->q[i] = q[i];
    for (int c = 0; c < 3; c++) {
        lanes_t x[3];
        AXES x[i] = add(d->B[c][i] * u[c], d->A[c][i], g->x[c]);
        AXES g->x[c][i] = x[i];
    }
    AXES {
        g->r1[i] = r[i];
        g->yd2[i] = g->yd1[i]; g->yd1[i] = g->yd[i]; g->yd[i] = next[i];
        g->older[i] = g->u1[i] + u1[i]; g->u1[i] = u1[i];
    }
}

INLINE void block(int steps, const struct design *d, const lanes_t *gains,
                  const lanes_t *reference, const lanes_t *noise, double *rms)
{
    const int half = steps / 2;
    struct state g;

    start(&g, d, gains);
    for (int k = 0; k < steps; k++) {
        if (k == half)                       /* only the second half counts */
            AXES g.sum[i] = (lanes_t){0};
        /* Else gcc takes the matrices out of the loop, every number spread to a
           vector: 14 KB of stack, slower to read than the numbers themselves. */
        __asm__("" : "+r"(d));
        step(&g, d, reference + 3 * k, noise + 3 * k);
    }
    AXES for (int l = 0; l < GROUP; l++)
        rms[i * GROUP + l] = sqrt(g.sum[i][l] / (steps - half));
}

void three_dof_pid_smc(int lanes, int steps, const double *design, const double *gains,
                       const double *reference, const double *noise, double *rms)
{
    for (int done = 0; done < lanes; done += GROUP) {
        block(steps, (const struct design *)design, (const lanes_t *)gains,
              (const lanes_t *)reference, (const lanes_t *)noise, rms);
        gains += 9 * GROUP;
        reference += (size_t)(steps + 1) * 3 * GROUP;
        noise += (size_t)steps * 3 * GROUP;
        rms += 3 * GROUP;
    }
}
