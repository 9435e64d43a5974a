/* C interface of the tracker's inner loops: matching near predicted pixels, and fitting a pose to landmarks.
 *
 * rse_pf/slam/tracking.py calls it.  Every function may be called from any thread, on arrays of its own.  Nothing is
 * allocated, and equal arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused with -1. */
#define RSE_PF_TRACK_ABI 2

/* Return the RSE_PF_TRACK_ABI with which the library was compiled. */
uint32_t rse_pf_track_abi(void);

/* Measure how distinctive the features of one image are, so that repeated texture is not matched.
 *
 * Writes for each feature the smallest Hamming distance (bits) of its descriptor to that of another feature of the
 * image that is at least apart_px away in column or in row; 256 where there is no such feature.
 *
 * descriptors: rows x 32 bytes; pixels: rows x 2 (column, row); distances: memory for `rows` numbers.  Returns 0, or
 * -1 if a pointer is null or `rows` is not valid. */
int32_t rse_pf_distinct(const uint8_t *descriptors, const double *pixels, int64_t rows, double apart_px,
                        int32_t *distances);

/* Predicted features, the features of an image, and the conditions under which a pair of them matches.  Sizes are
 * scales of which only ratios count, such as 1 for ORB's finest pyramid level. */
typedef struct rse_pf_near_request {
    uint32_t abi;
    uint32_t flags;                      /* 0 */
    int64_t predicted_rows, rows;        /* number of predicted features, and of features of the image */
    const double *predicted_pixels;      /* predicted_rows x 2 */
    const double *predicted_directions;  /* predicted_rows x 2: cosine and sine of the orientation, or shorter vector */
    const double *predicted_sizes;       /* predicted_rows: size of the feature, above 0 */
    const uint8_t *predicted_descriptors; /* predicted_rows x 32 bytes */
    const double *pixels;                /* rows x 2 */
    const double *directions;            /* rows x 2: cosine and sine of the orientation */
    const double *sizes;                 /* rows: size of the feature, above 0 */
    const uint8_t *descriptors;          /* rows x 32 bytes */
    const int32_t *distinct;             /* rows: distances that rse_pf_distinct wrote */
    double radius_px;                    /* radius of the search around a predicted pixel */
    double ratio;                        /* the best distance must be below this share of the second best among the
                                            features that pass the tests of radius, orientation and size */
    double distinct_ratio;               /* and below this share of the feature's own distance in `distinct` */
    double min_cosine;                   /* smallest cosine of the angle between predicted and measured orientation */
    double max_size_ratio;               /* largest ratio of predicted and measured size, either way */
    int64_t max_distance;                /* largest Hamming distance of a match, bits */
} rse_pf_near_request;

/* 8-byte numbers of the workspace of rse_pf_match_near. */
#define RSE_PF_NEAR_WORKSPACE(predicted_rows, rows) ((predicted_rows) + 12 * (rows) + 16400)

/* Match predicted features to features of an image within a radius, one to one.
 *
 * Each predicted feature chooses the feature with the smallest Hamming distance.  Of several that choose the same one,
 * the nearest stays, and the others have no match.  Ties go to the lower row number.  predicted_matched and matched
 * get the row numbers of both sides of each match, by ascending predicted row; they have room for min(predicted_rows,
 * rows).  Returns the number of matches, or -1 if a pointer is null or a size, the radius or the ABI version is not
 * valid. */
int64_t rse_pf_match_near(const rse_pf_near_request *request, uint64_t *workspace, int64_t *predicted_matched,
                          int64_t *matched);

/* Landmarks, a predicted camera pose, and the conditions under which a landmark is expected to be visible. */
typedef struct rse_pf_seek_request {
    uint32_t abi;
    uint32_t flags;             /* 0 */
    int64_t rows, landmarks;    /* number of landmarks to look for, and of landmarks in the arrays below */
    const int64_t *numbers;     /* rows: the landmarks to look for; numbers outside of the arrays are ignored */
    const double *points;       /* landmarks x 3, metres, world frame */
    const double *rays;         /* landmarks x 3: from the camera that saw a landmark last to the landmark, metres,
                                   world frame */
    const double *directions;   /* landmarks x 3: orientation of the feature in that image, as a vector of the world */
    const double *sizes;        /* landmarks: size of the feature in that image, above 0 */
    const uint8_t *descriptors; /* landmarks x 32 bytes */
    double fx, fy, cx, cy, width, height; /* pinhole intrinsics and image size, pixels */
    double margin_px;           /* landmarks may project this far outside of the image */
    double min_depth_m;         /* landmarks at this depth along the optical axis or nearer are not visible */
    double min_cosine;          /* smallest cosine of the angle between the present and the last viewing ray */
    double max_nearer, max_farther; /* largest ratio of last to present distance, and of present to last distance */
    double T_camera_world[16];  /* 4 x 4, row-major: the predicted pose, which maps world to camera */
} rse_pf_seek_request;

