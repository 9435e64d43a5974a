// The two loops that take most of the time of a request: the MSAC cost of a pose, and the normal equations of a
// refinement step.  Both process eight correspondences at a time.
#pragma once

#include "small.hpp"
#include "workspace.hpp"

namespace RSE_PF_ISA {

constexpr double kMinDepthM = 1e-6;  // metres: points with a smaller depth count as behind the camera
constexpr double kPaddingPixel = 1e9;  // pixels: observation of the rows that pad the last vector, never an inlier
constexpr double kMaxError2 = 1e14;    // px^2: larger squared errors, such as those of padding, have no weight
constexpr int64_t kRowsBetweenStops = 64;  // rows of the MSAC cost between two tests whether to stop early

// Focal lengths in pixels; the principal point was subtracted from the pixels before.
struct FocalLengths {
    double fx, fy;
};

// Return the MSAC cost of a pose (px^2): the sum of the squared reprojection errors, each truncated at limit2 (px^2); a
// point behind the camera costs limit2.  As soon as the sum has reached `stop`, the loop ends and some number that is
// not below `stop` is returned.  Source: Torr and Zisserman, MLESAC, CVIU 2000.
static double msac_cost(const rse_pf::Columns<float>& rows, int64_t count, const FocalLengths& focal, const Pose& pose,
                    double limit2, double stop) {
    typedef Lanes<float> F;
    const float fx = static_cast<float>(focal.fx), fy = static_cast<float>(focal.fy);
    const F r00 = all(static_cast<float>(pose.R[0][0]) * fx), r01 = all(static_cast<float>(pose.R[0][1]) * fx),
            r02 = all(static_cast<float>(pose.R[0][2]) * fx), tx = all(static_cast<float>(pose.t.x) * fx);
    const F r10 = all(static_cast<float>(pose.R[1][0]) * fy), r11 = all(static_cast<float>(pose.R[1][1]) * fy),
            r12 = all(static_cast<float>(pose.R[1][2]) * fy), ty = all(static_cast<float>(pose.t.y) * fy);
    const F r20 = all(static_cast<float>(pose.R[2][0])), r21 = all(static_cast<float>(pose.R[2][1])),
            r22 = all(static_cast<float>(pose.R[2][2])), tz = all(static_cast<float>(pose.t.z));
    const F limit = all(static_cast<float>(limit2)), near = all(static_cast<float>(kMinDepthM)), one = all(1.0f);
    const int64_t end = padded(count);
    double total = 0.0;
    for (int64_t begin = 0; begin < end; begin += kRowsBetweenStops) {
        const int64_t until = begin + kRowsBetweenStops < end ? begin + kRowsBetweenStops : end;
        F cost = all(0.0f);
        for (int64_t i = begin; i < until; i += kLanes) {
            const F x = load(rows.x + i), y = load(rows.y + i), z = load(rows.z + i);
            const F depth = r20 * x + r21 * y + (r22 * z + tz);
            const F inverse = one / depth;
            const F du = (r00 * x + r01 * y + (r02 * z + tx)) * inverse - load(rows.u + i);
            const F dv = (r10 * x + r11 * y + (r12 * z + ty)) * inverse - load(rows.v + i);
            const F error2 = du * du + dv * dv;
            const F truncated = where_less(error2, limit, error2, limit);  // nan becomes limit as well
            cost = cost + where_less(near, depth, truncated, limit);
        }
        total += static_cast<double>(sum<float>(cost));
        if (!(total < stop)) break;
    }
    return total;
}

// Loss of a squared reprojection error e2 (px^2) with the scale limit2 (px^2).
enum class Loss {
    kTruncated,  // min(e2, limit2), the loss of MSAC
    kCauchy,     // limit2 * log(1 + e2 / limit2)
    kSquared,    // e2
};

// Write the normal equations at a pose, in which each row has the weight of the loss, and return the cost (px^2).  The
// cost is infinite under the Cauchy and the squared loss where a point lies behind the camera; under the truncated loss
// such a point costs limit2.  Under the truncated loss, `inliers` becomes the number of rows with a squared error below
// limit2; under the others it is not written.  limit2 is not used by the squared loss.
template <class T, Loss loss>
static double linearise(const rse_pf::Columns<T>& rows, int64_t count, const FocalLengths& focal, const Pose& pose,
                         double limit2, Normal& normal, int64_t& inliers) {
    typedef Lanes<T> F;
    const F r00 = all(static_cast<T>(pose.R[0][0])), r01 = all(static_cast<T>(pose.R[0][1])),
            r02 = all(static_cast<T>(pose.R[0][2])), tx = all(static_cast<T>(pose.t.x));
    const F r10 = all(static_cast<T>(pose.R[1][0])), r11 = all(static_cast<T>(pose.R[1][1])),
            r12 = all(static_cast<T>(pose.R[1][2])), ty = all(static_cast<T>(pose.t.y));
    const F r20 = all(static_cast<T>(pose.R[2][0])), r21 = all(static_cast<T>(pose.R[2][1])),
            r22 = all(static_cast<T>(pose.R[2][2])), tz = all(static_cast<T>(pose.t.z));
    const F fx = all(static_cast<T>(focal.fx)), fy = all(static_cast<T>(focal.fy));
    const F limit = all(static_cast<T>(limit2)), near = all(static_cast<T>(kMinDepthM));
    const F max_error2 = all(static_cast<T>(kMaxError2)), limit_inverse = all(static_cast<T>(limit2 > 0 ? 1.0 / limit2 : 0));
    const F one = all(T(1)), zero = all(T(0));
    F A00 = zero, A02 = zero, A03 = zero, A04 = zero, A05 = zero, A11 = zero, A12 = zero, A13 = zero, A14 = zero,
      A15 = zero, A22 = zero, A23 = zero, A24 = zero, A25 = zero, A33 = zero, A34 = zero, A35 = zero, A44 = zero,
      A45 = zero, A55 = zero;
    F b0 = zero, b1 = zero, b2 = zero, b3 = zero, b4 = zero, b5 = zero;
    F cost = zero, weights = zero, behind = zero;
    F ratios = one;     // product of (1 + e2 / limit2) of up to 16 rows of each lane, whose logarithm is taken once
    double logs = 0.0;  // sum of the logarithms
    const int64_t end = padded(count);
    for (int64_t i = 0; i < end; i += kLanes) {
        // 1. Project the points to the normalised image plane (a, b), and take the residuals (ru, rv) in pixels.
        const F x = load(rows.x + i), y = load(rows.y + i), z = load(rows.z + i);
        const F depth = r20 * x + r21 * y + (r22 * z + tz);
        const F inverse = one / where_less(near, depth, depth, one);
        const F a = (r00 * x + r01 * y + (r02 * z + tx)) * inverse;
        const F b = (r10 * x + r11 * y + (r12 * z + ty)) * inverse;
        const F ru = load(rows.u + i) - fx * a, rv = load(rows.v + i) - fy * b;
        const F error2 = ru * ru + rv * rv;
        // 2. Weigh the rows by the loss (iteratively reweighted least squares), and sum the cost.
        F weight;
        if (loss == Loss::kTruncated) {
            weight = where_less(near, depth, where_less(error2, limit, one, zero), zero);
            cost = cost + where_less(near, depth, where_less(error2, limit, error2, limit), limit);
        } else if (loss == Loss::kCauchy) {
            const F ratio = one + error2 * limit_inverse;
            const F inside = where_less(near, depth, where_less(error2, max_error2, one, zero), zero);
            weight = inside / ratio;
            ratios = ratios * where_less(zero, inside, ratio, one);
            behind = behind + where_less(near, depth, zero, one);
            if ((i / kLanes) % 16 == 15 || i + kLanes >= end) {
                alignas(64) T product[kLanes];
                store(product, ratios);
                for (int k = 0; k < kLanes; ++k) logs += natural_log(static_cast<double>(product[k]));
                ratios = one;
            }
        } else {
            weight = where_less(error2, max_error2, one, zero);
            cost = cost + error2 * weight;
            behind = behind + where_less(near, depth, zero, one) * weight;
        }
        if (loss == Loss::kTruncated) weights = weights + weight;
        // 3. Add the rows to A = J^T W J and b = J^T W r.  With the inverse depth i the rows of the Jacobian are
        // du = fx * (i, 0, -a i, -a b, 1 + a^2, -b) and dv = fy * (0, i, -b i, -(1 + b^2), a b, a).
        const F gu = weight * fx, gv = weight * fy;
        const F wu = gu * fx, wv = gv * fy;
        const F eu = gu * ru, ev = gv * rv;
        const F ab = a * b, a1 = one + a * a, b1b = one + b * b;
        const F ui = wu * inverse, vi = wv * inverse;
        const F uab = wu * ab, vab = wv * ab, ua1 = wu * a1, vb1 = wv * b1b;
        const F aui = a * ui, bvi = b * vi;
        A00 = A00 + ui * inverse;
        A02 = A02 - aui * inverse;
        A03 = A03 - uab * inverse;
        A04 = A04 + ua1 * inverse;
        A05 = A05 - b * ui;
        A11 = A11 + vi * inverse;
        A12 = A12 - bvi * inverse;
        A13 = A13 - vb1 * inverse;
        A14 = A14 + vab * inverse;
        A15 = A15 + a * vi;
        A22 = A22 + (a * aui + b * bvi) * inverse;
        A23 = A23 + (aui * ab + bvi * b1b);
        A24 = A24 - (aui * a1 + bvi * ab);
        A25 = A25 + (ui - vi) * ab;
        A33 = A33 + (uab * ab + vb1 * b1b);
        A34 = A34 - (uab * a1 + vb1 * ab);
        A35 = A35 + (uab * b - vb1 * a);
        A44 = A44 + (ua1 * a1 + vab * ab);
        A45 = A45 + (vab * a - ua1 * b);
        A55 = A55 + (wu * (b * b) + wv * (a * a));
        b0 = b0 + eu * inverse;
        b1 = b1 + ev * inverse;
        b2 = b2 - (eu * a + ev * b) * inverse;
        b3 = b3 - (eu * ab + ev * b1b);
        b4 = b4 + (eu * a1 + ev * ab);
        b5 = b5 + (ev * a - eu * b);
    }
    // 4. Sum the lanes of each element, and return the cost.
    const F* upper[6][6] = {{&A00, &zero, &A02, &A03, &A04, &A05}, {nullptr, &A11, &A12, &A13, &A14, &A15},
                            {nullptr, nullptr, &A22, &A23, &A24, &A25}, {nullptr, nullptr, nullptr, &A33, &A34, &A35},
                            {nullptr, nullptr, nullptr, nullptr, &A44, &A45}, {nullptr, nullptr, nullptr, nullptr, nullptr, &A55}};
    const F* right[6] = {&b0, &b1, &b2, &b3, &b4, &b5};
    for (int i = 0; i < 6; ++i) {
        for (int j = i; j < 6; ++j) normal.A[i][j] = static_cast<double>(sum<T>(*upper[i][j]));
        normal.b[i] = static_cast<double>(sum<T>(*right[i]));
    }
    if (loss == Loss::kTruncated) {
        inliers = static_cast<int64_t>(sum<T>(weights));
        return static_cast<double>(sum<T>(cost));
    }
    if (static_cast<double>(sum<T>(behind)) > 0.0) return kInfinity;
    return loss == Loss::kCauchy ? limit2 * logs : static_cast<double>(sum<T>(cost));
}

// Project `count` rows by a pose, and write to the workspace (u, v, z_inverse, error2) for each row the projected pixel
// relative to the principal point, the inverse depth (1/m), and the squared reprojection error (px^2), which is
// infinite for a point behind the camera.
static void project(const rse_pf::Columns<double>& rows, int64_t count, const FocalLengths& focal, const Pose& pose,
                    const rse_pf::Workspace& view) {
    typedef Lanes<double> F;
    const F r00 = all(pose.R[0][0]), r01 = all(pose.R[0][1]), r02 = all(pose.R[0][2]), tx = all(pose.t.x);
    const F r10 = all(pose.R[1][0]), r11 = all(pose.R[1][1]), r12 = all(pose.R[1][2]), ty = all(pose.t.y);
    const F r20 = all(pose.R[2][0]), r21 = all(pose.R[2][1]), r22 = all(pose.R[2][2]), tz = all(pose.t.z);
    const F fx = all(focal.fx), fy = all(focal.fy), near = all(kMinDepthM), one = all(1.0), never = all(kInfinity);
    const int64_t end = padded(count);
    for (int64_t i = 0; i < end; i += kLanes) {
        const F x = load(rows.x + i), y = load(rows.y + i), z = load(rows.z + i);
        const F depth = r20 * x + r21 * y + (r22 * z + tz);
        const F inverse = one / where_less(near, depth, depth, near);
        const F u = fx * ((r00 * x + r01 * y + (r02 * z + tx)) * inverse);
        const F v = fy * ((r10 * x + r11 * y + (r12 * z + ty)) * inverse);
        const F du = u - load(rows.u + i), dv = v - load(rows.v + i);
        store(view.u + i, u);
        store(view.v + i, v);
        store(view.z_inverse + i, inverse);
        store(view.error2 + i, where_less(near, depth, du * du + dv * dv, never));
    }
}

}  // namespace RSE_PF_ISA
