/* The C ABI of a tracker: matches near predicted pixels, and the pose that fits landmarks.
 *
 * Every function may be called from any thread, on arrays of its own.  Nothing is allocated, and equal
 * arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_TRACK_ABI 2

/* Return RSE_PF_TRACK_ABI of the library, to compare with the header's. */
uint32_t rse_pf_track_abi(void);

/* For each feature of an image write the least Hamming distance to another feature that is at least apart_px away
 * in a row or a column, 256 without one, and return 0; -1 if a size does not fit.
 *
 * descriptors: rows x 32; pixels: rows x 2. */
int32_t rse_pf_distinct(const uint8_t *descriptors, const double *pixels, int64_t rows, double apart_px,
                        int32_t *distinct);

typedef struct rse_pf_near_request {
    uint32_t abi;
    uint32_t flags;                 /* 0 */
    int64_t sought_rows, rows;      /* of the sought features; of the image's */
    const double *predicted;        /* sought_rows x 2: where they are expected */
    const double *sought_turns;     /* sought_rows x 2: their expected orientation, unit vectors or shorter */
    const double *sought_sizes;     /* sought_rows: their expected size, above 0 */
    const uint8_t *sought;          /* sought_rows x 32 */
    const double *pixels;           /* rows x 2 */
    const double *turns;            /* rows x 2, unit vectors */
    const double *sizes;            /* rows, above 0 */
    const uint8_t *descriptors;     /* rows x 32 */
    const int32_t *distinct;        /* rows, of rse_pf_distinct */
    double radius_px;               /* of the search */
    double ratio;                   /* the nearest must be this much nearer than the second within the radius */
    double distinct_ratio;          /* and this much nearer than its own image's most similar feature */
    double min_cosine;              /* between the expected orientation and that of the feature */
    double max_size_ratio;          /* between the sizes, either way */
    int64_t max_distance;           /* Hamming */
} rse_pf_near_request;

/* Numbers of 8 bytes that rse_pf_match_near works in. */
#define RSE_PF_NEAR_WORKSPACE(sought_rows, rows) ((sought_rows) + 12 * (rows) + 16400)

/* Match sought features to features of an image near predicted pixels; return the number of matches, -1 if a size
 * does not fit.  The first of equals is taken; of the sought features that take one feature the nearest stays, the
 * first of equals.  Writes the row of both for each match, by the rows of the sought features; there is room for
 * min(sought_rows, rows). */
int64_t rse_pf_match_near(const rse_pf_near_request *request, uint64_t *workspace, int64_t *sought_matched,
                          int64_t *matched);

typedef struct rse_pf_seek_request {
    uint32_t abi;
    uint32_t flags;             /* 0 */
    int64_t rows, landmarks;    /* of the sought numbers; of the arrays of landmarks */
    const int64_t *numbers;     /* rows: landmarks that are sought; none is beyond the arrays */
    const double *points;       /* landmarks x 3, metres, world */
    const double *rays;         /* landmarks x 3: from the camera that saw a landmark last to it, metres, world */
    const double *turns;        /* landmarks x 3: its orientation in that image, world */
    const double *sizes;        /* landmarks: its size in that image, above 0 */
    const uint8_t *descriptors; /* landmarks x 32 */
    double fx, fy, cx, cy, width, height;
    double margin_px;           /* around the image */
    double nearest_m;           /* along the optical axis */
    double min_cosine;          /* between the rays of now and of then */
    double max_nearer, max_farther; /* ratio of the distances of then and now, and of now and then */
    double T_camera_world[16];  /* row-major */
} rse_pf_seek_request;

/* Find landmarks in an image as a pose expects them there, and match them as rse_pf_match_near does; what image says
 * of sought features is not read.  Writes the row of the numbers and that of the image for each match.  workspace has
 * room for 10 * rows + RSE_PF_NEAR_WORKSPACE(rows, image->rows) numbers. */
int64_t rse_pf_seek(const rse_pf_seek_request *request, const rse_pf_near_request *image, uint64_t *workspace,
                    int64_t *sought_matched, int64_t *matched);

typedef struct rse_pf_fit_request {
    uint32_t abi;
    uint32_t flags;           /* 0 */
    int64_t rows;
    const double *points;     /* rows x 3, metres, world */
    const double *spreads;    /* rows x 6: upper triangle of the covariance of the point, square metres, world */
    const double *pixels;     /* rows x 2 */
    const double *pixels_px;  /* rows: deviation of the pixel */
    const double *depths_m;   /* rows: depth along the optical axis, 0 where there is none */
    const double *depths_dev; /* rows: deviation of that depth, metres; not read where there is none */
    double fx, fy, cx, cy;
    double cauchy2;           /* squared distance (in deviations) at which a row weighs half */
    double gate2;             /* squared distance beyond which a row is no inlier */
    double T_camera_world[16]; /* row-major: where the fit begins */
} rse_pf_fit_request;

typedef struct rse_pf_fit_result {
    int64_t inliers;
    double T_camera_world[16];
    double information[36]; /* of the twist (metres, then radians) left of the pose, by the inliers */
} rse_pf_fit_result;

/* Fit the pose to pixels and depths by the noise of both and of the points, robustly, and write which rows are
 * inliers (rows bytes, 0 or 1); return 0, 1 if some motion is free, -1 if a size or a number does not fit. */
int32_t rse_pf_fit_pose(const rse_pf_fit_request *request, uint8_t *is_inlier, rse_pf_fit_result *result);

/* Write by how much motions of the points (rows x 3, in the camera's frame) explain what is left of the errors at the
 * pose, solved together with the pose by one step, and the information of that number; both 0 where a motion of the
 * camera explains the same.  Return 0, -1 if a size or a number does not fit.  gate2 is not read. */
int32_t rse_pf_fit_sway(const rse_pf_fit_request *request, const double *sways, double *more, double *information);

#ifdef __cplusplus
}
#endif
