// A tracker's inner loops: features that resemble no other, matches near predicted pixels, and the pose that fits
// landmarks.  rse_pf/slam/tracking.py calls it and says why.
#include "rse_pf_track.h"

#include <cstring>

#define RSE_PF_ISA rse_pf_track_detail
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#include "small.hpp"
#pragma GCC diagnostic pop

namespace {

using namespace rse_pf_track_detail;

constexpr int64_t kMaxRows = int64_t{1} << 24, kBytes = 32, kBits = 256;
constexpr int64_t kCells = 128;
constexpr double kCellPx = 16.0;
constexpr uint64_t kNone = ~uint64_t{0};
constexpr int kIterations = 10, kFirstGated = 3;
constexpr double kConverged = 1e-6, kNearM = 0.05, kMaxAbs = 1e9, kMaxTwist = 1e6, kMaxDistance2 = 1e300;
// Least eigenvalue of the information, scaled to a diagonal of 1, of which no motion is free: points on a line
// have 1e-14 and less, a mark of 20 px, without depth, 1e-9.
constexpr double kFree = 1e-12;
constexpr int kInverseIterations = 6;
// Added to a search: the sum of a pixel and a radius is rounded, and cells have borders.
constexpr double kSlackPx = 1.0;
// No length is divided by less.
constexpr double kTiny = 1e-9;
// A motion of the points that a motion of the camera explains to this share tells nothing.
constexpr double kOwn = 1e-9;

bool within(double value, double low, double high) { return value >= low && value <= high; }

uint64_t word(const uint8_t* at) {
    uint64_t value;
    std::memcpy(&value, at, sizeof value);
    return value;
}

uint64_t bits(uint64_t word) { return static_cast<uint64_t>(__builtin_popcountll(word)); }

int32_t hamming(const uint8_t* a, const uint8_t* b) {
    uint64_t sum = 0;
    for (int64_t k = 0; k < kBytes; k += 8) sum += bits(word(a + k) ^ word(b + k));
    return static_cast<int32_t>(sum);
}

// The cell of a place along one side; what lies outside is in the first or the last one.
int64_t cell_of(double px) {
    const double cell = px / kCellPx;
    return cell >= 0.0 ? (cell < static_cast<double>(kCells) ? static_cast<int64_t>(cell) : kCells - 1) : 0;
}

// A feature of the image, beside the others of its cell.
struct Placed {
    double x, y, size, turn[2];
    uint64_t descriptor[4];
    int64_t row;
};

struct Grid {
    const uint64_t* starts;  // kCells * kCells + 1
    const Placed* features;
};

// Sort the features of the image by cell, those of one cell as they stand.
Grid grid_of(const rse_pf_near_request& request, uint64_t* starts, Placed* features) {
    std::memset(starts, 0, static_cast<size_t>(kCells * kCells + 2) * sizeof *starts);
    const auto cell = [&](int64_t row) {
        return cell_of(request.pixels[2 * row + 1]) * kCells + cell_of(request.pixels[2 * row]);
    };
    for (int64_t row = 0; row < request.rows; ++row) ++starts[cell(row) + 2];
    for (int64_t i = 0; i < kCells * kCells; ++i) starts[i + 2] += starts[i + 1];
    for (int64_t row = 0; row < request.rows; ++row) {
        Placed& placed = features[starts[cell(row) + 1]++];
        placed = {request.pixels[2 * row], request.pixels[2 * row + 1], request.sizes[row],
                  {request.turns[2 * row], request.turns[2 * row + 1]}, {}, row};
        std::memcpy(placed.descriptor, request.descriptors + kBytes * row, sizeof placed.descriptor);
    }
    return {starts, features};
}

// The nearest feature (its distance above its row), and the distance of the second.
struct Two {
    uint64_t first = kNone, second = kNone;
};

Two nearest_of(const rse_pf_near_request& request, const Grid& grid, int64_t sought, uint64_t* candidates) {
    Two two;
    const double x = request.predicted[2 * sought], y = request.predicted[2 * sought + 1];
    if (!(within(x, -kMaxAbs, kMaxAbs) && within(y, -kMaxAbs, kMaxAbs))) return two;
    const double reach = request.radius_px + kSlackPx, radius2 = request.radius_px * request.radius_px;
    const double expected = request.sought_sizes[sought];
    const double* const turn = request.sought_turns + 2 * sought;
    uint64_t descriptor[4];
    std::memcpy(descriptor, request.sought + kBytes * sought, sizeof descriptor);
    uint64_t count = 0;
    const int64_t left = cell_of(x - reach), right = cell_of(x + reach), bottom = cell_of(y + reach);
    for (int64_t line = cell_of(y - reach); line <= bottom; ++line) {
        const uint64_t end = grid.starts[line * kCells + right + 1];
        for (uint64_t at = grid.starts[line * kCells + left]; at < end; ++at) {
            // Without branches: half of the features are within the radius.
            const Placed& placed = grid.features[at];
            const double u = placed.x - x, v = placed.y - y;
            const double cosine = placed.turn[0] * turn[0] + placed.turn[1] * turn[1];
            candidates[count] = at;
            count += static_cast<uint64_t>(static_cast<int>(u * u + v * v <= radius2) &
                                           static_cast<int>(placed.size <= request.max_size_ratio * expected) &
                                           static_cast<int>(expected <= request.max_size_ratio * placed.size) &
                                           static_cast<int>(cosine >= request.min_cosine));
        }
    }
    for (uint64_t i = 0; i < count; ++i) {
        const Placed& placed = grid.features[candidates[i]];
        uint64_t distance = 0;
        for (int k = 0; k < 4; ++k) distance += bits(placed.descriptor[k] ^ descriptor[k]);
        const uint64_t key = distance << 32 | static_cast<uint64_t>(placed.row);
        const uint64_t later = key < two.first ? two.first : key;
        two.first = key < two.first ? key : two.first;
        two.second = later < two.second ? later : two.second;
    }
    return two;
}

bool is_clear(const rse_pf_near_request& request, const Two& two) {
    if (two.first == kNone) return false;
    const auto distance = static_cast<double>(two.first >> 32);
    const int64_t row = static_cast<int64_t>(two.first & 0xffffffffu);
    return distance <= static_cast<double>(request.max_distance) &&
           distance < request.distinct_ratio * static_cast<double>(request.distinct[row]) &&
           (two.second == kNone || distance < request.ratio * static_cast<double>(two.second >> 32));
}

// One row at a pose: slopes of (u, v, z), the inverse of their covariance, and the error.
struct Linearised {
    double by_point[3][3], by_twist[3][6], W[3][3], r[3], q[3];  // q = W r
    double distance2;
    bool is_distance, is_ahead;  // a covariance that is none gives no distance, or a negative one
};

Linearised linearised(const rse_pf_fit_request& request, const Pose& pose, int64_t i) {
    Linearised row;
    const double* const X = request.points + 3 * i;
    const double* const S = request.spreads + 6 * i;
    const Vector3 p = rotated(pose.R, {X[0], X[1], X[2]}) + pose.t;
    const double z = p.z > kNearM ? p.z : kNearM, depth = request.depths_m[i];
    const double has = depth > 0.0 ? 1.0 : 0.0;
    const double a = p.x / z, c = p.y / z, h0 = request.fx / z, h1 = request.fy / z;
    const double r[3] = {request.pixels[2 * i] - (request.fx * a + request.cx),
                         request.pixels[2 * i + 1] - (request.fy * c + request.cy), has * (depth - z)};
    // Slopes of (u, v, z) by the point in the camera's frame, then by the point in the world.
    const double J[3][3] = {{h0, 0.0, -(h0 * a)}, {0.0, h1, -(h1 * c)}, {0.0, 0.0, has}};
    double A[3][3], AS[3][3], V[3][3];
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k)
            A[j][k] = J[j][0] * pose.R[0][k] + J[j][1] * pose.R[1][k] + J[j][2] * pose.R[2][k];
    const double C[3][3] = {{S[0], S[1], S[2]}, {S[1], S[3], S[4]}, {S[2], S[4], S[5]}};
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) AS[j][k] = A[j][0] * C[0][k] + A[j][1] * C[1][k] + A[j][2] * C[2][k];
    for (int j = 0; j < 3; ++j)
        for (int k = j; k < 3; ++k) V[j][k] = AS[j][0] * A[k][0] + AS[j][1] * A[k][1] + AS[j][2] * A[k][2];
    const double pixel2 = request.pixels_px[i] * request.pixels_px[i];
    V[0][0] += pixel2;
    V[1][1] += pixel2;
    V[2][2] = has > 0.0 ? V[2][2] + request.depths_dev[i] * request.depths_dev[i] : 1.0;
    const double m00 = V[1][1] * V[2][2] - V[1][2] * V[1][2], m01 = V[0][2] * V[1][2] - V[0][1] * V[2][2];
    const double m02 = V[0][1] * V[1][2] - V[0][2] * V[1][1];
    const double scale = 1.0 / (V[0][0] * m00 + V[0][1] * m01 + V[0][2] * m02);
    const double w01 = m01 * scale, w02 = m02 * scale, w12 = (V[0][1] * V[0][2] - V[0][0] * V[1][2]) * scale;
    const double W[3][3] = {{m00 * scale, w01, w02},
                            {w01, (V[0][0] * V[2][2] - V[0][2] * V[0][2]) * scale, w12},
                            {w02, w12, (V[0][0] * V[1][1] - V[0][1] * V[0][1]) * scale}};
    for (int j = 0; j < 3; ++j) row.q[j] = W[j][0] * r[0] + W[j][1] * r[1] + W[j][2] * r[2];
    row.distance2 = r[0] * row.q[0] + r[1] * row.q[1] + r[2] * row.q[2];
    row.is_distance = within(row.distance2, 0.0, kMaxDistance2);
    row.is_ahead = p.z > kNearM;
    // By the twist: the point moves by rho + phi x point.
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

