// Refine a pose with the depths that both cameras measured: iterated least squares with a Cauchy weight, on
// residuals weighed by the noise of both images.  rse_pf/pnp/depth_refinement.py says why.
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

constexpr int64_t kMaxRows = int64_t{1} << 24;
constexpr int kMaxIterations = 6;
constexpr double kConverged = 1e-5;
constexpr double kMaxAbs = 1e6, kMaxDepthM = 1e3;
constexpr double kMinPixelPx = 0.05, kMinScale = 0.01;
// Growth of the pixel errors above which depths and pixels contradict each other.
constexpr double kMaxGrowth = 1.5, kLeastRmsePx = 0.2;

bool within(double value, double low, double high) { return value >= low && value <= high; }

template <bool kIsLast>
void add_portably(const Rows& rows, const Pose& pose, const Sensor& sensor, Sums& sums) {
    const double t[3] = {pose.t.x, pose.t.y, pose.t.z};
    add_rows<kIsLast>(rows, pose.R, t, sensor, sums);
}

template <bool kIsLast>
RSE_PF_DEPTH_AVX2 void add_by_avx2(const Rows& rows, const Pose& pose, const Sensor& sensor, Sums& sums) {
    const double t[3] = {pose.t.x, pose.t.y, pose.t.z};
    add_rows<kIsLast>(rows, pose.R, t, sensor, sums);
}

template <bool kIsLast>
void add(const Rows& rows, const Pose& pose, const Sensor& sensor, bool has_avx2, Sums& sums) {
    has_avx2 ? add_by_avx2<kIsLast>(rows, pose, sensor, sums) : add_portably<kIsLast>(rows, pose, sensor, sums);
}

bool may_use_avx2(uint32_t flags) {
#if defined(__x86_64__)
    return (flags & RSE_PF_DEPTH_PORTABLE) == 0 && rse_pf::processor().avx2;
#else
    (void)flags;
    return false;
#endif
}

int64_t checked(const rse_pf_depth_request& request, const double* workspace) {
    const bool is_whole =
        request.abi == RSE_PF_DEPTH_ABI && request.rows >= 0 && request.rows <= kMaxRows && request.inlier_rows >= 0 &&
        request.inlier_rows <= request.rows && request.points_reference != nullptr && request.pixels != nullptr &&
        request.depths_m != nullptr && request.inliers != nullptr && workspace != nullptr &&
        within(request.fx, 1e-9, 1e9) && within(request.fy, 1e-9, 1e9) && within(request.cx, -1e9, 1e9) &&
        within(request.cy, -1e9, 1e9) && within(request.base_m, 1e-5, 1.0) && within(request.growth_per_m, 0.0, 1.0) &&
        within(request.from_m, 0.0, 100.0) && within(request.rmse_px, 0.0, kMaxAbs);
    if (!is_whole) return RSE_PF_DEPTH_BAD_REQUEST;
    for (const double each : request.T_camera_reference)
        if (!within(each, -1e9, 1e9)) return RSE_PF_DEPTH_BAD_REQUEST;
    for (int64_t i = 0; i < request.inlier_rows; ++i)
        if (request.inliers[i] < 0 || request.inliers[i] >= request.rows) return RSE_PF_DEPTH_BAD_REQUEST;
    for (int64_t i = 0; i < request.rows; ++i)
        if (!within(request.depths_m[i], 0.0, kMaxDepthM)) return RSE_PF_DEPTH_BAD_DEPTHS;
    for (int64_t i = 0; i < request.rows; ++i) {
        const double* const point = request.points_reference + 3 * i;
        if (!(within(point[0], -kMaxAbs, kMaxAbs) && within(point[1], -kMaxAbs, kMaxAbs) &&
              within(point[2], kNearM, kMaxAbs)))
            return RSE_PF_DEPTH_BAD_POINTS;
    }
    for (int64_t i = 0; i < 2 * request.rows; ++i)
        if (!within(request.pixels[i], -kMaxAbs, kMaxAbs)) return RSE_PF_DEPTH_BAD_PIXELS;
    return RSE_PF_DEPTH_REFINED;
}

