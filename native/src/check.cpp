// The measurements that `rse-pf check` takes of each recorded image: edge sharpness, and depths at features.
#include "rse_pf_check.h"

namespace {

// Largest height or width of an image, pixels: a limit of plausible requests.
constexpr int64_t kMaxSide = int64_t{1} << 16;
// Most pixels at which depths are read in one call: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Distance (px) along the line over which the contrast of an edge is measured: wider than a blurred edge.
constexpr int64_t kContrastPx = 16;
// Distance (px) over which the steepest part of an edge is measured.
constexpr int64_t kSlopePx = 2;
// Shortest row of an image (px) along which edge sharpness is measured: three times kContrastPx.  An image with shorter
// rows is refused.
constexpr int64_t kMinLength = 48;
// Number of grey levels of a pixel, and so of contrasts.
constexpr int64_t kLevels = 256;
// Distance (px) of the four neighbours of a pixel whose depths join the median: near enough to show the same surface.
constexpr int64_t kNeighbourPx = 2;
// Number of requested pixels by which memory is fetched ahead, so that the depths are in the cache when they are
// needed.
constexpr int64_t kAhead = 16;

int absolute_difference(uint8_t a, uint8_t b) { return a < b ? b - a : a - b; }

int64_t clip(double value, int64_t low, int64_t high) {
    if (!(value > static_cast<double>(low))) return low;
    return value < static_cast<double>(high) ? static_cast<int64_t>(value) : high;
}

// A depth image with strides in numbers, not bytes; it may be a rotated view of another array.
struct DepthImage {
    const float* first;
    int64_t height, width, row_stride, column_stride;

    // Return the address of the depth nearest to a pixel, moved inwards so that all four neighbours exist.
    const float* at(const double* pixel) const {
        const int64_t column = clip(__builtin_rint(pixel[0]), kNeighbourPx, width - 1 - kNeighbourPx);
        const int64_t row = clip(__builtin_rint(pixel[1]), kNeighbourPx, height - 1 - kNeighbourPx);
        return first + row * row_stride + column * column_stride;
    }
};

// Exchange two numbers in place unless they are in ascending order.
void sort_two(float& a, float& b) {
    const float smaller = a < b ? a : b;
    b = a < b ? b : a;
    a = smaller;
}

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_check_abi(void) { return RSE_PF_CHECK_ABI; }

__attribute__((visibility("default"))) int64_t rse_pf_edges(const uint8_t* gray, int64_t lines, int64_t length,
                                                            int64_t wanted_edges, int64_t min_contrast,
                                                            int64_t max_edges, double* sharpness) {
    if (gray == nullptr || sharpness == nullptr || lines < 1 || lines > kMaxSide || length < kMinLength ||
        length > kMaxSide || wanted_edges < 1 || min_contrast < 1 || max_edges < 1)
        return -1;
    // 1. Count the pixels of all lines by their contrast.
    int64_t counts[kLevels] = {};
    const uint8_t* line = gray;
    for (int64_t number = 0; number < lines; ++number, line += length)
        for (int64_t i = 0; i + kContrastPx < length; ++i)
            ++counts[absolute_difference(line[i], line[i + kContrastPx])];
    // 2. Lower the threshold until enough pixels reach it, then raise it to the smallest contrast that counts.
    int64_t threshold = kLevels - 1, edges = counts[threshold];
    while (threshold > 0 && edges < wanted_edges) edges += counts[--threshold];
    for (; threshold < min_contrast && threshold < kLevels - 1; ++threshold) edges -= counts[threshold];
    // 3. Measure the sharpness of every n-th edge, so that at most max_edges are written.
    const int64_t every_nth = (edges + max_edges - 1) / max_edges;
    int64_t visited = 0, written = 0;
    line = gray;
    for (int64_t number = 0; number < lines && edges > 0; ++number, line += length) {
        for (int64_t i = 0; i + kContrastPx < length; ++i) {
            const int contrast = absolute_difference(line[i], line[i + kContrastPx]);
            if (contrast < threshold || visited++ % every_nth != 0) continue;
            int steepest = 0;
            for (int64_t k = i; k < i + kContrastPx - 1; ++k) {
                const int slope = absolute_difference(line[k], line[k + kSlopePx]);
                steepest = slope > steepest ? slope : steepest;
            }
            sharpness[written++] = static_cast<double>(steepest) / static_cast<double>(contrast);
        }
    }
    return edges;
}

__attribute__((visibility("default"))) int32_t rse_pf_depths_at(const float* depth_m, int64_t height, int64_t width,
                                                                int64_t row_stride, int64_t column_stride,
                                                                const double* pixels, int64_t rows,
                                                                double max_difference, double* depths_m) {
    if (depth_m == nullptr || pixels == nullptr || depths_m == nullptr || height <= 2 * kNeighbourPx ||
        width <= 2 * kNeighbourPx || height > kMaxSide || width > kMaxSide || rows < 0 || rows > kMaxRows)
        return -1;
    const DepthImage image = {depth_m, height, width, row_stride, column_stride};
    for (int64_t i = 0; i < rows; ++i) {
        // 1. Fetch the depths of a later pixel: the image is in no cache, and its pixels are in no order.
        if (i + kAhead < rows) {
            const float* const later = image.at(pixels + 2 * (i + kAhead));
            for (int64_t k = -kNeighbourPx; k <= kNeighbourPx; k += kNeighbourPx) __builtin_prefetch(later + k * row_stride);
        }
        // 2. Read the depths of the pixel and of its four neighbours; all five must be valid.
        const float* const at = image.at(pixels + 2 * i);
        float five[5] = {at[0], at[-kNeighbourPx * row_stride], at[kNeighbourPx * row_stride],
                         at[-kNeighbourPx * column_stride], at[kNeighbourPx * column_stride]};
        depths_m[i] = __builtin_nan("");
        if (!(five[0] > 0.0f && five[1] > 0.0f && five[2] > 0.0f && five[3] > 0.0f && five[4] > 0.0f)) continue;
        // 3. Sort them by a network of nine exchanges (Knuth, TAOCP 3, Sect. 5.3.4), and take the median, unless they
        // differ too much.
        sort_two(five[0], five[1]);
        sort_two(five[3], five[4]);
        sort_two(five[2], five[4]);
        sort_two(five[2], five[3]);
        sort_two(five[0], five[3]);
        sort_two(five[0], five[2]);
        sort_two(five[1], five[4]);
        sort_two(five[1], five[3]);
        sort_two(five[1], five[2]);
        const auto median = static_cast<double>(five[2]);
        if (static_cast<double>(five[4] - five[0]) <= max_difference * median && median <= __DBL_MAX__)
            depths_m[i] = median;
    }
    return 0;
}
}
