/* C interface of the PnP solver: from correspondences of 3-D points and pixels to one camera pose with its evidence.
 *
 * Every function may be called from any thread at any time.  Equal requests give equal bytes on every processor,
 * independent of earlier requests.  No function writes to its request. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused with RSE_PF_PNP_BAD_REQUEST. */
#define RSE_PF_NATIVE_ABI 5

/* Request flag: compute without AVX2 and AVX-512.  Tests use it to show that the bytes of the result are the same. */
#define RSE_PF_PNP_PORTABLE 1u
/* Request flag: compute without AVX-512; AVX2 stays allowed.  The bytes of the result are the same. */
#define RSE_PF_PNP_AVX2 4u

/* Outcome of a request.  Every status but RSE_PF_PNP_SOLVED refuses the pose; the comments name the fields of the
 * result that hold the measured values of the refusal.  The first of several causes, in the order of the rules,
 * counts. */
enum rse_pf_pnp_status {
    RSE_PF_PNP_SOLVED = 0,
    RSE_PF_PNP_BAD_REQUEST = 1,     /* A size, an option or the ABI version is not valid. */
    RSE_PF_PNP_BAD_POINTS = 2,      /* A coordinate of a point is not finite or beyond -1e6..1e6 m. */
    RSE_PF_PNP_BAD_PIXELS = 3,      /* A coordinate of a pixel is not finite or beyond -1e6..1e6 px. */
    RSE_PF_PNP_NO_CONSENSUS = 4,    /* No pose, fewer than 4 inliers, or as many as a random pose has: inlier_count. */
    RSE_PF_PNP_COLLINEAR = 5,       /* The points or the pixels lie on one line: width_to_length. */
    RSE_PF_PNP_DUPLICATES = 6,      /* Inliers may be copies of a few: inlier_count, independent_inliers. */
    RSE_PF_PNP_ONE_SPOT = 7,        /* The radius of the inliers in the image is below inlier_px: radius_px. */
    RSE_PF_PNP_UNCONSTRAINED = 8,   /* Some motion of the camera changes no pixel. */
    RSE_PF_PNP_TWO_POSES = 9,       /* A second pose fits as well: rmse_px, second_pose_rmse_px. */
    RSE_PF_PNP_MIRRORED = 10,       /* The reflected points have twice the inliers: inlier_count, mirrored_inliers. */
    RSE_PF_PNP_OUT_OF_MEMORY = 11   /* The memory of the request could not be allocated. */
};

/* Why a solved pose is weak: the first of these that holds, but RSE_PF_PNP_AMBIGUOUS before all others.  RSE_PF_PNP_OK
 * means that the pose is not weak.  The reason of a refused pose has no meaning. */
enum rse_pf_pnp_reason {
    RSE_PF_PNP_OK = 0,
    RSE_PF_PNP_FEW_INLIERS = 1,        /* fewer inliers than weak_inliers */
    RSE_PF_PNP_LOW_INLIER_RATIO = 2,   /* a smaller share of the rows is inliers than weak_inlier_ratio */
    RSE_PF_PNP_NEARLY_COLLINEAR = 3,   /* inlier_width_to_length is below 0.1 */
    RSE_PF_PNP_CLUSTERED = 4,          /* fewer independent_inliers than half of weak_inliers */
    RSE_PF_PNP_POORLY_CONSTRAINED = 5, /* a standard deviation is above its limit in the request */
    RSE_PF_PNP_AMBIGUOUS = 6           /* the second pose of a planar scene fits similarly well */
};

typedef struct rse_pf_pnp_request {
    uint32_t abi;   /* RSE_PF_NATIVE_ABI */
    uint32_t flags; /* 0, RSE_PF_PNP_PORTABLE or RSE_PF_PNP_AVX2 */
    int64_t rows;   /* number of correspondences, 4 to 2^24 */
    const double *points_world;   /* rows x 3, metres, world frame, row-major */
    const double *pixels;         /* rows x 2, undistorted pixels, row-major; row i observes point i */
    const double *T_camera_world; /* 4 x 4, row-major, maps world to camera: the pose whose evidence is wanted, which is
                                     not changed; null: estimate a pose */
    double fx, fy, cx, cy;        /* pinhole intrinsics, pixels */
    int32_t width, height;        /* image size, pixels */
    double inlier_px;             /* largest reprojection error of an inlier, pixels */
    double confidence;            /* RANSAC stops when it has drawn an all-inlier sample with this probability */
    int32_t max_iterations, min_iterations;       /* bounds of the number of RANSAC samples; the minimum is at least 30
                                                     for requests of up to 32 rows, and the maximum wins */
    double weak_inliers, weak_inlier_ratio;       /* a pose with fewer inliers, or a smaller ratio of inliers and rows,
                                                     is weak */
    double weak_translation_m, weak_rotation_rad; /* a pose is weak if the root of the summed variances of the three
                                                     components of its twist, translation or rotation, is larger */
} rse_pf_pnp_request;

