// Evidence for and against a proposed pose: probability of chance, geometry, covariance.
#pragma once

#include "kernels.hpp"

namespace RSE_PF_ISA {

constexpr double kMinError2 = 0.01;  // px^2: messages are rounded, and four points may fit by luck
constexpr double kKeptShare = 0.8;
constexpr double kOutlierFactor = 4.0;
constexpr double kClearlyWide = 0.15;
constexpr double kCellsAcross = 40.0;
constexpr int kManyCells = 24;
constexpr double kMaxLog10FalseAlarms = -5.0;
constexpr double kLog10E = 0.43429448190325183;

// Return log10 of the expected number of random poses that `inliers` of n rows fit within largest_error2 (px^2).
// Source: Moisan and Stival, IJCV 2004; for PnP: Moulon et al., ACCV 2012.
static double log10_false_alarms(int64_t n, int64_t inliers, double largest_error2, double area_px2) {
    if (inliers <= 3) return kInfinity;
    const double disc = kPi * (largest_error2 > kMinError2 ? largest_error2 : kMinError2) / area_px2;
    const double log = natural_log(4.0 * static_cast<double>(n - 3)) + log_choose(n, inliers) +
                       log_choose(inliers, 3) +
                       static_cast<double>(inliers - 3) * natural_log(disc < 1.0 ? disc : 1.0);
    return log * kLog10E;
}

// Return how many of the inliers count as independent: those in the same or in adjacent cells of the image
// count once, unless very many cells are occupied.
static int64_t independent_inliers(const double* u, const double* v, int64_t count, double cx, double cy,
                                   double width) {
    const double scale = kCellsAcross / width;
    int64_t columns[kManyCells], rows[kManyCells];
    int cells = 0;
    for (int64_t i = 0; i < count; ++i) {
        const int64_t column = static_cast<int64_t>((u[i] + cx) * scale),
                      row = static_cast<int64_t>((v[i] + cy) * scale);
        bool is_known = false;
        for (int k = 0; k < cells && !is_known; ++k) is_known = columns[k] == column && rows[k] == row;
        if (is_known) continue;
        columns[cells] = column;
        rows[cells] = row;
        if (++cells == kManyCells) return count;
    }
    // In order, take each cell that touches none of those taken.
    for (int i = 1; i < cells; ++i)
        for (int k = i; k > 0; --k) {
            if (columns[k - 1] < columns[k] || (columns[k - 1] == columns[k] && rows[k - 1] < rows[k])) break;
            const int64_t column = columns[k], row = rows[k];
            columns[k] = columns[k - 1];
            rows[k] = rows[k - 1];
            columns[k - 1] = column;
            rows[k - 1] = row;
        }
    int alone = 0;
    for (int i = 0; i < cells; ++i) {
        bool touches = false;
        for (int k = 0; k < alone && !touches; ++k) {
            const int64_t right = columns[i] - columns[k], down = rows[i] - rows[k];
            touches = (right == 1 && down >= -1 && down <= 1) || (right == 0 && down == 1);
        }
        if (touches) continue;
        columns[alone] = columns[i];
        rows[alone] = rows[i];
        ++alone;
    }
    return alone;
}

// Return the number that would stand at `kth` if the numbers were sorted; they are rearranged.
// Source: Hoare, Algorithm 65: FIND, CACM 1961.
static double selected(double* numbers, int64_t count, int64_t kth) {
    int64_t low = 0, high = count - 1;
    while (low < high) {
        const double pivot = numbers[low + (high - low) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (numbers[i] < pivot) ++i;
            while (pivot < numbers[j]) --j;
            if (i <= j) {
                const double number = numbers[i];
                numbers[i++] = numbers[j];
                numbers[j--] = number;
            }
        }
        if (kth <= j) high = j;
        else if (kth >= i) low = i;
        else break;
    }
    return numbers[kth];
}

// Return width over length of points of two or three coordinates (z null for two): 0 on a line, 0 if they
// coincide.  Width is what 80 % of the points stay below.
static double width_to_length(const double* x, const double* y, const double* z, int64_t count, double* along,
                              double* aside) {
    double middle[3] = {0.0, 0.0, 0.0}, moments[3][3] = {};
    const double share = 1.0 / static_cast<double>(count);
    for (int64_t i = 0; i < count; ++i) {
        middle[0] += x[i];
        middle[1] += y[i];
        middle[2] += z != nullptr ? z[i] : 0.0;
    }
    for (double& each : middle) each *= share;
    for (int64_t i = 0; i < count; ++i) {
        const double p[3] = {x[i] - middle[0], y[i] - middle[1], z != nullptr ? z[i] - middle[2] : 0.0};
        for (int j = 0; j < 3; ++j)
            for (int k = j; k < 3; ++k) moments[j][k] += p[j] * p[k];
    }
    moments[1][0] = moments[0][1];
    moments[2][0] = moments[0][2];
    moments[2][1] = moments[1][2];
    double values[3], axes[3][3];
    eigenvectors(moments, values, axes);
    for (int64_t i = 0; i < count; ++i) {
        const double p[3] = {x[i] - middle[0], y[i] - middle[1], z != nullptr ? z[i] - middle[2] : 0.0};
        const double main = p[0] * axes[2][0] + p[1] * axes[2][1] + p[2] * axes[2][2];
        along[i] = main * main;
        aside[i] = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - along[i];
    }
    const int64_t share_at = static_cast<int64_t>(kKeptShare * static_cast<double>(count));
    const int64_t kth = share_at < count - 1 ? share_at : count - 1;
    const double width2 = selected(aside, count, kth), length2 = selected(along, count, kth);
    if (!(length2 > 1e-18)) return 0.0;
    return square_root((width2 > 0.0 ? width2 : 0.0) / length2);
}

// Write how the inliers lie in the image: width over length, and the root mean square distance from their centre.
static void write_shape(const rse_pf::Workspace& view, int64_t count, const rse_pf_pnp_request& request,
                        rse_pf_pnp_result& result) {
    typedef Lanes<double> F;
    F u = all(0.0), v = u, uu = u, uv = u, vv = u;
    const int64_t whole = count / kLanes * kLanes;
    for (int64_t i = 0; i < whole; i += kLanes) {
        const F pu = load(view.u + i), pv = load(view.v + i);
        u = u + pu;
        v = v + pv;
        uu = uu + pu * pu;
        uv = uv + pu * pv;
        vv = vv + pv * pv;
    }
    double su = sum<double>(u), sv = sum<double>(v), suu = sum<double>(uu), suv = sum<double>(uv),
           svv = sum<double>(vv);
    for (int64_t i = whole; i < count; ++i) {
        const double pu = view.u[i], pv = view.v[i];
        su += pu;
        sv += pv;
        suu += pu * pu;
        suv += pu * pv;
        svv += pv * pv;
    }
    const double k = static_cast<double>(count), mean_u = su / k, mean_v = sv / k;
    const double xx = suu - su * mean_u, xy = suv - su * mean_v, yy = svv - sv * mean_v;
    const double half = 0.5 * (xx - yy), mean = 0.5 * (xx + yy), root = square_root(half * half + xy * xy);
    const double length2 = mean + root, width2 = mean - root, spread = length2 + width2;
    result.radius_px = square_root((spread > 0.0 ? spread : 0.0) / k);
    // No inlier lies further out than the corner of the image (or, outside it, than three times the rms).
    const double at_u = mean_u + request.cx, at_v = mean_v + request.cy;
    const double other_u = request.width - at_u, other_v = request.height - at_v;
    const double reach_u = at_u > other_u ? at_u : other_u, reach_v = at_v > other_v ? at_v : other_v;
    const double corner2 = reach_u * reach_u + reach_v * reach_v, rms2 = 9.0 * result.radius_px * result.radius_px;
    const double margin = width2 - kOutlierFactor * (corner2 > rms2 ? corner2 : rms2);
    if (margin > kClearlyWide * kClearlyWide * length2)
        result.inlier_thinness = square_root(margin / length2);
    else
        result.inlier_thinness = width_to_length(view.u, view.v, nullptr, count, view.along, view.aside);
}

struct Symmetric3 {
    double xx, xy, xz, yy, yz, zz;
};
RSE_PF_INLINE Symmetric3 inverse(const Symmetric3& m) {
    const double a = m.yy * m.zz - m.yz * m.yz, b = m.xz * m.yz - m.xy * m.zz, c = m.xy * m.yz - m.xz * m.yy;
    const double scale = 1.0 / (m.xx * a + m.xy * b + m.xz * c);
    return {a * scale,
            b * scale,
            c * scale,
            (m.xx * m.zz - m.xz * m.xz) * scale,
            (m.xy * m.xz - m.xx * m.yz) * scale,
            (m.xx * m.yy - m.xy * m.xy) * scale};
}
RSE_PF_INLINE double at(const Symmetric3& m, int i, int j) {
    const double full[3][3] = {{m.xx, m.xy, m.xz}, {m.xy, m.yy, m.yz}, {m.xz, m.yz, m.zz}};
    return full[i][j];
}

// Write variance (px^2) times the inverse of J^T J; false where some motion of the camera changes no pixel.
static bool covariance_of(const Normal& normal, double variance, double (&out)[36]) {
    const double s = 1.0 / variance;
    const auto& A = normal.A;
    const Symmetric3 P = inverse(
        {A[0][0] * s, A[0][1] * s, A[0][2] * s, A[1][1] * s, A[1][2] * s, A[2][2] * s});
    double B[3][3], W[3][3], S[3][3], X[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) B[i][j] = A[i][j + 3] * s;
    // W = A^-1 B, then the Schur complement S = D - B^T W.
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            W[i][j] = at(P, i, 0) * B[0][j] + at(P, i, 1) * B[1][j] + at(P, i, 2) * B[2][j];
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j)
            S[i][j] = A[i + 3][j + 3] * s - B[0][i] * W[0][j] - B[1][i] * W[1][j] - B[2][i] * W[2][j];
    const Symmetric3 Q = inverse({S[0][0], S[0][1], S[0][2], S[1][1], S[1][2], S[2][2]});
    // X = W S^-1 is minus the block off the diagonal, and the first block is A^-1 + X W^T.
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            X[i][j] = W[i][0] * at(Q, 0, j) + W[i][1] * at(Q, 1, j) + W[i][2] * at(Q, 2, j);
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j) {
            const double first = at(P, i, j) + (X[i][0] * W[j][0] + X[i][1] * W[j][1] + X[i][2] * W[j][2]);
            out[6 * i + j] = out[6 * j + i] = first;
            out[6 * (i + 3) + j + 3] = out[6 * (j + 3) + i + 3] = at(Q, i, j);
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[6 * i + j + 3] = out[6 * (j + 3) + i] = -X[i][j];
    double total = 0.0;
    for (const double each : out) total += each;
    if (!(total - total == 0.0)) return false;
    for (int i = 0; i < 6; ++i)
        if (!(out[7 * i] > 0.0)) return false;
    return true;
}

}  // namespace RSE_PF_ISA
