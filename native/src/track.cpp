// The tracker's inner loops: distinctiveness of features, projection matching of landmarks, and a robust pose fit that
// weighs the noise of pixels, depths and landmarks.  rse_pf/slam/tracking.py calls them.
#include "rse_pf_track.h"

#include <cstring>

#define RSE_PF_ISA rse_pf_track_detail
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#include "small.hpp"
#pragma GCC diagnostic pop

namespace {

using namespace rse_pf_track_detail;

// Most features, landmarks or measurements of a request: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Bytes of a descriptor.
constexpr int64_t kBytes = 32;
// Bits of a descriptor, and the distance of a feature that is compared with no other feature.
constexpr int64_t kBits = 256;
// Cells of the search grid along a side: 128 cells of 16 px cover 2048 px, and what lies beyond falls into the last
// cell.
constexpr int64_t kCells = 128;
// Side of a cell of the search grid (px): a search looks at a few cells.
constexpr double kCellPx = 16.0;
// Value of a candidate or a row number that means "none"; it is larger than all candidates.
constexpr uint64_t kNone = ~uint64_t{0};
// Most Gauss-Newton iterations of a pose fit: a bound for measurements on which the fit does not converge.
constexpr int kMaxIterations = 10;
// First iteration of a pose fit that leaves outliers out: before, the pose may be so far off that inliers look like
// outliers.
constexpr int kFirstGatedIteration = 3;
// A pose fit has converged when every component (m, rad) of a Gauss-Newton step without outliers is smaller than this.
constexpr double kConvergedStep = 1e-6;
// Smallest depth of an inlier (m); smaller depths are replaced by it, so that no division overflows.
constexpr double kMinDepthM = 0.05;
// Largest number of a valid request (m or px): a limit of plausible requests.
constexpr double kMaxAbs = 1e9;
// Largest component (m, rad) of a Gauss-Newton step: a larger step shows that the pose fit diverges, and ends it
// without a pose.
constexpr double kMaxTwist = 1e6;
// Largest squared Mahalanobis distance of a measurement that is used: larger ones come from a singular covariance, and
// the measurement is left out.
constexpr double kMaxDistance2 = 1e300;
// Smallest eigenvalue of the information matrix, scaled to a diagonal of 1, at which all motions are constrained:
// points on a line have 1e-14 and less, a marker of 20 px without depths has 1e-9.
constexpr double kMinEigenvalue = 1e-12;
// Inverse iterations by which the smallest eigenvalue of the information matrix is estimated.
constexpr int kInverseIterations = 6;
// Pixels that are added to a search radius when the cells of the grid are chosen, so that the rounding of the sum of
// pixel and radius leaves out no cell.
constexpr double kSlackPx = 1.0;
// Smallest divisor of a quotient of lengths, which avoids a division by 0.
constexpr double kMinLength = 1e-9;
// Smallest share of the information about the scalar of rse_pf_fit_sway that may remain after the camera motion is
// eliminated: with less, the camera motion explains the same residuals.
constexpr double kMinRemainingShare = 1e-9;

bool is_within(double value, double low, double high) { return value >= low && value <= high; }

uint64_t read_word(const uint8_t* at) {
    uint64_t value;
    std::memcpy(&value, at, sizeof value);
    return value;
}

uint64_t count_bits(uint64_t word) { return static_cast<uint64_t>(__builtin_popcountll(word)); }

int32_t hamming_distance(const uint8_t* a, const uint8_t* b) {
    uint64_t sum = 0;
    for (int64_t k = 0; k < kBytes; k += 8) sum += count_bits(read_word(a + k) ^ read_word(b + k));
    return static_cast<int32_t>(sum);
}

// Return the cell of a pixel coordinate along one axis; coordinates outside of the grid fall into the first or last
// cell.
int64_t cell_of(double px) {
    const double cell = px / kCellPx;
    return cell >= 0.0 ? (cell < static_cast<double>(kCells) ? static_cast<int64_t>(cell) : kCells - 1) : 0;
}

// A feature of the image, stored next to the others of its cell: pixel (x, y), scale, cosine and sine of its
// orientation, descriptor, and its row in the arrays of the request.
struct GridFeature {
    double x, y, size, direction[2];
    uint64_t descriptor[4];
    int64_t row;
};

// The features of the image by cell: those of cell c are features[starts[c]] to features[starts[c + 1] - 1].
struct Grid {
    const uint64_t* starts;  // kCells * kCells + 1 numbers
    const GridFeature* features;
};

// Sort the features of the image by cell with a counting sort; within a cell they stay in the order of their rows.
// The grid that is returned lies in the memory of the caller: `starts` for kCells * kCells + 2 numbers, `features` for
// one element for each feature.
Grid build_grid(const rse_pf_near_request& request, uint64_t* starts, GridFeature* features) {
    std::memset(starts, 0, static_cast<size_t>(kCells * kCells + 2) * sizeof *starts);
    const auto cell = [&](int64_t row) {
        return cell_of(request.pixels[2 * row + 1]) * kCells + cell_of(request.pixels[2 * row]);
    };
    for (int64_t row = 0; row < request.rows; ++row) ++starts[cell(row) + 2];
    for (int64_t i = 0; i < kCells * kCells; ++i) starts[i + 2] += starts[i + 1];
    for (int64_t row = 0; row < request.rows; ++row) {
        GridFeature& feature = features[starts[cell(row) + 1]++];
        feature = {request.pixels[2 * row], request.pixels[2 * row + 1], request.sizes[row],
                   {request.directions[2 * row], request.directions[2 * row + 1]}, {}, row};
        std::memcpy(feature.descriptor, request.descriptors + kBytes * row, sizeof feature.descriptor);
    }
    return {starts, features};
}

// The two nearest features by Hamming distance, as 64-bit candidates: distance (bits) in the upper half, row of the
// feature in the lower half; kNone where there is no such feature.
struct TwoNearest {
    uint64_t first = kNone, second = kNone;
};

// Return the two features whose descriptors are nearest to that of the predicted feature of row `predicted`, among
// those within radius_px of its pixel whose size and orientation match.  A predicted pixel that is not a number has
// none.  `candidates` is scratch memory for one number for each feature of the image.
TwoNearest find_two_nearest(const rse_pf_near_request& request, const Grid& grid, int64_t predicted,
                            uint64_t* candidates) {
    TwoNearest two;
    const double x = request.predicted_pixels[2 * predicted], y = request.predicted_pixels[2 * predicted + 1];
    if (!(is_within(x, -kMaxAbs, kMaxAbs) && is_within(y, -kMaxAbs, kMaxAbs))) return two;
    const double reach = request.radius_px + kSlackPx, radius2 = request.radius_px * request.radius_px;
    const double size = request.predicted_sizes[predicted];
    const double* const direction = request.predicted_directions + 2 * predicted;
    uint64_t descriptor[4];
    std::memcpy(descriptor, request.predicted_descriptors + kBytes * predicted, sizeof descriptor);
    // 1. List the features of the cells within reach that pass the tests of radius, size and orientation.
    uint64_t count = 0;
    const int64_t left = cell_of(x - reach), right = cell_of(x + reach), bottom = cell_of(y + reach);
    for (int64_t line = cell_of(y - reach); line <= bottom; ++line) {
        const uint64_t end = grid.starts[line * kCells + right + 1];
        for (uint64_t at = grid.starts[line * kCells + left]; at < end; ++at) {
            // No branches: half of these features lie within the radius, which no processor predicts.
            const GridFeature& feature = grid.features[at];
            const double u = feature.x - x, v = feature.y - y;
            const double cosine = feature.direction[0] * direction[0] + feature.direction[1] * direction[1];
            candidates[count] = at;
            count += static_cast<uint64_t>(static_cast<int>(u * u + v * v <= radius2) &
                                           static_cast<int>(feature.size <= request.max_size_ratio * size) &
                                           static_cast<int>(size <= request.max_size_ratio * feature.size) &
                                           static_cast<int>(cosine >= request.min_cosine));
        }
    }
    // 2. Compare the descriptors of the listed features with that of the predicted feature, and keep the two nearest.
    for (uint64_t i = 0; i < count; ++i) {
        const GridFeature& feature = grid.features[candidates[i]];
        uint64_t distance = 0;
        for (int k = 0; k < 4; ++k) distance += count_bits(feature.descriptor[k] ^ descriptor[k]);
        const uint64_t candidate = distance << 32 | static_cast<uint64_t>(feature.row);
        const uint64_t larger = candidate < two.first ? two.first : candidate;
        two.first = candidate < two.first ? candidate : two.first;
        two.second = larger < two.second ? larger : two.second;
    }
    return two;
}

// Return whether the nearest feature is near enough, distinctive in its image, and clearly nearer than the second one.
// Where there is no second one, the last test is left out; without a nearest feature, return false.
bool is_match(const rse_pf_near_request& request, const TwoNearest& two) {
    if (two.first == kNone) return false;
    const auto distance = static_cast<double>(two.first >> 32);
    const int64_t row = static_cast<int64_t>(two.first & 0xffffffffu);
    return distance <= static_cast<double>(request.max_distance) &&
           distance < request.distinct_ratio * static_cast<double>(request.distinct[row]) &&
           (two.second == kNone || distance < request.ratio * static_cast<double>(two.second >> 32));
}

// A measurement (pixel u, v and depth z) linearised at a pose.  The Jacobians are those of the predicted measurement,
// and the residual is measured minus predicted: the step is the twist for which by_twist * twist fits r best, weighted
// by W.
struct Linearised {
    double by_point[3][3];  // Jacobian of (u, v, z) by the point in the camera frame
    double by_twist[3][6];  // Jacobian of (u, v, z) by the twist (rho, phi) left of the pose
    double W[3][3];         // inverse covariance of the residual
    double r[3], q[3];      // residual r (px, px, m), and q = W r
    double distance2;       // squared Mahalanobis distance r^T W r
    bool is_distance;       // whether distance2 is valid: a singular covariance gives nan or a negative number
    bool is_in_front;       // whether the point lies more than kMinDepthM in front of the camera
};

// Return measurement i of the request, linearised at `pose` (T_camera_world).
Linearised linearise(const rse_pf_fit_request& request, const Pose& pose, int64_t i) {
    Linearised row;
    // 1. Transform the point into the camera frame, and compute the residual; a missing depth has a residual of 0.
    const double* const X = request.points + 3 * i;
    const double* const S = request.point_covariances + 6 * i;
    const Vector3 p = rotate(pose.R, {X[0], X[1], X[2]}) + pose.t;
    const double z = p.z > kMinDepthM ? p.z : kMinDepthM, depth = request.depths_m[i];
    const double has = depth > 0.0 ? 1.0 : 0.0;
    const double a = p.x / z, c = p.y / z, h0 = request.fx / z, h1 = request.fy / z;
    const double r[3] = {request.pixels[2 * i] - (request.fx * a + request.cx),
                         request.pixels[2 * i + 1] - (request.fy * c + request.cy), has * (depth - z)};
    // 2. Compute the Jacobian of the predicted (u, v, z) by the point in the camera frame (J), and by the point in the
    // world frame (A).
    const double J[3][3] = {{h0, 0.0, -(h0 * a)}, {0.0, h1, -(h1 * c)}, {0.0, 0.0, has}};
    double A[3][3], AS[3][3], V[3][3];
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k)
            A[j][k] = J[j][0] * pose.R[0][k] + J[j][1] * pose.R[1][k] + J[j][2] * pose.R[2][k];
    // 3. Compute the covariance of the residual: V = A C A^T, where C is the covariance of the landmark, plus the
    // variances of pixel and depth; a missing depth gets the variance 1.
    const double C[3][3] = {{S[0], S[1], S[2]}, {S[1], S[3], S[4]}, {S[2], S[4], S[5]}};
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) AS[j][k] = A[j][0] * C[0][k] + A[j][1] * C[1][k] + A[j][2] * C[2][k];
    for (int j = 0; j < 3; ++j)
        for (int k = j; k < 3; ++k) V[j][k] = AS[j][0] * A[k][0] + AS[j][1] * A[k][1] + AS[j][2] * A[k][2];
    const double pixel2 = request.pixel_sigmas_px[i] * request.pixel_sigmas_px[i];
    V[0][0] += pixel2;
    V[1][1] += pixel2;
    V[2][2] = has > 0.0 ? V[2][2] + request.depth_sigmas_m[i] * request.depth_sigmas_m[i] : 1.0;
    // 4. Invert V to W by its adjugate, and compute the Mahalanobis distance.
    const double m00 = V[1][1] * V[2][2] - V[1][2] * V[1][2], m01 = V[0][2] * V[1][2] - V[0][1] * V[2][2];
    const double m02 = V[0][1] * V[1][2] - V[0][2] * V[1][1];
    const double scale = 1.0 / (V[0][0] * m00 + V[0][1] * m01 + V[0][2] * m02);
    const double w01 = m01 * scale, w02 = m02 * scale, w12 = (V[0][1] * V[0][2] - V[0][0] * V[1][2]) * scale;
    const double W[3][3] = {{m00 * scale, w01, w02},
                            {w01, (V[0][0] * V[2][2] - V[0][2] * V[0][2]) * scale, w12},
                            {w02, w12, (V[0][0] * V[1][1] - V[0][1] * V[0][1]) * scale}};
    for (int j = 0; j < 3; ++j) row.q[j] = W[j][0] * r[0] + W[j][1] * r[1] + W[j][2] * r[2];
    row.distance2 = r[0] * row.q[0] + r[1] * row.q[1] + r[2] * row.q[2];
    row.is_distance = is_within(row.distance2, 0.0, kMaxDistance2);
    row.is_in_front = p.z > kMinDepthM;
    // 5. Compute the Jacobian by the twist, which moves the point in the camera frame by rho + phi x point.
    for (int j = 0; j < 3; ++j) {
        row.by_twist[j][0] = J[j][0];
        row.by_twist[j][1] = J[j][1];
        row.by_twist[j][2] = J[j][2];
        row.by_twist[j][3] = J[j][2] * p.y - J[j][1] * z;
        row.by_twist[j][4] = J[j][0] * z - J[j][2] * p.x;
        row.by_twist[j][5] = J[j][1] * p.x - J[j][0] * p.y;
    }
    std::memcpy(row.by_point, J, sizeof J);
    std::memcpy(row.W, W, sizeof W);
    std::memcpy(row.r, r, sizeof r);
    return row;
}