typedef struct rse_pf_pnp_result {
    int32_t status;              /* enum rse_pf_pnp_status */
    int32_t reason;              /* enum rse_pf_pnp_reason */
    int64_t inlier_count;        /* inliers of the pose, or of the best pose that was refused */
    int64_t independent_inliers; /* inliers of which neighbours in the image count once, as long as the inliers occupy
                                    few places of the image; else all inliers */
    int64_t mirrored_inliers;    /* inliers of the best pose of the reflected points; 0 where that was not tested */
    double rmse_px;              /* root mean square reprojection error of the inliers, pixels */
    double second_pose_rmse_px;  /* the same of the second pose of a planar scene; 0 where there is no second pose */
    double width_to_length;      /* width over length (0: a line) of all points or all pixels where there is no
                                    consensus, else of the projected inliers; 0 with RSE_PF_PNP_DUPLICATES */
    double radius_px;            /* root mean square distance of the projected inliers from their centroid */
    double inlier_width_to_length; /* width over length of the projected inliers; above 0.15 perhaps a lower bound */
    double log10_false_alarms;   /* log10 of the expected number of random poses that fit as well */
    double T_camera_world[16];   /* 4 x 4, row-major, maps world to camera; zeros where no pose was found */
    double covariance[36];       /* 6 x 6, of the twist (3 metres, 3 radians) that multiplies the pose on the left;
                                    zeros with fewer than 4 inliers, and perhaps not finite where the pose is refused */
    float upper_triangle[22];    /* the 21 values of the covariance's upper triangle by rows, then one 0 */
} rse_pf_pnp_result;

/* Return the RSE_PF_NATIVE_ABI with which the library was compiled. */
uint32_t rse_pf_native_abi(void);

/* Return the widest vector instructions that the solver uses on this processor: "avx512", "avx2" or "portable". */
const char *rse_pf_native_lanes(void);

/* Estimate a camera pose, or measure the evidence of the pose in the request, and fill in the result.
 *
 * Every field of the result is written; fields that were not computed are 0.  inliers: memory for `rows` numbers.  The
 * first inlier_count of them become the ascending row numbers of the inliers, also where the pose is refused; the
 * others may be overwritten. */
void rse_pf_pnp_solve(const rse_pf_pnp_request *request, uint32_t *inliers, rse_pf_pnp_result *result);

/* Most lists of numbers in one JSON text; a `pnp` command has up to three: points, pixels and depths. */
#define RSE_PF_MAX_LISTS 3
/* Most bytes of a JSON text without its lists; the other fields of a `pnp` command take some 400 bytes. */
#define RSE_PF_MAX_REST 1024

typedef struct rse_pf_lists {
    double *numbers; /* memory for `room` numbers: those of all lists, one list after the other */
    int64_t room;    /* numbers for which there is memory, set by the caller */
    int64_t count;                  /* written: lists in the text */
    int64_t ends[RSE_PF_MAX_LISTS]; /* for each list the index in `numbers` behind its last number */
    char rest[RSE_PF_MAX_REST];     /* the text without its lists */
} rse_pf_lists;

/* Move the lists of numbers out of a JSON text, so that a JSON parser need not make an object of each number.
 *
 * In `rest`, which gets no terminating zero, the JSON string "\u000K" stands in the place of list K, counted from 0.
 * The text cannot hold such a string itself, since a text with a backslash is refused.
 *
 * Returns the size of the rest in bytes, or -1 where the text must be parsed as usual: the rest is too long, there are
 * more than RSE_PF_MAX_LISTS lists or `room` numbers, a list is empty or holds something else, a number is "-0", or a
 * number has an exponent or more than 15 digits, which this function could not round as IEEE 754 requires.  Text
 * outside of the lists is not checked. */
int64_t rse_pf_cut_lists(const char *text, int64_t bytes, rse_pf_lists *lists);

#ifdef __cplusplus
}
#endif
