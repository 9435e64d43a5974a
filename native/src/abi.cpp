// The C interface of the solver: validates the request, provides the memory of the calling thread, and calls the copy
// of the solver that was compiled for the widest vector instructions of the processor.
#include "rse_pf_native.h"

#include <cstdlib>
#include <cstring>

#include "processor.hpp"
#include "workspace.hpp"

extern "C" {
int __cxa_thread_atexit_impl(void (*release)(void*), void* object, void* library);
extern void* __dso_handle __attribute__((visibility("hidden")));
}

namespace {

// Largest coordinate of a point (m) or pixel (px): single precision has steps of 6 cm there, too coarse for any pose.
constexpr double kMaxAbs = 1e6;
// Largest number of correspondences: a float, which counts inliers, holds integers up to 2^24 exactly.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Correspondences for which the first allocation of a thread has room: more than a robot sends of one frame.
constexpr int64_t kFirstRows = 512;
// Bytes to which arrays are aligned: a vector of eight doubles, which is also a cache line.
constexpr size_t kAlignment = 64;

// The workspace that a thread keeps for its next request.  It is freed when the thread exits, by a function of the
// C library: a destructor would need the C++ library, and with it symbols that an older C library lacks.
struct Memory {
    rse_pf::Workspace workspace;
    void* block;
    int64_t rows;

    static void release(void* memory) { std::free(static_cast<Memory*>(memory)->block); }

    // Return the memory at `next` as an array of `count` elements, and move `next` behind it.
    template <class T>
    static T* take_array(char*& next, int64_t count) {
        T* const array = reinterpret_cast<T*>(next);
        next += static_cast<size_t>(count) * sizeof(T);
        return array;
    }
    template <class T>
    static rse_pf::Columns<T> take_columns(char*& next, int64_t count) {
        rse_pf::Columns<T> columns;
        columns.x = take_array<T>(next, count);
        columns.y = take_array<T>(next, count);
        columns.z = take_array<T>(next, count);
        columns.u = take_array<T>(next, count);
        columns.v = take_array<T>(next, count);
        return columns;
    }

    // Enlarge the workspace to at least a number of rows, whose values are lost then; return false, with the workspace
    // as it was, if there is no memory.
    bool reserve(int64_t wanted_rows) {
        if (wanted_rows <= rows) return true;
        int64_t size = rows > kFirstRows ? rows : kFirstRows;
        while (size < wanted_rows) size *= 2;
        void* const larger =
            std::aligned_alloc(kAlignment, static_cast<size_t>(size) * (5 * sizeof(float) + 16 * sizeof(double)));
        if (larger == nullptr) return false;
        if (block == nullptr && __cxa_thread_atexit_impl(release, this, &__dso_handle) != 0) {
            std::free(larger);
            return false;
        }
        std::free(block);
        block = larger;
        rows = size;
        char* next = static_cast<char*>(block);
        workspace.single = take_columns<float>(next, size);
        workspace.all = take_columns<double>(next, size);
        workspace.inliers = take_columns<double>(next, size);
        workspace.error2 = take_array<double>(next, size);
        workspace.u = take_array<double>(next, size);
        workspace.v = take_array<double>(next, size);
        workspace.z_inverse = take_array<double>(next, size);
        workspace.length2 = take_array<double>(next, size);
        workspace.width2 = take_array<double>(next, size);
        return true;
    }
};

thread_local Memory memory;

bool is_within(double value, double low, double high) { return value >= low && value <= high; }

// Return whether all numbers are finite and at most kMaxAbs in absolute value.
bool are_bounded(const double* numbers, int64_t count) {
    int64_t wrong = 0;
    for (int64_t i = 0; i < count; ++i) wrong += is_within(numbers[i], -kMaxAbs, kMaxAbs) ? 0 : 1;
    return wrong == 0;
}

// Return RSE_PF_PNP_SOLVED for a valid request, else the status that names its first fault.
int32_t validate(const rse_pf_pnp_request& request, const uint32_t* inliers) {
    const bool is_valid =
        request.abi == RSE_PF_NATIVE_ABI && is_within(static_cast<double>(request.rows), 4, static_cast<double>(kMaxRows)) &&
        request.points_world != nullptr && request.pixels != nullptr &&
        inliers != nullptr && request.width > 0 && request.height > 0 && is_within(request.fx, 1e-9, 1e9) &&
        is_within(request.fy, 1e-9, 1e9) && is_within(request.cx, -1e9, 1e9) && is_within(request.cy, -1e9, 1e9) &&
        is_within(request.inlier_px, 1e-9, 1e4) && is_within(request.confidence, 1e-9, 1.0 - 1e-12) &&
        request.max_iterations > 0;
    if (!is_valid) return RSE_PF_PNP_BAD_REQUEST;
    if (!are_bounded(request.points_world, 3 * request.rows)) return RSE_PF_PNP_BAD_POINTS;
    if (!are_bounded(request.pixels, 2 * request.rows)) return RSE_PF_PNP_BAD_PIXELS;
    return RSE_PF_PNP_SOLVED;
}

enum class Lanes { portable, avx2, avx512 };

// Return the widest vector instructions that the processor has and the flags of a request allow.
Lanes widest_lanes(uint32_t flags) {
#if defined(__x86_64__)
    if ((flags & RSE_PF_PNP_PORTABLE) != 0) return Lanes::portable;
    if (rse_pf::processor().avx512 && (flags & RSE_PF_PNP_AVX2) == 0) return Lanes::avx512;
    if (rse_pf::processor().avx2) return Lanes::avx2;
#else
    (void)flags;
#endif
    return Lanes::portable;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_native_abi(void) { return RSE_PF_NATIVE_ABI; }

__attribute__((visibility("default"))) const char* rse_pf_native_lanes(void) {
    const Lanes widest = widest_lanes(0);
    return widest == Lanes::avx512 ? "avx512" : widest == Lanes::avx2 ? "avx2" : "portable";
}

__attribute__((visibility("default"))) void rse_pf_pnp_solve(const rse_pf_pnp_request* request, uint32_t* inliers,
                                                             rse_pf_pnp_result* result) {
    std::memset(result, 0, sizeof *result);
    result->status = validate(*request, inliers);
    if (result->status != RSE_PF_PNP_SOLVED) return;
    if (!memory.reserve(request->rows + 8)) {  // The last vector of eight rows may be partly filled.
        result->status = RSE_PF_PNP_OUT_OF_MEMORY;
        return;
    }
    const rse_pf::Task task = {request, &memory.workspace, inliers, result};
#if defined(__x86_64__)
    const Lanes lanes = widest_lanes(request->flags);
    if (lanes == Lanes::avx512) return rse_pf::avx512::solve(task);
    if (lanes == Lanes::avx2) return rse_pf::avx2::solve(task);
#endif
    rse_pf::portable::solve(task);
}
}
