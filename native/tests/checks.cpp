// Tests of the parts of the core that Python cannot call, each against an independent computation, and of the C interface
// with random input.  The allocations of the solver are counted by a wrapper of `aligned_alloc`.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <random>
#include <vector>

#define RSE_PF_ISA checked
#include "solve.hpp"
#include "rse_pf_track.h"

static int allocations = 0;
extern "C" void* __real_aligned_alloc(size_t alignment, size_t size);
extern "C" void* __wrap_aligned_alloc(size_t alignment, size_t size) {
    ++allocations;
    return __real_aligned_alloc(alignment, size);
}

namespace {

using namespace checked;

int failures = 0;
// Print a message and count a failure unless the condition is true.
void expect_true(bool condition, const char* message) {
    if (condition) return;
    std::printf("FAILED: %s\n", message);
    ++failures;
}

std::mt19937_64 random_bits(1);
double uniform(double low, double high) {
    return low + (high - low) * static_cast<double>(random_bits() >> 11) * 0x1p-53;
}

void check_elementary() {
    double worst = 0.0, worst_factorial = 0.0;
    for (int i = 0; i < 200000; ++i) {
        const double x = std::exp(uniform(-700.0, 700.0)), y = 1.0 - std::exp(uniform(-36.0, -0.01));
        worst = std::max(worst, std::fabs(natural_log(x) - std::log(x)) / std::max(1.0, std::fabs(std::log(x))));
        worst = std::max(worst, std::fabs(natural_log(y) - std::log(y)) / std::fabs(std::log(y)));
    }
    for (int64_t n = 0; n < 20000; ++n) {
        const double expected = std::lgamma(static_cast<double>(n) + 1.0);
        worst_factorial = std::max(worst_factorial, std::fabs(log_factorial(n) - expected) / std::max(1.0, expected));
    }
    expect_true(worst < 1e-15, "the logarithm equals std::log to the last bits");
    expect_true(worst_factorial < 1e-14, "the logarithm of the factorial equals std::lgamma");
    expect_true(natural_log(0.0) == -kInfinity && std::isnan(natural_log(-1.0)), "log of 0 and of a negative number");
    expect_true(std::fabs(natural_log(5e-324) - std::log(5e-324)) < 1e-12, "log of the smallest number");
}

void check_lanes() {
    alignas(64) float numbers[kLanes];
    for (int k = 0; k < kLanes; ++k) numbers[k] = static_cast<float>(uniform(-1e6, 1e6));
    const float pairs = ((numbers[0] + numbers[1]) + (numbers[2] + numbers[3])) +
                        ((numbers[4] + numbers[5]) + (numbers[6] + numbers[7]));
    expect_true(sum<float>(load(numbers)) == pairs, "lanes are summed in pairs");
    const Doubles nan = all(__builtin_nan("")), one = all(1.0), two = all(2.0);
    expect_true(sum<double>(where_less(nan, one, one, two)) == 16.0, "nan is not less than anything");
    expect_true(sum<double>(where_less(one, two, one, two)) == 8.0, "one is less than two");
}

void check_roots() {
    for (int i = 0; i < 20000; ++i) {
        const double p = uniform(-3, 3), q = uniform(-3, 3), r = uniform(-3, 3);
        const double t = find_real_root(-(p + q + r), p * q + q * r + r * p, -p * q * r);
        expect_true(std::min({std::fabs(t - p), std::fabs(t - q), std::fabs(t - r)}) < 1e-4, "a root of a cubic");
    }
}

void check_solve_p3p() {
    int found = 0, tries = 20000;
    for (int i = 0; i < tries; ++i) {
        double twist[6];
        for (double& component : twist) component = uniform(-1.5, 1.5);
        const Pose identity = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {0, 0, 0}};
        const Pose truth = apply_twist_by_cayley(twist, identity);
        Vector3 bearings[3], points[3];
        for (int k = 0; k < 3; ++k) {
            const double z = uniform(0.5, 6.0);
            const Vector3 seen = {uniform(-0.6, 0.6) * z, uniform(-0.5, 0.5) * z, z}, q = seen - truth.t;
            bearings[k] = normalise(seen);
            points[k] = {truth.R[0][0] * q.x + truth.R[1][0] * q.y + truth.R[2][0] * q.z,
                         truth.R[0][1] * q.x + truth.R[1][1] * q.y + truth.R[2][1] * q.z,
                         truth.R[0][2] * q.x + truth.R[1][2] * q.y + truth.R[2][2] * q.z};
        }
        Pose poses[4];
        double nearest = kInfinity;
        for (int k = solve_p3p(bearings, points, poses) - 1; k >= 0; --k) {
            double apart = std::sqrt(dot(poses[k].t - truth.t, poses[k].t - truth.t));
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) apart = std::max(apart, std::fabs(poses[k].R[a][b] - truth.R[a][b]));
            nearest = std::min(nearest, apart);
        }
        found += nearest < 1e-4 ? 1 : 0;
    }
    std::printf("p3p: %d of %d poses within 1e-4\n", found, tries);
    expect_true(found > tries - tries / 500, "three exact points give their pose");
    const Vector3 line[3] = {{0, 0, 1}, {0, 0, 2}, {0, 0, 3}}, same[3] = {{1, 2, 3}, {1, 2, 3}, {1, 2, 3}};
    const Vector3 seen[3] = {normalise({0, 0, 1}), normalise({0.1, 0, 1}), normalise({0, 0.1, 1})};
    Pose poses[4];
    expect_true(solve_p3p(seen, line, poses) == 0 && solve_p3p(seen, same, poses) == 0, "a line and one point give no pose");
}