// The normal equations of the measurements that were summed, and the number of inliers among all measurements.
struct Fit {
    Normal normal;
    int64_t inliers;
};

// Add a linearised measurement to the normal equations, times its robust weight.
void add_row(Normal& normal, const Linearised& row, double weight) {
    const auto& W = row.W;
    const auto& q = row.q;
    const auto& B = row.by_twist;
    for (int j = 0; j < 6; ++j) {
        double u[3];
        for (int k = 0; k < 3; ++k) u[k] = weight * (W[k][0] * B[0][j] + W[k][1] * B[1][j] + W[k][2] * B[2][j]);
        for (int k = j; k < 6; ++k) normal.A[j][k] += u[0] * B[0][k] + u[1] * B[1][k] + u[2] * B[2][k];
        normal.b[j] += weight * (B[0][j] * q[0] + B[1][j] * q[1] + B[2][j] * q[2]);
    }
}

// Sum the normal equations of the measurements at a pose: with is_gated those of the inliers only, else of all whose
// covariance can be inverted.  Each has its Cauchy weight, but the weight 1 with is_last, so that the information is
// that of the inliers.  An inlier lies in front of the camera and below gate2.  `is_inlier` is written unless it is
// null.
Fit sum_measurements(const rse_pf_fit_request& request, const Pose& pose, bool is_gated, bool is_last,
                     uint8_t* is_inlier) {
    Fit fit = {};
    for (int64_t i = 0; i < request.rows; ++i) {
        const Linearised row = linearise(request, pose, i);
        const bool is_in = row.is_distance && row.distance2 < request.gate2 && row.is_in_front;
        if (is_inlier != nullptr) is_inlier[i] = is_in ? 1 : 0;
        fit.inliers += is_in ? 1 : 0;
        if (!row.is_distance || (is_gated && !is_in)) continue;
        add_row(fit.normal, row, is_last ? 1.0 : 1.0 / (1.0 + row.distance2 / request.cauchy2));
    }
    return fit;
}

