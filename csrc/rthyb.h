/* rthyb: the real-time core of rthyb_rt.
 *
 * Contract
 *   - The caller allocates every struct. No function allocates memory, takes a lock, blocks, or uses
 *     a global variable.
 *   - A struct is initialised by its _init function, which returns 0, or the RTHYB_E_* code of the first
 *     value that it rejects. A struct that was rejected must not be used.
 *   - A _step function processes one sample and returns RTHYB_OK or a combination of RTHYB_S_* bits.
 *     A sample that is not finite or implausibly large is never stored: the kernel continues with its
 *     last good value and reports this in the code. The state therefore always remains finite.
 *   - A _run function does the same for n samples, for Python and for tests.
 *   - SI units everywhere: m, N, s, kg. alpha is in samples, beta in samples squared.
 *
 * Names follow Chen & Tsai (15WCEE 2012): x_c is the command from the integration, x_p the compensated
 * command that the drive receives, x_m the measured displacement. Time index: at instant t_n the rig
 * latches x_m[n] and f[n], and then applies x_p[n], which was computed in tick n-1.
 */
#ifndef RTHYB_H
#define RTHYB_H

#define RTHYB_VERSION "0.3.0"

/* The C compiler and cffi read the same text of each part, between two markers. cffi reads the parts in
 * this order. */
/* clang-format off */
#include "rthyb_record.h"
#include "rthyb_extra.h"
#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"
#include "rthyb_matrix_lead.h"
#include "rthyb_matrix_rfc.h"
#include "rthyb_law.h"
#include "rthyb_rig.h"
#include "rthyb_sparse.h"
#include "rthyb_coupled_plant.h"
#include "rthyb_coupled_rig.h"
#include "rthyb_plant.h"
#include "rthyb_numerical.h"
#include "rthyb_library.h"
#include "rthyb_own_part.h"
#include "rthyb_controller.h"
#include "rthyb_watch.h"
#include "rthyb_disagreement.h"
#include "rthyb_lone.h"
#include "rthyb_station.h"
#include "rthyb_parameters.h"
#include "rthyb_frame.h"
#include "rthyb_wire.h"
#include "rthyb_ring.h"
#include "rthyb_time.h"
#include "rthyb_link.h"
#include "rthyb_loop.h"
#include "rthyb_drive.h"
#include "rthyb_simulation.h"
/* clang-format on */

#endif
