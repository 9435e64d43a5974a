/* C interface of the sparse stereo matcher: disparities of features of a rectified stereo pair.
 *
 * rse_pf/slam/stereo.py calls it.  It may be called from any thread, on memory of its own.  It allocates nothing, and
 * equal arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused. */
#define RSE_PF_STEREO_ABI 1

/* Largest max_disparity_px of a request, pixels: the matcher keeps a search line of this length on the stack. */
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
    const double *pixels;      /* rows x 2: (column, row) of each feature in the left image */
    double min_disparity_px;   /* smaller disparities become NaN: their depth is nearly unknown */
    double min_correlation2;   /* smallest squared normalised cross-correlation of a match, 0..1 */
    double uniqueness;         /* largest ratio of (1 - correlation^2) of the best and the second best match */
    int64_t max_disparity_px;  /* 1..RSE_PF_STEREO_MAX_DISPARITY_PX */
    int64_t left_right_px;     /* largest difference of left-to-right and right-to-left disparity; below 0: no check */
} rse_pf_stereo_request;

/* Write the disparity of each feature in pixels, NaN where no match passes the limits of the request.
 *
 * disparities: memory for `rows` numbers.  Returns 0, or -1 if a value of the request is not valid. */
int32_t rse_pf_disparities(const rse_pf_stereo_request *request, double *disparities);

#ifdef __cplusplus
}
#endif