void check_systems() {
    for (int i = 0; i < 2000; ++i) {
        Normal normal = {};
        double x[6], expected[6];
        for (int row = 0; row < 12; ++row) {
            double jacobian[6];
            for (double& value : jacobian) value = uniform(-1, 1);
            for (int a = 0; a < 6; ++a)
                for (int b = 0; b < 6; ++b) normal.A[a][b] += jacobian[a] * jacobian[b];
        }
        for (double& value : expected) value = uniform(-1, 1);
        for (int a = 0; a < 6; ++a)
            for (int b = 0; b < 6; ++b) normal.b[a] += normal.A[a][b] * expected[b];
        expect_true(solve_normal_equations(normal, 0.0, x), "a positive system is solved");
        for (int a = 0; a < 6; ++a) expect_true(std::fabs(x[a] - expected[a]) < 1e-6, "the solution of a system");
        double covariance[36];
        expect_true(compute_covariance(normal, 2.0, covariance), "a positive system has a covariance");
        for (int a = 0; a < 6; ++a)
            for (int b = 0; b < 6; ++b) {
                double product = 0.0;
                for (int k = 0; k < 6; ++k) product += covariance[6 * a + k] * normal.A[k][b];
                expect_true(std::fabs(product - (a == b ? 2.0 : 0.0)) < 1e-6, "the covariance is the inverse");
            }
        double matrix[3][3], values[3], axes[3][3];
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) matrix[a][b] = normal.A[a][b];
        compute_eigenvectors(matrix, values, axes);
        expect_true(values[0] <= values[1] && values[1] <= values[2], "eigenvalues are in order");
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) {
                double product = 0.0;
                for (int k = 0; k < 3; ++k) product += matrix[b][k] * axes[a][k];
                expect_true(std::fabs(product - values[a] * axes[a][b]) < 1e-9, "eigenvectors keep their direction");
            }
    }
    Normal singular = {};
    double x[6];
    expect_true(!solve_normal_equations(singular, 0.0, x), "a system of zeros is refused");
}

