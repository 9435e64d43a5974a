// From matches to a pose with its evidence, or to the reason why there is none.
#pragma once

#include "evidence.hpp"
#include "robust.hpp"

namespace RSE_PF_ISA {

constexpr double kCollinear = 0.02, kNearlyCollinear = 0.1;
constexpr double kSameFit = 9.0, kSimilarFit = 40.0;
constexpr double kNoiseFloor2 = 0.01;
constexpr int64_t kMirrorIterations = 50;

static void give(double (&out)[16], const Pose& pose, const Vector3& centre) {
    const Vector3 shift = pose.t - rotated(pose.R, centre);
    const double t[3] = {shift.x, shift.y, shift.z};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) out[4 * i + j] = pose.R[i][j];
        out[4 * i + 3] = t[i];
    }
    out[12] = out[13] = out[14] = 0.0;
    out[15] = 1.0;
}

// Return the pose of the caller, which `give` wrote.
static Pose taken(const double* T, const Vector3& centre) {
    Pose pose = {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
    pose.t = pose.t + rotated(pose.R, centre);
    return pose;
}

// Degenerate input says more than "no consensus".
static int32_t without_pose(const rse_pf::Task& task, int64_t count) {
    const rse_pf::Workspace& data = *task.workspace;
    rse_pf_pnp_result& result = *task.result;
    const int64_t n = task.request->rows;
    result.count = count;
    result.thinness = width_to_length(data.all.x, data.all.y, data.all.z, n, data.along, data.aside);
    if (result.thinness < kCollinear) return RSE_PF_PNP_COLLINEAR;
    const double of_pixels = width_to_length(data.all.u, data.all.v, nullptr, n, data.along, data.aside);
    result.thinness = of_pixels < result.thinness ? of_pixels : result.thinness;
    return result.thinness < kCollinear ? RSE_PF_PNP_COLLINEAR : RSE_PF_PNP_NO_CONSENSUS;
}

static int32_t weakness(const rse_pf_pnp_request& request, const rse_pf_pnp_result& result) {
    const double count = static_cast<double>(result.count);
    const double(&C)[36] = result.covariance;
    if (count < request.weak_inliers) return RSE_PF_PNP_FEW_INLIERS;
    if (count < request.weak_inlier_ratio * static_cast<double>(request.rows)) return RSE_PF_PNP_LOW_INLIER_RATIO;
    if (result.inlier_thinness < kNearlyCollinear) return RSE_PF_PNP_NEARLY_COLLINEAR;
    if (2.0 * static_cast<double>(result.independent) < request.weak_inliers) return RSE_PF_PNP_CLUSTERED;
    if (C[0] + C[7] + C[14] > request.weak_translation_m * request.weak_translation_m ||
        C[21] + C[28] + C[35] > request.weak_rotation_rad * request.weak_rotation_rad)
        return RSE_PF_PNP_POORLY_CONSTRAINED;
    return RSE_PF_PNP_OK;
}

// Reflect all points in the centre; twice restores them.
static void reflect(const rse_pf::Workspace& data, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        data.single.x[i] = -data.single.x[i];
        data.single.y[i] = -data.single.y[i];
        data.single.z[i] = -data.single.z[i];
        data.all.x[i] = -data.all.x[i];
        data.all.y[i] = -data.all.y[i];
        data.all.z[i] = -data.all.z[i];
    }
}

