// The whole of a request: estimate a pose, measure its evidence, and apply the rules that refuse the pose or call it
// weak.
#pragma once

#include "evidence.hpp"
#include "robust.hpp"

namespace RSE_PF_ISA {

// Width over length of points or pixels below which they count as collinear, and the pose is refused.
constexpr double kCollinear = 0.02;
// Width over length of the inlier pixels below which a pose is weak.
constexpr double kNearlyCollinear = 0.1;
// Increase of the sum of squared errors from the first to the second pose of a planar scene, in units of the pixel
// variance, below which both fit equally well (3 sigma, squared), and the pose is refused.
constexpr double kEqualFit = 9.0;
// Increase of the sum of squared errors from the first to the second pose of a planar scene, in units of the pixel
// variance, below which both fit similarly well, and the pose is weak.
constexpr double kSimilarFit = 40.0;
// Smallest variance of a pixel (px^2) that is derived from the errors of the inliers: messages are rounded to 0.01 px,
// and four points may fit by luck.
constexpr double kMinPixelVariance = 0.01;
// Most RANSAC samples of the test whether the points are mirrored: a correct reflection has many inliers and is found
// soon.
constexpr int64_t kMirrorIterations = 50;

// Write the pose as a 4x4 matrix of the caller's world, from whose origin `centre` (metres) was subtracted.
static void write_matrix(double (&out)[16], const Pose& pose, const Vector3& centre) {
    const Vector3 shift = pose.t - rotate(pose.R, centre);
    const double t[3] = {shift.x, shift.y, shift.z};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) out[4 * i + j] = pose.R[i][j];
        out[4 * i + 3] = t[i];
    }
    out[12] = out[13] = out[14] = 0.0;
    out[15] = 1.0;
}

// Read a pose from a 4x4 matrix of the caller's world: the inverse of write_matrix.
static Pose read_matrix(const double* T, const Vector3& centre) {
    Pose pose = {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
    pose.t = pose.t + rotate(pose.R, centre);
    return pose;
}

// Return the status of a request without an acceptable pose: COLLINEAR where all points or all pixels lie on a line,
// which tells the caller more than NO_CONSENSUS.  The result gets `count` as its inlier_count, and the width_to_length
// of the points, or of the pixels if the points do not lie on a line and the pixels are narrower.
static int32_t status_without_pose(const rse_pf::Task& task, int64_t count) {
    const rse_pf::Workspace& data = *task.workspace;
    rse_pf_pnp_result& result = *task.result;
    const int64_t n = task.request->rows;
    result.inlier_count = count;
    result.width_to_length = width_to_length(data.all.x, data.all.y, data.all.z, n, data.length2, data.width2);
    if (result.width_to_length < kCollinear) return RSE_PF_PNP_COLLINEAR;
    const double of_pixels = width_to_length(data.all.u, data.all.v, nullptr, n, data.length2, data.width2);
    result.width_to_length = of_pixels < result.width_to_length ? of_pixels : result.width_to_length;
    return result.width_to_length < kCollinear ? RSE_PF_PNP_COLLINEAR : RSE_PF_PNP_NO_CONSENSUS;
}

// Return the first reason why a pose is weak, RSE_PF_PNP_OK where there is none.  The standard deviations that are
// compared are the roots of the summed variances of the three components of translation, and of those of rotation.
static int32_t find_weakness(const rse_pf_pnp_request& request, const rse_pf_pnp_result& result) {
    const double count = static_cast<double>(result.inlier_count);
    const double(&C)[36] = result.covariance;
    if (count < request.weak_inliers) return RSE_PF_PNP_FEW_INLIERS;
    if (count < request.weak_inlier_ratio * static_cast<double>(request.rows)) return RSE_PF_PNP_LOW_INLIER_RATIO;
    if (result.inlier_width_to_length < kNearlyCollinear) return RSE_PF_PNP_NEARLY_COLLINEAR;
    if (2.0 * static_cast<double>(result.independent_inliers) < request.weak_inliers) return RSE_PF_PNP_CLUSTERED;
    if (C[0] + C[7] + C[14] > request.weak_translation_m * request.weak_translation_m ||
        C[21] + C[28] + C[35] > request.weak_rotation_rad * request.weak_rotation_rad)
        return RSE_PF_PNP_POORLY_CONSTRAINED;
    return RSE_PF_PNP_OK;
}

// Reflect all points of the workspace in the origin, in place, which mirrors the scene.
static void reflect_points(const rse_pf::Workspace& data, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        data.single.x[i] = -data.single.x[i];
        data.single.y[i] = -data.single.y[i];
        data.single.z[i] = -data.single.z[i];
        data.all.x[i] = -data.all.x[i];
        data.all.y[i] = -data.all.y[i];
        data.all.z[i] = -data.all.z[i];
    }
}

