/* C interface of the sparse stereo matcher: disparities of features of a rectified stereo pair.
 *
 * rse_pf/slam/stereo.py calls it.  It may be called from any thread, on memory of its own.  It allocates nothing, and
 * equal arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused with -1. */
#define RSE_PF_STEREO_ABI 1

/* Largest max_disparity_px of a request, pixels: the matcher keeps search lines of this length on the stack. */
#define RSE_PF_STEREO_MAX_DISPARITY_PX 1024

/* Request flag: compute without AVX2.  The bytes of the result are the same. */
#define RSE_PF_STEREO_PORTABLE 1u

/* Return the RSE_PF_STEREO_ABI with which the library was compiled. */
uint32_t rse_pf_stereo_abi(void);

typedef struct rse_pf_stereo_request {
    uint32_t abi;
    uint32_t flags;            /* 0, or RSE_PF_STEREO_PORTABLE */
    int64_t width, height;     /* of both images: 1..65536 pixels */
    const uint8_t *left;       /* height x width grey levels, row-major */
    const uint8_t *right;      /* height x width grey levels, row-major */
    int64_t rows;              /* number of features */
    const double *pixels;      /* rows x 2: (column, row) of each feature in the left image, rounded to whole pixels */
    double min_disparity_px;   /* above 0; smaller disparities become NaN: their depth is nearly unknown */
    double min_correlation2;   /* smallest squared normalised cross-correlation of a match, above 0, to 1 */
    double uniqueness;         /* (1 - correlation^2) of the best match must be below this times that of the best match
                                  whose disparity differs by more than 2 pixels */
    int64_t max_disparity_px;  /* largest disparity that is searched, pixels: 1..RSE_PF_STEREO_MAX_DISPARITY_PX */
    int64_t left_right_px;     /* largest difference of left-to-right and right-to-left disparity, whole pixels; below
                                  0: no check */
} rse_pf_stereo_request;

/* Write the disparity of each feature in pixels, NaN where no match passes the limits of the request.
 *
 * The disparity d is that of the rounded feature: its point has the column - d in the right image.  It is NaN for a
 * feature in the outer 6 columns or rows, too.  disparities: memory for `rows` numbers.  Returns 0, or -1 if a value of
 * the request is not valid. */
int32_t rse_pf_disparities(const rse_pf_stereo_request *request, double *disparities);

#ifdef __cplusplus
}
#endif
