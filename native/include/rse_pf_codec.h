/* The C ABI of the codecs' hot path: guards, inflating, reading a `pnp` command into arrays, and from these
 * arrays to the bytes of its reply.
 *
 * Every byte comes from a stranger.  Nothing is read outside of `data` and nothing is written outside of the
 * buffers of the call.  What is not plainly a `pnp` command is RSE_PF_CODEC_NOT_MINE and left to the decoder
 * in Python; nothing is guessed.  Every function may be called from any thread, on buffers of its own. */
#ifndef RSE_PF_CODEC_H
#define RSE_PF_CODEC_H

#include <stdint.h>

#include "rse_pf_native.h"

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_CODEC_ABI 4

/* Bytes behind `text_room` and `deflated` that a call may write to. */
#define RSE_PF_CODEC_SLACK 64

enum rse_pf_codec_status {
    RSE_PF_CODEC_READ = 0,        /* The command is in the call, its arrays are in `numbers`. */
    RSE_PF_CODEC_NOT_MINE = 1,    /* The guards have passed it; decode it elsewhere. */
    RSE_PF_CODEC_CONTAINERS = 2,  /* A limit of the budget is exceeded. */
    RSE_PF_CODEC_DEPTH = 3,
    RSE_PF_CODEC_VALUES = 4,
    RSE_PF_CODEC_MEMORY = 5,
    RSE_PF_CODEC_CUT_OFF = 6,     /* MessagePack: it ends within a value. */
    RSE_PF_CODEC_FOLLOWED = 7,    /* MessagePack: bytes follow the value. */
    RSE_PF_CODEC_NOT_ZLIB = 8,
    RSE_PF_CODEC_NOT_ONE_STREAM = 9,
    RSE_PF_CODEC_TOO_LARGE = 10,  /* It inflates to more than `limit` of the call. */
    RSE_PF_CODEC_NEEDS_ROOM = 11, /* It inflates to more than `text_room`; ask again with more. */
    RSE_PF_CODEC_MANY_BLOCKS = 13, /* A deflate stream of more blocks than its bytes explain. */
    RSE_PF_CODEC_UNKNOWN = 12     /* These limits are not known here; judge it elsewhere. */
};

enum rse_pf_codec_encoding { RSE_PF_CODEC_JSON = 0, RSE_PF_CODEC_ZLIB = 1, RSE_PF_CODEC_MSGPACK = 2 };

/* rse_pf.budget.Budget, without the size on the wire. */
typedef struct rse_pf_codec_budget {
    int64_t inflated_bytes, free_bytes;
    double inflate_ratio;
    int64_t depth, containers, values, mixed_values, memory_bytes;
    int64_t short_bytes; /* Above 0: what inflates to more is RSE_PF_CODEC_NEEDS_ROOM, however much room there is. */
} rse_pf_codec_budget;

/* Which fields of a command were there. */
#define RSE_PF_CODEC_HAS_DEADLINE 1
#define RSE_PF_CODEC_HAS_KEEP 2
#define RSE_PF_CODEC_HAS_OPTIONS 4
#define RSE_PF_CODEC_HAS_ENGINE 8
#define RSE_PF_CODEC_HAS_INLIER_PX 16
#define RSE_PF_CODEC_HAS_MAX_ITERATIONS 32
#define RSE_PF_CODEC_HAS_MIN_ITERATIONS 64
#define RSE_PF_CODEC_HAS_CONFIDENCE 128

typedef struct rse_pf_codec_call {
    uint8_t *text;    /* for what is inflated: text_room bytes and RSE_PF_CODEC_SLACK more */
    int64_t text_room;
    double *numbers;  /* the points, the pixels, the depths */
    int64_t numbers_room;
    /* What was found: */
    int64_t text_bytes; /* inflated */
    int64_t limit;
    int64_t points, pixels, depths; /* numbers of each */
    int64_t id, seq;
    double deadline_ms;
    int64_t fields; /* RSE_PF_CODEC_HAS_... */
    /* Offsets and sizes in the text, or in `data` where nothing is inflated. */
    int64_t stream_at, stream_bytes, trace_at, trace_bytes;
    /* The same bytes mean the same camera and options. */
    double fx, fy, cx, cy;
    int64_t width, height;
    int64_t options; /* the fields that belong to the options */
    double inlier_px, confidence;
    int64_t max_iterations, min_iterations;
    char engine[16]; /* ASCII, zeros behind it */
} rse_pf_codec_call;

/* Return RSE_PF_CODEC_ABI of the library, to compare with the header's. */
uint32_t rse_pf_codec_abi(void);

/* Judge one JSON text or one MessagePack value by the budget; RSE_PF_CODEC_NOT_MINE if it may be decoded. */
int32_t rse_pf_codec_check(const uint8_t *data, int64_t bytes, const rse_pf_codec_budget *budget, int32_t encoding);

/* Inflate, judge, and read one message from a robot. */
int32_t rse_pf_codec_read(const uint8_t *data, int64_t bytes, const rse_pf_codec_budget *budget, int32_t encoding,
                          rse_pf_codec_call *call);

/* Return the size of the zlib stream of `text`, which is written to `deflated`; 0 if `room` may be too small.
 * 2 * bytes + 256 is enough. */
int64_t rse_pf_codec_deflate(const uint8_t *text, int64_t bytes, uint8_t *deflated, int64_t room);

typedef struct rse_pf_codec_answer {
    int64_t *inliers; /* room for inliers_room of them */
    int64_t inliers_room;
    uint8_t *reply;
    int64_t reply_room;
    rse_pf_pnp_result result;
} rse_pf_codec_answer;

/* Solve what a call has read and return the size of the reply, which is written to `reply` as JSON or MessagePack.
 *
 * `request` says all but the rows, which `numbers` holds: 3 * rows of points and 2 * rows of pixels.  0: there is
 * no pose, as the status of `result` says, or (with RSE_PF_PNP_SOLVED) it has to be asked for elsewhere. */
int64_t rse_pf_codec_solve(const rse_pf_pnp_request *request, const double *numbers, int64_t rows, int32_t encoding,
                           rse_pf_codec_answer *answer);

#ifdef __cplusplus
}
#endif
#endif
