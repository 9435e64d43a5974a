/* The C ABI of features: keypoints, descriptors, points at keypoints, and matches of descriptors of 256 bits.
 *
 * Every function may be called from any thread, on arrays of its own.  Nothing is allocated, and equal
 * arguments give equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_MATCH_ABI 4

/* Use no AVX2 and AVX-512, or no AVX-512, for tests: the bytes of the result are the same. */
#define RSE_PF_MATCH_PORTABLE 1u
#define RSE_PF_MATCH_AVX2 2u

/* Return RSE_PF_MATCH_ABI of the library, to compare with the header's. */
uint32_t rse_pf_match_abi(void);

/* Write the rows x 3 points of the camera frame that are seen at rows x 2 pixels, and return 0; -1 if a size
 * does not fit.
 *
 * The depth of a pixel is the median of its 3x3 patch; it is NaN where fewer than five readings are finite and
 * above 0, where they differ by more than spread * median, or where the median is out of range.
 * depth_m: height x width, row-major, metres along the optical axis. */
int32_t rse_pf_points_at(const float *depth_m, int64_t width, int64_t height, const double *pixels, int64_t rows,
                         double fx, double fy, double cx, double cy, double min_depth_m, double max_depth_m,
                         double spread, double *points_camera);

/* Match the descriptors of a reference view to those of a frame; return the number of matches, -1 if a size does not
 * fit.
 *
 * Descriptors have 256 bits.  A reference row takes the frame row at the least Hamming distance, the first one of
 * equals, if that distance is less than ratio times the second least.  Of the reference rows that take one frame row
 * the nearest stays, the first one of equals.  Matches are written by ascending distance, equals by reference row.
 * rows and columns have room for min(reference_rows, frame_rows) numbers; workspace has room for reference_rows +
 * 5 * frame_rows + 64. */
int64_t rse_pf_match(const uint8_t *reference, int64_t reference_rows, const uint8_t *frame, int64_t frame_rows,
                     double ratio, uint32_t flags, uint64_t *workspace, int64_t *rows, int64_t *columns);

/* An image of height x width, row-major; the scale of each level, 1 and more, and how many keypoints it gives;
 * FAST's threshold; for how many keypoints there is room; width * height / 2 + 8 * width + height + 64 numbers. */
typedef struct rse_pf_detect_request {
    const uint8_t *gray;
    int64_t width, height;
    const float *scales;
    const int64_t *wanted;
    int32_t levels, threshold;
    int64_t room;
    uint64_t *workspace;
} rse_pf_detect_request;

/* Write ORB's keypoints in OpenCV's order, bit by bit its own, and return their number; -1 if a size does not fit, if
 * there is no room, or if the processor lacks AVX2.
 *
 * pixels: rows x 2, of the whole image; the Harris measure, the orientation and the octave (level) of each. */
int64_t rse_pf_detect(const rse_pf_detect_request *request, float *pixels, float *responses, float *angles_deg,
                      int32_t *octaves);

/* Write ORB's descriptors (rows x 32) of keypoints, bit by bit those of OpenCV, and return 0; -1 if a size does not
 * fit, if a keypoint is nearer than 22 px to the edge of its level, or if the processor lacks AVX2 or FMA.
 *
 * gray: height x width, row-major.  scales: of each level, 1 and more.  pixels: rows x 2, of the whole image; the
 * cosine, sine and octave (level) of each keypoint.  workspace: 3 * width * height / 8 + 7 * width + 64 numbers. */
int32_t rse_pf_describe(const uint8_t *gray, int64_t width, int64_t height, const float *scales, int32_t levels,
                        const float *pixels, const float *cosines, const float *sines, const int32_t *octaves,
                        int64_t rows, uint64_t *workspace, uint8_t *descriptors);

#ifdef __cplusplus
}
#endif
