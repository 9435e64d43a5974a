/* C interface of the pose refinement with depths: the errors-in-variables least squares behind
 * rse_pf/pnp/depth_refinement.py.
 *
 * It may be called from any thread, on memory of its own.  It allocates nothing, and equal requests give equal bytes on
 * every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused with RSE_PF_DEPTH_BAD_REQUEST. */
#define RSE_PF_DEPTH_ABI 1

/* Request flag: compute without AVX2.  Tests use it to show that the bytes of the result are the same. */
#define RSE_PF_DEPTH_PORTABLE 1u

enum {
    RSE_PF_DEPTH_REFINED = 0,     /* The result holds the refined pose. */
    RSE_PF_DEPTH_KEPT = 1,        /* The input pose stays: no inlier has a depth, depths and pixels disagree, or they
                                     leave some motion of the camera free. */
    RSE_PF_DEPTH_BAD_REQUEST = 2, /* A size, an option or the ABI version is not valid. */
    RSE_PF_DEPTH_BAD_DEPTHS = 3,  /* A depth is not within 0..1000 m. */
    RSE_PF_DEPTH_BAD_POINTS = 4,  /* A point is not 1 mm or more in front of the reference camera, or beyond 1e6 m. */
    RSE_PF_DEPTH_BAD_PIXELS = 5   /* A pixel is not finite, or beyond 1e6 px. */
};

typedef struct rse_pf_depth_request {
    uint32_t abi;
    uint32_t flags;                 /* 0, or RSE_PF_DEPTH_PORTABLE */
    int64_t rows;                   /* number of correspondences */
    int64_t inlier_rows;            /* number of inliers among them */
    const double *points_reference; /* rows x 3, metres, in the frame of the reference camera, which measured them */
    const double *pixels;           /* rows x 2, undistorted pixels of the second image */
    const double *depths_m;         /* rows: depth in the second image at these pixels, metres; 0 where there is none */
    const int64_t *inliers;         /* inlier_rows row numbers, counted from 0; other rows are only validated */
    double fx, fy, cx, cy;          /* pinhole intrinsics of both images, pixels */
    double base_m, growth_per_m, from_m; /* standard deviation of depth z: base + growth * max(0, z - from)^2 metres */
    double rmse_px;                      /* root mean square reprojection error of the inliers at the input pose, from
                                            which the pixel noise is derived */
    double T_camera_reference[16];       /* 4 x 4, row-major: the input pose, which maps reference to second camera */
} rse_pf_depth_request;

typedef struct rse_pf_depth_result {
    int64_t status;                /* one of RSE_PF_DEPTH_... */
    double rmse_px;                /* root mean square reprojection error of the inliers at the refined pose */
    double T_camera_reference[16]; /* 4 x 4, row-major: the refined pose, maps reference to second camera */
    double covariance[36];         /* 6 x 6, of the twist (3 metres, 3 radians) that multiplies the pose on the left */
} rse_pf_depth_result;

/* Return the RSE_PF_DEPTH_ABI with which the library was compiled. */
uint32_t rse_pf_depth_abi(void);

/* Refine the pose of the request, which is not changed, and write the result.  Only with the status
 * RSE_PF_DEPTH_REFINED do the other fields of the result hold values.
 *
 * workspace: memory for 11 * (inlier_rows + 4) numbers. */
void rse_pf_depth_refine(const rse_pf_depth_request *request, double *workspace, rse_pf_depth_result *result);

#ifdef __cplusplus
}
#endif
