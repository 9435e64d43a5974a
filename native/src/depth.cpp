// Refinement of a pose with the depths of both images: Gauss-Newton on an errors-in-variables model with Cauchy
// weights. rse_pf/pnp/depth_refinement.py describes the model.
#include "rse_pf_depth.h"

#include <cstring>

#define RSE_PF_ISA rse_pf_depth_detail
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#include "processor.hpp"
#include "small.hpp"
#pragma GCC diagnostic pop

#include "depth_rows.hpp"

#if defined(__x86_64__)
#define RSE_PF_DEPTH_AVX2 __attribute__((target("avx2")))
#else
#define RSE_PF_DEPTH_AVX2
#endif

namespace {

using namespace rse_pf_depth_detail;

// Most correspondences of a request: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Most Gauss-Newton iterations of the refinement: the input pose is near the minimum.
constexpr int kMaxIterations = 6;
// Largest component (m, rad) of a Gauss-Newton step below which the refinement has converged.
constexpr double kConvergedStep = 1e-5;
// Largest coordinate of a point (m) or pixel (px): a limit of plausible requests.
constexpr double kMaxAbs = 1e6;
// Largest depth in the second image (m): a limit of plausible requests.
constexpr double kMaxDepthM = 1e3;
// Smallest standard deviation of a pixel (px) that is derived from the reprojection error, which may be small by chance
// where matches are few.
constexpr double kMinPixelPx = 0.05;
// Smallest factor by which the residuals may scale the covariance of the pose (1: they are as large as the assumed
// noise): few residuals may be small by chance.
constexpr double kMinScale = 0.01;
// Largest ratio of the root mean square reprojection errors after and before the refinement: a larger ratio shows that
// depths and pixels disagree, and the input pose stays.
constexpr double kMaxRmseGrowth = 1.5;
// Smallest root mean square reprojection error (px) with which the error after the refinement is compared: smaller
// errors of the input pose may grow more by chance.
constexpr double kMinRmsePx = 0.2;

bool is_within(double value, double low, double high) { return value >= low && value <= high; }

// Write the sums of the rows at a pose without AVX2; add_rows_with_avx2 gives the same bytes.
template <bool kIsLast>
void add_rows_portably(const Rows& rows, const Pose& pose, const Sensor& sensor, Sums& sums) {
    const double t[3] = {pose.t.x, pose.t.y, pose.t.z};
    add_rows<kIsLast>(rows, pose.R, t, sensor, sums);
}

template <bool kIsLast>
RSE_PF_DEPTH_AVX2 void add_rows_with_avx2(const Rows& rows, const Pose& pose, const Sensor& sensor, Sums& sums) {
    const double t[3] = {pose.t.x, pose.t.y, pose.t.z};
    add_rows<kIsLast>(rows, pose.R, t, sensor, sums);
}

template <bool kIsLast>
void add_all_rows(const Rows& rows, const Pose& pose, const Sensor& sensor, bool has_avx2, Sums& sums) {
    has_avx2 ? add_rows_with_avx2<kIsLast>(rows, pose, sensor, sums)
             : add_rows_portably<kIsLast>(rows, pose, sensor, sums);
}

bool may_use_avx2(uint32_t flags) {
#if defined(__x86_64__)
    return (flags & RSE_PF_DEPTH_PORTABLE) == 0 && rse_pf::processor().avx2;
#else
    (void)flags;
    return false;
#endif
}

// Return RSE_PF_DEPTH_REFINED for a valid request, else the status that names its first fault.
int64_t validate(const rse_pf_depth_request& request, const double* workspace) {
    const bool is_valid =
        request.abi == RSE_PF_DEPTH_ABI && request.rows >= 0 && request.rows <= kMaxRows && request.inlier_rows >= 0 &&
        request.inlier_rows <= request.rows && request.points_reference != nullptr && request.pixels != nullptr &&
        request.depths_m != nullptr && request.inliers != nullptr && workspace != nullptr &&
        is_within(request.fx, 1e-9, 1e9) && is_within(request.fy, 1e-9, 1e9) && is_within(request.cx, -1e9, 1e9) &&
        is_within(request.cy, -1e9, 1e9) && is_within(request.base_m, 1e-5, 1.0) && is_within(request.growth_per_m, 0.0, 1.0) &&
        is_within(request.from_m, 0.0, 100.0) && is_within(request.rmse_px, 0.0, kMaxAbs);
    if (!is_valid) return RSE_PF_DEPTH_BAD_REQUEST;
    for (const double element : request.T_camera_reference)
        if (!is_within(element, -1e9, 1e9)) return RSE_PF_DEPTH_BAD_REQUEST;
    for (int64_t i = 0; i < request.inlier_rows; ++i)
        if (request.inliers[i] < 0 || request.inliers[i] >= request.rows) return RSE_PF_DEPTH_BAD_REQUEST;
    for (int64_t i = 0; i < request.rows; ++i)
        if (!is_within(request.depths_m[i], 0.0, kMaxDepthM)) return RSE_PF_DEPTH_BAD_DEPTHS;
    for (int64_t i = 0; i < request.rows; ++i) {
        const double* const point = request.points_reference + 3 * i;
        if (!(is_within(point[0], -kMaxAbs, kMaxAbs) && is_within(point[1], -kMaxAbs, kMaxAbs) &&
              is_within(point[2], kMinDepthM, kMaxAbs)))
            return RSE_PF_DEPTH_BAD_POINTS;
    }
    for (int64_t i = 0; i < 2 * request.rows; ++i)
        if (!is_within(request.pixels[i], -kMaxAbs, kMaxAbs)) return RSE_PF_DEPTH_BAD_PIXELS;
    return RSE_PF_DEPTH_REFINED;
}

// Copy the inliers to columns in the workspace, and pad the last vector with copies of the first inlier, which must
// exist.  Return whether any inlier has a depth in the second image.
bool gather_inliers(const rse_pf_depth_request& request, const Sensor& sensor, double* workspace, Rows& rows) {
    rows.count = (request.inlier_rows + kFour - 1) / kFour * kFour;
    double** const columns[] = {&rows.x, &rows.y, &rows.z,     &rows.z_inverse, &rows.depth_variance, &rows.z2,
                                &rows.u, &rows.v, &rows.depth, &rows.has_depth, &rows.is_real};
    static_assert(sizeof columns / sizeof columns[0] == kColumns);
    for (int i = 0; i < kColumns; ++i) *columns[i] = workspace + i * rows.count;
    bool has_any_depth = false;
    for (int64_t i = 0; i < rows.count; ++i) {
        const bool is_real = i < request.inlier_rows;
        const int64_t row = request.inliers[is_real ? i : 0];
        const double* const point = request.points_reference + 3 * row;
        const double depth = request.depths_m[row];
        const double beyond = point[2] > sensor.from_m ? point[2] - sensor.from_m : 0.0;
        const double deviation = sensor.base_m + sensor.growth_per_m * (beyond * beyond);
        rows.x[i] = point[0];
        rows.y[i] = point[1];
        rows.z[i] = point[2];
        rows.z_inverse[i] = 1.0 / point[2];
        rows.depth_variance[i] = deviation * deviation;
        rows.z2[i] = point[2] * point[2];
        rows.u[i] = request.pixels[2 * row];
        rows.v[i] = request.pixels[2 * row + 1];
        rows.depth[i] = depth;
        rows.has_depth[i] = depth > 0.0 ? 1.0 : 0.0;
        rows.is_real[i] = is_real ? 1.0 : 0.0;
        has_any_depth = has_any_depth || depth > 0.0;
    }
    return has_any_depth;
}

Normal assemble_normal_equations(const Sums& sums) {
    Normal normal;
    for (int i = 0, k = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j, ++k) {
            normal.A[i][j] = sums.P[k];
            normal.A[3 + i][3 + j] = sums.D[k];
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) normal.A[i][3 + j] = sums.M[3 * i + j];
    for (int i = 0; i < 6; ++i) normal.b[i] = sums.b[i];
    return normal;
}

// Write the covariance of the twist (m, rad) left of the pose from the sums of the last pass: that of an M-estimator,
// Huber, Robust Statistics (1981), Sect. 7.6.  Return false where some motion of the camera is unconstrained, or where
// most residuals are outliers (a mean slope of 0 or less).
bool compute_covariance(const Sums& sums, double (&covariance)[36]) {
    // 1. Compute the factor by which the variance of the residuals exceeds that of their assumed noise.
    const double mean_slope = sums.slope / sums.residuals;
    if (!(mean_slope > 0.0)) return false;
    const double degrees_of_freedom = sums.residuals - 6.0 > 1.0 ? sums.residuals - 6.0 : 1.0;
    double scale = sums.weight2_distance2 / degrees_of_freedom / (mean_slope * mean_slope);
    scale = scale > kMinScale ? scale : kMinScale;
    // 2. Invert A column by column, and multiply its symmetric part by the factor.
    Normal normal = assemble_normal_equations(sums);
    double columns[6][6];
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) normal.b[j] = i == j ? 1.0 : 0.0;
        if (!solve_normal_equations(normal, 0.0, columns[i])) return false;
    }
    double total = 0.0;
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
            covariance[6 * i + j] = 0.5 * (columns[i][j] + columns[j][i]) * scale;
            total += covariance[6 * i + j];
        }
    // 3. Return false for a covariance that is not finite or has a variance that is not positive.
    for (int i = 0; i < 6; ++i)
        if (!(covariance[7 * i] > 0.0)) return false;
    return total - total == 0.0;
}

