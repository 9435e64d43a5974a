// The compiled core of icp-lua, as the paper has it: Lua decodes and encodes, a dynamic library computes.
#include "icp.hpp"

extern "C" __attribute__((visibility("default"))) double icp_align(const double *source, int n,
                                                                   const double *target, int m,
                                                                   int iterations, double *T_target_source) {
  icp::Motion T;
  double rmse = icp::align(source, n, target, m, iterations, T);
  std::copy(T.begin(), T.end(), T_target_source);
  return rmse;
}
