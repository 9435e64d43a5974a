// ORB's descriptors of keypoints that were found elsewhere, bit by bit those of OpenCV.
//
// Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, sect. 4: each bit compares the smoothed
// image at two places that turn with the keypoint.  The levels of the pyramid are integers; the smoothing adds
// floats in OpenCV's order, each product and sum rounded once.  So only processors that can do so (AVX2, FMA) have
// these descriptors, and all others leave them to OpenCV.
#include <cstdint>
#include <cstring>

#include "orb_pattern.hpp"
#include "processor.hpp"
#include "rse_pf_match.h"

#if defined(__x86_64__)
#include <smmintrin.h>

#define RSE_PF_INLINE static inline __attribute__((always_inline))
#define RSE_PF_FUSED __attribute__((target("avx2,fma")))

namespace {

constexpr int64_t kMaxSide = int64_t{1} << 14, kMaxRows = int64_t{1} << 24;
constexpr int32_t kMaxLevels = 32;
constexpr int64_t kPairs = 256, kBytes = 32;
// The farthest place, turned by any angle, and the smoothing around it.
constexpr int64_t kTurned = 19, kBlur = 3, kReach = kTurned + kBlur;
constexpr int64_t kTaps = 7, kEightBytes = 80;
// A Gaussian of 2 px, as OpenCV computes it.
constexpr float kGauss[kTaps] = {0x1.1f5f62p-4f, 0x1.0c70fcp-3f, 0x1.869472p-3f, 0x1.ba95cp-3f,
                                 0x1.869472p-3f, 0x1.0c70fcp-3f, 0x1.1f5f62p-4f};

struct Image {
    const uint8_t* pixels;
    int64_t width, height;
};

// How a line is made shorter: for each output pixel the first of two input pixels, and the share of the second.
struct Shares {
    int32_t* from;
    uint16_t* share;
};

struct Workspace {
    uint8_t *level, *next, *smooth;
    float* lines;  // kTaps + 1
    Shares across;
    uint16_t *above, *under;  // shortened lines
    uint8_t* eights;          // for eight output pixels each
};

int64_t rounded(float value) { return static_cast<int64_t>(__builtin_rintf(value)); }

// Where an output pixel lies between two input pixels: the first one, and the share of the second in 256.
void between(int64_t at, double scale, int64_t size, int64_t& from, uint16_t& share) {
    const double place = scale * (static_cast<double>(at) + 0.5) - 0.5;
    const double below = __builtin_floor(place);
    from = below < 0.0 ? 0 : static_cast<int64_t>(below);
    share = below < 0.0 ? uint16_t{0} : static_cast<uint16_t>(__builtin_rint((place - below) * 256.0));
    if (from >= size - 1) {
        from = size - 2;
        share = 256;
    }
}

void shorten(const uint8_t* line, const Shares& shares, int64_t width, uint16_t* to) {
    for (int64_t x = 0; x < width; ++x) {
        const uint8_t* const at = line + shares.from[x];
        to[x] = static_cast<uint16_t>(at[0] * (256 - shares.share[x]) + at[1] * shares.share[x]);
    }
}

void blend(const uint16_t* above, const uint16_t* under, uint32_t share, int64_t begin, int64_t width, uint8_t* to) {
    for (int64_t x = begin; x < width; ++x)
        to[x] = static_cast<uint8_t>((above[x] * (256 - share) + under[x] * share + 32768) >> 16);
}

// What eight neighbours of a shortened line need: 16 bytes that hold all their pixels, where the pixels are in
// them, and their shares.
struct Eight {
    int64_t base, at;
    __m128i places[2], shares[2];
};
static_assert(sizeof(Eight) == kEightBytes);

// Return how many eights make the line, the last one beside its end; 0 if they cannot.
int64_t eights_of(const Shares& shares, int64_t width, int64_t size, Eight* eights) {
    if (width < 8 || size < 16) return 0;
    const int64_t count = (width + 7) / 8;
    for (int64_t i = 0; i < count; ++i) {
        Eight& each = eights[i];
        each.at = 8 * i < width - 8 ? 8 * i : width - 8;
        each.base = shares.from[each.at] < size - 16 ? shares.from[each.at] : size - 16;
        for (int64_t half = 0; half < 2; ++half) {
            int8_t places[16];
            int16_t parts[8];
            for (int64_t k = 0; k < 4; ++k) {
                const int64_t x = each.at + 4 * half + k, place = shares.from[x] - each.base;
                if (place < 0 || place > 14) return 0;
                places[4 * k] = static_cast<int8_t>(place);
                places[4 * k + 2] = static_cast<int8_t>(place + 1);
                places[4 * k + 1] = places[4 * k + 3] = -1;  // zero
                parts[2 * k] = static_cast<int16_t>(256 - shares.share[x]);
                parts[2 * k + 1] = static_cast<int16_t>(shares.share[x]);
            }
            std::memcpy(&each.places[half], places, sizeof places);
            std::memcpy(&each.shares[half], parts, sizeof parts);
        }
    }
    return count;
}

void shorten(const uint8_t* line, const Eight* eights, int64_t count, uint16_t* to) {
    for (int64_t i = 0; i < count; ++i) {
        const Eight& each = eights[i];
        __m128i pixels;
        std::memcpy(&pixels, line + each.base, sizeof pixels);
        const __m128i low = _mm_madd_epi16(_mm_shuffle_epi8(pixels, each.places[0]), each.shares[0]);
        const __m128i high = _mm_madd_epi16(_mm_shuffle_epi8(pixels, each.places[1]), each.shares[1]);
        const __m128i both = _mm_packus_epi32(low, high);
        std::memcpy(to + each.at, &both, sizeof both);
    }
}

// As the loop above, eight at a time; a number less 2^15 has a sign, so that two products are added at once.
int64_t blend_eights(const uint16_t* above, const uint16_t* under, uint32_t share, int64_t width, uint8_t* to) {
    const __m128i parts = _mm_set1_epi32(static_cast<int32_t>((256 - share) | share << 16));
    const __m128i sign = _mm_set1_epi16(-32768), back = _mm_set1_epi32((256 << 15) + 32768);
    int64_t x = 0;
    for (; x + 8 <= width; x += 8) {
        __m128i a, b;
        std::memcpy(&a, above + x, sizeof a);
        std::memcpy(&b, under + x, sizeof b);
        a = _mm_xor_si128(a, sign);
        b = _mm_xor_si128(b, sign);
        const __m128i low = _mm_add_epi32(_mm_madd_epi16(_mm_unpacklo_epi16(a, b), parts), back);
        const __m128i high = _mm_add_epi32(_mm_madd_epi16(_mm_unpackhi_epi16(a, b), parts), back);
        const __m128i halves = _mm_packus_epi32(_mm_srli_epi32(low, 16), _mm_srli_epi32(high, 16));
        const __m128i bytes = _mm_packus_epi16(halves, halves);
        std::memcpy(to + x, &bytes, 8);
    }
    return x;
}

// Linear interpolation in parts of 256, rounded once.
void resize(const Image& image, uint8_t* to, int64_t width, int64_t height, const Workspace& work) {
    const double across = 1.0 / (static_cast<double>(width) / static_cast<double>(image.width));
    const double down = 1.0 / (static_cast<double>(height) / static_cast<double>(image.height));
    for (int64_t x = 0; x < width; ++x) {
        int64_t from;
        between(x, across, image.width, from, work.across.share[x]);
        work.across.from[x] = static_cast<int32_t>(from);
    }
    Eight* const each = reinterpret_cast<Eight*>(work.eights);
    const int64_t eights = eights_of(work.across, width, image.width, each);
    const auto shortened = [&](int64_t row, uint16_t* line) {
        const uint8_t* const pixels = image.pixels + row * image.width;
        if (eights > 0) return shorten(pixels, each, eights, line);
        return shorten(pixels, work.across, width, line);
    };
    uint16_t *above = work.above, *under = work.under;
    int64_t held = -1;  // the row that `under` holds
    for (int64_t y = 0; y < height; ++y) {
        int64_t row;
        uint16_t share;
        between(y, down, image.height, row, share);
        if (held != row + 1) {
            if (held == row) {
                uint16_t* const free = above;
                above = under;
                under = free;
            } else {
                shortened(row, above);
            }
            shortened(row + 1, under);
            held = row + 1;
        }
        const int64_t done = blend_eights(above, under, share, width, to + y * width);
        blend(above, under, share, done, width, to + y * width);
    }
}

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
    const float width = static_cast<float>(image.width), height = static_cast<float>(image.height);
    int32_t last = 0;
    for (int64_t row = 0; row < keypoints.rows; ++row) {
        const int32_t octave = keypoints.octaves[row];
        if (octave < 0 || octave >= levels) return -1;
        last = octave > last ? octave : last;
    }
    for (int32_t level = 0; level <= last; ++level) {
        if (!(scales[level] >= 1.0f && scales[level] < 1e4f)) return -1;
        if (level > 0) {
            const float inverse = 1.0f / scales[level];
            const int64_t w = rounded(width * inverse), h = rounded(height * inverse);
            if (w < 2 || h < 2 || w > image.width || h > image.height) return -1;
            resize(image, work.next, w, h, work);
            image = {work.next, w, h};
            uint8_t* const free = work.level;
            work.level = work.next;
            work.next = free;
        }
        if (!describe(image, keypoints, level, scales[level], work, descriptors)) return -1;
    }
    return 0;
}

}  // namespace
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
    // The widest numbers first, so that all are aligned: eights to 16 bytes, then numbers of 4, 2 and 1.
    Workspace work;
    work.eights = reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(workspace) + 15) / 16 * 16);
    work.lines = reinterpret_cast<float*>(work.eights + kEightBytes * (width / 8 + 1));
    work.across.from = reinterpret_cast<int32_t*>(work.lines + (kTaps + 1) * width);
    work.across.share = reinterpret_cast<uint16_t*>(work.across.from + width);
    work.above = work.across.share + width;
    work.under = work.above + width;
    work.level = reinterpret_cast<uint8_t*>(work.under + width);
    work.next = work.level + width * height;
    work.smooth = work.next + width * height;
    return describe_all({gray, width, height}, scales, levels, {pixels, cosines, sines, octaves, rows}, work,
                        descriptors);
#else
    // Not written for other processors yet: the caller describes with OpenCV.
    const void* const unused[] = {gray, scales, pixels, cosines, sines, octaves, workspace, descriptors};
    static_cast<void>(unused);
    static_cast<void>(width + height + levels + rows);
    return -1;
#endif
}
