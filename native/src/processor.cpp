// Source: Intel, "Software Developer's Manual", volume 1, Sect. 14.3 and 15.2: CPUID, then XGETBV.
#include "processor.hpp"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace {

rse_pf::Processor found = {};

#if defined(__x86_64__)
constexpr unsigned kOsSavesState = 1u << 27, kFma = 1u << 12, kAvx2 = 1u << 5, kAvx512F = 1u << 16;
constexpr unsigned kAvx512Dq = 1u << 17, kAvx512Vl = 1u << 31, kAvx512All = kAvx512F | kAvx512Dq | kAvx512Vl;
constexpr unsigned kAvx512Popcount = 1u << 14;
// Parts of the state that the operating system saves: SSE and AVX; besides these, masks and the wide registers.
constexpr unsigned kAvxState = 0x6, kAvx512State = 0xE6;

unsigned saved_state() {
    unsigned low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return low;
}

__attribute__((constructor)) void ask() {
    unsigned a, b, c, d;
    if (__get_cpuid(1, &a, &b, &c, &d) == 0 || (c & kOsSavesState) == 0) return;
    const unsigned state = saved_state();
    if ((state & kAvxState) != kAvxState) return;
    found.fma = (c & kFma) != 0;
    if (__get_cpuid_count(7, 0, &a, &b, &c, &d) == 0) return;
    found.avx2 = (b & kAvx2) != 0;
    if ((state & kAvx512State) != kAvx512State) return;
    found.avx512 = found.avx2 && (b & kAvx512All) == kAvx512All;
    found.avx512_popcount = (b & kAvx512F) != 0 && (c & kAvx512Popcount) != 0;
}
#endif

}  // namespace

const rse_pf::Processor& rse_pf::processor() { return found; }