void check_motion() {
    const Pose identity = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {0, 0, 0}};
    const double quarter[6] = {0, 0, 0, 0, 0, kPi / 2};
    const Pose turned = apply_twist(quarter, identity);
    expect_true(std::fabs(turned.R[0][1] + 1.0) < 1e-14 && std::fabs(turned.R[1][0] - 1.0) < 1e-14, "a quarter turn");
    const double small[6] = {1e-4, 2e-4, -1e-4, 3e-4, -2e-4, 1e-4};
    const Pose by_cayley = apply_twist_by_cayley(small, identity), by_series = apply_twist(small, identity);
    double apart = 0.0;
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) apart = std::max(apart, std::fabs(by_cayley.R[a][b] - by_series.R[a][b]));
    expect_true(apart < 1e-10, "Cayley's map and the exponential map agree for small twists");
}

void check_selection() {
    for (int i = 0; i < 300; ++i) {
        std::vector<double> numbers(static_cast<size_t>(1 + random_bits() % 200));
        for (double& number : numbers) number = std::floor(uniform(0, 30));
        std::vector<double> sorted = numbers;
        std::sort(sorted.begin(), sorted.end());
        const auto kth = static_cast<size_t>(random_bits() % numbers.size());
        const double found =
            select_kth(numbers.data(), static_cast<int64_t>(numbers.size()), static_cast<int64_t>(kth));
        expect_true(found == sorted[kth], "the kth of some numbers");
    }
}

void check_sampler() {
    Sampler sampler = {0};
    std::vector<int> drawn(10);
    for (int i = 0; i < 30000; ++i) {
        int64_t rows[3];
        sampler.draw_three(10, rows);
        expect_true(rows[0] != rows[1] && rows[1] != rows[2] && rows[0] != rows[2], "three different rows");
        for (const int64_t row : rows) ++drawn.at(static_cast<size_t>(row));
    }
    for (const int times : drawn) expect_true(std::abs(times - 9000) < 500, "every row is drawn equally often");
    int64_t rows[3];
    sampler.draw_three(3, rows);
    expect_true(rows[0] + rows[1] + rows[2] == 3, "all three of three rows are drawn");
}

rse_pf_pnp_request request_of(const std::vector<double>& points, const std::vector<double>& pixels) {
    rse_pf_pnp_request request = {};
    request.abi = RSE_PF_NATIVE_ABI;
    request.rows = static_cast<int64_t>(pixels.size() / 2);
    request.points_world = points.data();
    request.pixels = pixels.data();
    request.fx = request.fy = 500;
    request.cx = 320;
    request.cy = 240;
    request.width = 640;
    request.height = 480;
    request.inlier_px = 8;
    request.confidence = 0.999;
    request.max_iterations = 1000;
    request.min_iterations = 10;
    request.weak_inliers = 12;
    request.weak_inlier_ratio = 0.25;
    request.weak_translation_m = 0.03;
    request.weak_rotation_rad = 0.01;
    return request;
}

// Return a random number of a kind: 1 moderate, 2 often repeated, 3 large, 4 tiny, 5 at a limit, 6 random bits; 0 a mixture.
double hostile(int kind) {
    const uint64_t bits = random_bits();
    switch (kind == 0 ? static_cast<int>(bits % 7) : kind) {
        case 1: return uniform(-10.0, 700.0);
        case 2: return static_cast<double>(bits % 3);
        case 3: return uniform(-1e6, 1e6);
        case 4: return std::ldexp(uniform(-1.0, 1.0), -static_cast<int>(bits % 1070));
        case 5: return bits % 2 == 0 ? 1e6 : -1e6;
        default: {
            double any;
            std::memcpy(&any, &bits, sizeof any);
            return bits % 20 == 0 ? any : std::fmod(std::isfinite(any) ? any : 0.0, 1e6);
        }
    }
}

