// Iterative closest point, point to point, on plain arrays: the core that C++ and Lua share.
#ifndef ICP_HPP
#define ICP_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace icp {

using Motion = std::array<double, 16>;  // row-major, 4 x 4

inline Motion identity() { return {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}; }

inline Motion product(const Motion &a, const Motion &b) {
  Motion out{};
  for (int row = 0; row < 4; ++row)
    for (int column = 0; column < 4; ++column)
      for (int k = 0; k < 4; ++k) out[4 * row + column] += a[4 * row + k] * b[4 * k + column];
  return out;
}

inline std::vector<double> moved(const double *points, std::size_t n, const Motion &T) {
  std::vector<double> out(3 * n);
  for (std::size_t i = 0; i < n; ++i)
    for (int row = 0; row < 3; ++row)
      out[3 * i + row] = T[4 * row] * points[3 * i] + T[4 * row + 1] * points[3 * i + 1] +
                         T[4 * row + 2] * points[3 * i + 2] + T[4 * row + 3];
  return out;
}

inline double squared_distance(const double *a, const double *b) {
  double dx = a[0] - b[0], dy = a[1] - b[1], dz = a[2] - b[2];
  return dx * dx + dy * dy + dz * dz;
}

// For each point the closest of `among`, copied.
inline std::vector<double> closest(const std::vector<double> &points, const double *among, std::size_t m) {
  std::vector<double> out(points.size());
  for (std::size_t i = 0; i < points.size(); i += 3) {
    std::size_t best = 0;
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t j = 0; j < m; ++j) {
      double distance = squared_distance(&points[i], among + 3 * j);
      if (distance < least) least = distance, best = j;
    }
    std::copy(among + 3 * best, among + 3 * best + 3, out.begin() + i);
  }
  return out;
}

// The eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Jacobi rotations).
inline std::array<double, 4> largest_eigenvector(std::array<std::array<double, 4>, 4> A) {
  std::array<std::array<double, 4>, 4> V{};
  for (int i = 0; i < 4; ++i) V[i][i] = 1;
  for (int sweep = 0; sweep < 60; ++sweep) {
    double off = 0, scale = 0;
    for (int p = 0; p < 4; ++p)
      for (int q = 0; q < 4; ++q) (p == q ? scale : off) += A[p][q] * A[p][q];
    if (off <= 1e-30 * (scale + off)) break;
    for (int p = 0; p < 3; ++p)
      for (int q = p + 1; q < 4; ++q) {
        if (A[p][q] == 0) continue;
        double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
        double t = (theta >= 0 ? 1 : -1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < 4; ++k) {
          double kp = A[k][p], kq = A[k][q];
          A[k][p] = c * kp - s * kq, A[k][q] = s * kp + c * kq;
        }
        for (int k = 0; k < 4; ++k) {
          double pk = A[p][k], qk = A[q][k];
          A[p][k] = c * pk - s * qk, A[q][k] = s * pk + c * qk;
          double vp = V[k][p], vq = V[k][q];
          V[k][p] = c * vp - s * vq, V[k][q] = s * vp + c * vq;
        }
      }
  }
  int best = 0;
  for (int i = 1; i < 4; ++i)
    if (A[i][i] > A[best][best]) best = i;
  return {V[0][best], V[1][best], V[2][best], V[3][best]};
}

// The motion that takes `source` to `target` with least squares (Horn 1987).
inline Motion motion(const std::vector<double> &source, const std::vector<double> &target) {
  std::size_t n = source.size() / 3;
  double from[3] = {}, to[3] = {}, S[3][3] = {};
  for (std::size_t i = 0; i < source.size(); ++i) from[i % 3] += source[i] / n, to[i % 3] += target[i] / n;
  for (std::size_t i = 0; i < n; ++i)
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) S[a][b] += (source[3 * i + a] - from[a]) * (target[3 * i + b] - to[b]);
  double trace = S[0][0] + S[1][1] + S[2][2];
  std::array<std::array<double, 4>, 4> N{};
  N[0] = {trace, S[1][2] - S[2][1], S[2][0] - S[0][2], S[0][1] - S[1][0]};
  for (int a = 0; a < 3; ++a) {
    N[a + 1][0] = N[0][a + 1];
    for (int b = 0; b < 3; ++b) N[a + 1][b + 1] = S[a][b] + S[b][a] - (a == b ? trace : 0);
  }
  auto [w, x, y, z] = largest_eigenvector(N);
  Motion T = {w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y), 0,
              2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x), 0,
              2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z, 0,
              0, 0, 0, 1};
  for (int row = 0; row < 3; ++row)
    T[4 * row + 3] = to[row] - T[4 * row] * from[0] - T[4 * row + 1] * from[1] - T[4 * row + 2] * from[2];
  return T;
}

// Align n source points to m target points; return what is left of the distance (root mean square).
inline double align(const double *source, std::size_t n, const double *target, std::size_t m, int iterations,
                    Motion &T) {
  T = identity();
  for (int i = 0; i < std::min(std::max(iterations, 1), 100); ++i) {
    std::vector<double> points = moved(source, n, T);
    T = product(motion(points, closest(points, target, m)), T);
  }
  std::vector<double> points = moved(source, n, T), matches = closest(points, target, m);
  double sum = 0;
  for (std::size_t i = 0; i < n; ++i) sum += squared_distance(&points[3 * i], &matches[3 * i]);
  return std::sqrt(sum / n);
}

}  // namespace icp

#endif
