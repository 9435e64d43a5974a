/* The C ABI of the matcher of a rectified stereo pair.
 *
 * It does what rse_pf/slam/stereo.py does.  It may be called from any thread, on memory of its own.  Nothing is
 * allocated, and equal arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_STEREO_ABI 1

/* The largest disparity that may be sought. */
#define RSE_PF_STEREO_MOST 1024

/* Use no instructions beyond those that every processor has. */
#define RSE_PF_STEREO_PORTABLE 1u

/* Return RSE_PF_STEREO_ABI of the library, to compare with the header's. */
uint32_t rse_pf_stereo_abi(void);

typedef struct rse_pf_stereo_request {
    uint32_t abi;
    uint32_t flags;            /* 0, or RSE_PF_STEREO_PORTABLE */
    int64_t width, height;     /* 1..65536 */
    const uint8_t *left;       /* height x width, row-major */
    const uint8_t *right;      /* height x width */
    int64_t rows;
    const double *pixels;      /* rows x 2, in the left image */
    double min_disparity_px;   /* smaller ones are not believed */
    double min_likeness;       /* least squared correlation of two patches, 0..1 */
    double uniqueness;         /* what the best lacks of 1 is less than this share of what the second lacks */
    int64_t max_disparity_px;  /* 1..RSE_PF_STEREO_MOST */
    int64_t left_right_px;     /* tolerance from the right image back to the left one; below 0: not checked */
} rse_pf_stereo_request;

/* Write the disparity of each pixel, NaN where none is believed, and return 0; -1 if a size does not fit. */
int32_t rse_pf_disparities(const rse_pf_stereo_request *request, double *disparities);

#ifdef __cplusplus
}
#endif