// Return whether some motion of the camera is unconstrained: the smallest eigenvalue of the information matrix, scaled
// to a diagonal of 1, is at most kMinEigenvalue, or the matrix is not positive definite.  Inverse iteration; Golub and
// Van Loan, Matrix Computations, Sect. 8.2.
bool has_free_motion(const Normal& normal) {
    // 1. Scale the matrix to a diagonal of 1, and choose a start vector.
    Normal scaled = {};
    double scales[6];
    for (int i = 0; i < 6; ++i) {
        if (!is_within(normal.A[i][i], 1e-300, 1e300)) return true;
        scales[i] = 1.0 / square_root(normal.A[i][i]);
    }
    for (int i = 0; i < 6; ++i) {
        for (int j = i; j < 6; ++j) scaled.A[i][j] = normal.A[i][j] * scales[i] * scales[j];
        scaled.b[i] = 1.0 / (1.0 + i);
    }
    // 2. Solve A x = b for the present vector b, and take x / |x| as the next b; 1 / |x| converges to the smallest
    // eigenvalue.
    double eigenvalue = 0.0;
    for (int k = 0; k < kInverseIterations; ++k) {
        double x[6], size2 = 0.0;
        if (!solve_normal_equations(scaled, 0.0, x)) return true;
        for (const double number : x) size2 += number * number;
        eigenvalue = 1.0 / square_root(size2);
        for (int i = 0; i < 6; ++i) scaled.b[i] = x[i] * eigenvalue;
    }
    return !(eigenvalue > kMinEigenvalue);
}

