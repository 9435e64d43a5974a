// The solver, compiled for AVX2: the Makefile compiles this file with -mavx2.
#if defined(__x86_64__)
#define RSE_PF_ISA rse_pf_avx2
#include "solve.hpp"

void rse_pf::avx2::solve(const rse_pf::Task& task) { rse_pf_avx2::solve_task(task); }
#endif