void check_hostile() {
    for (int i = 0; i < 5000; ++i) {
        const auto n = static_cast<size_t>(random_bits() % 70);
        const int kind = static_cast<int>(random_bits() % 7), pixel_kind = static_cast<int>(random_bits() % 7);
        std::vector<double> points(3 * n), pixels(2 * n);
        for (double& number : points) number = hostile(kind);
        for (double& number : pixels) number = hostile(pixel_kind);
        std::vector<uint32_t> inliers(n);
        std::vector<double> pose(16);
        for (double& number : pose) number = hostile(kind);
        rse_pf_pnp_request request = request_of(points, pixels);
        request.T_camera_world = i % 3 == 0 ? pose.data() : nullptr;
        request.flags = static_cast<uint32_t>(random_bits() % 8);
        request.max_iterations = static_cast<int32_t>(1 + random_bits() % 50);
        request.inlier_px = i % 2 == 0 ? 8.0 : uniform(1e-3, 100.0);
        rse_pf_pnp_result result;
        rse_pf_pnp_solve(&request, inliers.data(), &result);
        expect_true(result.status >= 0 && result.status <= RSE_PF_PNP_OUT_OF_MEMORY, "a hostile request has a status");
        if (result.status != RSE_PF_PNP_SOLVED) continue;
        for (const double element : result.T_camera_world) expect_true(std::isfinite(element), "a pose is finite");
        for (const double element : result.covariance) expect_true(std::isfinite(element), "a covariance is finite");
        expect_true(result.inlier_count >= 0 && result.inlier_count <= request.rows, "there are at most `rows` inliers");
        for (int64_t k = 0; k < result.inlier_count; ++k) {
            const int64_t row = inliers[static_cast<size_t>(k)];
            const int64_t next_row = k > 0 ? int64_t{inliers[static_cast<size_t>(k - 1)]} + 1 : 0;
            expect_true(row >= next_row && row < request.rows, "row numbers of inliers ascend");
        }
    }
}

void check_lists() {
    static constexpr char kSigns[] = "[[],,::{}\"\\ .-+eE00123456789";
    for (int i = 0; i < 20000; ++i) {
        // The allocations have no spare bytes, so that the address sanitizer notices an access one element too far.
        std::vector<char> text(static_cast<size_t>(random_bits() % (i % 100 == 0 ? 3000 : 60)));
        for (char& character : text) character = kSigns[random_bits() % (sizeof kSigns - 1)];
        std::vector<double> numbers(static_cast<size_t>(random_bits() % 8));
        rse_pf_lists lists = {numbers.data(), static_cast<int64_t>(numbers.size()), 0, {}, {}};
        const int64_t size = rse_pf_cut_lists(text.data(), static_cast<int64_t>(text.size()), &lists);
        expect_true(size >= -1 && size <= RSE_PF_MAX_REST, "the rest of a text is short");
        if (size < 0) continue;
        int64_t last = 0;
        for (int64_t k = 0; k < lists.count; ++k) {
            expect_true(lists.ends[k] > last && lists.ends[k] <= lists.room, "lists of numbers follow each other");
            last = lists.ends[k];
        }
    }
    const char known[] = "{\"a\":[1, -2.50 ,0.125],\"b\":[123456789012345]}";
    double numbers[4] = {};
    rse_pf_lists lists = {numbers, 4, 0, {}, {}};
    const int64_t size = rse_pf_cut_lists(known, sizeof known - 1, &lists);
    expect_true(size == 27 && std::memcmp(lists.rest, "{\"a\":\"\\u0000\",\"b\":\"\\u0001\"}", 27) == 0, "lists are cut out");
    expect_true(lists.count == 2 && lists.ends[0] == 3 && lists.ends[1] == 4, "lists are counted");
    expect_true(numbers[0] == 1.0 && numbers[1] == -2.5 && numbers[2] == 0.125 && numbers[3] == 123456789012345.0,
                "numbers are read exactly");
}

