// The two loops that take the time: the score of a pose, and the normal equations of a refinement.
#pragma once

#include "small.hpp"
#include "workspace.hpp"

namespace RSE_PF_ISA {

constexpr double kNear = 1e-6;           // metres; what is nearer lies behind the camera
constexpr double kNowhere = 1e9;         // pixel of the rows that fill up the last vector: no pose explains it
constexpr double kFarthest2 = 1e14;      // px^2 beyond which a residual has no weight under Cauchy's loss
constexpr int64_t kRowsBetweenStops = 64;

struct Optics {
    double fx, fy;  // pixels
};

// Return the MSAC score: the sum of squared errors, each at most limit2 (px^2).  It stops at `stop`, and
// returns a number that is not below it, as soon as the sum has reached it.
// Source: Torr and Zisserman, MLESAC, CVIU 2000.
static double score(const rse_pf::Columns<float>& rows, int64_t count, const Optics& optics, const Pose& pose,
                    double limit2, double stop) {
    typedef Lanes<float> F;
    const float fx = static_cast<float>(optics.fx), fy = static_cast<float>(optics.fy);
    const F r00 = all(static_cast<float>(pose.R[0][0]) * fx), r01 = all(static_cast<float>(pose.R[0][1]) * fx),
            r02 = all(static_cast<float>(pose.R[0][2]) * fx), tx = all(static_cast<float>(pose.t.x) * fx);
    const F r10 = all(static_cast<float>(pose.R[1][0]) * fy), r11 = all(static_cast<float>(pose.R[1][1]) * fy),
            r12 = all(static_cast<float>(pose.R[1][2]) * fy), ty = all(static_cast<float>(pose.t.y) * fy);
    const F r20 = all(static_cast<float>(pose.R[2][0])), r21 = all(static_cast<float>(pose.R[2][1])),
            r22 = all(static_cast<float>(pose.R[2][2])), tz = all(static_cast<float>(pose.t.z));
    const F limit = all(static_cast<float>(limit2)), near = all(static_cast<float>(kNear)), one = all(1.0f);
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
            const F capped = where_less(error2, limit, error2, limit);  // and what is nan, too
            cost = cost + where_less(near, depth, capped, limit);
        }
        total += static_cast<double>(sum<float>(cost));
        if (!(total < stop)) break;
    }
    return total;
}

enum class Loss {
    kTruncated,  // squared error up to limit2, constant beyond
    kCauchy,     // limit2 log(1 + squared error / limit2)
    kSquared,    // squared error; infinite cost where a point lies behind the camera
};

