/* SPDX-License-Identifier: MIT
 *
 * The dimensions of a problem that is known at run time. In an exported controller another file takes the place of this one,
 * in which they are constants.
 */
#ifndef KPIRL_MPC_DIMENSIONS_H
#define KPIRL_MPC_DIMENSIONS_H

#define DIM(core, name) ((core)->dimensions.name)

#endif
