/* C interface of the measurements that `rse-pf check` takes of recorded images: edge sharpness, and depths at features.
 *
 * Every function may be called from any thread, on memory of its own.  Nothing is allocated, and equal arguments give
 * equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header, for the caller to compare with rse_pf_check_abi. */
#define RSE_PF_CHECK_ABI 2

/* Return the RSE_PF_CHECK_ABI with which the library was compiled. */
uint32_t rse_pf_check_abi(void);

/* Measure the sharpness of the strongest edges along the lines of an image, which tells blur from sharp images.
 *
 * The contrast at a pixel is the absolute difference of grey levels over 16 pixels along the line.  The threshold is
 * the highest contrast that at least `wanted_edges` pixels reach, but not below `min_contrast`.  For each edge, which
 * is a pixel at or above the threshold, the sharpness is the largest difference over 2 pixels within these 16, divided
 * by the contrast: near 1 for a step, near 1/8 for a ramp.
 *
 * gray: lines x length grey levels, with lines of at least 48 pixels.  sharpness: memory for max_edges numbers; of more
 * edges every n-th is written, in the order of the lines.  Returns the number of all edges, which may be above
 * max_edges or 0, or -1 if a size is not valid. */
int64_t rse_pf_edges(const uint8_t *gray, int64_t lines, int64_t length, int64_t wanted_edges, int64_t min_contrast,
                     int64_t max_edges, double *sharpness);

/* Write the depth at each pixel: the median of the depths at the pixel and two pixels above, below, left and right.
 *
 * The depth is NaN where one of the five is missing (not above 0), or where the largest and the smallest of them differ
 * by more than max_difference times the median.
 *
 * depth_m: height x width, at least 5 pixels each, metres, addressed by strides in numbers, so that it may be a rotated
 * view; pixels: rows x 2 (column, row), rounded, and moved inwards where they are within two pixels of the border or
 * outside; depths_m: memory for `rows` numbers.  Returns 0, or -1 if a size is not valid. */
int32_t rse_pf_depths_at(const float *depth_m, int64_t height, int64_t width, int64_t row_stride,
                         int64_t column_stride, const double *pixels, int64_t rows, double max_difference,
                         double *depths_m);

#ifdef __cplusplus
}
#endif
