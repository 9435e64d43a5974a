// ORB descriptors of given keypoints, equal to those of OpenCV bit by bit (Rublee et al., ORB: an efficient alternative
// to SIFT or SURF, ICCV 2011, Sect. 4).
//
// Each of the 256 bits compares the grey levels of two pixels of the smoothed image, whose positions are rotated by the
// orientation of the keypoint.  The smoothing adds floats in OpenCV's order with fused multiply-add, so processors
// without AVX2 or FMA have no implementation here; the caller uses OpenCV.
#include <cstdint>

#include "orb_pattern.hpp"
#include "processor.hpp"
#include "rse_pf_match.h"

#if defined(__x86_64__)
#include "pyramid.hpp"

#define RSE_PF_INLINE static inline __attribute__((always_inline))
#define RSE_PF_FUSED __attribute__((target("avx2,fma")))

namespace {

using rse_pf::Image, rse_pf::kMaxLevels, rse_pf::kMaxRows, rse_pf::kMaxSide, rse_pf::Pyramid, rse_pf::round_to_integer;

// Pairs of pixels that a descriptor compares: one pair for each bit.
constexpr int64_t kPairs = 256;
// Bytes of a descriptor.
constexpr int64_t kBytes = 32;
// Largest distance (px, along an axis) of a compared pixel from the keypoint at any orientation of the keypoint.
constexpr int64_t kPatternReach = 19;
// Pixels that the Gaussian smoothing reads on each side of a pixel.
constexpr int64_t kBlurRadius = 3;
// Smallest distance (px) of a keypoint from the border of its level: the rotated pattern and the smoothing must stay
// inside.
constexpr int64_t kReach = kPatternReach + kBlurRadius;
// Number of weights of the Gaussian smoothing along an axis: 3 pixels on each side, and the middle one.
constexpr int64_t kTaps = 7;
// Weights of the Gaussian smoothing, with a standard deviation of 2 px, in the rounding of OpenCV.
constexpr float kGauss[kTaps] = {0x1.1f5f62p-4f, 0x1.0c70fcp-3f, 0x1.869472p-3f, 0x1.ba95cp-3f,
                                 0x1.869472p-3f, 0x1.0c70fcp-3f, 0x1.1f5f62p-4f};

struct Workspace {
    Pyramid pyramid;
    float* lines;      // kTaps rows after horizontal smoothing, and one row of pixels as floats
    uint8_t* smoothed; // the smoothed level
};

// A part of an image: columns [left, right) and rows [top, bottom).
struct Box {
    int64_t left, top, right, bottom;
};

// Smooth the box of an image, which has at least kBlurRadius pixels around it, and write it to the same place of `to`,
// an image of the same size.  OpenCV's order of the sums: horizontally from the first weight on, then vertically from
// the middle weight outwards.
RSE_PF_INLINE void smooth(const Image& image, const Box& box, uint8_t* to, const Workspace& work) {
    const int64_t w = image.width, box_width = box.right - box.left;
    float* __restrict const pixel_line = work.lines + kTaps * w;
    for (int64_t y = box.top - kBlurRadius; y < box.bottom + kBlurRadius; ++y) {
        const uint8_t* const pixels = image.pixels + y * w + box.left - kBlurRadius;
        for (int64_t x = 0; x < box_width + 2 * kBlurRadius; ++x) pixel_line[x] = static_cast<float>(pixels[x]);
        float* __restrict const line = work.lines + y % kTaps * w;
        for (int64_t x = 0; x < box_width; ++x) {
            const float* const at = pixel_line + x;
            float sum = kGauss[0] * at[0];
            sum = __builtin_fmaf(kGauss[1], at[1], sum);
            sum = __builtin_fmaf(kGauss[2], at[2], sum);
            sum = __builtin_fmaf(kGauss[3], at[3], sum);
            sum = __builtin_fmaf(kGauss[4], at[4], sum);
            sum = __builtin_fmaf(kGauss[5], at[5], sum);
            line[x] = __builtin_fmaf(kGauss[6], at[6], sum);
        }
        if (y < box.top + kBlurRadius) continue;
        const float* tap[kTaps];
        for (int64_t k = 0; k < kTaps; ++k) tap[k] = work.lines + (y + 1 + k) % kTaps * w;
        uint8_t* __restrict const out = to + (y - kBlurRadius) * w + box.left;
        for (int64_t x = 0; x < box_width; ++x) {
            float sum = kGauss[3] * tap[3][x];
            sum = __builtin_fmaf(kGauss[4], tap[4][x] + tap[2][x], sum);
            sum = __builtin_fmaf(kGauss[5], tap[5][x] + tap[1][x], sum);
            sum = __builtin_fmaf(kGauss[6], tap[6][x] + tap[0][x], sum);
            out[x] = static_cast<uint8_t>(static_cast<int32_t>(__builtin_rintf(sum)));
        }
    }
}

// Write the 32 bytes of the descriptor of a keypoint at the pixel `centre` of a smoothed image with `width` columns.
// cosine, sine: of the keypoint's orientation.
RSE_PF_INLINE void write_descriptor(const uint8_t* centre, int64_t width, float cosine, float sine,
                                    uint8_t* descriptor) {
    // 1. Rotate the pattern by the orientation, and round it to whole pixels.
    int32_t offsets[2 * kPairs];
    const float row_step = static_cast<float>(width);
    for (int64_t k = 0; k < 2 * kPairs; ++k) {
        const float x = __builtin_rintf(kPatternX[k] * cosine - kPatternY[k] * sine);
        const float y = __builtin_rintf(kPatternX[k] * sine + kPatternY[k] * cosine);
        offsets[k] = static_cast<int32_t>(y * row_step + x);  // exact, since it is below 2^24
    }
    // 2. Set bit k if pixel k of the pattern is darker than pixel k + 256.
    for (int64_t byte = 0; byte < kBytes; ++byte) {
        uint32_t bits = 0;
        for (int64_t bit = 0; bit < 8; ++bit) {
            const int64_t k = 8 * byte + bit;
            bits |= static_cast<uint32_t>(centre[offsets[k]] < centre[offsets[k + kPairs]]) << bit;
        }
        descriptor[byte] = static_cast<uint8_t>(bits);
    }
}

struct Keypoints {
    const float *pixels, *cosines, *sines;
    const int32_t* octaves;
    int64_t rows;
};

// Return the index of a keypoint's pixel in its level, -1 if it is within kReach of the border.  `image` is the level,
// `pixel` that of the whole image, `inverse` the inverse scale of the level.
RSE_PF_INLINE int64_t index_in_level(const Image& image, const float* pixel, float inverse) {
    const float x = pixel[0] * inverse, y = pixel[1] * inverse;
    constexpr float kMaxCoordinate = static_cast<float>(kMaxSide);
    if (!(x >= 0.0f && y >= 0.0f && x <= kMaxCoordinate && y <= kMaxCoordinate)) return -1;
    const int64_t column = round_to_integer(x), row = round_to_integer(y);
    const bool is_inside =
        column >= kReach && row >= kReach && column < image.width - kReach && row < image.height - kReach;
    return is_inside ? row * image.width + column : -1;
}

// Write the descriptors of the keypoints of one level, each to its row of `descriptors`.  Return false, without
// writing, if one of them lies within kReach of the border, or has a cosine and sine that are not those of an angle.
RSE_PF_INLINE bool describe_level(const Image& image, const Keypoints& keypoints, int32_t octave, float scale,
                            const Workspace& work, uint8_t* descriptors) {
    const float inverse = 1.0f / scale;
    // 1. Find the part of the level that the keypoints read.
    Box box = {image.width, image.height, 0, 0};
    for (int64_t i = 0; i < keypoints.rows; ++i) {
        if (keypoints.octaves[i] != octave) continue;
        const int64_t index = index_in_level(image, keypoints.pixels + 2 * i, inverse);
        const float cosine = keypoints.cosines[i], sine = keypoints.sines[i];
        if (index < 0 || !(cosine * cosine + sine * sine < 1.001f)) return false;
        const int64_t column = index % image.width, row = index / image.width;
        box.left = column - kPatternReach < box.left ? column - kPatternReach : box.left;
        box.top = row - kPatternReach < box.top ? row - kPatternReach : box.top;
        box.right = column + kPatternReach >= box.right ? column + kPatternReach + 1 : box.right;
        box.bottom = row + kPatternReach >= box.bottom ? row + kPatternReach + 1 : box.bottom;
    }
    if (box.right == 0) return true;
    // 2. Smooth this part, and write the descriptors.
    smooth(image, box, work.smoothed, work);
    for (int64_t i = 0; i < keypoints.rows; ++i) {
        if (keypoints.octaves[i] != octave) continue;
        write_descriptor(work.smoothed + index_in_level(image, keypoints.pixels + 2 * i, inverse), image.width,
                         keypoints.cosines[i], keypoints.sines[i], descriptors + kBytes * i);
    }
    return true;
}

RSE_PF_FUSED int32_t describe_all(Image image, const float* scales, int32_t levels, const Keypoints& keypoints,
                                   Workspace work, uint8_t* descriptors) {
    const Image whole = image;
    int32_t last = 0;
    for (int64_t row = 0; row < keypoints.rows; ++row) {
        const int32_t octave = keypoints.octaves[row];
        if (octave < 0 || octave >= levels) return -1;
        last = octave > last ? octave : last;
    }
    for (int32_t level = 0; level <= last; ++level) {
        if (!(scales[level] >= 1.0f && scales[level] < 1e4f)) return -1;
        if (level > 0 && !work.pyramid.shrink(image, whole, scales[level])) return -1;
        if (!describe_level(image, keypoints, level, scales[level], work, descriptors)) return -1;
    }
    return 0;
}

}  // namespace
#else
#pragma GCC diagnostic ignored "-Wunused-parameter"  // Other processors have no implementation: the caller uses OpenCV.
#endif

extern "C" __attribute__((visibility("default"))) int32_t rse_pf_describe(
    const uint8_t* gray, int64_t width, int64_t height, const float* scales, int32_t levels, const float* pixels,
    const float* cosines, const float* sines, const int32_t* octaves, int64_t rows, uint64_t* workspace,
    uint8_t* descriptors) {
#if defined(__x86_64__)
    if (gray == nullptr || scales == nullptr || pixels == nullptr || cosines == nullptr || sines == nullptr ||
        octaves == nullptr || workspace == nullptr || descriptors == nullptr || width < 2 || height < 2 ||
        width > kMaxSide || height > kMaxSide || levels < 1 || levels > kMaxLevels || rows < 0 || rows > kMaxRows ||
        !rse_pf::processor().avx2 || !rse_pf::processor().fma)
        return -1;
    Workspace work;
    uint8_t* const rest = work.pyramid.divide_workspace(workspace, width, height);
    work.lines = reinterpret_cast<float*>(rest);
    work.smoothed = rest + (kTaps + 1) * width * static_cast<int64_t>(sizeof(float));
    return describe_all({gray, width, height}, scales, levels, {pixels, cosines, sines, octaves, rows}, work,
                        descriptors);
#else
    return -1;
#endif
}