// Estimate the pose, or take the pose of the request; write its evidence to the result, and return the status.
// `centre` (metres, caller's world) was subtracted from the points of the workspace, which may be mirrored afterwards.
static int32_t solve_centred(const rse_pf::Task& task, const Vector3& centre) {
    const rse_pf_pnp_request& request = *task.request;
    const rse_pf::Workspace& data = *task.workspace;
    rse_pf_pnp_result& result = *task.result;
    const FocalLengths focal = {request.fx, request.fy};
    const double limit2 = request.inlier_px * request.inlier_px, area = static_cast<double>(request.width) * request.height;
    const int64_t n = request.rows;
    const RansacOptions options = {limit2, request.confidence, request.max_iterations, request.min_iterations};
    // 1. Take the pose of the request, or estimate one.
    Pose pose;
    if (request.T_camera_world != nullptr)
        pose = read_matrix(request.T_camera_world, centre);
    else if (!estimate_pose(task, focal, options, centre, pose))
        return status_without_pose(task, 0);
    write_matrix(result.T_camera_world, pose, centre);

    // 2. Find the inliers of the pose; afterwards the projections in the workspace are those of the inliers only.
    project(data.all, n, focal, pose, data);
    const int64_t count = gather_inliers(data, n, limit2, task.inliers);
    if (count < 4) return status_without_pose(task, count);
    project(data.inliers, count, focal, pose, data);
    double squares = 0.0, largest = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        squares += data.error2[i];
        largest = data.error2[i] > largest ? data.error2[i] : largest;
    }
    result.inlier_count = count;
    result.rmse_px = square_root(squares / static_cast<double>(count));
    // 3. Test whether a random pose would fit as well.  Inliers that are neighbours in the image count once.  The first
    // rule that refuses the pose determines the status; the measured values of all rules are written.
    result.independent_inliers =
        count_independent_inliers(data.u, data.v, count, request.cx, request.cy, static_cast<double>(request.width));
    const int64_t independent_rows = n - (count - result.independent_inliers);
    result.log10_false_alarms = log10_false_alarms(independent_rows, result.independent_inliers, largest, area);
    int32_t status = RSE_PF_PNP_SOLVED;
    if (result.log10_false_alarms > kMaxLog10FalseAlarms)
        status = log10_false_alarms(n, count, largest, area) > kMaxLog10FalseAlarms ? status_without_pose(task, count)
                                                                                    : RSE_PF_PNP_DUPLICATES;
    // 4. Measure the shape of the inliers in the image, the pixel variance, and the covariance of the pose.
    measure_shape(data, count, request, result);
    const double degrees_of_freedom = 2.0 * static_cast<double>(count) - 6.0;
    const double noise2 = squares / (degrees_of_freedom > 1.0 ? degrees_of_freedom : 1.0);
    const double variance = noise2 > kMinPixelVariance ? noise2 : kMinPixelVariance;
    Normal normal;
    int64_t unused_inliers = 0;
    linearise<double, Loss::kSquared>(data.inliers, count, focal, pose, 0.0, normal, unused_inliers);
    const bool is_constrained = compute_covariance(normal, variance, result.covariance);
    // 5. Refuse inliers on a line or in one spot of the image, and a pose with an unconstrained motion.
    if (status == RSE_PF_PNP_SOLVED) {
        result.width_to_length = result.inlier_width_to_length;
        if (result.width_to_length < kCollinear) status = RSE_PF_PNP_COLLINEAR;
        else if (result.radius_px < request.inlier_px) status = RSE_PF_PNP_ONE_SPOT;
        else if (!is_constrained) status = RSE_PF_PNP_UNCONSTRAINED;
    }
    result.reason = find_weakness(request, result);
    // 6. Compare the pose with the second pose of a planar scene by a likelihood ratio: an equal fit refuses the pose,
    // a similar one makes it weak.
    if (inverse_depth_variation(data, count) < kWeakPerspective) {
        Pose second;
        const double second_squares = find_second_pose(data, count, focal, pose, centre, second);
        if (second_squares >= 0.0) {
            result.second_pose_rmse_px = square_root(second_squares / static_cast<double>(count));
            const double difference = (second_squares - squares) / variance;
            if (difference < kEqualFit && status == RSE_PF_PNP_SOLVED) status = RSE_PF_PNP_TWO_POSES;
            if (difference < kSimilarFit) result.reason = RSE_PF_PNP_AMBIGUOUS;
        }
    }
    const bool has_enough_inliers = static_cast<double>(count) >= request.weak_inlier_ratio * static_cast<double>(n);
    if (status != RSE_PF_PNP_SOLVED || has_enough_inliers) return status;

    // 7. Where the inlier ratio is weak, test whether the world is mirrored: a pose of the reflected points then has at
    // least twice as many inliers.
    RansacOptions mirror_options = options;
    mirror_options.max_iterations =
        mirror_options.max_iterations < kMirrorIterations ? mirror_options.max_iterations : kMirrorIterations;
    reflect_points(data, n);
    Pose reflected;
    if (estimate_pose(task, focal, mirror_options, centre * -1.0, reflected)) {
        project(data.all, n, focal, reflected, data);
        for (int64_t i = 0; i < n; ++i) result.mirrored_inliers += data.error2[i] <= limit2 ? 1 : 0;
        if (result.mirrored_inliers >= 2 * count) return RSE_PF_PNP_MIRRORED;
    }
    return RSE_PF_PNP_SOLVED;
}

