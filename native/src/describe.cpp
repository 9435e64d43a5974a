// ORB's descriptors of keypoints that were found elsewhere, bit by bit those of OpenCV.
//
// Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, sect. 4: each bit compares the smoothed
// image at two places that turn with the keypoint.  The levels of the pyramid are integers; the smoothing adds
// floats in OpenCV's order, each product and sum rounded once.  So only processors that can do so (AVX2, FMA) have
// these descriptors, and all others leave them to OpenCV.
#include <cstdint>

#include "orb_pattern.hpp"
#include "processor.hpp"
#include "rse_pf_match.h"

#if defined(__x86_64__)
#include "pyramid.hpp"

#define RSE_PF_INLINE static inline __attribute__((always_inline))
#define RSE_PF_FUSED __attribute__((target("avx2,fma")))

namespace {

using rse_pf::Image, rse_pf::kMaxLevels, rse_pf::kMaxRows, rse_pf::kMaxSide, rse_pf::Pyramid, rse_pf::rounded;

constexpr int64_t kPairs = 256, kBytes = 32;
// The farthest place, turned by any angle, and the smoothing around it.
constexpr int64_t kTurned = 19, kBlur = 3, kReach = kTurned + kBlur;
constexpr int64_t kTaps = 7;
// A Gaussian of 2 px, as OpenCV computes it.
constexpr float kGauss[kTaps] = {0x1.1f5f62p-4f, 0x1.0c70fcp-3f, 0x1.869472p-3f, 0x1.ba95cp-3f,
                                 0x1.869472p-3f, 0x1.0c70fcp-3f, 0x1.1f5f62p-4f};

struct Workspace {
    Pyramid pyramid;
    float* lines;  // kTaps + 1
    uint8_t* smooth;
};

// Part of an image: from the first row and column to before the last ones.
struct Box {
    int64_t left, top, right, bottom;
};

// Smooth a box that leaves three pixels on each side: along each row from the left, then down from the middle tap.
RSE_PF_INLINE void smooth(const Image& image, const Box& box, uint8_t* to, const Workspace& work) {
    const int64_t w = image.width, inner = box.right - box.left;
    float* __restrict const plain = work.lines + kTaps * w;
    for (int64_t y = box.top - kBlur; y < box.bottom + kBlur; ++y) {
        const uint8_t* const pixels = image.pixels + y * w + box.left - kBlur;
        for (int64_t x = 0; x < inner + 2 * kBlur; ++x) plain[x] = static_cast<float>(pixels[x]);
        float* __restrict const line = work.lines + y % kTaps * w;
        for (int64_t x = 0; x < inner; ++x) {
            const float* const at = plain + x;
            float sum = kGauss[0] * at[0];
            sum = __builtin_fmaf(kGauss[1], at[1], sum);
            sum = __builtin_fmaf(kGauss[2], at[2], sum);
            sum = __builtin_fmaf(kGauss[3], at[3], sum);
            sum = __builtin_fmaf(kGauss[4], at[4], sum);
            sum = __builtin_fmaf(kGauss[5], at[5], sum);
            line[x] = __builtin_fmaf(kGauss[6], at[6], sum);
        }
        if (y < box.top + kBlur) continue;
        const float* tap[kTaps];
        for (int64_t k = 0; k < kTaps; ++k) tap[k] = work.lines + (y + 1 + k) % kTaps * w;
        uint8_t* __restrict const out = to + (y - kBlur) * w + box.left;
        for (int64_t x = 0; x < inner; ++x) {
            float sum = kGauss[3] * tap[3][x];
            sum = __builtin_fmaf(kGauss[4], tap[4][x] + tap[2][x], sum);
            sum = __builtin_fmaf(kGauss[5], tap[5][x] + tap[1][x], sum);
            sum = __builtin_fmaf(kGauss[6], tap[6][x] + tap[0][x], sum);
            out[x] = static_cast<uint8_t>(static_cast<int32_t>(__builtin_rintf(sum)));
        }
    }
}

// Compare the pairs around a place of a smoothed image.
RSE_PF_INLINE void compare(const uint8_t* centre, int64_t width, float cosine, float sine, uint8_t* descriptor) {
    int32_t places[2 * kPairs];
    const float step = static_cast<float>(width);
    for (int64_t k = 0; k < 2 * kPairs; ++k) {
        const float x = __builtin_rintf(kPatternX[k] * cosine - kPatternY[k] * sine);
        const float y = __builtin_rintf(kPatternX[k] * sine + kPatternY[k] * cosine);
        places[k] = static_cast<int32_t>(y * step + x);  // exact: below 2^24
    }
    for (int64_t byte = 0; byte < kBytes; ++byte) {
        uint32_t bits = 0;
        for (int64_t bit = 0; bit < 8; ++bit) {
            const int64_t k = 8 * byte + bit;
            bits |= static_cast<uint32_t>(centre[places[k]] < centre[places[k + kPairs]]) << bit;
        }
        descriptor[byte] = static_cast<uint8_t>(bits);
    }
}

struct Keypoints {
    const float *pixels, *cosines, *sines;
    const int32_t* octaves;
    int64_t rows;
};

// Return the index of a keypoint's pixel in its level, -1 if that is too near to the edge.
RSE_PF_INLINE int64_t place_of(const Image& image, const float* pixel, float inverse) {
    const float x = pixel[0] * inverse, y = pixel[1] * inverse;
    constexpr float kMost = static_cast<float>(kMaxSide);
    if (!(x >= 0.0f && y >= 0.0f && x <= kMost && y <= kMost)) return -1;
    const int64_t column = rounded(x), row = rounded(y);
    const bool is_inside =
        column >= kReach && row >= kReach && column < image.width - kReach && row < image.height - kReach;
    return is_inside ? row * image.width + column : -1;
}

// Describe the keypoints of one level; say whether all of them lie far enough inside.
RSE_PF_INLINE bool describe(const Image& image, const Keypoints& keypoints, int32_t octave, float scale,
                            const Workspace& work, uint8_t* descriptors) {
    const float inverse = 1.0f / scale;
    Box box = {image.width, image.height, 0, 0};
    for (int64_t i = 0; i < keypoints.rows; ++i) {
        if (keypoints.octaves[i] != octave) continue;
        const int64_t place = place_of(image, keypoints.pixels + 2 * i, inverse);
        const float cosine = keypoints.cosines[i], sine = keypoints.sines[i];
        if (place < 0 || !(cosine * cosine + sine * sine < 1.001f)) return false;
        const int64_t column = place % image.width, row = place / image.width;
        box.left = column - kTurned < box.left ? column - kTurned : box.left;
        box.top = row - kTurned < box.top ? row - kTurned : box.top;
        box.right = column + kTurned >= box.right ? column + kTurned + 1 : box.right;
        box.bottom = row + kTurned >= box.bottom ? row + kTurned + 1 : box.bottom;
    }
    if (box.right == 0) return true;
    smooth(image, box, work.smooth, work);
    for (int64_t i = 0; i < keypoints.rows; ++i) {
        if (keypoints.octaves[i] != octave) continue;
        compare(work.smooth + place_of(image, keypoints.pixels + 2 * i, inverse), image.width, keypoints.cosines[i],
                keypoints.sines[i], descriptors + kBytes * i);
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
        if (!describe(image, keypoints, level, scales[level], work, descriptors)) return -1;
    }
    return 0;
}

}  // namespace
#else
#pragma GCC diagnostic ignored "-Wunused-parameter"  // not written for other processors: the caller uses OpenCV
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
    uint8_t* const rest = work.pyramid.lend(workspace, width, height);
    work.lines = reinterpret_cast<float*>(rest);
    work.smooth = rest + (kTaps + 1) * width * static_cast<int64_t>(sizeof(float));
    return describe_all({gray, width, height}, scales, levels, {pixels, cosines, sines, octaves, rows}, work,
                        descriptors);
#else
    return -1;
#endif
}
