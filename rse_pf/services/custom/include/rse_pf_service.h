/* The C interface of an RSE-PF service, version 1.
 *
 * A service is a shared library that exports the functions below.  It runs in the robot's own isolated
 * sandbox: one process per robot, one thread, no network, its current folder is a private scratch folder.
 *
 * Required:  rse_pf_service_abi, rse_pf_service_open, rse_pf_service_close, rse_pf_service_free, and at least
 *            one of rse_pf_service_call (JSON bytes) and rse_pf_service_call_arrays (typed arrays; preferred).
 * Optional:  rse_pf_service_error, rse_pf_service_snapshot with rse_pf_service_restore.
 *
 * Memory:    what the platform passes in belongs to the platform and is valid during the call only.
 *            What the service passes out belongs to the service until the platform gives it back with
 *            rse_pf_service_free, exactly once and before the next call.
 * Errors:    a function returns RSE_PF_OK or one of the codes; the robot gets the text of rse_pf_service_error.
 *            A crash, an abort or an exit is answered for you, to this robot alone.
 * C++:       do not let exceptions out of these functions; rse_pf_service.hpp sees to that.
 */
#ifndef RSE_PF_SERVICE_H
#define RSE_PF_SERVICE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define RSE_PF_SERVICE_ABI 1

#if defined(_WIN32)
#define RSE_PF_EXPORT __declspec(dllexport)
#else
#define RSE_PF_EXPORT __attribute__((visibility("default")))
#endif

/* What a function returns. */
enum rse_pf_status {
  RSE_PF_OK = 0,
  RSE_PF_BAD_REQUEST = 1, /* the robot's mistake: it gets "bad-request" */
  RSE_PF_FAILED = 2,      /* the request was good, there is no answer: "failed" */
  RSE_PF_DEGENERATE = 3   /* the geometry does not fix an answer: "degenerate" */
};

/* What a field holds. */
enum rse_pf_type {
  RSE_PF_FLOAT64 = 1, /* data: count doubles in the machine's order, row after row */
  RSE_PF_TEXT = 2     /* data: count bytes of UTF-8, not terminated */
};

/* One named field of a request or a reply.  rank 0 is a single number or a text; an array that a robot sends
 * flat has rank 1. */
typedef struct rse_pf_field {
  const char *name; /* UTF-8, terminated */
  uint32_t type;    /* enum rse_pf_type */
  uint32_t rank;    /* 0 to 4 */
  uint64_t shape[4];
  uint64_t count; /* numbers or bytes in data */
  const void *data;
} rse_pf_field;

/* Version of this interface that the library was built for: return RSE_PF_SERVICE_ABI. */
RSE_PF_EXPORT uint32_t rse_pf_service_abi(void);

/* Called once, before the first request.  *state is handed to every other function. */
RSE_PF_EXPORT int rse_pf_service_open(const char *scratch_folder, void **state);

/* Called once, after the last request. */
RSE_PF_EXPORT void rse_pf_service_close(void *state);

/* One request: fields in, fields out. */
RSE_PF_EXPORT int rse_pf_service_call_arrays(void *state, const rse_pf_field *request, uint32_t request_fields,
                                             rse_pf_field **reply, uint32_t *reply_fields);

/* One request: JSON text in, JSON text out. */
RSE_PF_EXPORT int rse_pf_service_call(void *state, const uint8_t *request, uint64_t request_size, uint8_t **reply,
                                      uint64_t *reply_size);

/* Give back what a call or a snapshot passed out. */
RSE_PF_EXPORT void rse_pf_service_free(void *state, void *memory);

/* What went wrong in the last call, UTF-8, terminated; valid until the next one. */
RSE_PF_EXPORT const char *rse_pf_service_error(void *state);

/* The state as bytes, so that rse_pf_service_restore can go on from it on another server. */
RSE_PF_EXPORT int rse_pf_service_snapshot(void *state, uint8_t **data, uint64_t *size);
RSE_PF_EXPORT int rse_pf_service_restore(void *state, const uint8_t *data, uint64_t size);

#ifdef __cplusplus
}
#endif
#endif
