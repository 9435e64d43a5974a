// Points at keypoints, and matches of 256-bit descriptors by Hamming distance.
//
// The caller lends all memory.  The results are integers, or single IEEE operations in one order, so the
// instructions chosen below change no byte.
#include "rse_pf_match.h"

#include <cstring>

#include "match_nearest.hpp"

namespace {

using namespace rse_pf_match_detail;

constexpr int64_t kMaxRows = int64_t{1} << 24;
constexpr int64_t kMaxSide = int64_t{1} << 16;
constexpr int kPatch = 9, kLeastReadings = 5;
constexpr int64_t kAhead = 16;

double not_a_number() { return __builtin_nan(""); }

// A sorting network of 25 exchanges for nine numbers (Floyd 1964; Knuth, TAOCP 3, sect. 5.3.4): no branches.
constexpr int8_t kExchanges[][2] = {{0, 3}, {1, 7}, {2, 5}, {4, 8}, {0, 7}, {2, 4}, {3, 8}, {5, 6}, {0, 2},
                                    {1, 3}, {4, 5}, {7, 8}, {1, 4}, {3, 6}, {5, 7}, {0, 1}, {2, 4}, {3, 5},
                                    {6, 8}, {2, 3}, {4, 5}, {6, 7}, {1, 2}, {3, 4}, {5, 6}};

struct DepthImage {
    const float* depth_m;
    int64_t width, height;
};

// Return the index of the first reading of a pixel's patch, -1 if the patch is not inside.
int64_t patch_at(const DepthImage& image, const double* pixel) {
    const double column = __builtin_rint(pixel[0]), row = __builtin_rint(pixel[1]);
    const bool is_inside = column >= 1.0 && row >= 1.0 && column < static_cast<double>(image.width - 1) &&
                           row < static_cast<double>(image.height - 1);
    return is_inside ? (static_cast<int64_t>(row) - 1) * image.width + static_cast<int64_t>(column) - 1 : -1;
}

// A camera's image is in no cache, and its patches lie anywhere: fetch them while others are sorted.
void fetch(const DepthImage& image, int64_t first) {
    if (first < 0) return;
    for (int64_t row = 0; row < 3; ++row) __builtin_prefetch(image.depth_m + first + row * image.width);
}

// Return the median of the 3x3 patch that begins at an index, NaN where it cannot be trusted.
double median_of_patch(const DepthImage& image, int64_t first, double least, double most, double spread) {
    float ascending[kPatch];
    int count = 0;
    for (int k = 0; k < kPatch; ++k) {
        const float reading = image.depth_m[first + k / 3 * image.width + k % 3];
        const bool is_valid = reading > 0.0f && reading <= __FLT_MAX__;
        count += is_valid ? 1 : 0;
        ascending[k] = is_valid ? reading : __builtin_inff();
    }
    if (count < kLeastReadings) return not_a_number();
#pragma GCC unroll 25
    for (const auto& pair : kExchanges) {
        const float a = ascending[pair[0]], b = ascending[pair[1]];
        ascending[pair[0]] = b < a ? b : a;
        ascending[pair[1]] = b < a ? a : b;
    }
    const double median = static_cast<double>(ascending[(count - 1) / 2]);
    const double apart = static_cast<double>(ascending[count - 1]) - static_cast<double>(ascending[0]);
    const bool is_trusted = apart < median * spread && median >= least && median <= most;
    return is_trusted ? median : not_a_number();
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
        if (i + kAhead < rows) fetch(image, patch_at(image, pixels + 2 * (i + kAhead)));
        const int64_t first = patch_at(image, pixels + 2 * i);
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
    uint64_t* const nearest = workspace;               // of each reference row
    uint64_t* const takers = nearest + reference_rows;  // of each frame row: distance and reference row
    const Lanes most = (flags & RSE_PF_MATCH_PORTABLE) != 0 ? Lanes::words
                       : (flags & RSE_PF_MATCH_AVX2) != 0   ? Lanes::avx2
                                                            : Lanes::avx512;
    const Search search = prepared(frame, frame_rows, takers + frame_rows, most);

    std::memset(takers, 0xff, static_cast<size_t>(frame_rows) * sizeof *takers);
    for (int64_t row = 0; row < reference_rows; ++row) {
        nearest[row] = kNone;
        const Nearest found = two_nearest(search, reference + kBytes * row);
        const double first = static_cast<double>(distance_of(found.first));
        if (!(first < ratio * static_cast<double>(distance_of(found.second)))) continue;
        nearest[row] = row_of(found.first);
        const uint64_t taker = key(distance_of(found.first), static_cast<uint64_t>(row));
        if (taker < takers[nearest[row]]) takers[nearest[row]] = taker;
    }

    // The rows that kept their frame row, the nearest first: one place for each distance.
    int64_t places[kBits + 2] = {};
    const auto has_kept = [&](int64_t row) {
        return nearest[row] != kNone && row_of(takers[nearest[row]]) == static_cast<uint64_t>(row);
    };
    for (int64_t row = 0; row < reference_rows; ++row)
        if (has_kept(row)) ++places[distance_of(takers[nearest[row]]) + 1];
    for (int64_t distance = 0; distance <= kBits; ++distance) places[distance + 1] += places[distance];
    const int64_t count = places[kBits + 1];
    for (int64_t row = 0; row < reference_rows; ++row) {
        if (!has_kept(row)) continue;
        const int64_t place = places[distance_of(takers[nearest[row]])]++;
        rows[place] = row;
        columns[place] = static_cast<int64_t>(nearest[row]);
    }
    return count;
}
}
