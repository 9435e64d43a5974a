// The compiled core of pnp-lua: RANSAC over 6-point DLT samples with a fixed seed, then Gauss-Newton.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

namespace {

constexpr int kIterations = 500, kSample = 6, kRefinements = 20;
constexpr double kInlierPx = 3.0;
struct Pose {
  double R[3][3], t[3];
};
struct Problem {
  const double *points, *pixels;
  int n;
  double fx, fy, cx, cy;
};

// Solve A x = b for N unknowns with pivots; false if A does not fix x.
template <std::size_t N>
bool solve(std::array<std::array<double, N>, N> A, std::array<double, N> b, std::array<double, N> &x) {
  double scale = 0;
  for (auto &row : A)
    for (double v : row) scale = std::max(scale, std::abs(v));
  for (std::size_t c = 0; c < N; ++c) {
    std::size_t p = c;
    for (std::size_t r = c + 1; r < N; ++r)
      if (std::abs(A[r][c]) > std::abs(A[p][c])) p = r;
    if (!(std::abs(A[p][c]) > 1e-13 * scale)) return false;
    std::swap(A[p], A[c]), std::swap(b[p], b[c]);
    for (std::size_t r = c + 1; r < N; ++r) {
      double f = A[r][c] / A[c][c];
      for (std::size_t k = c; k < N; ++k) A[r][k] -= f * A[c][k];
      b[r] -= f * b[c];
    }
  }
  for (std::size_t c = N; c-- > 0;) {
    x[c] = b[c];
    for (std::size_t k = c + 1; k < N; ++k) x[c] -= A[c][k] * x[k];
    x[c] /= A[c][c];
  }
  return true;
}

double determinant(const double R[3][3]) {
  return R[0][0] * (R[1][1] * R[2][2] - R[1][2] * R[2][1]) - R[0][1] * (R[1][0] * R[2][2] - R[1][2] * R[2][0]) +
         R[0][2] * (R[1][0] * R[2][1] - R[1][1] * R[2][0]);
}

// The closest rotation, by Newton's iteration for the polar decomposition; R has a positive determinant.
bool nearest_rotation(double R[3][3]) {
  for (int i = 0; i < 50; ++i) {
    double d = determinant(R), next[3][3];
    if (!(std::abs(d) > 1e-12)) return false;
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) {
        int a = (r + 1) % 3, b = (r + 2) % 3, e = (c + 1) % 3, f = (c + 2) % 3;
        next[r][c] = 0.5 * (R[r][c] + (R[a][e] * R[b][f] - R[a][f] * R[b][e]) / d);
      }
    std::copy(&next[0][0], &next[0][0] + 9, &R[0][0]);
  }
  return true;
}

// The least eigenvector of M by inverse iteration: what a DLT sample fixes.
bool least(std::array<std::array<double, 12>, 12> M, std::array<double, 12> &v) {
  double trace = 0;
  for (int i = 0; i < 12; ++i) trace += M[i][i];
  for (int i = 0; i < 12; ++i) M[i][i] += 1e-12 * trace, v[i] = 1.0 + 0.1 * i;
  for (int turn = 0; turn < 6; ++turn) {
    std::array<double, 12> x;
    if (!solve<12>(M, v, x)) return false;
    double norm = 0;
    for (double each : x) norm += each * each;
    for (int i = 0; i < 12; ++i) v[i] = x[i] / std::sqrt(norm);
  }
  return true;
}

bool dlt(const Problem &p, const std::array<int, kSample> &rows, Pose &pose) {
  double mean[3] = {}, spread = 0;
  for (int i : rows)
    for (int a = 0; a < 3; ++a) mean[a] += p.points[3 * i + a] / kSample;
  for (int i : rows)
    for (int a = 0; a < 3; ++a) spread += std::pow(p.points[3 * i + a] - mean[a], 2) / kSample;
  spread = std::sqrt(spread);
  if (!(spread > 1e-9)) return false;
  std::array<std::array<double, 12>, 12> M{};
  for (int i : rows) {
    double X[4] = {0, 0, 0, 1}, uv[2] = {(p.pixels[2 * i] - p.cx) / p.fx, (p.pixels[2 * i + 1] - p.cy) / p.fy};
    for (int a = 0; a < 3; ++a) X[a] = (p.points[3 * i + a] - mean[a]) / spread;
    for (int k = 0; k < 2; ++k) {
      double row[12] = {};
      for (int a = 0; a < 4; ++a) row[4 * k + a] = X[a], row[8 + a] = -uv[k] * X[a];
      for (int a = 0; a < 12; ++a)
        for (int b = 0; b < 12; ++b) M[a][b] += row[a] * row[b];
    }
  }
  std::array<double, 12> v;
  if (!least(M, v)) return false;
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) pose.R[r][c] = v[4 * r + c];
  double d = determinant(pose.R), size = std::cbrt(d);  // of the sign that makes it a rotation
  if (!(std::abs(size) > 1e-6)) return false;
  for (auto &row : pose.R)
    for (double &each : row) each /= size;
  if (!nearest_rotation(pose.R)) return false;
  for (int r = 0; r < 3; ++r) {
    pose.t[r] = v[4 * r + 3] / size * spread;
    for (int c = 0; c < 3; ++c) pose.t[r] -= pose.R[r][c] * mean[c];
  }
  return true;
}