Pose read_matrix(const double (&T)[16]) {
    return {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
}

// The features that a pose predicts, in arrays of the caller with room for every landmark that is looked for: two
// pixel coordinates, two orientation coordinates, a scale, 32 bytes, and a row of the request's `numbers` for each.
struct PredictedFeatures {
    int64_t count;
    double *pixels, *directions, *sizes;
    uint8_t* descriptors;
    int64_t* rows;
};

// Append to `out` the predicted features of the landmarks that are farther than min_depth_m in front of the camera,
// project into the image or its margin, and were seen last from a similar direction and distance.
void predict_features(const rse_pf_seek_request& request, const Pose& pose, PredictedFeatures& out) {
    for (int64_t row = 0; row < request.rows; ++row) {
        const int64_t number = request.numbers[row];
        if (number < 0 || number >= request.landmarks) continue;
        // 1. Project the landmark.
        const double* const X = request.points + 3 * number;
        const Vector3 p = rotate(pose.R, {X[0], X[1], X[2]}) + pose.t;
        if (!(p.z > request.min_depth_m)) continue;
        const double u = request.fx * p.x / p.z + request.cx, v = request.fy * p.y / p.z + request.cy;
        if (!(u > -request.margin_px && u < request.width + request.margin_px && v > -request.margin_px &&
              v < request.height + request.margin_px))
            continue;
        // 2. Compare viewing direction and distance of the landmark with those of the image that showed it last.
        const double* const last_ray = request.rays + 3 * number;
        const Vector3 ray = rotate(pose.R, {last_ray[0], last_ray[1], last_ray[2]});
        const double distance = square_root(dot(p, p)), last_distance = square_root(dot(ray, ray));
        const double scale = distance * last_distance, cosine = dot(ray, p) / (scale > kMinLength ? scale : kMinLength);
        if (!(cosine > request.min_cosine && distance < request.max_farther * last_distance &&
              last_distance < request.max_nearer * distance))
            continue;
        // 3. Predict the orientation of the feature, by rotation into this image, and its size, by the ratio of the
        // distances.
        const double* const world = request.directions + 3 * number;
        const Vector3 direction = rotate(pose.R, {world[0], world[1], world[2]});
        const double length = square_root(direction.x * direction.x + direction.y * direction.y);
        const int64_t k = out.count++;
        out.pixels[2 * k] = u;
        out.pixels[2 * k + 1] = v;
        out.directions[2 * k] = direction.x / (length > kMinLength ? length : kMinLength);
        out.directions[2 * k + 1] = direction.y / (length > kMinLength ? length : kMinLength);
        out.sizes[k] = request.sizes[number] * last_distance / (distance > kMinLength ? distance : kMinLength);
        std::memcpy(out.descriptors + kBytes * k, request.descriptors + kBytes * number, kBytes);
        out.rows[k] = row;
    }
}

bool is_valid(const rse_pf_fit_request& request) {
    if (request.abi != RSE_PF_TRACK_ABI || request.rows < 0 || request.rows > kMaxRows || request.points == nullptr ||
        request.point_covariances == nullptr || request.pixels == nullptr || request.pixel_sigmas_px == nullptr ||
        request.depths_m == nullptr || request.depth_sigmas_m == nullptr || !is_within(request.fx, 1e-9, kMaxAbs) ||
        !is_within(request.fy, 1e-9, kMaxAbs) || !is_within(request.cx, -kMaxAbs, kMaxAbs) ||
        !is_within(request.cy, -kMaxAbs, kMaxAbs) || !is_within(request.cauchy2, 1e-9, kMaxAbs) ||
        !is_within(request.gate2, 0.0, kMaxAbs))
        return false;
    for (const double number : request.T_camera_world)
        if (!is_within(number, -kMaxAbs, kMaxAbs)) return false;
    for (int64_t i = 0; i < request.rows; ++i) {
        if (!(is_within(request.pixel_sigmas_px[i], 1e-3, 1e6) && is_within(request.depths_m[i], 0.0, 1e3))) return false;
        if (request.depths_m[i] > 0.0 && !is_within(request.depth_sigmas_m[i], 1e-6, 1e3)) return false;
        for (int k = 0; k < 3; ++k)
            if (!is_within(request.points[3 * i + k], -kMaxAbs, kMaxAbs)) return false;
        for (int k = 0; k < 2; ++k)
            if (!is_within(request.pixels[2 * i + k], -kMaxAbs, kMaxAbs)) return false;
        for (int k = 0; k < 6; ++k)  // variances are not negative
            if (!is_within(request.point_covariances[6 * i + k], k == 0 || k == 3 || k == 5 ? 0.0 : -kMaxAbs, kMaxAbs)) return false;
    }
    return true;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_track_abi(void) { return RSE_PF_TRACK_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_distinct(const uint8_t* descriptors, const double* pixels,
                                                               int64_t rows, double apart_px, int32_t* distances) {
    if (descriptors == nullptr || pixels == nullptr || distances == nullptr || rows < 0 || rows > kMaxRows) return -1;
    for (int64_t i = 0; i < rows; ++i) distances[i] = static_cast<int32_t>(kBits);
    for (int64_t i = 0; i < rows; ++i) {
        int32_t smallest = distances[i];
        for (int64_t j = i + 1; j < rows; ++j) {
            const int32_t distance = hamming_distance(descriptors + kBytes * i, descriptors + kBytes * j);
            if (distance >= smallest && distance >= distances[j]) continue;
            const double x = pixels[2 * i] - pixels[2 * j], y = pixels[2 * i + 1] - pixels[2 * j + 1];
            if (!(x >= apart_px || -x >= apart_px || y >= apart_px || -y >= apart_px)) continue;
            smallest = distance < smallest ? distance : smallest;
            distances[j] = distance < distances[j] ? distance : distances[j];
        }
        distances[i] = smallest;
    }
    return 0;
}

__attribute__((visibility("default"))) int64_t rse_pf_match_near(const rse_pf_near_request* request,
                                                                 uint64_t* workspace, int64_t* predicted_matched,
                                                                 int64_t* matched) {
    if (request == nullptr) return -1;
    const rse_pf_near_request& near = *request;
    if (near.abi != RSE_PF_TRACK_ABI || near.predicted_rows < 0 || near.predicted_rows > kMaxRows || near.rows < 0 ||
        near.rows > kMaxRows || near.predicted_pixels == nullptr || near.predicted_directions == nullptr ||
        near.predicted_sizes == nullptr || near.predicted_descriptors == nullptr || near.pixels == nullptr ||
        near.directions == nullptr || near.sizes == nullptr || near.descriptors == nullptr ||
        near.distinct == nullptr || !is_within(near.radius_px, 0.0, kMaxAbs) || workspace == nullptr ||
        predicted_matched == nullptr || matched == nullptr)
        return -1;
    // 1. Divide the workspace, and sort the features into the grid.
    uint64_t* const nearest = workspace;  // for each predicted feature the feature that it chooses, or kNone
    uint64_t* const best_of_feature = nearest + near.predicted_rows;  // the best candidate that chose a feature
    uint64_t* const features = best_of_feature + near.rows;
    static_assert(sizeof(GridFeature) == 10 * sizeof(uint64_t), "RSE_PF_NEAR_WORKSPACE counts ten numbers a feature");
    uint64_t* const candidates = features + 10 * near.rows;
    const Grid grid = build_grid(near, candidates + near.rows + 1, reinterpret_cast<GridFeature*>(features));
    // 2. Each predicted feature chooses a feature; a feature keeps the nearest of those that choose it.
    std::memset(best_of_feature, 0xff, static_cast<size_t>(near.rows) * sizeof *best_of_feature);
    for (int64_t i = 0; i < near.predicted_rows; ++i) {
        const TwoNearest two = find_two_nearest(near, grid, i, candidates);
        nearest[i] = kNone;
        if (!is_match(near, two)) continue;
        nearest[i] = two.first & 0xffffffffu;
        const uint64_t candidate = (two.first >> 32) << 32 | static_cast<uint64_t>(i);
        if (candidate < best_of_feature[nearest[i]]) best_of_feature[nearest[i]] = candidate;
    }
    // 3. Write the pairs in which the feature has kept the predicted feature that chose it.
    int64_t count = 0;
    for (int64_t i = 0; i < near.predicted_rows; ++i) {
        if (nearest[i] == kNone || (best_of_feature[nearest[i]] & 0xffffffffu) != static_cast<uint64_t>(i)) continue;
        predicted_matched[count] = i;
        matched[count++] = static_cast<int64_t>(nearest[i]);
    }
    return count;
}

__attribute__((visibility("default"))) int32_t rse_pf_fit_pose(const rse_pf_fit_request* request, uint8_t* is_inlier,
                                                               rse_pf_fit_result* result) {
    if (request == nullptr || is_inlier == nullptr || result == nullptr || !is_valid(*request)) return -1;
    // 1. Apply Gauss-Newton steps with Cauchy weights to the pose, from kFirstGatedIteration on without outliers.
    Pose pose = read_matrix(request->T_camera_world);
    for (int i = 0; i < kMaxIterations; ++i) {
        const Fit fit = sum_measurements(*request, pose, i >= kFirstGatedIteration, false, nullptr);
        double twist[6], largest = 0.0;
        if (!solve_normal_equations(fit.normal, 0.0, twist)) return 1;
        for (const double number : twist) {
            if (!is_within(number, -kMaxTwist, kMaxTwist)) return 1;
            const double size = number < 0.0 ? -number : number;
            largest = size > largest ? size : largest;
        }
        pose = apply_twist(twist, pose);
        if (largest < kConvergedStep && i > kFirstGatedIteration) break;
    }
    // 2. Classify the measurements at the final pose, and test whether they constrain it.
    const Fit fit = sum_measurements(*request, pose, true, true, is_inlier);
    if (!is_finite(pose) || has_free_motion(fit.normal)) return 1;
    // 3. Write the pose and its information.
    result->inliers = fit.inliers;
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j)
            result->information[6 * i + j] = i <= j ? fit.normal.A[i][j] : fit.normal.A[j][i];
    const double out[16] = {pose.R[0][0], pose.R[0][1], pose.R[0][2], pose.t.x, pose.R[1][0], pose.R[1][1],
                            pose.R[1][2], pose.t.y,     pose.R[2][0], pose.R[2][1], pose.R[2][2], pose.t.z,
                            0.0,          0.0,          0.0,          1.0};
    std::memcpy(result->T_camera_world, out, sizeof out);
    return 0;
}

__attribute__((visibility("default"))) int64_t rse_pf_seek(const rse_pf_seek_request* request,
                                                           const rse_pf_near_request* image, uint64_t* workspace,
                                                           int64_t* predicted_matched, int64_t* matched) {
    if (request == nullptr || image == nullptr || workspace == nullptr || predicted_matched == nullptr ||
        request->abi != RSE_PF_TRACK_ABI || request->rows < 0 || request->rows > kMaxRows || request->landmarks < 0 ||
        request->landmarks > kMaxRows || request->numbers == nullptr || request->points == nullptr ||
        request->rays == nullptr || request->directions == nullptr || request->sizes == nullptr || request->descriptors == nullptr)
        return -1;
    const int64_t rows = request->rows;
    double* const numbers = reinterpret_cast<double*>(workspace);
    PredictedFeatures predicted = {0,
                                   numbers,
                                   numbers + 2 * rows,
                                   numbers + 4 * rows,
                                   reinterpret_cast<uint8_t*>(workspace + 5 * rows),
                                   reinterpret_cast<int64_t*>(workspace + 9 * rows)};
    predict_features(*request, read_matrix(request->T_camera_world), predicted);
    rse_pf_near_request near = *image;
    near.predicted_rows = predicted.count;
    near.predicted_pixels = predicted.pixels;
    near.predicted_directions = predicted.directions;
    near.predicted_sizes = predicted.sizes;
    near.predicted_descriptors = predicted.descriptors;
    const int64_t count = rse_pf_match_near(&near, workspace + 10 * rows, predicted_matched, matched);
    for (int64_t i = 0; i < count; ++i) predicted_matched[i] = predicted.rows[predicted_matched[i]];
    return count;
}

__attribute__((visibility("default"))) int32_t rse_pf_fit_sway(const rse_pf_fit_request* request,
                                                               const double* displacements, double* scalar,
                                                               double* information) {
    if (request == nullptr || displacements == nullptr || scalar == nullptr || information == nullptr ||
        !is_valid(*request))
        return -1;
    // 1. Sum the normal equations of twist and scalar: by_pose (twist), mixed (twist and scalar), own (scalar), and
    // the gradient of the scalar.
    const Pose pose = read_matrix(request->T_camera_world);
    Normal by_pose = {};
    double mixed[6] = {}, own = 0.0, gradient = 0.0;
    for (int64_t i = 0; i < request->rows; ++i) {
        const Linearised row = linearise(*request, pose, i);
        if (!row.is_distance) continue;
        const double weight = 1.0 / (1.0 + row.distance2 / request->cauchy2);
        add_row(by_pose, row, weight);
        double slope[3];
        for (int k = 0; k < 3; ++k)
            slope[k] = row.by_point[k][0] * displacements[3 * i] + row.by_point[k][1] * displacements[3 * i + 1] +
                       row.by_point[k][2] * displacements[3 * i + 2];
        for (int k = 0; k < 3; ++k) {
            const double weighted =
                weight * (row.W[k][0] * slope[0] + row.W[k][1] * slope[1] + row.W[k][2] * slope[2]);
            for (int j = 0; j < 6; ++j) mixed[j] += row.by_twist[k][j] * weighted;
            own += slope[k] * weighted;
            gradient += weighted * row.r[k];
        }
    }
    // 2. Eliminate the twist by the Schur complement.
    *scalar = *information = 0.0;
    Normal system = by_pose;
    std::memcpy(system.b, mixed, sizeof mixed);
    double x[6], remaining = own;
    if (!solve_normal_equations(system, 0.0, x)) return 0;
    for (int j = 0; j < 6; ++j) {
        remaining -= mixed[j] * x[j];
        gradient -= by_pose.b[j] * x[j];
    }
    // 3. Solve for the scalar.
    if (!(remaining > kMinRemainingShare * own)) return 0;
    *scalar = gradient / remaining;
    *information = remaining;
    return 0;
}
}
