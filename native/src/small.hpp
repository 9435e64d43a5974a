// Vectors of three numbers, camera poses, and normal equations of six unknowns.
#pragma once

#include "elementary.hpp"

namespace RSE_PF_ISA {

struct Vector3 {
    double x, y, z;
};
RSE_PF_INLINE Vector3 operator+(const Vector3& a, const Vector3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
RSE_PF_INLINE Vector3 operator-(const Vector3& a, const Vector3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
RSE_PF_INLINE Vector3 operator*(const Vector3& a, double s) { return {a.x * s, a.y * s, a.z * s}; }
RSE_PF_INLINE double dot(const Vector3& a, const Vector3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
RSE_PF_INLINE Vector3 cross(const Vector3& a, const Vector3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
RSE_PF_INLINE Vector3 normalise(const Vector3& a) { return a * (1.0 / square_root(dot(a, a))); }

// T_camera_world: a point p of the world has the camera coordinates R p + t (metres).
struct Pose {
    double R[3][3];
    Vector3 t;
};

RSE_PF_INLINE Vector3 rotate(const double (&R)[3][3], const Vector3& p) {
    return {R[0][0] * p.x + R[0][1] * p.y + R[0][2] * p.z, R[1][0] * p.x + R[1][1] * p.y + R[1][2] * p.z,
            R[2][0] * p.x + R[2][1] * p.y + R[2][2] * p.z};
}

RSE_PF_INLINE bool is_finite(const Pose& pose) {
    double total = pose.t.x + pose.t.y + pose.t.z;
    for (const auto& row : pose.R) total += row[0] + row[1] + row[2];
    return total - total == 0.0;
}

// Return the product (rotation, translation) * pose: a rigid motion in the camera frame, after the pose.
static inline Pose compose(const double (&rotation)[3][3], const Vector3& translation, const Pose& pose) {
    Pose product;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            product.R[i][j] =
                rotation[i][0] * pose.R[0][j] + rotation[i][1] * pose.R[1][j] + rotation[i][2] * pose.R[2][j];
    product.t = rotate(rotation, pose.t) + translation;
    return product;
}

// Return the pose after a small twist (rho metres, phi radians) on its left.  The rotation is Cayley's map, a rational
// function that agrees with the exponential map to second order, so an iteration has the same fixed point with both.
static inline Pose apply_twist_by_cayley(const double (&twist)[6], const Pose& pose) {
    const double a = 0.5 * twist[3], b = 0.5 * twist[4], c = 0.5 * twist[5];
    const double s = 2.0 / (1.0 + a * a + b * b + c * c);
    const double rotation[3][3] = {
        {1.0 - s * (b * b + c * c), s * (a * b - c), s * (a * c + b)},
        {s * (a * b + c), 1.0 - s * (a * a + c * c), s * (b * c - a)},
        {s * (a * c - b), s * (b * c + a), 1.0 - s * (a * a + b * b)},
    };
    return compose(rotation, {twist[0], twist[1], twist[2]}, pose);
}

// Return exp(twist) * pose for a twist (rho metres, phi radians) of any length, by scaling and squaring.
// Source: Moler and Van Loan, Nineteen Dubious Ways, SIAM Review 2003, method 3.
static inline Pose apply_twist(const double (&twist)[6], const Pose& pose) {
    // 1. Halve the twist until its angle is at most 1/4 rad.
    Vector3 rho = {twist[0], twist[1], twist[2]}, phi = {twist[3], twist[4], twist[5]};
    int doublings = 0;
    for (; dot(phi, phi) > 0.0625 && doublings < 12; ++doublings) {
        rho = rho * 0.5;
        phi = phi * 0.5;
    }
    // 2. Compute its exponential from the Taylor series of sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3 with
    // x^2 = q; Barfoot, State Estimation for Robotics (2017), eqs. 7.16 and 7.34.
    const double q = dot(phi, phi);
    const double a = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (1.0 - q / 110.0))));
    const double b = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0))));
    const double c = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * (1.0 - q / 110.0)))) / 6.0;
    const double x = phi.x, y = phi.y, z = phi.z;
    Pose step = {{{1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y},
                  {b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x},
                  {b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)}},
                 rho + cross(phi, rho) * b + cross(phi, cross(phi, rho)) * c};
    // 3. Square the exponential as often as the twist was halved.
    for (; doublings > 0; --doublings) step = compose(step.R, step.t, Pose(step));
    return compose(step.R, step.t, pose);
}

