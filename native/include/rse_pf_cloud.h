/* C interface of the voxel grid that thins a point cloud: each voxel holds the mean position and colour of its points.
 *
 * Every function may be called from any thread, on memory of its own.  Nothing is allocated, and equal arguments give
 * equal bytes on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this header; a request that carries another version is refused with -1. */
#define RSE_PF_CLOUD_ABI 1

/* Return the RSE_PF_CLOUD_ABI with which the library was compiled. */
uint32_t rse_pf_cloud_abi(void);

/* The voxel grid, in memory of the caller, which the functions change in place, and the points that rse_pf_cloud_add
 * adds. */
typedef struct rse_pf_cloud_request {
    uint32_t abi;
    uint32_t flags;          /* 0 */
    int64_t rows;            /* points to add */
    const double *points;    /* rows x 3, metres, world frame */
    const float *colours;    /* rows x 3: red, green, blue, 0..255 */
    const int32_t *weights;  /* rows: number of measurements of which a point is the mean, above 0 */
    double voxel_m;          /* edge length of a voxel, metres */
    int64_t reach;           /* along each axis the grid ends this many voxels from the origin, at most 2^20; points
                                beyond are left out */
    int64_t slots;           /* size of the hash table, a power of two above max_voxels */
    int64_t *slot_keys;      /* slots: key of the voxel in a slot, -1 in an empty slot */
    int32_t *slot_rows;      /* slots: row of that voxel in keys, means and counts */
    int64_t voxels, max_voxels; /* voxels in the grid; rows of the three arrays below */
    int64_t *keys;           /* max_voxels: x << 42 | y << 21 | z, the place of a voxel from the negative end of the
                                grid along each axis */
    float *means;            /* max_voxels x 6: mean position (metres, world frame), mean colour */
    int32_t *counts;         /* max_voxels: measurements in a voxel */
    int64_t used, probes;    /* written by each call: measurements that it added (sum of the weights), and slots of the
                                hash table that it read */
} rse_pf_cloud_request;

/* One image of a depth camera with its pose. */
typedef struct rse_pf_cloud_frame {
    int64_t width, height, every_px; /* pixels whose row and column are multiples of every_px are added */
    const float *depth_m;            /* height x width, metres along the optical axis */
    const uint8_t *rgb;              /* height x width x 3, row-major */
    double fx, fy, cx, cy;           /* pinhole intrinsics, pixels */
    float min_depth_m, max_depth_m;  /* depths outside are left out */
    float edge_share;                /* below 1: a pixel whose depth differs from a neighbour's by more than this share
                                        of the right or lower depth of the two lies on a depth edge and is left out, as
                                        is a pixel beside one without a depth */
    float zero;                      /* 0, which fills the place before the doubles */
    double T_world_camera[16];       /* 4 x 4, row-major, maps camera to world */
} rse_pf_cloud_frame;

/* Add the points of the request to the grid, in their order, and update voxels, used and probes.
 *
 * Once max_voxels is reached, points that need a new voxel are left out, which only `used` shows.  Returns 0, or -1 if
 * a pointer is null or a size or the ABI version is not valid. */
int32_t rse_pf_cloud_add(rse_pf_cloud_request *request);

/* Add the pixels of a depth image to the grid, as rse_pf_cloud_add does with points; each has the weight 1.
 *
 * points, colours and weights of the request are not read, but must not be null.  Returns 0, or -1 if a pointer is null
 * or a size or the ABI version is not valid. */
int32_t rse_pf_cloud_add_frame(rse_pf_cloud_request *request, const rse_pf_cloud_frame *frame);

/* Write slot_keys and slot_rows anew from the first `voxels` keys, which is needed after the caller has enlarged them.
 *
 * points, colours and weights of the request are not read, but must not be null.  Returns 0, or -1 if a pointer is null
 * or a size or the ABI version is not valid. */
int32_t rse_pf_cloud_index(rse_pf_cloud_request *request);

#ifdef __cplusplus
}
#endif
