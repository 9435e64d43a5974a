/* The C ABI of the check of a drive: how sharp edges are, and depths around features.
 *
 * Every function may be called from any thread, on memory of its own.  Nothing is allocated, and equal arguments give
 * equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_CHECK_ABI 2

/* Return RSE_PF_CHECK_ABI of the library, to compare with the header's. */
uint32_t rse_pf_check_abi(void);

/* Find the strongest edges along lines of an image, and write for each the steepest difference over 2 pixels as a share
 * of the step over 16.  Return how many there are, all of them in the order of lines, at most `most` of them, evenly
 * chosen; -1 if a size does not fit.
 *
 * gray: lines x length; strong: how many steps over 16 pixels are strong, by which the least one is found that counts,
 * which is least_step at least. */
int64_t rse_pf_edges(const uint8_t *gray, int64_t lines, int64_t length, int64_t strong, int64_t least_step,
                     int64_t most, double *sharpness);

/* Write the median of the depths at each pixel and two pixels above, below, left and right of it, NaN where one is
 * missing or they differ by more than a share of it; return 0, -1 if a size does not fit.
 *
 * depth_m: height x width, whose strides are in readings; pixels: rows x 2. */
int32_t rse_pf_depths_at(const float *depth_m, int64_t height, int64_t width, int64_t row_stride,
                         int64_t column_stride, const double *pixels, int64_t rows, double share, double *depths_m);

#ifdef __cplusplus
}
#endif
