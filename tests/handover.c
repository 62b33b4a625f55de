/* A set of parameters that is half written, as seen by the tick. Prints how often something was
 * adopted before the set was complete, or less than all of it afterwards. */
#include <stdio.h>
#include <string.h>

#include "loop_state.h"

int main(void)
{
    static rthyb_handover handover;
    rthyb_parameters wanted = {.generation = 7, .adapt = 1, .velocity_limit_m_per_s = 0.125};
    rthyb_parameters before = {.generation = 6, .path_velocity_m_per_s = 0.5}, taken = {0};
    rthyb_handover half;
    rthyb_handover_write(&handover, &before);
    int wrong = rthyb_handover_read(&handover, &taken) != 1;
    rthyb_handover_write(&handover, &wanted);
    for (size_t words = 0; words < RTHYB_PARAMETER_WORDS; words++) {
        half = handover;
        half.stamp--;
        memcpy(half.words, &before, sizeof before);
        memcpy(half.words, &wanted, words * sizeof half.words[0]);
        wrong += rthyb_handover_read(&half, &taken) != 0;
    }
    wrong += memcmp(&taken, &before, sizeof taken) != 0;
    wrong += rthyb_handover_read(&handover, &taken) != 1;
    wrong += memcmp(&taken, &wanted, sizeof taken) != 0;
    wrong += rthyb_handover_read(&handover, &taken) != 0;
    printf("%d\n", wrong);
    return wrong > 0;
}