/* Project landmarks into an image by a predicted pose and match the visible ones as rse_pf_match_near does.
 *
 * The predicted size of a feature is its size in the last image times the last distance over the present one.  The
 * fields predicted_... of `image` are not read.  predicted_matched gets rows of `numbers` (not landmarks), matched
 * gets rows of the image's features; both have room for min(rows, image->rows).  workspace: memory for 10 * rows +
 * RSE_PF_NEAR_WORKSPACE(rows, image->rows) numbers.  Returns the number of matches, or -1 if a pointer is null or a
 * size, the radius or the ABI version is not valid. */
int64_t rse_pf_seek(const rse_pf_seek_request *request, const rse_pf_near_request *image, uint64_t *workspace,
                    int64_t *predicted_matched, int64_t *matched);

/* Landmarks, their measurements in one image, and the pose from which a fit starts. */
typedef struct rse_pf_fit_request {
    uint32_t abi;
    uint32_t flags;                  /* 0 */
    int64_t rows;                    /* number of measurements */
    const double *points;            /* rows x 3: landmark, metres, world frame */
    const double *point_covariances; /* rows x 6: upper triangle of the landmark's covariance, m^2, world frame */
    const double *pixels;            /* rows x 2: measured pixel (column, row), undistorted */
    const double *pixel_sigmas_px;   /* rows: standard deviation of each coordinate of the pixel */
    const double *depths_m;          /* rows: measured depth along the optical axis, to 1000 m; 0 where there is none */
    const double *depth_sigmas_m;    /* rows: standard deviation of the depth; not read where there is none */
    double fx, fy, cx, cy;           /* pinhole intrinsics, pixels */
    double cauchy2;                  /* squared Mahalanobis distance at which the Cauchy weight of a row is one half */
    double gate2;                    /* squared Mahalanobis distance from which on a row is an outlier */
    double T_camera_world[16];       /* 4 x 4, row-major: the pose from which the fit starts, maps world to camera */
} rse_pf_fit_request;

typedef struct rse_pf_fit_result {
    int64_t inliers;           /* number of inliers */
    double T_camera_world[16]; /* 4 x 4, row-major: the fitted pose, maps world to camera */
    double information[36];    /* 6 x 6, J^T W J of the inliers without robust weights: the inverse covariance of the
                                  twist (metres, radians) left of the pose */
} rse_pf_fit_result;

/* Fit the camera pose to landmarks by robust Gauss-Newton, weighted by the noise of pixels, depths and landmarks.
 *
 * An inlier is a row whose squared Mahalanobis distance at the fitted pose is below gate2, and whose landmark is in
 * front of the camera; no minimum number of them is required.  is_inlier: memory for `rows` bytes, set to 1 for
 * inliers and 0 for outliers.  Returns 0; 1 if the measurements leave some motion of the camera free or the fit
 * diverges; -1 if a size or a number is not valid.  Only with 0 are is_inlier and result valid. */
int32_t rse_pf_fit_pose(const rse_pf_fit_request *request, uint8_t *is_inlier, rse_pf_fit_result *result);

/* Estimate the scalar s for which the landmarks, displaced by s * displacements, explain the residuals at the pose.
 *
 * The tracker uses it for the displacement by a rolling shutter.  s and a correction of the pose are solved together
 * by one Gauss-Newton step with Cauchy weights over all rows, outliers too, and the correction is discarded.
 *
 * displacements: rows x 3, metres, camera axes, added to the landmark for s = 1.  Written: scalar, which is s, and
 * information, its inverse variance; both are 0 where a motion of the camera explains the same residuals, or where the
 * rows do not determine the pose.  gate2 of the request has no effect, but must be valid (0..1e9).  Returns 0, or -1
 * if a size or a number is not valid. */
int32_t rse_pf_fit_sway(const rse_pf_fit_request *request, const double *displacements, double *scalar,
                        double *information);

#ifdef __cplusplus
}
#endif