// The normal equations A x = b of a left perturbation x = (rho, phi) of a pose (m, rad): A = J^T W J and b = J^T W r,
// where r is measured minus predicted, and J the Jacobian of the prediction.  Only the upper triangle of A is filled.
struct Normal {
    double A[6][6];
    double b[6];
};

// Solve (A + damping diag(A)) x = b by Cholesky decomposition.  Return false, with an x that is not valid, where the
// matrix is not positive definite.
static bool solve_normal_equations(const Normal& normal, double damping, double (&x)[6]) {
    // 1. Decompose the matrix into L L^T.
    double L[6][6], inverse[6];
    for (int i = 0; i < 6; ++i) {
        double pivot = normal.A[i][i] * (1.0 + damping);
        for (int k = 0; k < i; ++k) pivot -= L[i][k] * L[i][k];
        if (!(pivot > 1e-14 * normal.A[i][i])) return false;
        inverse[i] = 1.0 / square_root(pivot);
        for (int j = i + 1; j < 6; ++j) {
            double value = normal.A[i][j];
            for (int k = 0; k < i; ++k) value -= L[i][k] * L[j][k];
            L[j][i] = value * inverse[i];
        }
    }
    // 2. Solve L y = b, then L^T x = y.
    for (int i = 0; i < 6; ++i) {
        double value = normal.b[i];
        for (int k = 0; k < i; ++k) value -= L[i][k] * x[k];
        x[i] = value * inverse[i];
    }
    for (int i = 5; i >= 0; --i) {
        double value = x[i];
        for (int k = i + 1; k < 6; ++k) value -= L[k][i] * x[k];
        x[i] = value * inverse[i];
    }
    return true;
}

// Write the eigenvalues of a symmetric 3x3 matrix in ascending order, and its unit eigenvectors as rows of `axes`.
// Cyclic Jacobi method; Golub and Van Loan, Matrix Computations, Sect. 8.5.
static void compute_eigenvectors(const double (&matrix)[3][3], double (&values)[3], double (&axes)[3][3]) {
    double a[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            a[i][j] = matrix[i][j];
            axes[i][j] = i == j ? 1.0 : 0.0;
        }
    for (int sweep = 0; sweep < 12; ++sweep) {
        const double off_diagonal = absolute(a[0][1]) + absolute(a[0][2]) + absolute(a[1][2]);
        if (!(off_diagonal > 1e-17 * (absolute(a[0][0]) + absolute(a[1][1]) + absolute(a[2][2])))) break;
        for (int p = 0; p < 2; ++p)
            for (int q = p + 1; q < 3; ++q) {
                if (a[p][q] == 0.0) continue;
                const double theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                const double sign = theta < 0.0 ? -1.0 : 1.0;
                const double tangent = sign / (absolute(theta) + square_root(theta * theta + 1.0));
                const double cosine = 1.0 / square_root(tangent * tangent + 1.0), sine = tangent * cosine;
                for (int k = 0; k < 3; ++k) {
                    const double kp = a[k][p], kq = a[k][q];
                    a[k][p] = cosine * kp - sine * kq;
                    a[k][q] = sine * kp + cosine * kq;
                }
                for (int k = 0; k < 3; ++k) {
                    const double pk = a[p][k], qk = a[q][k];
                    a[p][k] = cosine * pk - sine * qk;
                    a[q][k] = sine * pk + cosine * qk;
                }
                for (int k = 0; k < 3; ++k) {
                    const double pk = axes[p][k], qk = axes[q][k];
                    axes[p][k] = cosine * pk - sine * qk;
                    axes[q][k] = sine * pk + cosine * qk;
                }
            }
    }
    // Sort by bubble sort: two passes suffice for three values.
    for (int i = 0; i < 3; ++i) values[i] = a[i][i];
    for (int pass = 0; pass < 2; ++pass)
        for (int i = 0; i < 2; ++i)
            if (values[i + 1] < values[i]) {
                const double value = values[i];
                values[i] = values[i + 1];
                values[i + 1] = value;
                for (int k = 0; k < 3; ++k) {
                    const double axis = axes[i][k];
                    axes[i][k] = axes[i + 1][k];
                    axes[i + 1][k] = axis;
                }
            }
}

}  // namespace RSE_PF_ISA
