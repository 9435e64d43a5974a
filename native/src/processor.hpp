// What the processor can do and the operating system allows: own checks, because __builtin_cpu_supports answers 0
// in a library that zig builds.
#pragma once

namespace rse_pf {

struct Processor {
    bool avx2, fma;
    bool avx512;           // AVX-512 F, DQ and VL
    bool avx512_popcount;  // AVX-512 F and VPOPCNTDQ
};

// Return what this process may use; asked once, when the library is loaded.
const Processor& processor();

}  // namespace rse_pf
