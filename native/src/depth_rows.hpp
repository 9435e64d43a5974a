// The inner loop of the pose refinement with depths: residuals, their covariances, and the normal equations.
//
// The loop takes four correspondences at a time.  A vector of four doubles is one AVX register or two narrower ones,
// and gives the same bytes, because each operation is a single IEEE 754 operation and lanes are added in one order.
#pragma once

#include <cstdint>

namespace rse_pf_depth_detail {

typedef double Four __attribute__((vector_size(32)));

// Correspondences that the loop takes at a time: four doubles fill a register of AVX.
constexpr int64_t kFour = 4;
// Arrays of a Rows, which the workspace of the caller must hold, each with a number per correspondence.
constexpr int kColumns = 11;
// Smallest depth of a point in front of a camera (m); smaller depths are replaced by it, so that no division overflows.
constexpr double kMinDepthM = 1e-3;
// Squared Mahalanobis distance at which the Cauchy weight of a residual is one half: 2.5 standard deviations, squared.
constexpr double kCauchy2 = 6.25;

// Inliers as a structure of arrays; `count`, a multiple of four, includes the rows that pad the last vector.
struct Rows {
    int64_t count;
    double *x, *y, *z;        // point in the reference camera, metres
    double *z_inverse;        // 1 / z
    double *depth_variance;   // variance of z by the depth noise, square metres
    double *z2;               // z^2
    double *u, *v, *depth;    // pixel and depth (metres, 0: none) in the second image
    double *has_depth;        // 1 where there is a depth in the second image, else 0
    double *is_real;          // 1, or 0 for padding
};

struct Sensor {
    double fx, fy, cx, cy;               // pinhole intrinsics, pixels
    double base_m, growth_per_m, from_m; // standard deviation of depth z: base + growth * max(0, z - from)^2, metres
    double pixel_px2;                    // variance of a pixel coordinate in each image, px^2
};

// The sums of one pass over the rows.  b is 0 after the last pass, and what follows b is 0 after the others.
struct Sums {
    // Blocks of A = J^T W J (upper triangles of translation P and rotation D, all of the mixed block M), and b = J^T W
    // r.
    double P[6], M[9], D[6], b[6];
    // For the covariance of an M-estimator: the sum of the squared Mahalanobis distances times the squared weights, the
    // sum of the derivatives of the influence function, and the number of residuals (two of a pixel, one of a depth).
    double weight2_distance2, slope, residuals;
    // Sum of the squared reprojection errors, px^2.
    double error2;
};

#define RSE_PF_ROWS_INLINE static inline __attribute__((always_inline))

RSE_PF_ROWS_INLINE Four all(double value) { return Four{value, value, value, value}; }
RSE_PF_ROWS_INLINE void load(const double* from, Four& lanes) { __builtin_memcpy(&lanes, from, sizeof lanes); }
RSE_PF_ROWS_INLINE double total(const Four& lanes) { return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]); }

