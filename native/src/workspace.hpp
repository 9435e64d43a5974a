// The memory of one thread: arrays with an element for each correspondence, reused from request to request.
#pragma once

#include <cstdint>

#include "rse_pf_native.h"

namespace rse_pf {

// Correspondences as a structure of arrays.
template <class T>
struct Columns {
    T *x, *y, *z;  // point, metres, in the world frame shifted so that its origin is a median of the points
    T *u, *v;      // pixel, relative to the principal point
};

struct Workspace {
    Columns<float> single;    // all correspondences in single precision, for the search
    Columns<double> all;      // all correspondences in double precision
    Columns<double> inliers;  // the inliers of the pose without the rows between them, in double precision
    double *error2;           // squared reprojection error at the last projected pose, of each row of `all` or of
                              // `inliers`, whichever was projected last, px^2
    double *u, *v;            // projection of each row at that pose, pixels from the principal point
    double *z_inverse;        // inverse depth of each row at that pose, 1/m
    double *length2, *width2; // scratch of width_to_length: squared distances along and across the main axis
};

// One request with the memory that the solver uses for it: `inliers` of the caller gets the row numbers of the inliers.
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
