/* rthyb: the real-time core of rthyb_rt.
 *
 * Contract
 *   - The caller allocates every struct; nothing here allocates, locks, blocks or keeps a global.
 *   - A struct is set up by its _init function, which returns 0 or the RTHYB_E_* of the first value
 *     that it refuses, and leaves a refused struct unusable.
 *   - A _step function takes one sample. It returns RTHYB_OK or a set of RTHYB_S_* bits. A sample
 *     that is not finite, or larger than any laboratory could mean, is never stored: the kernel
 *     works on with its last good value and says so by the code. State stays finite for ever.
 *   - A _run function is the same over n samples, for Python and for tests.
 *   - SI units everywhere: m, N, s, kg. alpha is in samples, beta in samples squared.
 *
 * Names follow Chen & Tsai (15WCEE 2012): x_c the command of the integration, x_p the compensated
 * command that the drive has, x_m the measured displacement. Time index: at instant t_n the rig
 * latches x_m[n] and f[n], then applies x_p[n], computed at tick n-1.
 */
#ifndef RTHYB_H
#define RTHYB_H

#define RTHYB_VERSION "0.3.0"

/* In each part the C compiler and cffi read the same text, which stands between two markers; cffi takes
 * the parts in this order. */
/* clang-format off */
#include "rthyb_record.h"
#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"
#include "rthyb_matrix_lead.h"
#include "rthyb_matrix_rfc.h"
#include "rthyb_law.h"
#include "rthyb_rig.h"
#include "rthyb_sparse.h"
#include "rthyb_coupled_plant.h"
#include "rthyb_coupled_rig.h"
#include "rthyb_numerical.h"
#include "rthyb_library.h"
#include "rthyb_own_part.h"
#include "rthyb_controller.h"
#include "rthyb_station.h"
#include "rthyb_parameters.h"
#include "rthyb_wire.h"
#include "rthyb_ring.h"
#include "rthyb_time.h"
#include "rthyb_link.h"
#include "rthyb_loop.h"
#include "rthyb_drive.h"
#include "rthyb_simulation.h"
/* clang-format on */

#endif