// Write the sums of the rows at the pose (R, t), which maps the reference camera to the second camera.  The last pass,
// at the final pose, leaves the robust weights out of A, and sums what covariance and rmse need instead of b.
template <bool kIsLast>
RSE_PF_ROWS_INLINE void add_rows(const Rows& rows, const double (&R)[3][3], const double (&t)[3],
                                 const Sensor& sensor, Sums& sums) {
    const Four zero = all(0.0), one = all(1.0), near = all(kMinDepthM), pixel = all(sensor.pixel_px2);
    const Four fx = all(sensor.fx), fy = all(sensor.fy), cx = all(sensor.cx), cy = all(sensor.cy);
    const Four by_fx2 = all(sensor.pixel_px2 / (sensor.fx * sensor.fx));
    const Four by_fy2 = all(sensor.pixel_px2 / (sensor.fy * sensor.fy));
    Four P[6], M[9], D[6], b[6], squares = zero, slopes = zero, residuals = zero, errors = zero;
    for (Four& lanes : P) lanes = zero;
    for (Four& lanes : M) lanes = zero;
    for (Four& lanes : D) lanes = zero;
    for (Four& lanes : b) lanes = zero;
    for (int64_t i = 0; i < rows.count; i += kFour) {
        Four X, Y, Z, z_inverse, depth_variance, z2, u, v, depth, has, real;
        load(rows.x + i, X), load(rows.y + i, Y), load(rows.z + i, Z), load(rows.z_inverse + i, z_inverse);
        load(rows.depth_variance + i, depth_variance), load(rows.z2 + i, z2);
        load(rows.u + i, u), load(rows.v + i, v), load(rows.depth + i, depth);
        load(rows.has_depth + i, has), load(rows.is_real + i, real);
        // 1. Rotate the point.  Before t is added, the point divided by its depth in the reference camera is the ray
        // along which its depth noise lies.
        Four x = R[0][0] * X + R[0][1] * Y + R[0][2] * Z;
        Four y = R[1][0] * X + R[1][1] * Y + R[1][2] * Z;
        Four z = R[2][0] * X + R[2][1] * Y + R[2][2] * Z;
        const Four rx = x * z_inverse, ry = y * z_inverse, rz = z * z_inverse;
        // 2. Translate the point, and compute the residuals of pixel and depth, measured minus predicted.  A missing
        // depth has the residual 0.
        x += all(t[0]);
        y += all(t[1]);
        z += all(t[2]);
        z = z > near ? z : near;
        const Four inverse = one / z, a = x * inverse, c = y * inverse;
        const Four r0 = u - (fx * a + cx), r1 = v - (fy * c + cy), r2 = has * (depth - z);
        // 3. Compute the covariance G of the point in the second camera's frame, from the noise of the reference image.
        const Four gx = by_fx2 * z2, gy = by_fy2 * z2;
        const Four dx = depth_variance * rx, dy = depth_variance * ry, dz = depth_variance * rz;
        const Four g00 = dx * rx + gx * (R[0][0] * R[0][0]) + gy * (R[0][1] * R[0][1]);
        const Four g01 = dx * ry + gx * (R[0][0] * R[1][0]) + gy * (R[0][1] * R[1][1]);
        const Four g02 = dx * rz + gx * (R[0][0] * R[2][0]) + gy * (R[0][1] * R[2][1]);
        const Four g11 = dy * ry + gx * (R[1][0] * R[1][0]) + gy * (R[1][1] * R[1][1]);
        const Four g12 = dy * rz + gx * (R[1][0] * R[2][0]) + gy * (R[1][1] * R[2][1]);
        const Four g22 = dz * rz + gx * (R[2][0] * R[2][0]) + gy * (R[2][1] * R[2][1]);
        // 4. Compute the covariance S of the residuals: G through the Jacobian [h0 0 k0; 0 h1 k1; 0 0 has] of (u, v, z)
        // by the point, plus the noise of the second image.  A missing depth has the variance 1.
        const Four h0 = fx * inverse, h1 = fy * inverse, k0 = -(h0 * a), k1 = -(h1 * c);
        const Four e0 = h0 * g02 + k0 * g22, e1 = h1 * g12 + k1 * g22;
        Four beyond = z - all(sensor.from_m);
        beyond = beyond > zero ? beyond : zero;
        const Four deviation = all(sensor.base_m) + all(sensor.growth_per_m) * (beyond * beyond);
        const Four s00 = h0 * (h0 * g00 + k0 * g02) + k0 * e0 + pixel;
        const Four s01 = h1 * (h0 * g01 + k0 * g12) + k1 * e0;
        const Four s11 = h1 * (h1 * g11 + k1 * g12) + k1 * e1 + pixel;
        const Four s02 = has * e0, s12 = has * e1;
        const Four s22 = has * (g22 + deviation * deviation) + (one - has);
        // 5. Invert S to W by its adjugate, and multiply W with the residuals.
        const Four m00 = s11 * s22 - s12 * s12, m01 = s02 * s12 - s01 * s22, m02 = s01 * s12 - s02 * s11;
        const Four scale = one / (s00 * m00 + s01 * m01 + s02 * m02);
        const Four w00 = m00 * scale, w01 = m01 * scale, w02 = m02 * scale;
        const Four w11 = (s00 * s22 - s02 * s02) * scale, w12 = (s01 * s02 - s00 * s12) * scale;
        const Four w22 = (s00 * s11 - s01 * s01) * scale;
        const Four q0 = w00 * r0 + w01 * r1 + w02 * r2, q1 = w01 * r0 + w11 * r1 + w12 * r2;
        const Four q2 = w02 * r0 + w12 * r1 + w22 * r2;
        // 6. Compute the squared Mahalanobis distance and the Cauchy weight.
        const Four distance2 = r0 * q0 + r1 * q1 + r2 * q2;
        const Four weight = one / (one + distance2 * (1.0 / kCauchy2));
        const Four share = real * (kIsLast ? one : weight);
        // 7. Add the information of the point, and from it that of the twist (rho, phi), which moves the point by
        // rho + phi x point.
        const Four f0 = w00 * k0 + w01 * k1 + w02 * has, f1 = w01 * k0 + w11 * k1 + w12 * has;
        const Four f2 = w02 * k0 + w12 * k1 + w22 * has;
        const Four p00 = share * (h0 * h0 * w00), p01 = share * (h0 * h1 * w01), p02 = share * (h0 * f0);
        const Four p11 = share * (h1 * h1 * w11), p12 = share * (h1 * f1);
        const Four p22 = share * (k0 * f0 + k1 * f1 + has * f2);
        const Four n00 = y * p02 - z * p01, n01 = z * p00 - x * p02, n02 = x * p01 - y * p00;
        const Four n10 = y * p12 - z * p11, n11 = z * p01 - x * p12, n12 = x * p11 - y * p01;
        const Four n20 = y * p22 - z * p12, n21 = z * p02 - x * p22, n22 = x * p12 - y * p02;
        P[0] += p00, P[1] += p01, P[2] += p02, P[3] += p11, P[4] += p12, P[5] += p22;
        M[0] += n00, M[1] += n01, M[2] += n02, M[3] += n10, M[4] += n11, M[5] += n12;
        M[6] += n20, M[7] += n21, M[8] += n22;
        D[0] += y * n20 - z * n10, D[1] += y * n21 - z * n11, D[2] += y * n22 - z * n12;
        D[3] += z * n01 - x * n21, D[4] += z * n02 - x * n22, D[5] += x * n12 - y * n02;
        if (kIsLast) {
            const Four count = real * (all(2.0) + has), weighted2 = weight * weight * distance2;
            squares += real * weighted2;
            slopes += count * weight - real * (all(2.0 / kCauchy2) * weighted2);
            residuals += count;
            errors += real * (r0 * r0 + r1 * r1);
        } else {
            const Four b0 = share * (h0 * q0), b1 = share * (h1 * q1);
            const Four b2 = share * (k0 * q0 + k1 * q1 + has * q2);
            b[0] += b0, b[1] += b1, b[2] += b2;
            b[3] += y * b2 - z * b1, b[4] += z * b0 - x * b2, b[5] += x * b1 - y * b0;
        }
    }
    for (int i = 0; i < 6; ++i) sums.P[i] = total(P[i]), sums.D[i] = total(D[i]), sums.b[i] = total(b[i]);
    for (int i = 0; i < 9; ++i) sums.M[i] = total(M[i]);
    sums.weight2_distance2 = total(squares);
    sums.slope = total(slopes);
    sums.residuals = total(residuals);
    sums.error2 = total(errors);
}

}  // namespace rse_pf_depth_detail
