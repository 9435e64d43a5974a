/* C interface of a robot's front end: ORB keypoints and descriptors, depths at keypoints, and brute-force matching.
 *
 * Every function may be called from any thread, on arrays of its own.  Nothing is allocated, and equal arguments give
 * equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header, for the caller to compare with rse_pf_match_abi. */
#define RSE_PF_MATCH_ABI 4

/* Flag of rse_pf_match: compute without AVX2 and AVX-512.  The bytes of the result are the same. */
#define RSE_PF_MATCH_PORTABLE 1u
/* Flag of rse_pf_match: compute without AVX-512; AVX2 stays allowed.  The bytes of the result are the same. */
#define RSE_PF_MATCH_AVX2 2u

/* Return the RSE_PF_MATCH_ABI with which the library was compiled. */
uint32_t rse_pf_match_abi(void);

/* Back-project pixels of a depth image to points of the camera frame.
 *
 * The depth of a pixel is the median of the valid depths, which are finite and above 0, of the 3x3 patch around the
 * nearest pixel.  All three coordinates of the point are NaN where the patch is not inside the image, where it has
 * fewer than five valid depths, where the largest and the smallest of them differ by `spread` times the median or more,
 * or where the median is not within min_depth_m..max_depth_m.
 *
 * depth_m: height x width, row-major, metres along the optical axis; pixels: rows x 2 (column, row); fx, fy, cx, cy:
 * pinhole intrinsics, pixels; points_camera: memory for rows x 3 numbers, metres.  Returns 0, -1 if a size is not
 * valid or a pointer is null. */
int32_t rse_pf_points_at(const float *depth_m, int64_t width, int64_t height, const double *pixels, int64_t rows,
                         double fx, double fy, double cx, double cy, double min_depth_m, double max_depth_m,
                         double spread, double *points_camera);

/* Match the 256-bit descriptors of a reference image to those of a frame, one to one.
 *
 * A reference descriptor is matched to the frame descriptor with the smallest Hamming distance if that distance is
 * below `ratio` times the second smallest (Lowe's ratio test).  Of several reference descriptors that choose the same
 * frame descriptor, the one with the smallest distance stays, and the others have no match.  Ties go to the lower row
 * number.  A frame with fewer than two descriptors has no matches.
 *
 * reference: reference_rows x 32 bytes; frame: frame_rows x 32 bytes; flags: 0 or one of the flags above; workspace:
 * memory for reference_rows + 5 * frame_rows + 64 numbers; rows and columns: memory for min(reference_rows, frame_rows)
 * row numbers of the reference and of the frame, written by ascending distance, then by reference row.  Returns the
 * number of matches, -1 if a size is not valid or a pointer is null. */
int64_t rse_pf_match(const uint8_t *reference, int64_t reference_rows, const uint8_t *frame, int64_t frame_rows,
                     double ratio, uint32_t flags, uint64_t *workspace, int64_t *rows, int64_t *columns);

typedef struct rse_pf_detect_request {
    const uint8_t *gray;         /* height x width grey levels, row-major */
    int64_t width, height;       /* pixels */
    const float *scales;         /* levels: how many times smaller than the image each pyramid level is, ascending; the
                                    first one is 1 */
    const int64_t *wanted;       /* levels: keypoints wanted of each pyramid level; equal ones may make more */
    int32_t levels, threshold;   /* pyramid levels; FAST threshold in grey levels */
    int64_t room;                /* keypoints for which the output arrays have room */
    uint64_t *workspace;         /* memory for width * height / 2 + 8 * width + height + 64 numbers */
} rse_pf_detect_request;

/* Detect ORB keypoints, equal to those of OpenCV bit by bit and in the same order.
 *
 * Written for each keypoint: pixels (rows x 2: column and row in the whole image), Harris response, orientation in
 * degrees (0..360, clockwise from the x axis), and octave (pyramid level).  Returns the number of keypoints, or
 * -1 if a size is not valid, if a level has less than 2 px on a side, if `room` is too small, if the order in which
 * OpenCV leaves the keypoints is not known, or if the processor lacks AVX2; the caller then uses OpenCV. */
int64_t rse_pf_detect(const rse_pf_detect_request *request, float *pixels, float *responses, float *angles_deg,
                      int32_t *octaves);

/* Compute the ORB descriptors of keypoints, equal to those of OpenCV bit by bit.
 *
 * gray: height x width grey levels, row-major; scales: as in rse_pf_detect_request; pixels: rows x 2, in the whole
 * image; cosines, sines: of the keypoints' orientations; octaves: their pyramid levels; workspace: memory for 3 * width
 * * height / 8 + 7 * width + 64 numbers; descriptors: memory for rows x 32 bytes.  Returns 0, or -1 if a size, an
 * octave or an orientation is not valid, if a keypoint lies within 22 px of the border of its level, or if the
 * processor lacks AVX2 or FMA; the caller then uses OpenCV.  With -1, `descriptors` may be written in part. */
int32_t rse_pf_describe(const uint8_t *gray, int64_t width, int64_t height, const float *scales, int32_t levels,
                        const float *pixels, const float *cosines, const float *sines, const int32_t *octaves,
                        int64_t rows, uint64_t *workspace, uint8_t *descriptors);

#ifdef __cplusplus
}
#endif