// Fill the normal equations at `pose` and return the cost; under the truncated loss, `agree` becomes the number
// of rows that have weight.
template <class T, Loss loss>
static double linearised(const rse_pf::Columns<T>& rows, int64_t count, const Optics& optics, const Pose& pose,
                         double limit2, Normal& normal, int64_t& agree) {
    typedef Lanes<T> F;
    const F r00 = all(static_cast<T>(pose.R[0][0])), r01 = all(static_cast<T>(pose.R[0][1])),
            r02 = all(static_cast<T>(pose.R[0][2])), tx = all(static_cast<T>(pose.t.x));
    const F r10 = all(static_cast<T>(pose.R[1][0])), r11 = all(static_cast<T>(pose.R[1][1])),
            r12 = all(static_cast<T>(pose.R[1][2])), ty = all(static_cast<T>(pose.t.y));
    const F r20 = all(static_cast<T>(pose.R[2][0])), r21 = all(static_cast<T>(pose.R[2][1])),
            r22 = all(static_cast<T>(pose.R[2][2])), tz = all(static_cast<T>(pose.t.z));
    const F fx = all(static_cast<T>(optics.fx)), fy = all(static_cast<T>(optics.fy));
    const F limit = all(static_cast<T>(limit2)), near = all(static_cast<T>(kNear));
    const F farthest = all(static_cast<T>(kFarthest2)), unlikely = all(static_cast<T>(limit2 > 0 ? 1.0 / limit2 : 0));
    const F one = all(T(1)), zero = all(T(0));
    F A00 = zero, A02 = zero, A03 = zero, A04 = zero, A05 = zero, A11 = zero, A12 = zero, A13 = zero, A14 = zero,
      A15 = zero, A22 = zero, A23 = zero, A24 = zero, A25 = zero, A33 = zero, A34 = zero, A35 = zero, A44 = zero,
      A45 = zero, A55 = zero;
    F b0 = zero, b1 = zero, b2 = zero, b3 = zero, b4 = zero, b5 = zero;
    F cost = zero, weights = zero, behind = zero, likely = one;
    double logs = 0.0;
    const int64_t end = padded(count);
    for (int64_t i = 0; i < end; i += kLanes) {
        const F x = load(rows.x + i), y = load(rows.y + i), z = load(rows.z + i);
        const F depth = r20 * x + r21 * y + (r22 * z + tz);
        const F inverse = one / where_less(near, depth, depth, one);
        const F a = (r00 * x + r01 * y + (r02 * z + tx)) * inverse;
        const F b = (r10 * x + r11 * y + (r12 * z + ty)) * inverse;
        const F ru = load(rows.u + i) - fx * a, rv = load(rows.v + i) - fy * b;
        const F error2 = ru * ru + rv * rv;
        F weight;
        if (loss == Loss::kTruncated) {
            weight = where_less(near, depth, where_less(error2, limit, one, zero), zero);
            cost = cost + where_less(near, depth, where_less(error2, limit, error2, limit), limit);
        } else if (loss == Loss::kCauchy) {
            const F ratio = one + error2 * unlikely;
            const F inside = where_less(near, depth, where_less(error2, farthest, one, zero), zero);
            weight = inside / ratio;
            likely = likely * where_less(zero, inside, ratio, one);
            behind = behind + where_less(near, depth, zero, one);
            if ((i / kLanes) % 16 == 15 || i + kLanes >= end) {
                alignas(64) T each[kLanes];
                store(each, likely);
                for (int k = 0; k < kLanes; ++k) logs += natural_log(static_cast<double>(each[k]));
                likely = one;
            }
        } else {
            weight = where_less(error2, farthest, one, zero);
            cost = cost + error2 * weight;
            behind = behind + where_less(near, depth, zero, one) * weight;
        }
        if (loss == Loss::kTruncated) weights = weights + weight;
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
    const F* upper[6][6] = {{&A00, &zero, &A02, &A03, &A04, &A05}, {nullptr, &A11, &A12, &A13, &A14, &A15},
                            {nullptr, nullptr, &A22, &A23, &A24, &A25}, {nullptr, nullptr, nullptr, &A33, &A34, &A35},
                            {nullptr, nullptr, nullptr, nullptr, &A44, &A45}, {nullptr, nullptr, nullptr, nullptr, nullptr, &A55}};
    const F* right[6] = {&b0, &b1, &b2, &b3, &b4, &b5};
    for (int i = 0; i < 6; ++i) {
        for (int j = i; j < 6; ++j) normal.A[i][j] = static_cast<double>(sum<T>(*upper[i][j]));
        normal.b[i] = static_cast<double>(sum<T>(*right[i]));
    }
    if (loss == Loss::kTruncated) {
        agree = static_cast<int64_t>(sum<T>(weights));
        return static_cast<double>(sum<T>(cost));
    }
    if (static_cast<double>(sum<T>(behind)) > 0.0) return kInfinity;
    return loss == Loss::kCauchy ? limit2 * logs : static_cast<double>(sum<T>(cost));
}

// Fill the view of the first `count` rows from `pose`: projected pixels from the principal point, 1/z, and
// squared errors (px^2), infinite behind the camera.
static void project(const rse_pf::Columns<double>& rows, int64_t count, const Optics& optics, const Pose& pose,
                    const rse_pf::Workspace& view) {
    typedef Lanes<double> F;
    const F r00 = all(pose.R[0][0]), r01 = all(pose.R[0][1]), r02 = all(pose.R[0][2]), tx = all(pose.t.x);
    const F r10 = all(pose.R[1][0]), r11 = all(pose.R[1][1]), r12 = all(pose.R[1][2]), ty = all(pose.t.y);
    const F r20 = all(pose.R[2][0]), r21 = all(pose.R[2][1]), r22 = all(pose.R[2][2]), tz = all(pose.t.z);
    const F fx = all(optics.fx), fy = all(optics.fy), near = all(kNear), one = all(1.0), never = all(kInfinity);
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
