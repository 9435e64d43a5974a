// What the check of a drive measures of each frame.
#include "rse_pf_check.h"

namespace {

constexpr int64_t kMaxSide = int64_t{1} << 16, kMaxRows = int64_t{1} << 24;
constexpr int64_t kWhole = 16, kFine = 2, kShortest = 48, kLevels = 256, kBorder = 2, kAhead = 16;

int step(uint8_t a, uint8_t b) { return a < b ? b - a : a - b; }

int64_t clipped(double value, int64_t least, int64_t most) {
    if (!(value > static_cast<double>(least))) return least;
    return value < static_cast<double>(most) ? static_cast<int64_t>(value) : most;
}

// A depth image, whose strides are in readings; it may be a turned view of one.
struct DepthImage {
    const float* first;
    int64_t height, width, row_stride, column_stride;

    // The reading nearest to a pixel that has neighbours on all sides.
    const float* at(const double* pixel) const {
        const int64_t column = clipped(__builtin_rint(pixel[0]), kBorder, width - 1 - kBorder);
        const int64_t row = clipped(__builtin_rint(pixel[1]), kBorder, height - 1 - kBorder);
        return first + row * row_stride + column * column_stride;
    }
};

void order(float& a, float& b) {
    const float least = a < b ? a : b;
    b = a < b ? b : a;
    a = least;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_check_abi(void) { return RSE_PF_CHECK_ABI; }

__attribute__((visibility("default"))) int64_t rse_pf_edges(const uint8_t* gray, int64_t lines, int64_t length,
                                                            int64_t strong, int64_t least_step, int64_t most,
                                                            double* sharpness) {
    if (gray == nullptr || sharpness == nullptr || lines < 1 || lines > kMaxSide || length < kShortest ||
        length > kMaxSide || strong < 1 || least_step < 1 || most < 1)
        return -1;
    int64_t counts[kLevels] = {};
    const uint8_t* line = gray;
    for (int64_t number = 0; number < lines; ++number, line += length)
        for (int64_t i = 0; i + kWhole < length; ++i) ++counts[step(line[i], line[i + kWhole])];
    int64_t limit = kLevels - 1, edges = counts[limit];
    while (limit > 0 && edges < strong) edges += counts[--limit];
    for (; limit < least_step && limit < kLevels - 1; ++limit) edges -= counts[limit];
    const int64_t every = (edges + most - 1) / most;
    int64_t seen = 0, written = 0;
    line = gray;
    for (int64_t number = 0; number < lines && edges > 0; ++number, line += length) {
        for (int64_t i = 0; i + kWhole < length; ++i) {
            const int whole = step(line[i], line[i + kWhole]);
            if (whole < limit || seen++ % every != 0) continue;
            int steepest = 0;
            for (int64_t k = i; k < i + kWhole - 1; ++k) {
                const int fine = step(line[k], line[k + kFine]);
                steepest = fine > steepest ? fine : steepest;
            }
            sharpness[written++] = static_cast<double>(steepest) / static_cast<double>(whole);
        }
    }
    return edges;
}

__attribute__((visibility("default"))) int32_t rse_pf_depths_at(const float* depth_m, int64_t height, int64_t width,
                                                                int64_t row_stride, int64_t column_stride,
                                                                const double* pixels, int64_t rows, double share,
                                                                double* depths_m) {
    if (depth_m == nullptr || pixels == nullptr || depths_m == nullptr || height <= 2 * kBorder ||
        width <= 2 * kBorder || height > kMaxSide || width > kMaxSide || rows < 0 || rows > kMaxRows)
        return -1;
    const DepthImage image = {depth_m, height, width, row_stride, column_stride};
    for (int64_t i = 0; i < rows; ++i) {
        // The image is in no cache, and its pixels lie anywhere: fetch some while others are sorted.
        if (i + kAhead < rows) {
            const float* const later = image.at(pixels + 2 * (i + kAhead));
            for (int64_t k = -kBorder; k <= kBorder; k += kBorder) __builtin_prefetch(later + k * row_stride);
        }
        const float* const at = image.at(pixels + 2 * i);
        float five[5] = {at[0], at[-kBorder * row_stride], at[kBorder * row_stride], at[-kBorder * column_stride],
                         at[kBorder * column_stride]};
        depths_m[i] = __builtin_nan("");
        if (!(five[0] > 0.0f && five[1] > 0.0f && five[2] > 0.0f && five[3] > 0.0f && five[4] > 0.0f)) continue;
        // A sorting network of nine exchanges (Knuth, TAOCP 3, sect. 5.3.4).
        order(five[0], five[1]);
        order(five[3], five[4]);
        order(five[2], five[4]);
        order(five[2], five[3]);
        order(five[0], five[3]);
        order(five[0], five[2]);
        order(five[1], five[4]);
        order(five[1], five[3]);
        order(five[1], five[2]);
        const auto middle = static_cast<double>(five[2]);
        if (static_cast<double>(five[4] - five[0]) <= share * middle && middle <= __DBL_MAX__) depths_m[i] = middle;
    }
    return 0;
}
}
