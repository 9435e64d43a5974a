// The second pose of a planar scene: under weak perspective, a tilted plane looks like the plane tilted the other way.
//
// Sources: Schweighofer and Pinz, Robust Pose Estimation from a Planar Target, PAMI 2006; Collins and Bartoli,
// Infinitesimal Plane-Based Pose Estimation, IJCV 2014.
#pragma once

#include "kernels.hpp"

namespace RSE_PF_ISA {

// Standard deviation over mean of the inverse depths of the inliers below which a planar scene may have a second pose:
// above it, perspective tells the poses apart.
constexpr double kWeakPerspective = 0.08;
// Most iterations of the refinement of the second pose of a planar scene, which starts near its minimum.
constexpr int kSecondPoseIterations = 15;
// Largest component (m, rad) of a step of the refinement of the second pose of a planar scene: a larger step shows that
// the refinement diverges.
constexpr double kMaxSecondPoseStep = 10.0;
// Relative decrease of the cost below which the refinement of the second pose of a planar scene has converged.
constexpr double kConvergedDecrease = 1e-7;
// Poses whose translations differ by less than this (metres) and whose rotations differ by less than 1 degree count as
// the same pose.
constexpr double kSameTranslationM = 0.05;
// Sine of the largest angle, 1 degree, between the rotations of two poses that count as the same.
constexpr double kSameRotationSine = 0.017452406437283512;

// Refine a pose in place over the rows by the Levenberg-Marquardt method under the squared loss.  Return false if it
// diverges, or if a point lies behind the camera at the first pose.
static bool refine_second_pose(const rse_pf::Columns<double>& rows, int64_t count, const FocalLengths& focal, Pose& pose) {
    Normal normal, next_normal;
    int64_t unused_inliers = 0;
    double damping = 1e-3;
    double cost = linearise<double, Loss::kSquared>(rows, count, focal, pose, 0.0, normal, unused_inliers);
    if (!(cost < kInfinity)) return false;
    for (int step = 0; step < kSecondPoseIterations; ++step) {
        double twist[6], largest = 0.0;
        if (!solve_normal_equations(normal, damping, twist)) return false;
        for (const double component : twist) largest = absolute(component) > largest ? absolute(component) : largest;
        if (!(largest < kMaxSecondPoseStep)) return false;
        const Pose next = apply_twist(twist, pose);
        const double next_cost =
            linearise<double, Loss::kSquared>(rows, count, focal, next, 0.0, next_normal, unused_inliers);
        if (next_cost > cost) {
            damping *= 10.0;
            continue;
        }
        const bool has_converged = cost - next_cost < kConvergedDecrease * cost;
        pose = next;
        cost = next_cost;
        normal = next_normal;
        damping *= 0.1;
        if (has_converged) break;
    }
    return true;
}

// Find the second pose of a planar scene, and return its sum of squared reprojection errors over the inliers (px^2), or
// -1 where there is none: the plane faces the camera or contains the line of sight, or the refinement diverges or
// returns to the first pose.
//
// data.inliers holds the `count` inliers of the first pose, `pose`; `origin` is the point of the caller's world
// (metres) that was subtracted from the points.  The projections in the workspace become those of the second pose if
// there is one.
static double find_second_pose(const rse_pf::Workspace& data, int64_t count, const FocalLengths& focal, const Pose& pose,
                               const Vector3& origin, Pose& second) {
    const rse_pf::Columns<double>& rows = data.inliers;
    // 1. Fit a plane to the inliers in the camera frame: its normal is the axis of the smallest second moment.
    Vector3 centre = {0.0, 0.0, 0.0};
    for (int64_t i = 0; i < count; ++i)
        centre = centre + (rotate(pose.R, {rows.x[i], rows.y[i], rows.z[i]}) + pose.t);
    centre = centre * (1.0 / static_cast<double>(count));
    double moments[3][3] = {}, values[3], axes[3][3];
    for (int64_t i = 0; i < count; ++i) {
        const Vector3 p = rotate(pose.R, {rows.x[i], rows.y[i], rows.z[i]}) + pose.t - centre;
        const double xyz[3] = {p.x, p.y, p.z};
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) moments[j][k] += xyz[j] * xyz[k];
    }
    compute_eigenvectors(moments, values, axes);
    // 2. Rotate the plane about its centroid so that its normal becomes the reflection of the normal in the plane that
    // is perpendicular to the line of sight.
    const Vector3 sight = normalise(centre), normal = {axes[0][0], axes[0][1], axes[0][2]};
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
    const double rotation[3][3] = {  // Rodrigues' formula
        {cosine + c * k.x * k.x, c * k.x * k.y - sine * k.z, c * k.x * k.z + sine * k.y},
        {c * k.x * k.y + sine * k.z, cosine + c * k.y * k.y, c * k.y * k.z - sine * k.x},
        {c * k.x * k.z - sine * k.y, c * k.y * k.z + sine * k.x, cosine + c * k.z * k.z},
    };
    second = compose(rotation, centre - rotate(rotation, centre), pose);
    // 3. Refine the rotated pose.
    if (!refine_second_pose(rows, count, focal, second)) return -1.0;
    // 4. Compare both poses in the caller's world, as pose_difference of rse_pf/geometry/transforms.py does; equal ones
    // are no second pose.
    double D[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            D[i][j] = second.R[0][i] * pose.R[0][j] + second.R[1][i] * pose.R[1][j] + second.R[2][i] * pose.R[2][j];
    const Vector3 offset = (pose.t - rotate(pose.R, origin)) - (second.t - rotate(second.R, origin));
    const double distance_m = square_root(dot(offset, offset));
    const double a = D[2][1] - D[1][2], b = D[0][2] - D[2][0], d = D[1][0] - D[0][1];
    const double angle_sine = 0.5 * square_root(a * a + b * b + d * d);
    const double angle_cosine = 0.5 * (D[0][0] + D[1][1] + D[2][2] - 1.0);
    if (distance_m < kSameTranslationM && angle_cosine > 0.0 && angle_sine < kSameRotationSine) return -1.0;
    // 5. Sum the squared reprojection errors of the inliers at the second pose.
    project(rows, count, focal, second, data);
    double squares = 0.0;
    for (int64_t i = 0; i < count; ++i) squares += data.error2[i];
    return squares;
}

// Return the ratio of standard deviation and mean of the inverse depths of the first `count` rows that `project` wrote.
static double inverse_depth_variation(const rse_pf::Workspace& view, int64_t count) {
    double w = 0.0, ww = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        w += view.z_inverse[i];
        ww += view.z_inverse[i] * view.z_inverse[i];
    }
    const double variation2 = ww * static_cast<double>(count) / (w * w) - 1.0;
    return square_root(variation2 > 0.0 ? variation2 : 0.0);
}

}  // namespace RSE_PF_ISA
