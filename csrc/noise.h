/* Seeded noise for virtual sensors, so that a test can be repeated exactly. */
#ifndef RTHYB_NOISE_H
#define RTHYB_NOISE_H

#include "numeric.h"

static inline uint64_t splitmix(uint64_t *state)
{
    uint64_t z = (*state += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* xoroshiro128+ (Blackman & Vigna): uniform in (0, 1]. */
static inline double uniform(uint64_t s[2])
{
    const uint64_t a = s[0], sum = a + s[1], b = s[1] ^ a;
    s[0] = ((a << 24) | (a >> 40)) ^ b ^ (b << 16);
    s[1] = (b << 37) | (b >> 27);
    return ((double)(sum >> 11) + 1.0) * 0x1p-53;
}

static inline void noise_seed(rthyb_noise *noise, uint64_t seed)
{
    noise->random[0] = splitmix(&seed);
    noise->random[1] = splitmix(&seed);
    noise->has_spare = 0;
}

/* Box-Muller method; the second value of a pair is kept for the next call. */
static inline double normal(rthyb_noise *noise)
{
    if (noise->has_spare) {
        noise->has_spare = 0;
        return noise->spare;
    }
    const double r = sqrt(-2.0 * log(uniform(noise->random)));
    const double angle = 2.0 * RTHYB_PI * uniform(noise->random);
    noise->spare = r * sin(angle);
    noise->has_spare = 1;
    return r * cos(angle);
}

#endif
