// The vector instructions that the processor has and the operating system supports.  The library reads CPUID itself,
// because __builtin_cpu_supports returns 0 in a library that zig 0.17 compiled.
#pragma once

namespace rse_pf {

struct Processor {
    bool avx2, fma;
    bool avx512;           // AVX-512 F, DQ and VL
    bool avx512_popcount;  // AVX-512 F and VPOPCNTDQ
};

// Return the instructions that this process may use; they are determined once, when the library is loaded.  All are
// false on processors other than x86-64.
const Processor& processor();

}  // namespace rse_pf
