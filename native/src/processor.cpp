// Detect vector instructions by CPUID, and by XGETBV whether the operating system saves their registers.
// Source: Intel, "Software Developer's Manual", volume 1, Sect. 14.3 and 15.2.
#include "processor.hpp"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace {

rse_pf::Processor detected = {};

#if defined(__x86_64__)
// Bits of CPUID leaf 1, register ECX.
constexpr unsigned kFma = 1u << 12;
constexpr unsigned kOsSavesState = 1u << 27;  // OSXSAVE: XGETBV may be executed
// Bits of CPUID leaf 7, register EBX.
constexpr unsigned kAvx2 = 1u << 5;
constexpr unsigned kAvx512F = 1u << 16;
constexpr unsigned kAvx512Dq = 1u << 17;
constexpr unsigned kAvx512Vl = 1u << 31;
constexpr unsigned kAvx512All = kAvx512F | kAvx512Dq | kAvx512Vl;
// Bit of CPUID leaf 7, register ECX: VPOPCNTDQ.
constexpr unsigned kAvx512Popcount = 1u << 14;
// Bits of XCR0, the registers that the operating system saves: SSE and AVX.
constexpr unsigned kAvxState = 0x6;
// Bits of XCR0: SSE, AVX, the mask registers of AVX-512, and its 512-bit registers.
constexpr unsigned kAvx512State = 0xE6;

// Return the low half of XCR0.
unsigned read_saved_state() {
    unsigned low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return low;
}

__attribute__((constructor)) void detect_instructions() {
    unsigned a, b, c, d;
    if (__get_cpuid(1, &a, &b, &c, &d) == 0 || (c & kOsSavesState) == 0) return;
    const unsigned state = read_saved_state();
    if ((state & kAvxState) != kAvxState) return;
    detected.fma = (c & kFma) != 0;
    if (__get_cpuid_count(7, 0, &a, &b, &c, &d) == 0) return;
    detected.avx2 = (b & kAvx2) != 0;
    if ((state & kAvx512State) != kAvx512State) return;
    detected.avx512 = detected.avx2 && (b & kAvx512All) == kAvx512All;
    detected.avx512_popcount = (b & kAvx512F) != 0 && (c & kAvx512Popcount) != 0;
}
#endif

}  // namespace

const rse_pf::Processor& rse_pf::processor() { return detected; }
