/* Constants of the laws that estimate by least squares after a filter pair: gain_lead.c, matrix_lead.c. */
#ifndef RTHYB_LEARNING_H
#define RTHYB_LEARNING_H

#define UNIT 1e3            /* 1/m: the least-squares problem is in millimetres */
#define OFFSET_TIME_S 3.2   /* lower end of the filter pair: 0.05 Hz */
#define GATE_TIME_S 0.2     /* averaging time of phi^2 for the gate */
#define RESPONSE_S 8.0      /* length of the impulse response summed during initialisation, */
#define RESPONSE_MAX 32768u /* and its largest number of samples, at 4096 Hz */
#define NUMB_MM 1e-6        /* lower bound of the noise: keeps the normal equations regular */
#define STANDS_MM2 1e-18    /* power of phi below which the axis is considered at rest */
#define NOISE_SHARE_MAX                                                                            \
    0.5 /* largest fraction of a moment or pivot that noise compensation may subtract */

#endif