// Error of one match in pixels, and the point in the camera's frame; false behind the camera.
bool residual(const Problem &p, const Pose &pose, int i, double e[2], double X[3]) {
  for (int r = 0; r < 3; ++r) {
    X[r] = pose.t[r];
    for (int c = 0; c < 3; ++c) X[r] += pose.R[r][c] * p.points[3 * i + c];
  }
  if (!(X[2] > 1e-6)) return false;
  e[0] = p.fx * X[0] / X[2] + p.cx - p.pixels[2 * i];
  e[1] = p.fy * X[1] / X[2] + p.cy - p.pixels[2 * i + 1];
  return true;
}

std::vector<int> agreeing(const Problem &p, const Pose &pose) {
  std::vector<int> found;
  double e[2], X[3];
  for (int i = 0; i < p.n; ++i)
    if (residual(p, pose, i, e, X) && e[0] * e[0] + e[1] * e[1] < kInlierPx * kInlierPx) found.push_back(i);
  return found;
}

// Turn and move the pose on the left by a twist (metres, then radians).
void apply(Pose &pose, const std::array<double, 6> &d) {
  double angle = std::sqrt(d[3] * d[3] + d[4] * d[4] + d[5] * d[5]), D[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  if (angle > 0) {
    double k[3] = {d[3] / angle, d[4] / angle, d[5] / angle}, s = std::sin(angle), c = 1 - std::cos(angle);
    double K[3][3] = {{0, -k[2], k[1]}, {k[2], 0, -k[0]}, {-k[1], k[0], 0}};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) D[i][j] += s * K[i][j] + c * (k[i] * k[j] - (i == j));
  }
  Pose old = pose;
  for (int i = 0; i < 3; ++i) {
    pose.t[i] = d[i];
    for (int j = 0; j < 3; ++j) {
      pose.t[i] += D[i][j] * old.t[j];
      pose.R[i][j] = 0;
      for (int k = 0; k < 3; ++k) pose.R[i][j] += D[i][k] * old.R[k][j];
    }
  }
}

void refine(const Problem &p, const std::vector<int> &rows, Pose &pose) {
  for (int turn = 0; turn < kRefinements; ++turn) {
    std::array<std::array<double, 6>, 6> H{};
    std::array<double, 6> g{}, d{};
    double e[2], X[3];
    for (int i : rows) {
      if (!residual(p, pose, i, e, X)) continue;
      double z = 1 / X[2], a[2][3] = {{p.fx * z, 0, -p.fx * X[0] * z * z}, {0, p.fy * z, -p.fy * X[1] * z * z}};
      for (int k = 0; k < 2; ++k) {
        double *v = a[k], J[6] = {v[0], v[1], v[2], X[1] * v[2] - X[2] * v[1], X[2] * v[0] - X[0] * v[2],
                                  X[0] * v[1] - X[1] * v[0]};
        for (int r = 0; r < 6; ++r) {
          g[r] -= J[r] * e[k];
          for (int c = 0; c < 6; ++c) H[r][c] += J[r] * J[c];
        }
      }
    }
    if (!solve<6>(H, g, d)) return;
    apply(pose, d);
  }
}

}  // namespace

// Return how many matches agree with the pose, fewer than 6 if there is none.
extern "C" __attribute__((visibility("default"))) int pnp_solve(const double *points_world, const double *pixels,
                                                                int n, const double *camera,
                                                                double *T_camera_world, double *rmse_px) {
  Problem p{points_world, pixels, n, camera[0], camera[1], camera[2], camera[3]};
  std::mt19937 random(1);
  std::vector<int> best;
  Pose found{};
  for (int turn = 0; turn < kIterations; ++turn) {
    std::array<int, kSample> rows;
    for (int k = 0; k < kSample;) {
      rows[k] = static_cast<int>(random() % static_cast<std::uint32_t>(n));
      if (std::find(rows.begin(), rows.begin() + k, rows[k]) == rows.begin() + k) ++k;
    }
    Pose pose;
    if (!dlt(p, rows, pose)) continue;
    std::vector<int> inliers = agreeing(p, pose);
    if (inliers.size() > best.size()) best = inliers, found = pose;
  }
  for (int turn = 0; turn < 5 && best.size() >= 6; ++turn) {
    refine(p, best, found);
    best = agreeing(p, found);
  }
  if (best.size() < 6) return 0;
  double sum = 0, e[2], X[3];
  for (int i : best)
    if (residual(p, found, i, e, X)) sum += e[0] * e[0] + e[1] * e[1];
  *rmse_px = std::sqrt(sum / best.size());
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 4; ++c)
      T_camera_world[4 * r + c] = r == 3 ? c == 3 : c == 3 ? found.t[r] : found.R[r][c];
  return static_cast<int>(best.size());
}
