/* The C ABI of the native core: one call from matches, or from a pose and matches, to a pose with its evidence.
 *
 * Every function may be called from any thread at any time.  Equal requests give equal bytes on every
 * processor, whatever was solved before.  A request is never written to. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_NATIVE_ABI 5

/* Flags of a request. */
#define RSE_PF_PNP_PORTABLE 1u /* Use no AVX, for tests: the bytes of the result are the same. */
#define RSE_PF_PNP_AVX2 4u     /* Use no AVX-512, for tests as well. */

/* What became of a request; all but the first refuse the pose. */
enum rse_pf_pnp_status {
    RSE_PF_PNP_SOLVED = 0,
    RSE_PF_PNP_BAD_REQUEST = 1,   /* A size, an option or the ABI does not fit. */
    RSE_PF_PNP_BAD_POINTS = 2,    /* A coordinate is not finite or is beyond 1e6. */
    RSE_PF_PNP_BAD_PIXELS = 3,
    RSE_PF_PNP_NO_CONSENSUS = 4,  /* No more rows agree than chance would give: count. */
    RSE_PF_PNP_COLLINEAR = 5,     /* thinness */
    RSE_PF_PNP_COPIES = 6,        /* count, independent */
    RSE_PF_PNP_ONE_PLACE = 7,     /* radius_px */
    RSE_PF_PNP_UNCONSTRAINED = 8,
    RSE_PF_PNP_TWO_POSES = 9,     /* rmse_px, other_rmse_px */
    RSE_PF_PNP_MIRRORED = 10,     /* count, other_count */
    RSE_PF_PNP_OUT_OF_MEMORY = 11
};

/* Why a pose is weak; 0 for a pose that is ok. */
enum rse_pf_pnp_reason {
    RSE_PF_PNP_OK = 0,
    RSE_PF_PNP_FEW_INLIERS = 1,
    RSE_PF_PNP_LOW_INLIER_RATIO = 2,
    RSE_PF_PNP_NEARLY_COLLINEAR = 3,
    RSE_PF_PNP_CLUSTERED = 4,
    RSE_PF_PNP_POORLY_CONSTRAINED = 5,
    RSE_PF_PNP_AMBIGUOUS = 6
};

typedef struct rse_pf_pnp_request {
    uint32_t abi;   /* RSE_PF_NATIVE_ABI */
    uint32_t flags;
    int64_t rows;   /* 4 and more */
    const double *points_world; /* rows x 3, metres, world frame, row-major */
    const double *pixels;       /* rows x 2, undistorted pixels, row-major */
    const double *T_camera_world; /* row-major, the pose to judge; null: find one */
    double fx, fy, cx, cy;      /* pixels */
    int32_t width, height;      /* pixels */
    double inlier_px;
    double confidence;
    int32_t max_iterations, min_iterations;
    double weak_inliers, weak_inlier_ratio, weak_translation_m, weak_rotation_rad;
} rse_pf_pnp_request;

typedef struct rse_pf_pnp_result {
    int32_t status;
    int32_t reason;
    int64_t count, independent, other_count;
    double rmse_px, other_rmse_px, thinness, radius_px; /* other_rmse_px: 0 without a second pose */
    double inlier_thinness, log10_false_alarms;
    double T_camera_world[16]; /* row-major; zeros where there is none */
    double covariance[36];     /* of the twist (rho metres, phi radians) left of the pose */
    float upper_triangle[22];  /* of the covariance, row after row; the last one is 0 */
} rse_pf_pnp_result;

/* Return RSE_PF_NATIVE_ABI of the library, to compare with the header's. */
uint32_t rse_pf_native_abi(void);

/* Return "avx512", "avx2" or "portable": the instructions that this processor gets. */
const char *rse_pf_native_lanes(void);

/* Estimate or judge the camera pose.  inliers has room for as many numbers as the request has rows; the first
 * `count` of them become the sorted row numbers that agree, also where the pose is refused. */
void rse_pf_pnp_solve(const rse_pf_pnp_request *request, uint32_t *inliers, rse_pf_pnp_result *result);

#define RSE_PF_MAX_LISTS 3
#define RSE_PF_MAX_REST 1024

typedef struct rse_pf_lists {
    double *numbers; /* of all lists, one behind the other; `room` of them */
    int64_t room;
    int64_t count;                  /* lists that were found */
    int64_t ends[RSE_PF_MAX_LISTS]; /* of each list in `numbers` */
    char rest[RSE_PF_MAX_REST];
} rse_pf_lists;

/* Cut the lists of numbers out of a JSON text: `rest` becomes the text with the string "\u000K" in the place of
 * list K, which the text itself cannot hold, since one with a backslash is not read.
 *
 * Returns the size of the rest; -1 if it is too long, if there are other lists or too many of them, and for a number
 * with an exponent or more than 15 digits, which this function could not round as IEEE 754 does. */
int64_t rse_pf_cut_lists(const char *text, int64_t bytes, rse_pf_lists *lists);

#ifdef __cplusplus
}
#endif
