// Back-projection of keypoints by a depth image, and brute-force matching of 256-bit descriptors.
//
// The caller provides all memory.  The results are integers, or single IEEE 754 operations in one order, so the choice
// of instructions changes no byte.
#include "rse_pf_match.h"

#include <cstring>

#include "match_nearest.hpp"

namespace {

using namespace rse_pf_match_detail;

// Most keypoints or descriptors of one call: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Largest height or width of a depth image, pixels: a limit of plausible requests.
constexpr int64_t kMaxSide = int64_t{1} << 16;
// Pixels of the 3 x 3 patch whose median is the depth of a keypoint.
constexpr int kPatch = 9;
// Fewest valid depths in the 3 x 3 patch of a keypoint whose median is used: more than half.
constexpr int kMinDepths = 5;
// Number of keypoints by which memory is fetched ahead, so that the depths are in the cache when they are needed.
constexpr int64_t kAhead = 16;

double not_a_number() { return __builtin_nan(""); }

// A sorting network of 25 exchanges for nine numbers, which needs no branches (Floyd 1964; Knuth, TAOCP 3, Sect.
// 5.3.4).
constexpr int8_t kExchanges[][2] = {{0, 3}, {1, 7}, {2, 5}, {4, 8}, {0, 7}, {2, 4}, {3, 8}, {5, 6}, {0, 2},
                                    {1, 3}, {4, 5}, {7, 8}, {1, 4}, {3, 6}, {5, 7}, {0, 1}, {2, 4}, {3, 5},
                                    {6, 8}, {2, 3}, {4, 5}, {6, 7}, {1, 2}, {3, 4}, {5, 6}};

struct DepthImage {
    const float* depth_m;
    int64_t width, height;
};

// Return the index of the first depth of the 3x3 patch around the nearest pixel, -1 if the patch is not inside the
// image.
int64_t first_of_patch(const DepthImage& image, const double* pixel) {
    const double column = __builtin_rint(pixel[0]), row = __builtin_rint(pixel[1]);
    const bool is_inside = column >= 1.0 && row >= 1.0 && column < static_cast<double>(image.width - 1) &&
                           row < static_cast<double>(image.height - 1);
    return is_inside ? (static_cast<int64_t>(row) - 1) * image.width + static_cast<int64_t>(column) - 1 : -1;
}

// Fetch a patch into the cache while others are sorted: a camera's image is in no cache, and its patches are in no
// order.
void prefetch_patch(const DepthImage& image, int64_t first) {
    if (first < 0) return;
    for (int64_t row = 0; row < 3; ++row) __builtin_prefetch(image.depth_m + first + row * image.width);
}

// Return the median (the lower one of two) of the valid depths of the 3x3 patch that begins at an index, metres.  NaN
// where fewer than kMinDepths are valid, where the largest and the smallest of them differ by `spread` times the median
// or more (a depth edge), or where the median is not within min_depth_m..max_depth_m.
double median_of_patch(const DepthImage& image, int64_t first, double min_depth_m, double max_depth_m, double spread) {
    // 1. Read the depths; invalid ones become infinite, and are sorted to the end.
    float ascending[kPatch];
    int count = 0;
    for (int k = 0; k < kPatch; ++k) {
        const float depth = image.depth_m[first + k / 3 * image.width + k % 3];
        const bool is_valid = depth > 0.0f && depth <= __FLT_MAX__;
        count += is_valid ? 1 : 0;
        ascending[k] = is_valid ? depth : __builtin_inff();
    }
    if (count < kMinDepths) return not_a_number();
    // 2. Sort the nine depths.
#pragma GCC unroll 25
    for (const auto& pair : kExchanges) {
        const float a = ascending[pair[0]], b = ascending[pair[1]];
        ascending[pair[0]] = b < a ? b : a;
        ascending[pair[1]] = b < a ? a : b;
    }
    // 3. Take the median of the valid depths, and test their difference and its range.
    const double median = static_cast<double>(ascending[(count - 1) / 2]);
    const double difference = static_cast<double>(ascending[count - 1]) - static_cast<double>(ascending[0]);
    const bool is_reliable = difference < median * spread && median >= min_depth_m && median <= max_depth_m;
    return is_reliable ? median : not_a_number();
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_match_abi(void) { return RSE_PF_MATCH_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_points_at(const float* depth_m, int64_t width, int64_t height,
                                                                const double* pixels, int64_t rows, double fx,
                                                                double fy, double cx, double cy, double min_depth_m,
                                                                double max_depth_m, double spread,
                                                                double* points_camera) {
    if (depth_m == nullptr || pixels == nullptr || points_camera == nullptr || rows < 0 || rows > kMaxRows ||
        width < 1 || height < 1 || width > kMaxSide || height > kMaxSide)
        return -1;
    const DepthImage image = {depth_m, width, height};
    for (int64_t i = 0; i < rows; ++i) {
        if (i + kAhead < rows) prefetch_patch(image, first_of_patch(image, pixels + 2 * (i + kAhead)));
        const int64_t first = first_of_patch(image, pixels + 2 * i);
        const double z = first < 0 ? not_a_number() : median_of_patch(image, first, min_depth_m, max_depth_m, spread);
        points_camera[3 * i] = (pixels[2 * i] - cx) / fx * z;
        points_camera[3 * i + 1] = (pixels[2 * i + 1] - cy) / fy * z;
        points_camera[3 * i + 2] = z;
    }
    return 0;
}

__attribute__((visibility("default"))) int64_t rse_pf_match(const uint8_t* reference, int64_t reference_rows,
                                                            const uint8_t* frame, int64_t frame_rows, double ratio,
                                                            uint32_t flags, uint64_t* workspace, int64_t* rows,
                                                            int64_t* columns) {
    if (reference == nullptr || frame == nullptr || workspace == nullptr || rows == nullptr || columns == nullptr ||
        reference_rows < 0 || reference_rows > kMaxRows || frame_rows < 0 || frame_rows > kMaxRows)
        return -1;
    if (frame_rows < 2) return 0;
    uint64_t* const nearest = workspace;  // for each reference row the frame row that it chooses, or kNone
    uint64_t* const best_of_frame_row = nearest + reference_rows;  // the best candidate that chose a frame row
    const Lanes widest = (flags & RSE_PF_MATCH_PORTABLE) != 0 ? Lanes::words
                         : (flags & RSE_PF_MATCH_AVX2) != 0   ? Lanes::avx2
                                                              : Lanes::avx512;
    const Search search = prepare_search(frame, frame_rows, best_of_frame_row + frame_rows, widest);

    // 1. Each reference row chooses the nearest frame row, if the ratio test allows; a frame row keeps the nearest of
    // the reference rows that choose it.
    std::memset(best_of_frame_row, 0xff, static_cast<size_t>(frame_rows) * sizeof *best_of_frame_row);
    for (int64_t row = 0; row < reference_rows; ++row) {
        nearest[row] = kNone;
        const TwoNearest two = find_two_nearest(search, reference + kBytes * row);
        const double first = static_cast<double>(distance_of(two.first));
        if (!(first < ratio * static_cast<double>(distance_of(two.second)))) continue;
        nearest[row] = row_of(two.first);
        const uint64_t candidate = make_candidate(distance_of(two.first), static_cast<uint64_t>(row));
        if (candidate < best_of_frame_row[nearest[row]]) best_of_frame_row[nearest[row]] = candidate;
    }

    // 2. Write the pairs in which the frame row has kept the reference row that chose it, by ascending distance, by a
    // counting sort over the distances 0..256.
    int64_t starts[kBits + 2] = {};
    const auto is_matched = [&](int64_t row) {
        return nearest[row] != kNone && row_of(best_of_frame_row[nearest[row]]) == static_cast<uint64_t>(row);
    };
    for (int64_t row = 0; row < reference_rows; ++row)
        if (is_matched(row)) ++starts[distance_of(best_of_frame_row[nearest[row]]) + 1];
    for (int64_t distance = 0; distance <= kBits; ++distance) starts[distance + 1] += starts[distance];
    const int64_t count = starts[kBits + 1];
    for (int64_t row = 0; row < reference_rows; ++row) {
        if (!is_matched(row)) continue;
        const int64_t match = starts[distance_of(best_of_frame_row[nearest[row]])]++;
        rows[match] = row;
        columns[match] = static_cast<int64_t>(nearest[row]);
    }
    return count;
}
}