struct Fit {
    Normal normal;
    int64_t inliers;
};

// Add a row to the normal equations.
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

// Add the rows at one pose; the last pass takes inliers without their robust weights.
Fit fit_of(const rse_pf_fit_request& request, const Pose& pose, bool is_gated, bool is_last, uint8_t* is_inlier) {
    Fit fit = {};
    for (int64_t i = 0; i < request.rows; ++i) {
        const Linearised row = linearised(request, pose, i);
        const bool is_in = row.is_distance && row.distance2 < request.gate2 && row.is_ahead;
        if (is_inlier != nullptr) is_inlier[i] = is_in ? 1 : 0;
        fit.inliers += is_in ? 1 : 0;
        if (!row.is_distance || (is_gated && !is_in)) continue;
        add_row(fit.normal, row, is_last ? 1.0 : 1.0 / (1.0 + row.distance2 / request.cauchy2));
    }
    return fit;
}

// Whether some motion is free, by inverse iteration towards the least eigenvalue; Golub and Van Loan, Sect. 8.2.
bool has_free_motion(const Normal& normal) {
    Normal scaled = {};
    double scales[6];
    for (int i = 0; i < 6; ++i) {
        if (!within(normal.A[i][i], 1e-300, 1e300)) return true;
        scales[i] = 1.0 / square_root(normal.A[i][i]);
    }
    for (int i = 0; i < 6; ++i) {
        for (int j = i; j < 6; ++j) scaled.A[i][j] = normal.A[i][j] * scales[i] * scales[j];
        scaled.b[i] = 1.0 / (1.0 + i);
    }
    double least = 0.0;
    for (int k = 0; k < kInverseIterations; ++k) {
        double x[6], size2 = 0.0;
        if (!solved(scaled, 0.0, x)) return true;
        for (const double number : x) size2 += number * number;
        least = 1.0 / square_root(size2);
        for (int i = 0; i < 6; ++i) scaled.b[i] = x[i] * least;
    }
    return !(least > kFree);
}

