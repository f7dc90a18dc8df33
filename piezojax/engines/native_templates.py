"""Templates of the C source of a run of many lanes."""

from string import Template

HEAD = Template("""#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>

#define WIDTH $width
#define GROUPS $groups
#define STRIDE (GROUPS * WIDTH)
#define EVERY $every
#define SEGMENT $segment
#define OUTPUTS $outputs
#define AHEAD 8  /* samples by which inputs are fetched ahead */
#if WIDTH > 1 && !defined __clang__
/* These passes put operations into branches, which keep loops over lanes from SIMD. */
#pragma GCC optimize "no-tree-pre", "no-tree-sink", "no-thread-jumps"
#endif
#define LANES for (int l = 0; l < WIDTH; l++)
#define INLINE static inline __attribute__((always_inline))
#define LANE_ARRAY(name) double name[WIDTH] __attribute__((aligned(64)))
$functions
/* Values that do not change with the step: fixed in all lanes, steady by lane. */
struct fixed {
$fixed
};

struct steady {
$steady
};

/* Values of a step that its derivatives need. */
struct kept {
$kept
};

INLINE void start_fixed(struct fixed *of, const double *restrict shared)
{
$start_fixed
}

INLINE void start_steady(struct steady *of, const struct fixed *restrict fixed,
                         const double *restrict shared, const double *restrict own)
{
    LANES {
$start_steady
    }
}
""")

PART = Template("""
struct ${part} {
$fields
};

INLINE void start_${part}(struct ${part} *of, const double *restrict start,
                          const struct fixed *restrict fixed,
                          const struct steady *restrict steady,
                          const double *restrict shared, const double *restrict own,
                          const double *restrict slopes)
{
    LANES {
$start
    }
}

INLINE void step_${part}(struct ${part} *restrict of, $kept *restrict kept, int64_t k,
                         int64_t lanes, const struct fixed *restrict fixed,
                         const struct steady *restrict steady,
                         const double *restrict shared, const double *restrict own,
                         const double *restrict slopes, double *restrict log$rows)
{
$ahead
    LANES {
$step
    }
}

INLINE void end_${part}(const struct ${part} *of, double *restrict end)
{
    LANES {
$end
    }
}
""")

SIGNATURE = """
/* Returns the reason of a failure, or NULL. */
const char *run_blocks(
    int64_t outer, int64_t blocks, int64_t directions, int64_t samples,
    const double *shared, const double *all_own, const double *start,
    const double *all_slopes, const double *slope_start$rows,
    double *end, double *log, double *slope_end, double *slope_log)
"""

RUN = Template(
    SIGNATURE
    + """{
    const int64_t lanes = blocks * STRIDE, logged = samples / (EVERY ? EVERY : samples);
    struct fixed fixed;
    start_fixed(&fixed, shared);
    $begin
    for (int64_t block = 0; block < outer * blocks; block++) {
        const double *own = all_own + block * $own * STRIDE;
        const int64_t first = block % blocks * STRIDE;
        double ignored[(OUTPUTS + 1) * STRIDE];
        int64_t row = block * logged, left = EVERY;
        struct kept kept;
        $start
        for (int64_t k = 0; k < samples; k++) {
            const bool now = --left == 0;
            double *here = now ? log + row * OUTPUTS * STRIDE : ignored;
            $step
            if (now) {
                left = EVERY;
                row++;
            }
        }
        $end
    }
    $finish
    return NULL;
}
"""
)

REVERSE = Template(
    SIGNATURE
    + """{
    const int64_t lanes = blocks * STRIDE, segments = (samples + SEGMENT - 1) / SEGMENT;
    struct kept *kept = aligned_alloc(64, SEGMENT * GROUPS * sizeof *kept);
    if (!kept && sizeof *kept)
        return "no memory for the values of a segment";
    struct fixed fixed;
    start_fixed(&fixed, shared);
    for (int64_t block = 0; block < outer * blocks; block++) {
        const double *own = all_own + block * $own * STRIDE;
        const int64_t first = block % blocks * STRIDE;
        $start
        for (int64_t segment = segments - 1; segment >= 0; segment--) {
            const int64_t begin = segment * SEGMENT, most = begin + SEGMENT;
            const int64_t stop = most < samples ? most : samples;
            $again
            for (int64_t k = begin; k < stop; k++) {
                struct kept *here = kept + (k - begin) * GROUPS;
                $forth
            }
            for (int64_t k = stop - 1; k >= begin; k--) {
                struct kept *here = kept + (k - begin) * GROUPS;
                $back
            }
        }
        $end
    }
    free(kept);
    return NULL;
}
"""
)
"""Reverse pass: each segment runs forward again from its stored carry, then back."""

STEADY = """struct steady steady$g;
        start_steady(&steady$g, &fixed, shared, own + $g * WIDTH);
        """
"""Start of each group, forward and back."""

BACK = {
    "start": STEADY
    + """struct slopes slopes$g;
        start_slopes(&slopes$g, slope_start + block * $sloping * STRIDE + $g * WIDTH,
                     &fixed, &steady$g, shared, own + $g * WIDTH, NULL);""",
    "again": """struct values values$g;
            start_values(&values$g, start + (block * segments + segment) * $carried
                         * STRIDE + $g * WIDTH, &fixed, &steady$g, shared,
                         own + $g * WIDTH, NULL);""",
    "forth": """step_values(&values$g, here + $g, k, lanes, &fixed, &steady$g, shared,
                            own + $g * WIDTH, NULL, NULL$row_values);""",
    "back": """step_slopes(&slopes$g, here + $g, k, lanes, &fixed, &steady$g, shared,
                            own + $g * WIDTH, NULL, NULL$row_values);""",
    "end": "end_slopes(&slopes$g, slope_end + block * $slope_ends * STRIDE"
    " + $g * WIDTH);",
}
"""Parts of ``REVERSE`` for each group."""

VALUES = {
    "start": STEADY
    + """struct values values$g;
        start_values(&values$g, start + block * $carried * STRIDE + $g * WIDTH,
                     &fixed, &steady$g, shared, own + $g * WIDTH, NULL);""",
    "step": """step_values(&values$g, &kept, k, lanes, &fixed, &steady$g, shared,
                        own + $g * WIDTH, NULL, here + $g * WIDTH$row_values);""",
    "end": "end_values(&values$g, end + block * $ends * STRIDE + $g * WIDTH);",
}
"""Parts of ``RUN``, written for each group, because compilers do not unroll a loop over
groups."""

SLOPES = {
    "begin": """struct slopes *turned = aligned_alloc(64, directions * sizeof *turned);
    if (!turned && directions)
        return "no memory for the derivatives";""",
    "start": """for (int64_t n = 0; n < directions; n++)
            start_slopes(&turned[n],
                         slope_start + (block * directions + n) * $sloping * STRIDE,
                         &fixed, &steady0, shared, own,
                         all_slopes + (block * directions + n) * $slopes * STRIDE);""",
    "step": """for (int64_t n = 0; n < directions; n++)
                step_slopes(&turned[n], &kept, k, lanes, &fixed, &steady0, shared, own,
                            all_slopes + (block * directions + n) * $slopes * STRIDE,
                            now ? slope_log + OUTPUTS * STRIDE
                                * (row + (block * (directions - 1) + n) * logged)
                                : ignored$row_values);""",
    "end": """for (int64_t n = 0; n < directions; n++)
            end_slopes(&turned[n], slope_end
                       + (block * directions + n) * $slope_ends * STRIDE);""",
    "finish": "free(turned);",
}
"""Parts of ``RUN`` for the derivatives."""
