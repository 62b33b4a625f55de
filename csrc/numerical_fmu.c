/* An FMU for co-simulation, FMI 2 or 3, as a numerical part: forces in, one step of a sampling
 * period, displacements out. All of its work takes place between force and command. */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rthyb.h"

enum { OK, WARNING }; /* statuses of the standard with a valid result */
enum { CO_SIMULATION = 1 };
#define AT_REST_M 1e-6

/* ---- the standard's interfaces, as far as they are needed ---------------------------------------- */

typedef struct {
    void (*logger)(void *fmu, const char *instance, int status, const char *category,
                   const char *message, ...);
    void *(*allocate)(size_t count, size_t size);
    void (*free)(void *block);
    void (*step_finished)(void *fmu, int status);
    void *fmu;
} fmi2_callbacks;

typedef void *(*fmi2_instantiate)(const char *, int, const char *, const char *,
                                  const fmi2_callbacks *, int, int);
typedef int (*fmi2_setup)(void *, int, double, double, int, double);
typedef int (*fmi2_plain)(void *);
typedef int (*fmi2_set)(void *, const uint32_t *, size_t, const double *);
typedef int (*fmi2_get)(void *, const uint32_t *, size_t, double *);
typedef int (*fmi2_step)(void *, double, double, int);

typedef void (*fmi3_log)(void *fmu, int status, const char *category, const char *message);
typedef void *(*fmi3_instantiate)(const char *, const char *, const char *, bool, bool, bool, bool,
                                  const uint32_t *, size_t, void *, fmi3_log, void *);
typedef int (*fmi3_enter)(void *, bool, double, double, bool, double);
typedef int (*fmi3_set)(void *, const uint32_t *, size_t, const double *, size_t);
typedef int (*fmi3_get)(void *, const uint32_t *, size_t, double *, size_t);
typedef int (*fmi3_step)(void *, double, double, bool, bool *, bool *, bool *, double *);
typedef void (*fmi_free)(void *);

/* Calls a function by its address, with the type that the standard defines. */
#define AS(type, function) ((type)(function))

static int went_well(int status)
{
    return status == OK || status == WARNING;
}

/* ---- what it complains of ------------------------------------------------------------------------ */

static void note(rthyb_fmu *fmu, int status, const char *message)
{
    if (!fmu || went_well(status) || !message)
        return;
    (void)snprintf(fmu->said, sizeof fmu->said, "%s", message);
}

/* The message may contain placeholders for further arguments, whose types are not known here. */
static void note_log2(void *fmu, const char *instance, int status, const char *category,
                      const char *message, ...)
{
    (void)instance;
    (void)category;
    note(fmu, status, message);
}

static void note_log3(void *fmu, int status, const char *category, const char *message)
{
    (void)category;
    note(fmu, status, message);
}

/* FMI 2 requires them at an address that outlives the instance. */
static const fmi2_callbacks *callbacks_of(rthyb_fmu *fmu)
{
    const fmi2_callbacks made = {.logger = note_log2, .allocate = calloc, .free = free, .fmu = fmu};
    _Static_assert(sizeof made == sizeof fmu->callbacks, "the callbacks have another size");
    memcpy((void *)fmu->callbacks, &made, sizeof made);
    return (const fmi2_callbacks *)(const void *)fmu->callbacks;
}

/* ---- beginning and end --------------------------------------------------------------------------- */

void rthyb_fmu_close(rthyb_fmu *fmu)
{
    if (fmu->instance) {
        (void)AS(fmi2_plain, fmu->call.terminate)(fmu->instance);
        AS(fmi_free, fmu->call.free_instance)(fmu->instance);
    }
    fmu->instance = NULL;
}

static int set(rthyb_fmu *fmu, const uint32_t *at, size_t count, const double *values)
{
    if (count == 0)
        return OK;
    return fmu->fmi == 2 ? AS(fmi2_set, fmu->call.set)(fmu->instance, at, count, values)
                         : AS(fmi3_set, fmu->call.set)(fmu->instance, at, count, values, count);
}