static int32_t judged(const rse_pf::Task& task, const Vector3& centre) {
    const rse_pf_pnp_request& request = *task.request;
    const rse_pf::Workspace& data = *task.workspace;
    rse_pf_pnp_result& result = *task.result;
    const Optics optics = {request.fx, request.fy};
    const double limit2 = request.inlier_px * request.inlier_px, area = static_cast<double>(request.width) * request.height;
    const int64_t n = request.rows;
    const SearchOptions options = {limit2, request.confidence, request.max_iterations, request.min_iterations};
    Pose pose;
    if (request.T_camera_world != nullptr)
        pose = taken(request.T_camera_world, centre);
    else if (!propose(task, optics, options, centre, pose))
        return without_pose(task, 0);
    give(result.T_camera_world, pose, centre);

    project(data.all, n, optics, pose, data);
    const int64_t count = gather(data, n, limit2, task.inliers);
    if (count < 4) return without_pose(task, count);
    // From here on the view holds the inliers only.
    project(data.inliers, count, optics, pose, data);
    double squares = 0.0, largest = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        squares += data.error2[i];
        largest = data.error2[i] > largest ? data.error2[i] : largest;
    }
    result.count = count;
    result.rmse_px = square_root(squares / static_cast<double>(count));
    result.independent =
        independent_inliers(data.u, data.v, count, request.cx, request.cy, static_cast<double>(request.width));
    const int64_t places = n - (count - result.independent);
    result.log10_false_alarms = log10_false_alarms(places, result.independent, largest, area);
    // The first rule that refuses gives the status; the figures of the others are written as well.
    int32_t status = RSE_PF_PNP_SOLVED;
    if (result.log10_false_alarms > kMaxLog10FalseAlarms)
        status = log10_false_alarms(n, count, largest, area) > kMaxLog10FalseAlarms ? without_pose(task, count)
                                                                                    : RSE_PF_PNP_COPIES;
    write_shape(data, count, request, result);
    const double freedom = 2.0 * static_cast<double>(count) - 6.0;
    const double noise2 = squares / (freedom > 1.0 ? freedom : 1.0);
    const double variance = noise2 > kNoiseFloor2 ? noise2 : kNoiseFloor2;
    Normal normal;
    int64_t agree = 0;
    linearised<double, Loss::kSquared>(data.inliers, count, optics, pose, 0.0, normal, agree);
    const bool is_constrained = covariance_of(normal, variance, result.covariance);
    if (status == RSE_PF_PNP_SOLVED) {
        result.thinness = result.inlier_thinness;
        if (result.thinness < kCollinear) status = RSE_PF_PNP_COLLINEAR;
        else if (result.radius_px < request.inlier_px) status = RSE_PF_PNP_ONE_PLACE;
        else if (!is_constrained) status = RSE_PF_PNP_UNCONSTRAINED;
    }
    result.reason = weakness(request, result);
    if (depth_variation(data, count) < kWeakPerspective) {
        Pose twin;
        const double second = second_pose(data, count, optics, pose, centre, twin);
        if (second >= 0.0) {
            result.other_rmse_px = square_root(second / static_cast<double>(count));
            const double difference = (second - squares) / variance;
            if (difference < kSameFit && status == RSE_PF_PNP_SOLVED) status = RSE_PF_PNP_TWO_POSES;
            if (difference < kSimilarFit) result.reason = RSE_PF_PNP_AMBIGUOUS;
        }
    }
    const bool most_agree = static_cast<double>(count) >= request.weak_inlier_ratio * static_cast<double>(n);
    if (status != RSE_PF_PNP_SOLVED || most_agree) return status;

    // Where most rows disagree, test whether the world is mirrored: its reflection then fits far better.
    SearchOptions few = options;
    few.max_iterations = few.max_iterations < kMirrorIterations ? few.max_iterations : kMirrorIterations;
    reflect(data, n);
    Pose reflected;
    if (propose(task, optics, few, centre * -1.0, reflected)) {
        project(data.all, n, optics, reflected, data);
        for (int64_t i = 0; i < n; ++i) result.other_count += data.error2[i] <= limit2 ? 1 : 0;
        if (result.other_count >= 2 * count) return RSE_PF_PNP_MIRRORED;
    }
    return RSE_PF_PNP_SOLVED;
}

// Fill in the rows relative to `centre`.
static void fill_rows(const rse_pf::Task& task, const Vector3& centre) {
    const rse_pf_pnp_request& request = *task.request;
    const rse_pf::Workspace& data = *task.workspace;
    const int64_t n = request.rows;
    const double* const points = request.points_world;
    const double* const pixels = request.pixels;
    for (int64_t i = 0; i < n; ++i) {
        data.all.x[i] = points[3 * i] - centre.x;
        data.all.y[i] = points[3 * i + 1] - centre.y;
        data.all.z[i] = points[3 * i + 2] - centre.z;
        data.all.u[i] = pixels[2 * i] - request.cx;
        data.all.v[i] = pixels[2 * i + 1] - request.cy;
    }
    for (int64_t i = n; i < padded(n); ++i) {
        data.all.x[i] = data.all.y[i] = data.all.z[i] = 0.0;
        data.all.u[i] = data.all.v[i] = kNowhere;
    }
    for (int64_t i = 0; i < padded(n); ++i) {
        data.single.x[i] = static_cast<float>(data.all.x[i]);
        data.single.y[i] = static_cast<float>(data.all.y[i]);
        data.single.z[i] = static_cast<float>(data.all.z[i]);
        data.single.u[i] = static_cast<float>(data.all.u[i]);
        data.single.v[i] = static_cast<float>(data.all.v[i]);
    }
}

// Return the coordinate-wise median of some rows: single precision needs a centre near most points, wherever
// the wrong ones lie.
static Vector3 centre_of(const rse_pf_pnp_request& request) {
    constexpr int64_t kSome = 15;
    const int64_t some = request.rows < kSome ? request.rows : kSome;
    double middle[3];
    for (int axis = 0; axis < 3; ++axis) {
        double sorted[kSome] = {};
        for (int64_t i = 0; i < some; ++i) {
            const double value = request.points_world[3 * (i * request.rows / some) + axis];
            int64_t k = i;
            for (; k > 0 && sorted[k - 1] > value; --k) sorted[k] = sorted[k - 1];
            sorted[k] = value;
        }
        middle[axis] = sorted[some / 2];
    }
    return {middle[0], middle[1], middle[2]};
}

static void solve_task(const rse_pf::Task& task) {
    const Vector3 centre = centre_of(*task.request);
    fill_rows(task, centre);
    task.result->status = judged(task, centre);
    float* upper = task.result->upper_triangle;
    for (int row = 0; row < 6; ++row) {
        for (int column = row; column < 6; ++column)
            *upper++ = static_cast<float>(task.result->covariance[6 * row + column]);
    }
}

}  // namespace RSE_PF_ISA