Pose pose_of(const double (&T)[16]) {
    return {{{T[0], T[1], T[2]}, {T[4], T[5], T[6]}, {T[8], T[9], T[10]}}, {T[3], T[7], T[11]}};
}

// What a pose expects of landmarks in its image, in memory of the caller.
struct Expected {
    int64_t count;
    double *pixels, *turns, *sizes;
    uint8_t* descriptors;
    int64_t* rows;  // of the numbers
};

// Take the landmarks ahead, in the image, and seen from such a direction and distance before.
void expect(const rse_pf_seek_request& request, const Pose& pose, Expected& out) {
    for (int64_t row = 0; row < request.rows; ++row) {
        const int64_t number = request.numbers[row];
        if (number < 0 || number >= request.landmarks) continue;
        const double* const X = request.points + 3 * number;
        const Vector3 p = rotated(pose.R, {X[0], X[1], X[2]}) + pose.t;
        if (!(p.z > request.nearest_m)) continue;
        const double u = request.fx * p.x / p.z + request.cx, v = request.fy * p.y / p.z + request.cy;
        if (!(u > -request.margin_px && u < request.width + request.margin_px && v > -request.margin_px &&
              v < request.height + request.margin_px))
            continue;
        const double* const ray_at = request.rays + 3 * number;
        const Vector3 ray = rotated(pose.R, {ray_at[0], ray_at[1], ray_at[2]});
        const double distance = square_root(dot(p, p)), before = square_root(dot(ray, ray));
        const double scale = distance * before, cosine = dot(ray, p) / (scale > kTiny ? scale : kTiny);
        if (!(cosine > request.min_cosine && distance < request.max_farther * before &&
              before < request.max_nearer * distance))
            continue;
        const double* const turn_at = request.turns + 3 * number;
        const Vector3 turn = rotated(pose.R, {turn_at[0], turn_at[1], turn_at[2]});
        const double length = square_root(turn.x * turn.x + turn.y * turn.y);
        const int64_t k = out.count++;
        out.pixels[2 * k] = u;
        out.pixels[2 * k + 1] = v;
        out.turns[2 * k] = turn.x / (length > kTiny ? length : kTiny);
        out.turns[2 * k + 1] = turn.y / (length > kTiny ? length : kTiny);
        out.sizes[k] = request.sizes[number] * before / (distance > kTiny ? distance : kTiny);
        std::memcpy(out.descriptors + kBytes * k, request.descriptors + kBytes * number, kBytes);
        out.rows[k] = row;
    }
}