static int get(const rthyb_fmu *fmu, const uint32_t *at, size_t count, double *values)
{
    return fmu->fmi == 2 ? AS(fmi2_get, fmu->call.get)(fmu->instance, at, count, values)
                         : AS(fmi3_get, fmu->call.get)(fmu->instance, at, count, values, count);
}

static int begin2(rthyb_fmu *fmu, const double *parameter)
{
    fmu->instance = AS(fmi2_instantiate, fmu->call.instantiate)(
        fmu->name, CO_SIMULATION, fmu->token, fmu->resources, callbacks_of(fmu), 0, 0);
    return fmu->instance &&
           went_well(set(fmu, fmu->parameter, (size_t)fmu->parameters, parameter)) &&
           went_well(
               AS(fmi2_setup, fmu->call.setup_experiment)(fmu->instance, 0, 0.0, 0.0, 0, 0.0)) &&
           went_well(AS(fmi2_plain, fmu->call.enter_initialization)(fmu->instance)) &&
           went_well(AS(fmi2_plain, fmu->call.exit_initialization)(fmu->instance));
}

static int begin3(rthyb_fmu *fmu, const double *parameter)
{
    fmu->instance = AS(fmi3_instantiate,
                       fmu->call.instantiate)(fmu->name, fmu->token, fmu->resources, false, false,
                                              false, false, NULL, 0, fmu, note_log3, NULL);
    return fmu->instance &&
           went_well(set(fmu, fmu->parameter, (size_t)fmu->parameters, parameter)) &&
           went_well(AS(fmi3_enter, fmu->call.enter_initialization)(fmu->instance, false, 0.0, 0.0,
                                                                    false, 0.0)) &&
           went_well(AS(fmi2_plain, fmu->call.exit_initialization)(fmu->instance));
}

int32_t rthyb_fmu_init(void *of, const rthyb_part_setup *setup)
{
    rthyb_fmu *fmu = of;
    double x[RTHYB_FMU_INTERFACES_MAX];
    rthyb_fmu_close(fmu);
    fmu->period_s = setup->period_s;
    fmu->step = 0;
    fmu->said[0] = '\0';
    const int begun = fmu->fmi == 2 ? begin2(fmu, setup->parameter) : begin3(fmu, setup->parameter);
    if (!begun)
        return 1;
    if (!went_well(get(fmu, fmu->displacement, (size_t)fmu->interfaces, x)))
        return 1;
    for (int i = 0; i < fmu->interfaces; i++)
        if (!(fabs(x[i]) <= AT_REST_M)) {
            (void)snprintf(fmu->said, sizeof fmu->said,
                           "begins at %g m; a numerical part must begin at 0", x[i]);
            return 2;
        }
    return 0;
}

/* ---- a step -------------------------------------------------------------------------------------- */

static int step(const rthyb_fmu *fmu)
{
    const double at = (double)fmu->step * fmu->period_s;
    if (fmu->fmi == 2)
        return AS(fmi2_step, fmu->call.do_step)(fmu->instance, at, fmu->period_s, 1);
    bool event = false, terminate = false, early = false;
    double reached = at;
    const int status = AS(fmi3_step, fmu->call.do_step)(fmu->instance, at, fmu->period_s, true,
                                                        &event, &terminate, &early, &reached);
    return terminate || early ? WARNING + 1 : status;
}

int32_t rthyb_fmu_answer(void *of, double ag_mps2, const double *force_n, double *x_next_m)
{
    rthyb_fmu *fmu = of;
    if (!fmu->instance)
        return 1;
    int status = OK;
    if (fmu->has_ground_acceleration)
        status = set(fmu, &fmu->ground_acceleration, 1, &ag_mps2);
    if (went_well(status))
        status = set(fmu, fmu->force, (size_t)fmu->interfaces, force_n);
    if (went_well(status))
        status = step(fmu);
    if (!went_well(status))
        return 1;
    fmu->step++;
    return went_well(get(fmu, fmu->displacement, (size_t)fmu->interfaces, x_next_m)) ? 0 : 1;
}

void rthyb_fmu_report(const void *of, double *values)
{
    const rthyb_fmu *fmu = of;
    if (fmu->instance && fmu->responses > 0)
        (void)get(fmu, fmu->response, (size_t)fmu->responses, values);
}
