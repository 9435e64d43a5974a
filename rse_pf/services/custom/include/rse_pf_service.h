/* The C interface of an RSE-PF service, version 1.
 *
 * A service is a shared library that exports the functions below.  The library runs in the sandbox of one robot: a
 * process with one thread, without network, whose current folder is a private scratch folder.
 *
 * Required:  rse_pf_service_abi, rse_pf_service_open, rse_pf_service_close, rse_pf_service_free, and at least
 *            one of rse_pf_service_call (JSON bytes) and rse_pf_service_call_arrays (typed arrays; preferred).
 * Optional:  rse_pf_service_error, rse_pf_service_snapshot with rse_pf_service_restore.
 *
 * Memory:    Memory that the platform passes in belongs to the platform, and is valid during the call only.
 *            Memory that the service passes out belongs to the service until the platform gives it back with
 *            rse_pf_service_free, once and before the next call.  After a call that fails, the platform neither reads
 *            nor gives back what it passed out.
 * Errors:    A function returns RSE_PF_OK or an error code of enum rse_pf_status; the robot receives the text of
 *            rse_pf_service_error.  After a crash, an abort or an exit of the process, the platform answers the command
 *            of this robot with a failure; other robots do not notice.
 * C++:       No exception may leave these functions; rse_pf_service.hpp catches them.
 */
#ifndef RSE_PF_SERVICE_H
#define RSE_PF_SERVICE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Version of this interface; a library that was compiled with another version is not loaded. */
#define RSE_PF_SERVICE_ABI 1

#if defined(_WIN32)
#define RSE_PF_EXPORT __declspec(dllexport)
#else
#define RSE_PF_EXPORT __attribute__((visibility("default")))
#endif

/* Result of a function; the comments name the error code that the robot receives.  Any other number counts as
 * RSE_PF_FAILED. */
enum rse_pf_status {
  RSE_PF_OK = 0,
  RSE_PF_BAD_REQUEST = 1, /* the request is invalid: "bad-request" */
  RSE_PF_FAILED = 2,      /* the request is valid, but has no result: "failed" */
  RSE_PF_DEGENERATE = 3   /* the geometry of the request does not determine a result: "degenerate" */
};

/* Type of a field. */
enum rse_pf_type {
  RSE_PF_FLOAT64 = 1, /* data: count doubles in the byte order of the machine, row-major */
  RSE_PF_TEXT = 2     /* data: count bytes of UTF-8, without a terminating zero */
};

/* A named field of a request or a reply.  The numbers of a request are finite. */
typedef struct rse_pf_field {
  const char *name;  /* UTF-8 with a terminating zero */
  uint32_t type;     /* enum rse_pf_type */
  uint32_t rank;     /* axes, 0 to 4: 0 for a single number or a text, 1 for a flat array */
  uint64_t shape[4]; /* length of each axis; the first `rank` numbers are read */
  uint64_t count;    /* doubles or bytes in data; for a rank above 0 the product of the lengths in shape */
  const void *data;
} rse_pf_field;

/* Return RSE_PF_SERVICE_ABI, the version of this interface with which the library was compiled. */
RSE_PF_EXPORT uint32_t rse_pf_service_abi(void);

/* Prepare the service; called before the first request.  Files may be written to scratch_folder only.  The platform
 * passes *state to every other function but rse_pf_service_abi.  After a failure it reports the returned code only, and
 * calls this function again for the next request. */
RSE_PF_EXPORT int rse_pf_service_open(const char *scratch_folder, void **state);

/* Release the state.  The platform ends the process of a sandbox without a call of this function; programs that load
 * the library themselves, such as tests, call it after the last request. */
RSE_PF_EXPORT void rse_pf_service_close(void *state);

/* Compute the reply to one request; both are arrays of fields.  A reply has at most 1,024 fields, of at most 2^28 bytes
 * each; a robot receives an array of a reply as a flat list of numbers, without its shape.  The platform gives back
 * *reply as one block; what the fields point to must be valid until then. */
RSE_PF_EXPORT int rse_pf_service_call_arrays(void *state, const rse_pf_field *request, uint32_t request_fields,
                                             rse_pf_field **reply, uint32_t *reply_fields);

/* Compute the reply to one request; both are JSON texts; the reply has at most 2^28 bytes.  Not called if the library
 * exports rse_pf_service_call_arrays. */
RSE_PF_EXPORT int rse_pf_service_call(void *state, const uint8_t *request, uint64_t request_size, uint8_t **reply,
                                      uint64_t *reply_size);

/* Release memory that a call or a snapshot passed out; it may be NULL. */
RSE_PF_EXPORT void rse_pf_service_free(void *state, void *memory);

/* Return why the last call failed, UTF-8 with a terminating zero, or NULL; valid until the next call. */
RSE_PF_EXPORT const char *rse_pf_service_error(void *state);

/* Pass out the state as at most 2^28 bytes, from which rse_pf_service_restore continues in another process; called
 * after each request that had a reply. */
RSE_PF_EXPORT int rse_pf_service_snapshot(void *state, uint8_t **data, uint64_t *size);

/* Replace the state by a snapshot, whose bytes are valid during the call only. */
RSE_PF_EXPORT int rse_pf_service_restore(void *state, const uint8_t *data, uint64_t size);

#ifdef __cplusplus
}
#endif
#endif