// The arrays have no spare bytes, so that the address sanitizer notices an access one element too far.
void check_matches_near() {
    for (int i = 0; i < 3000; ++i) {
        const auto m = static_cast<size_t>(random_bits() % 40), n = static_cast<size_t>(random_bits() % 40);
        const int kind = static_cast<int>(random_bits() % 7);
        std::vector<double> predicted_pixels(2 * m), predicted_directions(2 * m), predicted_sizes(m);
        std::vector<double> pixels(2 * n), directions(2 * n), sizes(n);
        for (auto* numbers : {&predicted_pixels, &predicted_directions, &predicted_sizes, &pixels, &directions, &sizes})
            for (double& number : *numbers) number = hostile(kind);
        std::vector<uint8_t> predicted_descriptors(32 * m), descriptors(32 * n);
        for (auto* bytes : {&predicted_descriptors, &descriptors})
            for (uint8_t& byte : *bytes) byte = static_cast<uint8_t>(random_bits() % 2);
        std::vector<int32_t> distinct(n);
        const uint8_t none = 0;
        const double zero = 0.0;
        const auto numbers_at = [&](const std::vector<double>& numbers) { return numbers.empty() ? &zero : numbers.data(); };
        const uint8_t* const at = n == 0 ? &none : descriptors.data();
        int32_t spare = 0;
        expect_true(rse_pf_distinct(at, numbers_at(pixels), static_cast<int64_t>(n), 6.0,
                                    n == 0 ? &spare : distinct.data()) == 0,
                    "any features have distances");
        rse_pf_near_request request = {};
        request.abi = RSE_PF_TRACK_ABI;
        request.predicted_rows = static_cast<int64_t>(m);
        request.rows = static_cast<int64_t>(n);
        request.predicted_pixels = numbers_at(predicted_pixels);
        request.predicted_directions = numbers_at(predicted_directions);
        request.predicted_sizes = numbers_at(predicted_sizes);
        request.predicted_descriptors = m == 0 ? &none : predicted_descriptors.data();
        request.pixels = numbers_at(pixels);
        request.directions = numbers_at(directions);
        request.sizes = numbers_at(sizes);
        request.descriptors = at;
        request.distinct = n == 0 ? &spare : distinct.data();
        request.radius_px = i % 2 == 0 ? 1e9 : uniform(0.0, 900.0);
        request.ratio = request.distinct_ratio = uniform(0.5, 2.0);
        request.min_cosine = -1e18;
        request.max_size_ratio = 1e18;
        request.max_distance = 256;
        std::vector<uint64_t> workspace(RSE_PF_NEAR_WORKSPACE(m, n));
        std::vector<int64_t> rows(std::min(m, n) + 1), columns(std::min(m, n) + 1);
        const int64_t count = rse_pf_match_near(&request, workspace.data(), rows.data(), columns.data());
        expect_true(count >= 0 && count <= static_cast<int64_t>(std::min(m, n)), "no more matches than features");
        std::vector<bool> is_taken(n);
        for (size_t k = 0; k < static_cast<size_t>(count); ++k) {
            const int64_t next_row = k > 0 ? rows[k - 1] + 1 : 0;
            expect_true(rows[k] >= next_row && rows[k] < request.predicted_rows, "predicted rows of matches ascend");
            expect_true(columns[k] >= 0 && columns[k] < request.rows, "a match names a feature of the image");
            expect_true(!is_taken[static_cast<size_t>(columns[k])], "a feature is matched at most once");
            is_taken[static_cast<size_t>(columns[k])] = true;
        }
        request.radius_px = -1.0;
        expect_true(rse_pf_match_near(&request, workspace.data(), rows.data(), columns.data()) == -1, "a negative radius");
    }
}

