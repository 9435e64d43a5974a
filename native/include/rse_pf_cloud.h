/* The C ABI of a cloud of voxels: each holds the mean place and colour of the readings that fell into it.
 *
 * It may be called from any thread, on memory of its own.  Nothing is allocated, and equal arguments give equal bytes
 * on every processor. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_CLOUD_ABI 1

/* Return RSE_PF_CLOUD_ABI of the library, to compare with the header's. */
uint32_t rse_pf_cloud_abi(void);

typedef struct rse_pf_cloud_request {
    uint32_t abi;
    uint32_t flags;          /* 0 */
    int64_t rows;            /* of the readings */
    const double *points;    /* rows x 3, metres, world */
    const float *colours;    /* rows x 3 */
    const int32_t *readings; /* rows: how many readings a row stands for, above 0 */
    double voxel_m;
    int64_t reach;           /* voxels on either side of the origin; beyond, rows are left out */
    int64_t slots;           /* of the hash table, a power of two */
    int64_t *slot_keys;      /* slots: key of a voxel, -1 in an empty slot */
    int32_t *slot_rows;      /* slots: row of the voxel */
    int64_t size, room;      /* voxels that there are, and that there is room for; below slots */
    int64_t *keys;           /* room */
    float *means;            /* room x 6: metres, then colours */
    int32_t *counts;         /* room: readings */
    int64_t used, probes;    /* written: readings that were added, and slots that were read */
} rse_pf_cloud_request;

typedef struct rse_pf_cloud_frame {
    int64_t width, height, every_px; /* each row and column that every_px divides is taken */
    const float *depth_m;            /* height x width */
    const uint8_t *rgb;              /* height x width x 3 */
    double fx, fy, cx, cy;
    float min_depth_m, max_depth_m;
    float edge_share;                /* a neighbour differs by at most this share of the right or lower depth */
    float zero;
    double T_world_camera[16];       /* row-major */
} rse_pf_cloud_frame;

/* Add readings to voxels, in their order, and update size, used and probes; return 0, -1 if a size does not fit.  Voxels
 * for which there is no room are left out. */
int32_t rse_pf_cloud_add(rse_pf_cloud_request *request);

/* Do that for what a depth camera shows; points, colours and readings of the request are not read. */
int32_t rse_pf_cloud_add_frame(rse_pf_cloud_request *request, const rse_pf_cloud_frame *frame);

/* Fill the hash table with the voxels that there are, such as after it grew; return 0, -1 if a size does not fit.  Rows
 * are not read. */
int32_t rse_pf_cloud_index(rse_pf_cloud_request *request);

#ifdef __cplusplus
}
#endif
