/* Parameters that may change during a test, handed over as a whole: one writer and one tick thread,
 * neither of which waits. The stamp is odd while a set is being written. */
#include <string.h>

#include "internal.h"
#include "loop_state.h"
#include "numeric.h"
#include "relaxed.h"

#define SPEED_MAX 1e6 /* m/s, m/s^2 */

_Static_assert(sizeof(rthyb_parameters) == RTHYB_PARAMETER_WORDS * sizeof(uint64_t),
               "a set of parameters is whole words");

int rthyb_watches_check(const rthyb_watch *watch, int count)
{
    for (int i = 0; i < count; i++) {
        if (!(watch[i].value >= 0.0 && watch[i].value <= RTHYB_FORCE_MAX_N) ||
            watch[i].reaction < RTHYB_REACT_NONE || watch[i].reaction > RTHYB_REACT_TRIP)
            return RTHYB_E_LIMIT;
    }
    return 0;
}

int rthyb_path_limits_check(double velocity_m_per_s, double acceleration_m_per_s2,
                            double brake_m_per_s2)
{
    const int good = velocity_m_per_s >= 1e-9 && velocity_m_per_s <= 1e3 &&
                     acceleration_m_per_s2 >= 1e-9 && acceleration_m_per_s2 <= 1e6;
    const int brake_ok = brake_m_per_s2 == 0.0 || (brake_m_per_s2 >= 1e-9 && brake_m_per_s2 <= 1e6);
    return good && brake_ok ? 0 : RTHYB_E_LIMIT;
}

static int speeds_ok(double velocity, double acceleration)
{
    return velocity >= 0.0 && velocity <= SPEED_MAX && acceleration >= 0.0 &&
           acceleration <= SPEED_MAX;
}

int rthyb_parameters_check(const rthyb_parameters *p)
{
    if (!speeds_ok(p->velocity_limit_m_per_s, p->acceleration_limit_m_per_s2) ||
        rthyb_watches_check(p->watch, RTHYB_CAUSE_COUNT))
        return RTHYB_E_LIMIT;
    for (int i = 0; i < RTHYB_COUPLED_MAX; i++) {
        const rthyb_axis_parameters *a = &p->axis[i];
        if (!speeds_ok(a->velocity_limit_m_per_s, a->acceleration_limit_m_per_s2) ||
            rthyb_watches_check(a->watch, RTHYB_CAUSE_COUNT) ||
            rthyb_watches_check(&a->interface.position, 1) ||
            rthyb_watches_check(&a->interface.force, 1))
            return RTHYB_E_LIMIT;
    }
    return rthyb_path_limits_check(p->path_velocity_m_per_s, p->path_acceleration_m_per_s2,
                                   p->brake_acceleration_m_per_s2);
}

void rthyb_handover_write(rthyb_handover *h, const rthyb_parameters *parameters)
{
    const char *bytes = (const char *)parameters;
    const uint64_t stamp = peek(&h->stamp);
    put(&h->stamp, stamp + 1);
    for (size_t i = 0; i < RTHYB_PARAMETER_WORDS; i++) {
        uint64_t word;
        memcpy(&word, bytes + i * sizeof word, sizeof word);
        /* A reader of this word also sees the odd stamp. */
        __atomic_store_n(&h->words[i], word, __ATOMIC_RELEASE);
    }
    __atomic_store_n(&h->stamp, stamp + 2, __ATOMIC_RELEASE);
}

int rthyb_handover_read(rthyb_handover *h, rthyb_parameters *parameters)
{
    char *bytes = (char *)parameters;
    const uint64_t stamp = __atomic_load_n(&h->stamp, __ATOMIC_ACQUIRE);
    if (stamp == h->taken || stamp % 2 != 0)
        return 0;
    for (size_t i = 0; i < RTHYB_PARAMETER_WORDS; i++) {
        const uint64_t word = __atomic_load_n(&h->words[i], __ATOMIC_ACQUIRE);
        memcpy(bytes + i * sizeof word, &word, sizeof word);
    }
    if (peek(&h->stamp) != stamp)
        return 0;
    h->taken = stamp;
    return 1;
}
