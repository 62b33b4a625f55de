/* What leads that learn by least squares behind a filter pair have in common: gain_lead.c, matrix_lead.c. */
#ifndef RTHYB_LEARNING_H
#define RTHYB_LEARNING_H

#define UNIT 1e3            /* 1/m: least squares in millimetres */
#define OFFSET_TIME_S 3.2   /* lower end of the filter pair: 0.05 Hz */
#define GATE_TIME_S 0.2     /* mean of phi^2 that the gate looks at */
#define RESPONSE_S 8.0      /* length of the impulse response summed at the beginning, */
#define RESPONSE_MAX 32768u /* and the most samples of it: at 4096 Hz */
#define NUMB_MM 1e-6        /* what less noise is taken for: keeps the normal equations regular */
#define STANDS_MM2 1e-18    /* power of phi below which nothing moves */
#define NOISE_SHARE_MAX 0.5 /* of a moment, or pivot, that noise compensation may take away */

#endif
