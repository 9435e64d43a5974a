// The evidence of a pose: the expected number of equally good random poses, the shape of the inliers, the covariance.
#pragma once

#include "kernels.hpp"

namespace RSE_PF_ISA {

// Smallest squared error (px^2) of the false alarm test, to which a smaller largest error of the inliers is raised:
// messages are rounded, and four points may fit by luck.
constexpr double kMinError2 = 0.01;
// Quantile of the distances of points from and along their main axis that is their width and length: up to a fifth of
// the points may be outliers.
constexpr double kShapeQuantile = 0.8;
// Number of inliers that may lie at the farthest corner of the image while the others are still called wide without an
// exact quantile.
constexpr double kOutlierFactor = 4.0;
// Width over length of inliers (0: a line) from which on a lower bound is enough, and the exact quantile, a selection
// over all inliers, is left out.
constexpr double kClearlyWide = 0.15;
// Cells of a grid across the width of the image: inliers in one cell or in adjacent cells count as one independent
// inlier.
constexpr double kCellsAcross = 40.0;
// Occupied cells of the image from which on all inliers count as independent: copies of a few features occupy fewer.
constexpr int kManyCells = 24;
// Largest log10 of the expected number of random poses that fit as well as an accepted pose: one in 100,000 requests.
constexpr double kMaxLog10FalseAlarms = -5.0;
// log10(e), which converts natural to decimal logarithms.
constexpr double kLog10E = 0.43429448190325183;

// Return log10 of the expected number of random poses (number of false alarms, NFA) for which at least `inliers` of n
// rows have a squared error of at most largest_error2 (px^2) in an image of area_px2; infinity for up to 3 inliers.
// The lower the number, the stronger the evidence.  Sources: a-contrario RANSAC, Moisan and Stival, IJCV 2004; for PnP,
// Moulon et al., ACCV 2012.
static double log10_false_alarms(int64_t n, int64_t inliers, double largest_error2, double area_px2) {
    if (inliers <= 3) return kInfinity;
    const double disc = kPi * (largest_error2 > kMinError2 ? largest_error2 : kMinError2) / area_px2;
    const double log = natural_log(4.0 * static_cast<double>(n - 3)) + log_choose(n, inliers) +
                       log_choose(inliers, 3) +
                       static_cast<double>(inliers - 3) * natural_log(disc < 1.0 ? disc : 1.0);
    return log * kLog10E;
}

// Count the independent inliers: of the occupied cells of a grid over the image, in the order of columns and rows, count
// each cell that touches no counted cell, also not diagonally (a row of five cells counts 3).  Where at least kManyCells
// cells are occupied, return the number of all inliers (`count`).  u, v: pixels relative to the principal point (cx, cy);
// width: of the image, pixels.
static int64_t count_independent_inliers(const double* u, const double* v, int64_t count, double cx, double cy,
                                         double width) {
    // 1. List the occupied cells.
    const double scale = kCellsAcross / width;
    int64_t columns[kManyCells], rows[kManyCells];
    int cells = 0;
    for (int64_t i = 0; i < count; ++i) {
        const int64_t column = static_cast<int64_t>((u[i] + cx) * scale),
                      row = static_cast<int64_t>((v[i] + cy) * scale);
        bool is_listed = false;
        for (int k = 0; k < cells && !is_listed; ++k) is_listed = columns[k] == column && rows[k] == row;
        if (is_listed) continue;
        columns[cells] = column;
        rows[cells] = row;
        if (++cells == kManyCells) return count;
    }
    // 2. Sort the cells by column, then by row (insertion sort).
    for (int i = 1; i < cells; ++i)
        for (int k = i; k > 0; --k) {
            if (columns[k - 1] < columns[k] || (columns[k - 1] == columns[k] && rows[k - 1] < rows[k])) break;
            const int64_t column = columns[k], row = rows[k];
            columns[k] = columns[k - 1];
            rows[k] = rows[k - 1];
            columns[k - 1] = column;
            rows[k - 1] = row;
        }
    // 3. In this order, count each cell that touches no counted cell, and move it to the counted ones in front.
    int counted = 0;
    for (int i = 0; i < cells; ++i) {
        bool touches = false;
        for (int k = 0; k < counted && !touches; ++k) {
            const int64_t right = columns[i] - columns[k], down = rows[i] - rows[k];
            touches = (right == 1 && down >= -1 && down <= 1) || (right == 0 && down == 1);
        }
        if (touches) continue;
        columns[counted] = columns[i];
        rows[counted] = rows[i];
        ++counted;
    }
    return counted;
}

// Return the k-th smallest number, counted from 0, and rearrange the numbers in place on the way (quickselect).
// Source: Hoare, Algorithm 65: FIND, CACM 1961.
static double select_kth(double* numbers, int64_t count, int64_t kth) {
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

// Return width over length of a set of points: 0 if they are collinear or coincide, about 1 if they are round.
//
// Length is the 80 % quantile of the distances of the points from their centroid along their main axis, width that of
// their distances from the axis.  z is null for points of the image.  length2, width2: scratch memory for `count`
// numbers each.
static double width_to_length(const double* x, const double* y, const double* z, int64_t count, double* length2,
                              double* width2) {
    // 1. Compute centroid and second moments.
    double centroid[3] = {0.0, 0.0, 0.0}, moments[3][3] = {};
    const double count_inverse = 1.0 / static_cast<double>(count);
    for (int64_t i = 0; i < count; ++i) {
        centroid[0] += x[i];
        centroid[1] += y[i];
        centroid[2] += z != nullptr ? z[i] : 0.0;
    }
    for (double& coordinate : centroid) coordinate *= count_inverse;
    for (int64_t i = 0; i < count; ++i) {
        const double p[3] = {x[i] - centroid[0], y[i] - centroid[1], z != nullptr ? z[i] - centroid[2] : 0.0};
        for (int j = 0; j < 3; ++j)
            for (int k = j; k < 3; ++k) moments[j][k] += p[j] * p[k];
    }
    moments[1][0] = moments[0][1];
    moments[2][0] = moments[0][2];
    moments[2][1] = moments[1][2];
    // 2. Take the main axis, which has the largest second moment.
    double values[3], axes[3][3];
    compute_eigenvectors(moments, values, axes);
    // 3. Measure the squared distances along and across the axis.
    for (int64_t i = 0; i < count; ++i) {
        const double p[3] = {x[i] - centroid[0], y[i] - centroid[1], z != nullptr ? z[i] - centroid[2] : 0.0};
        const double along = p[0] * axes[2][0] + p[1] * axes[2][1] + p[2] * axes[2][2];
        length2[i] = along * along;
        width2[i] = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - length2[i];
    }
    // 4. Take the quantiles of these distances, and return the root of their ratio.
    const int64_t quantile_at = static_cast<int64_t>(kShapeQuantile * static_cast<double>(count));
    const int64_t kth = quantile_at < count - 1 ? quantile_at : count - 1;
    const double width_quantile2 = select_kth(width2, count, kth), length_quantile2 = select_kth(length2, count, kth);
    if (!(length_quantile2 > 1e-18)) return 0.0;
    return square_root((width_quantile2 > 0.0 ? width_quantile2 : 0.0) / length_quantile2);
}

// Measure how the projections of the `count` inliers, as `project` wrote them, lie in the image, and write it to the
// result: inlier_width_to_length (a lower bound where they are clearly wide), and radius_px, the root mean square
// distance from their centroid.
static void measure_shape(const rse_pf::Workspace& view, int64_t count, const rse_pf_pnp_request& request,
                          rse_pf_pnp_result& result) {
    // 1. Sum the projected pixels and their products.
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
    // 2. Compute the eigenvalues length2 >= width2 of the second moments about the centroid.
    const double k = static_cast<double>(count), mean_u = su / k, mean_v = sv / k;
    const double xx = suu - su * mean_u, xy = suv - su * mean_v, yy = svv - sv * mean_v;
    const double half = 0.5 * (xx - yy), mean = 0.5 * (xx + yy), root = square_root(half * half + xy * xy);
    const double length2 = mean + root, width2 = mean - root, spread = length2 + width2;
    result.radius_px = square_root((spread > 0.0 ? spread : 0.0) / k);
    // 3. Subtract from width2 what a few outlying inliers may contribute: each the squared distance to the farthest
    // corner of the image, or the square of three times the radius where that is larger.  If the inliers are still
    // wide, this bound is the answer; otherwise compute the quantiles, which takes longer.
    const double left = mean_u + request.cx, top = mean_v + request.cy;
    const double right = request.width - left, bottom = request.height - top;
    const double reach_u = left > right ? left : right, reach_v = top > bottom ? top : bottom;
    const double corner2 = reach_u * reach_u + reach_v * reach_v, rms2 = 9.0 * result.radius_px * result.radius_px;
    const double width_bound2 = width2 - kOutlierFactor * (corner2 > rms2 ? corner2 : rms2);
    if (width_bound2 > kClearlyWide * kClearlyWide * length2)
        result.inlier_width_to_length = square_root(width_bound2 / length2);
    else
        result.inlier_width_to_length = width_to_length(view.u, view.v, nullptr, count, view.length2, view.width2);
}

// A symmetric 3x3 matrix by its upper triangle.  The inverse of a singular one has numbers that are not finite.
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

// Write the covariance of the twist (m, rad) on the left of the pose, variance (px^2) times the inverse of J^T J, by
// the inverse of a 2x2 block matrix.  Return false where it does not exist, because some motion of the camera changes
// no pixel; what was written is then no covariance.
static bool compute_covariance(const Normal& normal, double variance, double (&out)[36]) {
    const double s = 1.0 / variance;
    // 1. Split J^T J / variance into the blocks A (translation), B (mixed) and D (rotation); P = A^-1.
    const auto& A = normal.A;
    const Symmetric3 P = inverse(
        {A[0][0] * s, A[0][1] * s, A[0][2] * s, A[1][1] * s, A[1][2] * s, A[2][2] * s});
    double B[3][3], W[3][3], S[3][3], X[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) B[i][j] = A[i][j + 3] * s;
    // 2. W = A^-1 B, and the Schur complement S = D - B^T W, whose inverse is the covariance of the rotation.
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            W[i][j] = at(P, i, 0) * B[0][j] + at(P, i, 1) * B[1][j] + at(P, i, 2) * B[2][j];
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j)
            S[i][j] = A[i + 3][j + 3] * s - B[0][i] * W[0][j] - B[1][i] * W[1][j] - B[2][i] * W[2][j];
    const Symmetric3 Q = inverse({S[0][0], S[0][1], S[0][2], S[1][1], S[1][2], S[2][2]});
    // 3. With X = W S^-1, the mixed block of the covariance is -X, and the block of the translation is A^-1 + X W^T.
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
    // 4. Return false for a covariance that is not finite (x - x is nan then) or has a variance that is not positive.
    double total = 0.0;
    for (const double element : out) total += element;
    if (!(total - total == 0.0)) return false;
    for (int i = 0; i < 6; ++i)
        if (!(out[7 * i] > 0.0)) return false;
    return true;
}

}  // namespace RSE_PF_ISA
