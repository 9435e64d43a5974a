// The same solver with vectors of eight doubles and twice the registers; the build compiles this file for
// AVX-512.
#if defined(__x86_64__)
#define RSE_PF_ISA rse_pf_avx512
#include "solve.hpp"

void rse_pf::avx512::solve(const rse_pf::Task& task) { rse_pf_avx512::solve_task(task); }
#endif