void check_fits() {
    int fitted = 0;
    for (int i = 0; i < 3000; ++i) {
        const auto n = static_cast<size_t>(1 + random_bits() % 40);
        const int kind = i % 2 == 0 ? -1 : static_cast<int>(random_bits() % 7);
        std::vector<double> points(3 * n), point_covariances(6 * n), pixels(2 * n), ones(n, 1.0), depths(n);
        for (size_t k = 0; k < n; ++k) {
            const double z = uniform(1.0, 5.0), x = uniform(-0.5, 0.5) * z, y = uniform(-0.4, 0.4) * z;
            points[3 * k] = x, points[3 * k + 1] = y, points[3 * k + 2] = z;
            pixels[2 * k] = 500 * x / z + 320, pixels[2 * k + 1] = 500 * y / z + 240;
            point_covariances[6 * k] = point_covariances[6 * k + 3] = point_covariances[6 * k + 5] = 1e-6;
            depths[k] = k % 3 == 0 ? 0.0 : z;
        }
        if (kind >= 0)
            for (auto* numbers : {&points, &point_covariances, &pixels, &ones, &depths})
                if (random_bits() % 2 == 0) (*numbers)[random_bits() % numbers->size()] = hostile(kind);
        rse_pf_fit_request request = {};
        request.abi = RSE_PF_TRACK_ABI;
        request.rows = static_cast<int64_t>(n);
        request.points = points.data();
        request.point_covariances = point_covariances.data();
        request.pixels = pixels.data();
        request.pixel_sigmas_px = request.depth_sigmas_m = ones.data();
        request.depths_m = depths.data();
        request.fx = request.fy = 500;
        request.cx = 320;
        request.cy = 240;
        request.cauchy2 = 6.25;
        request.gate2 = 11.3;
        for (size_t k = 0; k < 4; ++k) request.T_camera_world[5 * k] = 1.0;
        request.T_camera_world[3] = kind < 0 ? 0.02 : hostile(kind);
        std::vector<uint8_t> is_inlier(n);
        rse_pf_fit_result result;
        const int32_t status = rse_pf_fit_pose(&request, is_inlier.data(), &result);
        expect_true(status == -1 || status == 0 || status == 1, "a fit has a status");
        if (status != 0) continue;
        for (const double number : result.T_camera_world) expect_true(std::isfinite(number), "a fitted pose is finite");
        for (const double number : result.information) expect_true(std::isfinite(number), "information is finite");
        expect_true(result.inliers == std::count(is_inlier.begin(), is_inlier.end(), 1), "inliers are counted");
        if (kind >= 0) continue;
        ++fitted;
        if (n >= 6) expect_true(std::fabs(result.T_camera_world[3]) < 1e-6, "exact pixels give the pose");
    }
    expect_true(fitted > 1200, "most exact problems have a pose");
}

void check_allocations() {
    const int64_t n = 300;
    std::vector<double> points(3 * n), pixels(2 * n);
    std::vector<uint32_t> inliers(n);
    for (int64_t i = 0; i < n; ++i) {
        const auto p = static_cast<size_t>(3 * i), q = static_cast<size_t>(2 * i);
        points[p + 2] = uniform(1, 5);
        points[p] = uniform(-0.5, 0.5) * points[p + 2];
        points[p + 1] = uniform(-0.4, 0.4) * points[p + 2];
        pixels[q] = 500 * points[p] / points[p + 2] + 320 + (i % 3 == 0 ? uniform(-200, 200) : uniform(-1, 1));
        pixels[q + 1] = 500 * points[p + 1] / points[p + 2] + 240 + uniform(-1, 1);
    }
    rse_pf_pnp_request request = request_of(points, pixels);
    rse_pf_pnp_result result;
    rse_pf_pnp_solve(&request, inliers.data(), &result);
    expect_true(result.status == RSE_PF_PNP_SOLVED && result.inlier_count >= 190, "a request is solved");
    const int warm = allocations;
    expect_true(warm >= 1, "the workspace is allocated, and that is counted");
    for (int i = 0; i < 100; ++i) rse_pf_pnp_solve(&request, inliers.data(), &result);
    expect_true(allocations == warm, "no allocation after the first request");
    request.abi += 1;
    rse_pf_pnp_solve(&request, inliers.data(), &result);
    expect_true(result.status == RSE_PF_PNP_BAD_REQUEST, "another ABI is refused");
}

}  // namespace

int main() {
    static_cast<void>(&solve_task);  // Not called here: the tests call the solver through the C interface.
    check_elementary();
    check_lanes();
    check_roots();
    check_solve_p3p();
    check_systems();
    check_motion();
    check_selection();
    check_sampler();
    check_allocations();
    check_hostile();
    check_lists();
    check_matches_near();
    check_fits();
    std::printf(failures == 0 ? "all checks passed (%s)\n" : "checks failed (%s)\n", rse_pf_native_lanes());
    return failures == 0 ? 0 : 1;
}
