// The solver, compiled for every processor of the architecture (on x86-64: x86-64-v2).
#define RSE_PF_ISA rse_pf_portable
#include "solve.hpp"

void rse_pf::portable::solve(const rse_pf::Task& task) { rse_pf_portable::solve_task(task); }
