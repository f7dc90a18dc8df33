/* Time of a loop of an exported controller and plant beside that of loop.c.

   usage: program STEPS < gains, reference and noise as double: 8, STEPS + 1, STEPS

   Prints ns a step of the exported loop and of loop.c, the best of TURNS, and the RMS
   errors of both in um. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "controller.h"
#include "plant.h"

#define TURNS 21

void dob_pid_smc(int lanes, int steps, const double *gains, const double *reference,
                 const double *noise, double *rms);

static double exported(int steps, const controller_parameters *controller,
                       const plant_parameters *plant, const double *reference,
                       const double *noise)
{
    controller_state a;
    plant_state b;
    double y = 0.0, sum = 0.0;
    const int half = steps / 2;

    controller_init(&a, controller, reference[0], reference[0], 0.0, 0.0);
    plant_init(&b, plant, 0.0);
    for (int k = 0; k < steps; k++) {
        const double miss = y - reference[k];
        if (k == half)
            sum = 0.0;
        sum += miss * miss;
        y = plant_step(&b, plant, controller_step(&a, controller, reference[k],
                                                  reference[k + 1], y + noise[k]));
    }
    return sqrt(sum / (steps - half));
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return 1e9 * t.tv_sec + t.tv_nsec;
}

int main(int count, char **arguments)
{
    const int steps = count == 2 ? atoi(arguments[1]) : 0;
    const size_t size = 8 + 2 * (size_t)steps + 1;
    double *data = malloc(size * sizeof *data), best[2] = {1e300, 1e300}, rms[2];
    const controller_parameters controller = controller_defaults();
    const plant_parameters plant = plant_defaults();

    if (!steps || fread(data, sizeof *data, size, stdin) != size)
        return 1;
    for (int turn = 0; turn < TURNS; turn++)
        for (int i = 0; i < 2; i++) {
            const double begin = now();
            if (i)
                dob_pid_smc(1, steps, data, data + 8, data + 8 + steps + 1, &rms[1]);
            else
                rms[0] = exported(steps, &controller, &plant, data + 8,
                                  data + 8 + steps + 1);
            best[i] = fmin(best[i], (now() - begin) / steps);
        }
    printf("%.17g %.17g %.17g %.17g\n", best[0], best[1], rms[0], rms[1]);
    free(data);
    return 0;
}
