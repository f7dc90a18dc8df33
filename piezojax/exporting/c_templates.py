"""Templates of an exported C project: Makefile, header, source, test and loop."""

MAKEFILE = """\
# `make test` compiles {name}.c and replays the golden vectors of the simulation.
CFLAGS ?= -std=c99 -O2 -Wall -Wextra -pedantic -Werror -ffp-contract=off

test: test_{name}
	./test_{name} vectors.csv

test_{name}: test_{name}.c {name}.c {name}.h
	$(CC) $(CFLAGS) -o $@ test_{name}.c {name}.c -lm

clean:
	rm -f test_{name}

.PHONY: test clean
"""

HEADER = """\
/* {origin}

   {name}_init starts at rest; {name}_step advances one sample. Signals: {units}.
   No allocation, no global state, and no dependency except libm. */
#ifndef {guard}
#define {guard}

{prepared}typedef struct {{
{parameters}
}} {name}_parameters;

typedef struct {{
{state}
}} {name}_state;

{output}/* Return the exported parameters, ready for {name}_step. */
{defaults};

/* Recompute the numbers that depend on parameters: call it after a change. */
{prepare};

/* Return 0, or the number (from 1) of the first parameter outside its limits. */
{check};

/* Set the state at rest under these signals{rest}. */
{init};

/* Advance one sample. */
{step};

#endif
"""

FIXED_REST = """, for the exported parameters. The
   equations of this state are not in this file: a change of parameters does not change
   the state, and the loop then does not begin at rest"""

PREPARED_TYPE = """\
/* Numbers that {name}_prepare computes from the parameters. */
typedef struct {{
{fields}
}} {name}_prepared;

"""

SOURCE = """\
/* {origin} */
#include "{name}.h"

#include <math.h>

{defaults} {{
    {name}_parameters parameters = {{0}};
{set}
    {name}_prepare(&parameters);
    return parameters;
}}

{check} {{
{checks}
    return 0;
}}

{init} {{
{init_body}
}}

{prepare} {{
{prepare_body}
}}

{step} {{
{step_body}
}}
"""

TEST = """\
/* {origin}

   Replays the golden vectors of the simulation; returns 1 if an output differs. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "{name}.h"

static int after_comments(FILE *file) {{
    int first;
    while ((first = getc(file)) == '#')
        if (fscanf(file, "%*[^\\n] ") == EOF) return 0;
    return ungetc(first, file) != EOF;
}}

static int row_of(FILE *file, double *values, int count) {{
    int i;
    for (i = 0; i < count; i++)
        if (fscanf(file, i ? ",%lf" : " %lf", &values[i]) != 1) return 0;
    return 1;
}}

int main(int count, char **arguments) {{
    double start[{starts}], row[{columns}], found[{outputs}], wanted;
    double worst[{outputs}] = {{0}}, largest[{outputs}] = {{0}};
    const {name}_parameters parameters = {name}_defaults();
    {name}_state state;
{output}    FILE *file = count == 2 ? fopen(arguments[1], "r") : NULL;
    long samples = 0;
    int i, failed = 0;
    if (!file || !after_comments(file) || !row_of(file, start, {starts})
        || fscanf(file, " %*[^\\n]") < 0) {{
        fprintf(stderr, "usage: %s vectors.csv\\n", arguments[0]);
        return 2;
    }}
    if ({name}_check(&parameters)) {{
        fprintf(stderr, "parameter %d is outside its limits\\n",
                {name}_check(&parameters));
        return 1;
    }}
    {name}_init(&state, &parameters{begin});
    while (row_of(file, row, {columns})) {{
{step}
        for (i = 0; i < {outputs}; i++) {{
            wanted = row[{inputs} + i];
            if (!(fabs(found[i] - wanted) <= worst[i]))
                worst[i] = fabs(found[i] - wanted);
            if (fabs(wanted) > largest[i]) largest[i] = fabs(wanted);
        }}
        samples++;
    }}
    fclose(file);
    for (i = 0; i < {outputs}; i++) {{
        const int wrong = !(worst[i] <= {tolerance} * largest[i]);
        printf("output %d: largest difference %.3g, largest value %.6g, "
               "%ld samples: %s\\n",
               i, worst[i], largest[i], samples, wrong ? "FAILED" : "passed");
        failed |= wrong || samples == 0;
    }}
    return failed;
}}
"""

LOOP = """\
#include "controller.h"
#include "plant.h"
#include "sensor.h"

int state_bytes(void) {{
    return (int)sizeof(controller_state);
}}

/* Simulate the loop: write the controller inputs of each sample to `seen`, and the
   displacements to `moved`. */
void run(long samples, const double *start, const double *row, double *seen,
         double *moved) {{
    const controller_parameters parameters = controller_defaults();
    const plant_parameters of_plant = plant_defaults();
    const sensor_parameters of_sensor = sensor_defaults();
    controller_state state;
    plant_state plant;
    sensor_state sensor;
    double y[{axes}], z[{axes}], u[{axes}];
    int i;
    controller_init(&state, &parameters, {begin});
    plant_init(&plant, &of_plant, {voltage});
    sensor_init(&sensor, &of_sensor, {displacement});
    for (i = 0; i < {axes}; i++) y[i] = start[4 * {axes} + i];
    for (; samples > 0; samples--) {{
{sense}
        for (i = 0; i < {axes}; i++) {{
            moved[i] = y[i];
            seen[i] = row[i];
            seen[{axes} + i] = row[{axes} + i];
            seen[2 * {axes} + i] = z[i];
        }}
{control}
{move}
        for (i = 0; i < {axes}; i++) y[i] += row[3 * {axes} + i];
        row += 5 * {axes};
        seen += 3 * {axes};
        moved += {axes};
    }}
}}

/* Run the controller alone on the inputs `seen`, to time its steps. */
double replay(long samples, const double *start, const double *seen) {{
    const controller_parameters parameters = controller_defaults();
    controller_state state;
    double u[{axes}], sum = 0.0;
    controller_init(&state, &parameters, {begin});
    for (; samples > 0; samples--) {{
{control}
        sum += u[0];
        seen += 3 * {axes};
    }}
    return sum;
}}
"""
