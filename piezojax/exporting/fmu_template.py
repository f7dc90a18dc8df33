"""Template of the FMI 2.0 functions around an exported System."""

FMU = """\
/* Functions of FMI 2.0 for co-simulation, around {name}.c. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "{name}.h"

#define GUID "{guid}"
#define SAMPLE {dt}

typedef enum {{ OK, WARNING, DISCARD, ERROR, FATAL, PENDING }} status;
typedef enum {{ MODEL_EXCHANGE, CO_SIMULATION }} kind;
typedef const char *text;
typedef unsigned int reference_number;
typedef struct {{
    void (*log)(void *, text, status, text, text, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, status);
    void *environment;
}} callbacks;

typedef struct {{
    {name}_parameters parameters;
    {name}_state state;
{fields}
    int started;
    const callbacks *functions;
}} instance;

static double *variable(instance *this, reference_number number) {{
    switch (number) {{
{cases}
    default: return NULL;
    }}
}}

static void restart(instance *this) {{
    this->parameters = {name}_defaults();
    memset(&this->state, 0, sizeof this->state);
    this->started = 0;
{defaults}
}}

text fmi2GetTypesPlatform(void) {{ return "default"; }}
text fmi2GetVersion(void) {{ return "2.0"; }}

status fmi2SetDebugLogging(void *it, int on, size_t count, const text *names) {{
    (void)it; (void)on; (void)count; (void)names;
    return OK;
}}

void *fmi2Instantiate(text name, kind type, text guid, text resources,
                      const callbacks *functions, int visible, int logging) {{
    instance *this;
    (void)name; (void)resources; (void)visible; (void)logging;
    if (type != CO_SIMULATION || !guid || strcmp(guid, GUID)) return NULL;
    this = functions->allocate(1, sizeof *this);
    if (!this) return NULL;
    this->functions = functions;
    restart(this);
    return this;
}}

void fmi2FreeInstance(void *it) {{
    instance *this = it;
    if (this) this->functions->release(this);
}}

status fmi2SetupExperiment(void *it, int tolerance_set, double tolerance, double start,
                           int stop_set, double stop) {{
    (void)it; (void)tolerance_set; (void)tolerance; (void)start; (void)stop_set;
    (void)stop;
    return OK;
}}

status fmi2EnterInitializationMode(void *it) {{
    (void)it;
    return OK;
}}

static void begin(instance *this) {{
    {name}_state state;
    {name}_prepare(&this->parameters);
    {name}_init(&this->state, &this->parameters{begin});
    state = this->state; /* a copy, because the first sample comes later */
{rest}
    this->started = 1;
}}

status fmi2ExitInitializationMode(void *it) {{
    instance *this = it;
    if ({name}_check(&this->parameters)) return ERROR;
    begin(this);
    return OK;
}}

status fmi2Terminate(void *it) {{
    (void)it;
    return OK;
}}

status fmi2Reset(void *it) {{
    restart(it);
    return OK;
}}

status fmi2GetReal(void *it, const reference_number *numbers, size_t count,
                   double *values) {{
    size_t i;
    for (i = 0; i < count; i++) {{
        const double *place = variable(it, numbers[i]);
        if (!place) return ERROR;
        values[i] = *place;
    }}
    return OK;
}}

status fmi2SetReal(void *it, const reference_number *numbers, size_t count,
                   const double *values) {{
    size_t i;
    for (i = 0; i < count; i++) {{
        double *place = variable(it, numbers[i]);
        if (!place || numbers[i] >= {settable}) return ERROR;
        *place = values[i];
    }}
    return OK;
}}

status fmi2DoStep(void *it, double time, double step, int keep) {{
    instance *this = it;
    const double samples = floor(step / SAMPLE + 0.5);
{output}    double k;
    (void)time; (void)keep;
    if (!this->started || samples < 1.0) return ERROR;
    if (fabs(step / SAMPLE - samples) > 1e-3) return ERROR;
    if ({name}_check(&this->parameters)) return ERROR;
    {name}_prepare(&this->parameters);
    for (k = 0.0; k < samples; k += 1.0) {{
{step}
    }}
    return OK;
}}

status fmi2CancelStep(void *it) {{
    (void)it;
    return ERROR;
}}

/* Not supported: other types, derivatives, saved states, and pending steps. */
#define NONE(function, type) \\
    status function(void *it, const reference_number *numbers, size_t count, \\
                    type *values) {{ \\
        (void)it; (void)numbers; (void)values; \\
        return count ? ERROR : OK; \\
    }}
NONE(fmi2GetInteger, int)
NONE(fmi2GetBoolean, int)
NONE(fmi2GetString, text)
NONE(fmi2SetInteger, const int)
NONE(fmi2SetBoolean, const int)
NONE(fmi2SetString, const text)

#define ABSENT(function, ...) \\
    status function(__VA_ARGS__) {{ return ERROR; }}
ABSENT(fmi2GetFMUstate, void *a, void **b)
ABSENT(fmi2SetFMUstate, void *a, void *b)
ABSENT(fmi2FreeFMUstate, void *a, void **b)
ABSENT(fmi2SerializedFMUstateSize, void *a, void *b, size_t *c)
ABSENT(fmi2SerializeFMUstate, void *a, void *b, char *c, size_t d)
ABSENT(fmi2DeSerializeFMUstate, void *a, const char *b, size_t c, void **d)
ABSENT(fmi2GetDirectionalDerivative, void *a, const reference_number *b, size_t c,
       const reference_number *d, size_t e, const double *f, double *g)
ABSENT(fmi2SetRealInputDerivatives, void *a, const reference_number *b, size_t c,
       const int *d, const double *e)
ABSENT(fmi2GetRealOutputDerivatives, void *a, const reference_number *b, size_t c,
       const int *d, double *e)
ABSENT(fmi2GetStatus, void *a, int b, status *c)
ABSENT(fmi2GetRealStatus, void *a, int b, double *c)
ABSENT(fmi2GetIntegerStatus, void *a, int b, int *c)
ABSENT(fmi2GetBooleanStatus, void *a, int b, int *c)
ABSENT(fmi2GetStringStatus, void *a, int b, text *c)
"""
