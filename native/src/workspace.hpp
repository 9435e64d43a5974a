// The memory of one thread: arrays for the rows of a request, kept for the next one.
#pragma once

#include <cstdint>

#include "rse_pf_native.h"

namespace rse_pf {

template <class T>
struct Columns {
    T *x, *y, *z, *u, *v;  // metres in the centred world; pixels from the principal point
};

struct Workspace {
    Columns<float> single;
    Columns<double> all, inliers;
    double *error2, *u, *v, *z_inverse;  // the view of all rows from the pose
    double *along, *aside;               // scratch of the width of a cloud of points
};

// What the caller of the solvers has prepared; the centre was taken from all points.
struct Task {
    const rse_pf_pnp_request* request;
    Workspace* workspace;
    uint32_t* inliers;
    rse_pf_pnp_result* result;
};

namespace portable {
void solve(const Task& task);
}
#if defined(__x86_64__)
namespace avx2 {
void solve(const Task& task);
}
namespace avx512 {
void solve(const Task& task);
}
#endif

}  // namespace rse_pf