bool is_whole(const rse_pf_fit_request& request) {
    if (request.abi != RSE_PF_TRACK_ABI || request.rows < 0 || request.rows > kMaxRows || request.points == nullptr ||
        request.spreads == nullptr || request.pixels == nullptr || request.pixels_px == nullptr ||
        request.depths_m == nullptr || request.depths_dev == nullptr || !within(request.fx, 1e-9, kMaxAbs) ||
        !within(request.fy, 1e-9, kMaxAbs) || !within(request.cx, -kMaxAbs, kMaxAbs) ||
        !within(request.cy, -kMaxAbs, kMaxAbs) || !within(request.cauchy2, 1e-9, kMaxAbs) ||
        !within(request.gate2, 0.0, kMaxAbs))
        return false;
    for (const double number : request.T_camera_world)
        if (!within(number, -kMaxAbs, kMaxAbs)) return false;
    for (int64_t i = 0; i < request.rows; ++i) {
        if (!(within(request.pixels_px[i], 1e-3, 1e6) && within(request.depths_m[i], 0.0, 1e3))) return false;
        if (request.depths_m[i] > 0.0 && !within(request.depths_dev[i], 1e-6, 1e3)) return false;
        for (int k = 0; k < 3; ++k)
            if (!within(request.points[3 * i + k], -kMaxAbs, kMaxAbs)) return false;
        for (int k = 0; k < 2; ++k)
            if (!within(request.pixels[2 * i + k], -kMaxAbs, kMaxAbs)) return false;
        for (int k = 0; k < 6; ++k)  // variances are not negative
            if (!within(request.spreads[6 * i + k], k == 0 || k == 3 || k == 5 ? 0.0 : -kMaxAbs, kMaxAbs)) return false;
    }
    return true;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_track_abi(void) { return RSE_PF_TRACK_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_distinct(const uint8_t* descriptors, const double* pixels,
                                                               int64_t rows, double apart_px, int32_t* distinct) {
    if (descriptors == nullptr || pixels == nullptr || distinct == nullptr || rows < 0 || rows > kMaxRows) return -1;
    for (int64_t i = 0; i < rows; ++i) distinct[i] = static_cast<int32_t>(kBits);
    for (int64_t i = 0; i < rows; ++i) {
        int32_t least = distinct[i];
        for (int64_t j = i + 1; j < rows; ++j) {
            const int32_t distance = hamming(descriptors + kBytes * i, descriptors + kBytes * j);
            if (distance >= least && distance >= distinct[j]) continue;
            const double x = pixels[2 * i] - pixels[2 * j], y = pixels[2 * i + 1] - pixels[2 * j + 1];
            if (!(x >= apart_px || -x >= apart_px || y >= apart_px || -y >= apart_px)) continue;
            least = distance < least ? distance : least;
            distinct[j] = distance < distinct[j] ? distance : distinct[j];
        }
        distinct[i] = least;
    }
    return 0;
}

__attribute__((visibility("default"))) int64_t rse_pf_match_near(const rse_pf_near_request* request,
                                                                 uint64_t* workspace, int64_t* sought_matched,
                                                                 int64_t* matched) {
    if (request == nullptr) return -1;
    const rse_pf_near_request& all = *request;
    if (all.abi != RSE_PF_TRACK_ABI || all.sought_rows < 0 || all.sought_rows > kMaxRows || all.rows < 0 ||
        all.rows > kMaxRows || all.predicted == nullptr || all.sought_turns == nullptr || all.sought_sizes == nullptr ||
        all.sought == nullptr || all.pixels == nullptr || all.turns == nullptr || all.sizes == nullptr ||
        all.descriptors == nullptr || all.distinct == nullptr || !within(all.radius_px, 0.0, kMaxAbs) ||
        workspace == nullptr || sought_matched == nullptr || matched == nullptr)
        return -1;
    uint64_t* const nearest = workspace;  // of each sought feature
    uint64_t* const takers = nearest + all.sought_rows;
    uint64_t* const features = takers + all.rows;
    static_assert(sizeof(Placed) == 10 * sizeof(uint64_t), "as RSE_PF_NEAR_WORKSPACE counts");
    uint64_t* const candidates = features + 10 * all.rows;
    const Grid grid = grid_of(all, candidates + all.rows + 1, reinterpret_cast<Placed*>(features));
    std::memset(takers, 0xff, static_cast<size_t>(all.rows) * sizeof *takers);
    for (int64_t i = 0; i < all.sought_rows; ++i) {
        const Two two = nearest_of(all, grid, i, candidates);
        nearest[i] = kNone;
        if (!is_clear(all, two)) continue;
        nearest[i] = two.first & 0xffffffffu;
        const uint64_t taker = (two.first >> 32) << 32 | static_cast<uint64_t>(i);
        if (taker < takers[nearest[i]]) takers[nearest[i]] = taker;
    }
    int64_t count = 0;
    for (int64_t i = 0; i < all.sought_rows; ++i) {
        if (nearest[i] == kNone || (takers[nearest[i]] & 0xffffffffu) != static_cast<uint64_t>(i)) continue;
        sought_matched[count] = i;
        matched[count++] = static_cast<int64_t>(nearest[i]);
    }
    return count;
}

__attribute__((visibility("default"))) int32_t rse_pf_fit_pose(const rse_pf_fit_request* request, uint8_t* is_inlier,
                                                               rse_pf_fit_result* result) {
    if (request == nullptr || is_inlier == nullptr || result == nullptr || !is_whole(*request)) return -1;
    Pose pose = pose_of(request->T_camera_world);
    for (int i = 0; i < kIterations; ++i) {
        const Fit fit = fit_of(*request, pose, i >= kFirstGated, false, nullptr);
        double twist[6], largest = 0.0;
        if (!solved(fit.normal, 0.0, twist)) return 1;
        for (const double number : twist) {
            if (!within(number, -kMaxTwist, kMaxTwist)) return 1;
            const double size = number < 0.0 ? -number : number;
            largest = size > largest ? size : largest;
        }
        pose = moved_along(twist, pose);
        if (largest < kConverged && i > kFirstGated) break;
    }
    const Fit fit = fit_of(*request, pose, true, true, is_inlier);
    if (!is_finite(pose) || has_free_motion(fit.normal)) return 1;
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
                                                           int64_t* sought_matched, int64_t* matched) {
    if (request == nullptr || image == nullptr || workspace == nullptr || sought_matched == nullptr ||
        request->abi != RSE_PF_TRACK_ABI || request->rows < 0 || request->rows > kMaxRows || request->landmarks < 0 ||
        request->landmarks > kMaxRows || request->numbers == nullptr || request->points == nullptr || request->rays == nullptr || request->turns == nullptr ||
        request->sizes == nullptr || request->descriptors == nullptr)
        return -1;
    const int64_t rows = request->rows;
    double* const numbers = reinterpret_cast<double*>(workspace);
    Expected expected = {0,
                         numbers,
                         numbers + 2 * rows,
                         numbers + 4 * rows,
                         reinterpret_cast<uint8_t*>(workspace + 5 * rows),
                         reinterpret_cast<int64_t*>(workspace + 9 * rows)};
    expect(*request, pose_of(request->T_camera_world), expected);
    rse_pf_near_request near = *image;
    near.sought_rows = expected.count;
    near.predicted = expected.pixels;
    near.sought_turns = expected.turns;
    near.sought_sizes = expected.sizes;
    near.sought = expected.descriptors;
    const int64_t count = rse_pf_match_near(&near, workspace + 10 * rows, sought_matched, matched);
    for (int64_t i = 0; i < count; ++i) sought_matched[i] = expected.rows[sought_matched[i]];
    return count;
}

__attribute__((visibility("default"))) int32_t rse_pf_fit_sway(const rse_pf_fit_request* request, const double* sways,
                                                               double* more, double* information) {
    if (request == nullptr || sways == nullptr || more == nullptr || information == nullptr || !is_whole(*request))
        return -1;
    const Pose pose = pose_of(request->T_camera_world);
    Normal by_pose = {};
    double shared[6] = {}, own = 0.0, gradient = 0.0;  // information of a pose's twist with the motion, and of that
    for (int64_t i = 0; i < request->rows; ++i) {
        const Linearised row = linearised(*request, pose, i);
        if (!row.is_distance) continue;
        const double weight = 1.0 / (1.0 + row.distance2 / request->cauchy2);
        add_row(by_pose, row, weight);
        double slope[3];
        for (int k = 0; k < 3; ++k)
            slope[k] = row.by_point[k][0] * sways[3 * i] + row.by_point[k][1] * sways[3 * i + 1] +
                       row.by_point[k][2] * sways[3 * i + 2];
        for (int k = 0; k < 3; ++k) {
            const double weighted =
                weight * (row.W[k][0] * slope[0] + row.W[k][1] * slope[1] + row.W[k][2] * slope[2]);
            for (int j = 0; j < 6; ++j) shared[j] += row.by_twist[k][j] * weighted;
            own += slope[k] * weighted;
            gradient += weighted * row.r[k];
        }
    }
    *more = *information = 0.0;
    Normal system = by_pose;
    std::memcpy(system.b, shared, sizeof shared);
    double x[6], left = own;
    if (!solved(system, 0.0, x)) return 0;
    for (int j = 0; j < 6; ++j) {
        left -= shared[j] * x[j];
        gradient -= by_pose.b[j] * x[j];
    }
    if (!(left > kOwn * own)) return 0;
    *more = gradient / left;
    *information = left;
    return 0;
}
}
