// The perspective-three-point problem (P3P): up to four camera poses from three bearing vectors and three points.
//
// The solver intersects two conics in the ratios of the distances, by a degenerate conic of their pencil, which is a
// pair of lines.  Sources: Persson and Nordberg, Lambda Twist, ECCV 2018; Ding et al., Revisiting the P3P Problem,
// CVPR 2023; for the lines of a degenerate conic: Richter-Gebert, Perspectives on Projective Geometry (2011), 11.1.
#pragma once

#include "small.hpp"

namespace RSE_PF_ISA {

// A conic as its symmetric 3x3 matrix [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]].
struct Conic {
    double xx, xy, xz, yy, yz, zz;
};

RSE_PF_INLINE Conic adjugate(const Conic& c) {
    return {c.yy * c.zz - c.yz * c.yz, c.xz * c.yz - c.xy * c.zz, c.xy * c.yz - c.xz * c.yy,
            c.xx * c.zz - c.xz * c.xz, c.xy * c.xz - c.xx * c.yz, c.xx * c.yy - c.xy * c.xy};
}
// Return the trace of the product of two symmetric matrices.
RSE_PF_INLINE double product_trace(const Conic& a, const Conic& b) {
    return a.xx * b.xx + a.yy * b.yy + a.zz * b.zz + 2.0 * (a.xy * b.xy + a.xz * b.xz + a.yz * b.yz);
}

// Return a real root of t^3 + a t^2 + b t + c by Newton's method, started outside of the two extrema (if the cubic has
// them), where it converges.
static double find_real_root(double a, double b, double c) {
    const double discriminant = a * a - 3.0 * b;
    double t = -a / 3.0;
    // 1. Choose the start.
    if (discriminant > 0.0) {
        // Beyond an extremum the cubic is monotone and convex towards the root: start where the parabola that
        // approximates the cubic at the extremum is zero.
        const double spread = square_root(discriminant);
        const double low = (-a - spread) / 3.0, value = ((low + a) * low + b) * low + c;
        if (value > 0.0) {
            t = low - square_root(value / spread);
        } else {
            const double high = (-a + spread) / 3.0, high_value = ((high + a) * high + b) * high + c;
            t = high + square_root((high_value < 0.0 ? -high_value : 0.0) / spread);
        }
    } else {
        // A cubic without extrema: leave the inflection point if it is nearly flat there.
        const double value = ((t + a) * t + b) * t + c;
        if (absolute(3.0 * t * t + 2.0 * a * t + b) < 1e-4) t += value > 0.0 ? -1.0 : 1.0;
    }
    // 2. Apply Newton steps to t until they are as small as rounding errors.
    for (int i = 0; i < 24; ++i) {
        const double slope = (3.0 * t + 2.0 * a) * t + b;
        if (slope == 0.0) break;
        const double step = (((t + a) * t + b) * t + c) / slope;
        t -= step;
        if (absolute(step) <= 1e-13 * (1.0 + absolute(t))) break;
    }
    return t;
}

// Solve P3P: write the poses that map three world points (metres) onto three bearings (unit vectors of the camera
// frame), all points in front of the camera.  Return the number of poses, 0..4; collinear points have none.
static int solve_p3p(const Vector3 (&bearing)[3], const Vector3 (&point)[3], Pose (&poses)[4]) {
    // 1. Compute the sides of the triangle; coincident or collinear points determine no pose.
    const Vector3 side12 = point[0] - point[1], side13 = point[0] - point[2], side23 = point[1] - point[2];
    const double d23 = dot(side23, side23), d12 = dot(side12, side12), d13 = dot(side13, side13);
    const Vector3 normal = cross(side12, side13);
    const double area2 = dot(normal, normal);
    if (!(area2 > 1e-10 * d12 * d13) || !(d23 > 1e-12 * (d12 + d13))) return 0;
    // 2. Write the law of cosines as two conics in x = s1 / s3 and y = s2 / s3, where s1, s2, s3 are the distances of
    // the points from the camera, f1, f2, f3 the bearings, and a12, a13 ratios of squared sides: |s1 f1 - s2 f2|^2 =
    // a12 |s2 f2 - s3 f3|^2 and |s1 f1 - s3 f3|^2 = a13 |s2 f2 - s3 f3|^2.
    const double scale = 1.0 / d23, a12 = d12 * scale, a13 = d13 * scale;
    const double b12 = dot(bearing[0], bearing[1]), b13 = dot(bearing[0], bearing[2]),
                 b23 = dot(bearing[1], bearing[2]);
    const Conic first = {1.0, -b12, 0.0, 1.0 - a12, a12 * b23, -a12};
    const Conic second = {1.0, 0.0, -b13, -a13, a13 * b23, 1.0 - a13};
    // 3. Find the degenerate conic u * first + v * second, whose determinant is a cubic in u and v with the
    // coefficients c0..c3.
    const Conic adjugate1 = adjugate(first), adjugate2 = adjugate(second);
    const double c0 = first.xx * adjugate1.xx + first.xy * adjugate1.xy + first.xz * adjugate1.xz;
    const double c1 = product_trace(adjugate1, second), c2 = product_trace(adjugate2, first);
    const double c3 = second.xx * adjugate2.xx + second.xy * adjugate2.xy + second.xz * adjugate2.xz;
    // Divide the cubic by the larger of its outer coefficients, and solve for v (with u = 1) or for u (with v = 1).
    double u = 1.0, v = 1.0;
    if (absolute(c3) >= absolute(c0)) {
        if (!(absolute(c3) > 1e-14)) return 0;
        const double inverse = 1.0 / c3;
        v = find_real_root(c2 * inverse, c1 * inverse, c0 * inverse);
    } else {
        const double inverse = 1.0 / c0;
        u = find_real_root(c1 * inverse, c2 * inverse, c3 * inverse);
    }
    const Conic degenerate = {u * first.xx + v * second.xx, u * first.xy + v * second.xy,
                              u * first.xz + v * second.xz, u * first.yy + v * second.yy,
                              u * first.yz + v * second.yz, u * first.zz + v * second.zz};
    // 4. Split the degenerate conic into two lines.  A column of its adjugate is, up to scale, their intersection p;
    // the conic plus the cross product matrix of p has rank one, and one row and one column of it are the lines.
    const Conic dual = adjugate(degenerate);
    double largest_diagonal = -dual.xx;
    Vector3 column = {dual.xx, dual.xy, dual.xz};
    if (-dual.yy > largest_diagonal) {
        largest_diagonal = -dual.yy;
        column = {dual.xy, dual.yy, dual.yz};
    }
    if (-dual.zz > largest_diagonal) {
        largest_diagonal = -dual.zz;
        column = {dual.xz, dual.yz, dual.zz};
    }
    if (!(largest_diagonal > 0.0)) return 0;
    const Vector3 p = column * (1.0 / square_root(largest_diagonal));
    const double M[3][3] = {{degenerate.xx, degenerate.xy - p.z, degenerate.xz + p.y},
                            {degenerate.xy + p.z, degenerate.yy, degenerate.yz - p.x},
                            {degenerate.xz - p.y, degenerate.yz + p.x, degenerate.zz}};
    int row = 0, col = 0;
    double largest = 0.0;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            if (absolute(M[i][j]) > largest) {
                largest = absolute(M[i][j]);
                row = i;
                col = j;
            }
    const Vector3 lines[2] = {{M[row][0], M[row][1], M[row][2]}, {M[0][col], M[1][col], M[2][col]}};

    // 5. Intersect each line with the second conic, and compute a pose from each intersection. (e1, e2, e3) is an
    // orthonormal frame of the triangle in the world; (f1, f2, f3) is that frame in the camera frame.
    const Vector3 e1 = normalise(side12), e3 = normal * (1.0 / square_root(area2)), e2 = cross(e3, e1);
    int count = 0;
    for (const Vector3& line : lines) {
        // Substitute the line into the second conic, which has no term xy: a quadratic in x or in y, whichever
        // expresses the line with the smaller slope.
        const bool by_x = absolute(line.y) >= absolute(line.x);
        const double divisor = by_x ? line.y : line.x;
        if (divisor == 0.0) continue;
        const double slope = -(by_x ? line.x : line.y) / divisor, offset = -line.z / divisor;
        double qa, qb, qc;  // qa w^2 + 2 qb w + qc = 0
        if (by_x) {
            qa = 1.0 - a13 * slope * slope;
            qb = -b13 - a13 * slope * offset + a13 * b23 * slope;
            qc = -a13 * offset * offset + 2.0 * a13 * b23 * offset + 1.0 - a13;
        } else {
            qa = slope * slope - a13;
            qb = slope * offset - b13 * slope + a13 * b23;
            qc = offset * offset - 2.0 * b13 * offset + 1.0 - a13;
        }
        const double discriminant = qb * qb - qa * qc;
        if (!(discriminant >= 0.0)) continue;
        // Both roots without cancellation (Numerical Recipes, Sect. 5.6).
        const double q = -(qb + (qb < 0.0 ? -1.0 : 1.0) * square_root(discriminant));
        const double roots[2] = {q / qa, qc / q};
        for (const double root : roots) {
            const double x = by_x ? root : slope * root + offset, y = by_x ? slope * root + offset : root;
            if (!(x > 0.0 && y > 0.0 && x < 1e9 && y < 1e9) || count == 4) continue;
            const double ratio = y * y - 2.0 * b23 * y + 1.0;
            if (!(ratio > 0.0)) continue;
            const double s3 = square_root(d23 / ratio);
            const Vector3 q1 = bearing[0] * (x * s3), q2 = bearing[1] * (y * s3), q3 = bearing[2] * s3;
            const Vector3 f1 = normalise(q1 - q2), f3 = normalise(cross(q1 - q2, q1 - q3)), f2 = cross(f3, f1);
            Pose& pose = poses[count];
            pose.R[0][0] = f1.x * e1.x + f2.x * e2.x + f3.x * e3.x;
            pose.R[0][1] = f1.x * e1.y + f2.x * e2.y + f3.x * e3.y;
            pose.R[0][2] = f1.x * e1.z + f2.x * e2.z + f3.x * e3.z;
            pose.R[1][0] = f1.y * e1.x + f2.y * e2.x + f3.y * e3.x;
            pose.R[1][1] = f1.y * e1.y + f2.y * e2.y + f3.y * e3.y;
            pose.R[1][2] = f1.y * e1.z + f2.y * e2.z + f3.y * e3.z;
            pose.R[2][0] = f1.z * e1.x + f2.z * e2.x + f3.z * e3.x;
            pose.R[2][1] = f1.z * e1.y + f2.z * e2.y + f3.z * e3.y;
            pose.R[2][2] = f1.z * e1.z + f2.z * e2.z + f3.z * e3.z;
            const Vector3 centroid = (point[0] + point[1] + point[2]) * (1.0 / 3.0);
            pose.t = (q1 + q2 + q3) * (1.0 / 3.0) - rotate(pose.R, centroid);
            if (is_finite(pose)) ++count;
        }
    }
    return count;
}

}  // namespace RSE_PF_ISA
