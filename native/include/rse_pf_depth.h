/* The C ABI of the refinement of a pose with the depths that two cameras measured.
 *
 * It does what rse_pf/pnp/depth_refinement.py does.  It may be called from any thread, on memory of its own.
 * Nothing is allocated, and equal requests give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_DEPTH_ABI 1

/* Use no AVX2, for tests: the bytes of the result are the same. */
#define RSE_PF_DEPTH_PORTABLE 1u

enum {
    RSE_PF_DEPTH_REFINED = 0,
    RSE_PF_DEPTH_KEPT = 1, /* No row has a depth, or depths and pixels contradict each other. */
    RSE_PF_DEPTH_BAD_REQUEST = 2,
    RSE_PF_DEPTH_BAD_DEPTHS = 3, /* One is not within 0..1000 m. */
    RSE_PF_DEPTH_BAD_POINTS = 4, /* One is not before the reference camera, or beyond 1e6 m. */
    RSE_PF_DEPTH_BAD_PIXELS = 5  /* One is not finite, or beyond 1e6. */
};

typedef struct rse_pf_depth_request {
    uint32_t abi;
    uint32_t flags;
    int64_t rows;
    int64_t inlier_rows;
    const double *points_reference; /* rows x 3, metres, in the frame of the camera that measured them */
    const double *pixels;           /* rows x 2, in the second image */
    const double *depths_m;         /* rows, at these pixels; 0 where there is none */
    const int64_t *inliers;         /* inlier_rows row numbers */
    double fx, fy, cx, cy;
    double base_m, growth_per_m, from_m; /* deviation of depth z: base + growth * max(0, z - from)^2 */
    double rmse_px;                      /* that the pixels left */
    double T_camera_reference[16];       /* row-major */
} rse_pf_depth_request;

typedef struct rse_pf_depth_result {
    int64_t status;
    double rmse_px;
    double T_camera_reference[16];
    double covariance[36]; /* of the twist (metres, then radians) left of the pose */
} rse_pf_depth_result;

/* Return RSE_PF_DEPTH_ABI of the library, to compare with the header's. */
uint32_t rse_pf_depth_abi(void);

/* Refine the pose; the result holds numbers only where its status is RSE_PF_DEPTH_REFINED.  workspace has room for
 * 11 * (inlier_rows + 4) numbers. */
void rse_pf_depth_refine(const rse_pf_depth_request *request, double *workspace, rse_pf_depth_result *result);

#ifdef __cplusplus
}
#endif