// Copy the inliers to columns, and fill up the last four rows with the first one; say whether any has a depth.
bool gathered(const rse_pf_depth_request& request, const Sensor& sensor, double* workspace, Rows& rows) {
    rows.count = (request.inlier_rows + kFour - 1) / kFour * kFour;
    double** const columns[] = {&rows.x, &rows.y, &rows.z,     &rows.z_inverse, &rows.depth_variance, &rows.z2,
                                &rows.u, &rows.v, &rows.depth, &rows.has_depth, &rows.is_real};
    static_assert(sizeof columns / sizeof columns[0] == kColumns);
    for (int i = 0; i < kColumns; ++i) *columns[i] = workspace + i * rows.count;
    bool has_any = false;
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
        has_any = has_any || depth > 0.0;
    }
    return has_any;
}

Normal normal_of(const Sums& sums) {
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

// Write the covariance of the twist; false where some motion is free or the weights leave no slope.
bool covariance_of(const Sums& sums, double (&covariance)[36]) {
    const double mean_slope = sums.slope / sums.numbers;
    if (!(mean_slope > 0.0)) return false;
    const double freedom = sums.numbers - 6.0 > 1.0 ? sums.numbers - 6.0 : 1.0;
    double scale = sums.weight2_distance2 / freedom / (mean_slope * mean_slope);
    scale = scale > kMinScale ? scale : kMinScale;
    Normal normal = normal_of(sums);
    double columns[6][6];
    for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) normal.b[j] = i == j ? 1.0 : 0.0;
        if (!solved(normal, 0.0, columns[i])) return false;
    }
    double size = 0.0;
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
            covariance[6 * i + j] = 0.5 * (columns[i][j] + columns[j][i]) * scale;
            size += covariance[6 * i + j];
        }
    for (int i = 0; i < 6; ++i)
        if (!(covariance[7 * i] > 0.0)) return false;
    return size - size == 0.0;
}

int64_t refined(const rse_pf_depth_request& request, double* workspace, rse_pf_depth_result& result) {
    const double pixel_px = 0.5 * request.rmse_px > kMinPixelPx ? 0.5 * request.rmse_px : kMinPixelPx;
    const Sensor sensor = {request.fx,     request.fy,           request.cx,     request.cy,
                           request.base_m, request.growth_per_m, request.from_m, pixel_px * pixel_px};
    Rows rows;
    if (request.inlier_rows == 0 || !gathered(request, sensor, workspace, rows)) return RSE_PF_DEPTH_KEPT;
    const bool has_avx2 = may_use_avx2(request.flags);
    const double* const T = request.T_camera_reference;
    Pose pose = {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
    Sums sums;
    for (int i = 0; i < kMaxIterations; ++i) {
        add<false>(rows, pose, sensor, has_avx2, sums);
        double twist[6], largest = 0.0;
        if (!solved(normal_of(sums), 0.0, twist)) return RSE_PF_DEPTH_KEPT;
        for (const double each : twist) {
            if (!within(each, -kMaxAbs, kMaxAbs)) return RSE_PF_DEPTH_KEPT;
            largest = absolute(each) > largest ? absolute(each) : largest;
        }
        pose = moved_along(twist, pose);
        if (largest < kConverged) break;
    }
    add<true>(rows, pose, sensor, has_avx2, sums);
    result.rmse_px = square_root(sums.error2 / static_cast<double>(request.inlier_rows));
    const double before_px = request.rmse_px > kLeastRmsePx ? request.rmse_px : kLeastRmsePx;
    // Also refuses what is not finite.
    if (!(is_finite(pose) && result.rmse_px <= kMaxGrowth * before_px)) return RSE_PF_DEPTH_KEPT;
    if (!covariance_of(sums, result.covariance)) return RSE_PF_DEPTH_KEPT;
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
    result->status = checked(*request, workspace);
    if (result->status == RSE_PF_DEPTH_REFINED) result->status = refined(*request, workspace, *result);
}
}
