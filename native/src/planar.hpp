// The second pose of a plane: under weak perspective, a plane and its mirror image look alike.
//
// Source: Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014.
#pragma once

#include "kernels.hpp"

namespace RSE_PF_ISA {

constexpr double kWeakPerspective = 0.08;  // variation of 1/z below which a plane may have two poses
constexpr int kMirrorSteps = 15;
constexpr double kMaxMirrorStep = 10.0, kConverged = 1e-7;
constexpr double kDistinctMetres = 0.05;
constexpr double kDistinctSine = 0.017452406437283512;  // of 1 degree

static bool refine_mirrored(const rse_pf::Columns<double>& rows, int64_t count, const Optics& optics, Pose& pose) {
    Normal normal, next_normal;
    int64_t agree = 0;
    double damping = 1e-3;
    double cost = linearised<double, Loss::kSquared>(rows, count, optics, pose, 0.0, normal, agree);
    if (!(cost < kInfinity)) return false;
    for (int step = 0; step < kMirrorSteps; ++step) {
        double twist[6], length = 0.0;
        if (!solved(normal, damping, twist)) return false;
        for (const double each : twist) length = absolute(each) > length ? absolute(each) : length;
        if (!(length < kMaxMirrorStep)) return false;
        const Pose next = moved_along(twist, pose);
        const double next_cost =
            linearised<double, Loss::kSquared>(rows, count, optics, next, 0.0, next_normal, agree);
        if (next_cost > cost) {
            damping *= 10.0;
            continue;
        }
        const bool has_converged = cost - next_cost < kConverged * cost;
        pose = next;
        cost = next_cost;
        normal = next_normal;
        damping *= 0.1;
        if (has_converged) break;
    }
    return true;
}

// Find the second pose of the gathered inliers and its sum of squared errors (px^2), which is -1 where the
// refinement fails or comes back to `pose`.  `origin` is the origin of the rows in the caller's world.
static double second_pose(const rse_pf::Workspace& data, int64_t count, const Optics& optics, const Pose& pose,
                          const Vector3& origin, Pose& other) {
    const rse_pf::Columns<double>& rows = data.inliers;
    Vector3 centre = {0.0, 0.0, 0.0};
    for (int64_t i = 0; i < count; ++i)
        centre = centre + (rotated(pose.R, {rows.x[i], rows.y[i], rows.z[i]}) + pose.t);
    centre = centre * (1.0 / static_cast<double>(count));
    double moments[3][3] = {}, values[3], axes[3][3];
    for (int64_t i = 0; i < count; ++i) {
        const Vector3 p = rotated(pose.R, {rows.x[i], rows.y[i], rows.z[i]}) + pose.t - centre;
        const double each[3] = {p.x, p.y, p.z};
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) moments[j][k] += each[j] * each[k];
    }
    eigenvectors(moments, values, axes);
    const Vector3 sight = normalised(centre), normal = {axes[0][0], axes[0][1], axes[0][2]};
    const Vector3 mirrored = normal - sight * (2.0 * dot(normal, sight));
    Vector3 axis = cross(normal, mirrored);
    const double sine = square_root(dot(axis, axis));
    double cosine = dot(normal, mirrored);
    if (cosine < 0.0) {
        axis = axis * -1.0;
        cosine = -cosine;
    }
    if (!(sine >= 1e-6)) return -1.0;
    const Vector3 k = axis * (1.0 / sine);
    const double c = 1.0 - cosine;
    const double turn[3][3] = {
        {cosine + c * k.x * k.x, c * k.x * k.y - sine * k.z, c * k.x * k.z + sine * k.y},
        {c * k.x * k.y + sine * k.z, cosine + c * k.y * k.y, c * k.y * k.z - sine * k.x},
        {c * k.x * k.z - sine * k.y, c * k.y * k.z + sine * k.x, cosine + c * k.z * k.z},
    };
    other = moved(turn, centre - rotated(turn, centre), pose);
    if (!refine_mirrored(rows, count, optics, other)) return -1.0;
    // The poses are told apart as pose_difference in rse_pf/geometry.py does, in the caller's world.
    double D[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            D[i][j] = other.R[0][i] * pose.R[0][j] + other.R[1][i] * pose.R[1][j] + other.R[2][i] * pose.R[2][j];
    const Vector3 apart = (pose.t - rotated(pose.R, origin)) - (other.t - rotated(other.R, origin));
    const double metres = square_root(dot(apart, apart));
    const double a = D[2][1] - D[1][2], b = D[0][2] - D[2][0], d = D[1][0] - D[0][1];
    const double sine_apart = 0.5 * square_root(a * a + b * b + d * d);
    const double cosine_apart = 0.5 * (D[0][0] + D[1][1] + D[2][2] - 1.0);
    if (metres < kDistinctMetres && cosine_apart > 0.0 && sine_apart < kDistinctSine) return -1.0;
    project(rows, count, optics, other, data);
    double squares = 0.0;
    for (int64_t i = 0; i < count; ++i) squares += data.error2[i];
    return squares;
}

// Return the standard deviation of 1/z over its mean, for the rows in the view.
static double depth_variation(const rse_pf::Workspace& view, int64_t count) {
    double w = 0.0, ww = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        w += view.z_inverse[i];
        ww += view.z_inverse[i] * view.z_inverse[i];
    }
    const double variation2 = ww * static_cast<double>(count) / (w * w) - 1.0;
    return square_root(variation2 > 0.0 ? variation2 : 0.0);
}

}  // namespace RSE_PF_ISA