// Refine the pose of a valid request, write pose, covariance and error to the result, and return RSE_PF_DEPTH_REFINED.
// Return RSE_PF_DEPTH_KEPT where that fails: the fields of the result are then not valid.
int64_t refine(const rse_pf_depth_request& request, double* workspace, rse_pf_depth_result& result) {
    // 1. Derive the standard deviation of a pixel coordinate from the reprojection error, whose square sums two
    // coordinates in each of two images: it is half of the error.
    const double pixel_px = 0.5 * request.rmse_px > kMinPixelPx ? 0.5 * request.rmse_px : kMinPixelPx;
    const Sensor sensor = {request.fx,     request.fy,           request.cx,     request.cy,
                           request.base_m, request.growth_per_m, request.from_m, pixel_px * pixel_px};
    Rows rows;
    if (request.inlier_rows == 0 || !gather_inliers(request, sensor, workspace, rows)) return RSE_PF_DEPTH_KEPT;
    // 2. Apply Gauss-Newton steps to the pose until they are small.
    const bool has_avx2 = may_use_avx2(request.flags);
    const double* const T = request.T_camera_reference;
    Pose pose = {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
    Sums sums;
    for (int i = 0; i < kMaxIterations; ++i) {
        add_all_rows<false>(rows, pose, sensor, has_avx2, sums);
        double twist[6], largest = 0.0;
        if (!solve_normal_equations(assemble_normal_equations(sums), 0.0, twist)) return RSE_PF_DEPTH_KEPT;
        for (const double component : twist) {
            if (!is_within(component, -kMaxAbs, kMaxAbs)) return RSE_PF_DEPTH_KEPT;
            largest = absolute(component) > largest ? absolute(component) : largest;
        }
        pose = apply_twist(twist, pose);
        if (largest < kConvergedStep) break;
    }
    // 3. Keep the input pose if the reprojection error has grown too much or the refined pose is not finite.
    add_all_rows<true>(rows, pose, sensor, has_avx2, sums);
    result.rmse_px = square_root(sums.error2 / static_cast<double>(request.inlier_rows));
    const double before_px = request.rmse_px > kMinRmsePx ? request.rmse_px : kMinRmsePx;
    if (!(is_finite(pose) && result.rmse_px <= kMaxRmseGrowth * before_px)) return RSE_PF_DEPTH_KEPT;
    // 4. Write the covariance and the pose; keep the input pose if there is no covariance.
    if (!compute_covariance(sums, result.covariance)) return RSE_PF_DEPTH_KEPT;
    const double out[16] = {pose.R[0][0], pose.R[0][1], pose.R[0][2], pose.t.x, pose.R[1][0], pose.R[1][1],
                            pose.R[1][2], pose.t.y,     pose.R[2][0], pose.R[2][1], pose.R[2][2], pose.t.z,
                            0.0,          0.0,          0.0,          1.0};
    std::memcpy(result.T_camera_reference, out, sizeof out);
    return RSE_PF_DEPTH_REFINED;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_depth_abi(void) { return RSE_PF_DEPTH_ABI; }

__attribute__((visibility("default"))) void rse_pf_depth_refine(const rse_pf_depth_request* request,
                                                                double* workspace, rse_pf_depth_result* result) {
    result->status = validate(*request, workspace);
    if (result->status == RSE_PF_DEPTH_REFINED) result->status = refine(*request, workspace, *result);
}
}