// Copy the correspondences to the workspace: points relative to `centre`, pixels relative to the principal point, in
// double and in single precision, with the last vector of eight rows padded by rows that are never inliers.
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
        data.all.u[i] = data.all.v[i] = kPaddingPixel;
    }
    for (int64_t i = 0; i < padded(n); ++i) {
        data.single.x[i] = static_cast<float>(data.all.x[i]);
        data.single.y[i] = static_cast<float>(data.all.y[i]);
        data.single.z[i] = static_cast<float>(data.all.z[i]);
        data.single.u[i] = static_cast<float>(data.all.u[i]);
        data.single.v[i] = static_cast<float>(data.all.v[i]);
    }
}

// Return the coordinate-wise median (metres) of up to 15 points of the request, spread evenly over the rows.
// Subtracting it keeps the digits of single precision; a mean would be pulled away by outliers.
static Vector3 compute_centre(const rse_pf_pnp_request& request) {
    constexpr int64_t kMaxSamples = 15;
    const int64_t samples = request.rows < kMaxSamples ? request.rows : kMaxSamples;
    double median[3];
    for (int axis = 0; axis < 3; ++axis) {
        double sorted[kMaxSamples] = {};
        for (int64_t i = 0; i < samples; ++i) {
            const double value = request.points_world[3 * (i * request.rows / samples) + axis];
            int64_t k = i;
            for (; k > 0 && sorted[k - 1] > value; --k) sorted[k] = sorted[k - 1];
            sorted[k] = value;
        }
        median[axis] = sorted[samples / 2];
    }
    return {median[0], median[1], median[2]};
}

// Solve a validated request, and write its result: status, pose, evidence, and the upper triangle of the covariance.
static void solve_task(const rse_pf::Task& task) {
    const Vector3 centre = compute_centre(*task.request);
    fill_rows(task, centre);
    task.result->status = solve_centred(task, centre);
    float* upper = task.result->upper_triangle;
    for (int row = 0; row < 6; ++row) {
        for (int column = row; column < 6; ++column)
            *upper++ = static_cast<float>(task.result->covariance[6 * row + column]);
    }
}

}  // namespace RSE_PF_ISA
