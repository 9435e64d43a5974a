// The C ABI: checks the request, lends the thread's workspace, and chooses the solver for the processor.
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

constexpr double kMaxAbs = 1e6;
constexpr int64_t kMaxRows = int64_t{1} << 24;
constexpr int64_t kFirstRows = 512;

// What a thread has allocated.  It is freed when the thread ends by the C library's own means: a destructor
// would need the C++ library, and with it symbols that an older C library lacks.
struct Memory {
    rse_pf::Workspace workspace;
    void* block;
    int64_t rows;

    static void release(void* memory) { std::free(static_cast<Memory*>(memory)->block); }

    template <class T>
    static T* taken(char*& from, int64_t count) {
        T* const begin = reinterpret_cast<T*>(from);
        from += static_cast<size_t>(count) * sizeof(T);
        return begin;
    }
    template <class T>
    static rse_pf::Columns<T> columns(char*& from, int64_t count) {
        rse_pf::Columns<T> each;
        each.x = taken<T>(from, count);
        each.y = taken<T>(from, count);
        each.z = taken<T>(from, count);
        each.u = taken<T>(from, count);
        each.v = taken<T>(from, count);
        return each;
    }

    bool holds(int64_t wanted) {
        if (wanted <= rows) return true;
        int64_t size = rows > kFirstRows ? rows : kFirstRows;
        while (size < wanted) size *= 2;
        void* const larger =
            std::aligned_alloc(64, static_cast<size_t>(size) * (5 * sizeof(float) + 16 * sizeof(double)));
        if (larger == nullptr) return false;
        if (block == nullptr && __cxa_thread_atexit_impl(release, this, &__dso_handle) != 0) {
            std::free(larger);
            return false;
        }
        std::free(block);
        block = larger;
        rows = size;
        char* at = static_cast<char*>(block);
        workspace.single = columns<float>(at, size);
        workspace.all = columns<double>(at, size);
        workspace.inliers = columns<double>(at, size);
        workspace.error2 = taken<double>(at, size);
        workspace.u = taken<double>(at, size);
        workspace.v = taken<double>(at, size);
        workspace.z_inverse = taken<double>(at, size);
        workspace.along = taken<double>(at, size);
        workspace.aside = taken<double>(at, size);
        return true;
    }
};

thread_local Memory memory;

bool within(double value, double low, double high) { return value >= low && value <= high; }

// Say whether all numbers are finite and at most 1e6 in size.
bool are_sane(const double* numbers, int64_t count) {
    int64_t wrong = 0;
    for (int64_t i = 0; i < count; ++i) wrong += within(numbers[i], -kMaxAbs, kMaxAbs) ? 0 : 1;
    return wrong == 0;
}

int32_t checked(const rse_pf_pnp_request& request, const uint32_t* inliers) {
    const bool is_whole =
        request.abi == RSE_PF_NATIVE_ABI && within(static_cast<double>(request.rows), 4, static_cast<double>(kMaxRows)) &&
        request.points_world != nullptr && request.pixels != nullptr &&
        inliers != nullptr && request.width > 0 && request.height > 0 && within(request.fx, 1e-9, 1e9) &&
        within(request.fy, 1e-9, 1e9) && within(request.cx, -1e9, 1e9) && within(request.cy, -1e9, 1e9) &&
        within(request.inlier_px, 1e-9, 1e4) && within(request.confidence, 1e-9, 1.0 - 1e-12) &&
        request.max_iterations > 0;
    if (!is_whole) return RSE_PF_PNP_BAD_REQUEST;
    if (!are_sane(request.points_world, 3 * request.rows)) return RSE_PF_PNP_BAD_POINTS;
    if (!are_sane(request.pixels, 2 * request.rows)) return RSE_PF_PNP_BAD_PIXELS;
    return RSE_PF_PNP_SOLVED;
}

enum class Lanes { portable, avx2, avx512 };

// Return the widest instructions of the processor that a request allows.
Lanes lanes_for(uint32_t flags) {
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
    const Lanes widest = lanes_for(0);
    return widest == Lanes::avx512 ? "avx512" : widest == Lanes::avx2 ? "avx2" : "portable";
}

__attribute__((visibility("default"))) void rse_pf_pnp_solve(const rse_pf_pnp_request* request, uint32_t* inliers,
                                                             rse_pf_pnp_result* result) {
    std::memset(result, 0, sizeof *result);
    result->status = checked(*request, inliers);
    if (result->status != RSE_PF_PNP_SOLVED) return;
    if (!memory.holds(request->rows + 8)) {
        result->status = RSE_PF_PNP_OUT_OF_MEMORY;
        return;
    }
    const rse_pf::Task task = {request, &memory.workspace, inliers, result};
#if defined(__x86_64__)
    const Lanes lanes = lanes_for(request->flags);
    if (lanes == Lanes::avx512) return rse_pf::avx512::solve(task);
    if (lanes == Lanes::avx2) return rse_pf::avx2::solve(task);
#endif
    rse_pf::portable::solve(task);
}
}
