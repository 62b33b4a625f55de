/* An oscillator m x'' + c x' = -m ag - f as an FMU for co-simulation, FMI 2 or 3 depending on the
 * macro FMI: the central difference of csrc/motion.c, one step per communication step. Variables by
 * reference: 0 ag, 1 f (inputs), 2 x (output), 3 m, 4 c (parameters), 5 v (local), 6 start; and of a
 * second, undamped mass beside it: 7 f2 (input), 8 x2 (output), 9 k between the two, 10 m2
 * (parameters). WRONG is inserted into a step. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifndef WRONG
#define WRONG
#endif

enum { AG, F, X, M, C, V, START, F2, X2, K, M2, COUNT };

typedef struct {
    double value[COUNT];
    double x, x1, y, y1;
    int begun;
} model;

static int step(model *s, double h)
{
    const double *p = s->value, half = 0.5 * h * p[C], spring = p[K] * (s->x - s->y);
    const double net = -p[M] * p[AG] - p[F] - spring;
    const double beside =
        2.0 * s->y - s->y1 + h * h * (spring - p[M2] * p[AG] - p[F2]) / p[M2];
    const double next =
        s->x + ((p[M] - half) * (s->x - s->x1) + h * h * net) * (1.0 / (p[M] + half));
    s->x1 = s->x;
    s->x = s->value[X] = next;
    s->y1 = s->y;
    s->y = s->value[X2] = beside;
    s->value[V] = (s->x - s->x1) / h;
    WRONG;
    return 0;
}

static model *make(void)
{
    model *s = calloc(1, sizeof *s);
    s->value[M] = s->value[M2] = 1000.0;
    return s;
}

static int begin(model *s)
{
    s->x = s->x1 = s->value[X] = s->value[START];
    return s->value[M] > 0.0 ? 0 : 3;
}

#if FMI == 2
#include "fmi2Functions.h"

static const fmi2CallbackFunctions *callbacks;

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)visible, (void)logging;
    callbacks = functions;
    if (type != fmi2CoSimulation || strcmp(guid, "{oscillator}") || strncmp(resources, "file:", 5))
        return NULL;
    return make();
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean td, fmi2Real t, fmi2Real start,
                               fmi2Boolean sd, fmi2Real stop)
{
    (void)c, (void)td, (void)t, (void)start, (void)sd, (void)stop;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    const int status = begin(c);
    if (status)
        callbacks->logger(callbacks->componentEnvironment, "x", fmi2Error, "error",
                          "the mass must be positive");
    return (fmi2Status)status;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    ((model *)c)->begun = 1;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    (void)c;
    return fmi2Error;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference at[], size_t n, const fmi2Real v[])
{
    for (size_t i = 0; i < n; i++)
        ((model *)c)->value[at[i]] = v[i];
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference at[], size_t n, fmi2Real v[])
{
    for (size_t i = 0; i < n; i++)
        v[i] = ((model *)c)->value[at[i]];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no)
{
    (void)t, (void)no;
    return (fmi2Status)step(c, h);
}
#else
#include "fmi3Functions.h"

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
                                         fmi3Boolean early, const fmi3ValueReference required[],
                                         size_t count, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)visible, (void)logging, (void)events, (void)early, (void)required, (void)count;
    (void)environment, (void)log, (void)update, (void)resources;
    return strcmp(token, "{oscillator}") ? NULL : make();
}

void fmi3FreeInstance(fmi3Instance c)
{
    free(c);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean td, fmi3Float64 t,
                                       fmi3Float64 start, fmi3Boolean sd, fmi3Float64 stop)
{
    (void)td, (void)t, (void)start, (void)sd, (void)stop;
    return (fmi3Status)begin(c);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    ((model *)c)->begun = 1;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t n,
                          const fmi3Float64 v[], size_t count)
{
    (void)count;
    for (size_t i = 0; i < n; i++)
        ((model *)c)->value[at[i]] = v[i];
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t n, fmi3Float64 v[],
                          size_t count)
{
    (void)count;
    for (size_t i = 0; i < n; i++)
        v[i] = ((model *)c)->value[at[i]];
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no,
                      fmi3Boolean *events, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *last)
{
    (void)no;
    *events = *terminate = *early = fmi3False;
    *last = t + h;
    return (fmi3Status)step(c, h);
}
#endif
