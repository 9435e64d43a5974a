// The solver, compiled for AVX-512, with vectors of eight doubles and 32 registers: the Makefile compiles this file
// with -mavx512f -mavx512dq -mavx512vl.
#if defined(__x86_64__)
#define RSE_PF_ISA rse_pf_avx512
#include "solve.hpp"

void rse_pf::avx512::solve(const rse_pf::Task& task) { rse_pf_avx512::solve_task(task); }
#endif
