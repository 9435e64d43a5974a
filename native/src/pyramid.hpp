// The levels of ORB's image pyramid, equal bit by bit to OpenCV's (cv::resize with INTER_LINEAR_EXACT): bilinear
// interpolation in fixed-point numbers, with weights in 1/256.
#pragma once

#include <smmintrin.h>

#include <cstdint>
#include <cstring>

namespace rse_pf {

// Largest height or width of an image, pixels: the index of a pixel then fits into 32 bits.
constexpr int64_t kMaxSide = int64_t{1} << 14;
// Most keypoints of one call: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Most levels of a pyramid: a limit of plausible requests; ORB has eight.
constexpr int32_t kMaxLevels = 32;
// Size of an EightPixels in bytes: the caller, who provides the memory, counts with it.
constexpr int64_t kEightPixelsBytes = 80;

// Grey levels, height x width, row-major.
struct Image {
    const uint8_t* pixels;
    int64_t width, height;
};

// Horizontal interpolation: for each output pixel the first of two neighbouring input pixels, and the weight of the
// second in 1/256.
struct Weights {
    int32_t* from;
    uint16_t* weight;
};

// Memory for the computation of one level, with room for the width of the whole image.
struct ResizeMemory {
    Weights columns;
    uint16_t *above, *below;  // two input lines after horizontal interpolation, in 1/256 grey levels
    uint8_t* eights;          // EightPixels of a line
};

// Return the nearest integer; halves go to the even one.
inline int64_t round_to_integer(float value) { return static_cast<int64_t>(__builtin_rintf(value)); }

// Find the two neighbouring input pixels (or lines) between which output pixel `at` lies: the first one is written to
// `from`, the weight of the second in 1/256 to `weight`.  `scale` is the input size over the output size, `size` the
// input size, which is at least 2.
inline void find_neighbours(int64_t at, double scale, int64_t size, int64_t& from, uint16_t& weight) {
    const double position = scale * (static_cast<double>(at) + 0.5) - 0.5;
    const double whole = __builtin_floor(position);
    from = whole < 0.0 ? 0 : static_cast<int64_t>(whole);
    weight = whole < 0.0 ? uint16_t{0} : static_cast<uint16_t>(__builtin_rint((position - whole) * 256.0));
    if (from >= size - 1) {
        from = size - 2;
        weight = 256;
    }
}

// Interpolate a line horizontally, one pixel at a time, and write the `width` output pixels in 1/256 grey levels.
inline void interpolate_line(const uint8_t* line, const Weights& weights, int64_t width, uint16_t* to) {
    for (int64_t x = 0; x < width; ++x) {
        const uint8_t* const at = line + weights.from[x];
        to[x] = static_cast<uint16_t>(at[0] * (256 - weights.weight[x]) + at[1] * weights.weight[x]);
    }
}

// Interpolate vertically between two lines, one pixel at a time, from column `begin` on.  `weight` is that of the line
// below, in 1/256.
inline void blend_lines(const uint16_t* above, const uint16_t* below, uint32_t weight, int64_t begin, int64_t width,
                        uint8_t* to) {
    for (int64_t x = begin; x < width; ++x)
        to[x] = static_cast<uint8_t>((above[x] * (256 - weight) + below[x] * weight + 32768) >> 16);
}

// The horizontal interpolation of eight neighbouring output pixels by SSE: `base` is the first of 16 input bytes that
// hold all their neighbours, `at` the first output pixel; `positions` selects the bytes, `weights` weighs them.
struct EightPixels {
    int64_t base, at;
    __m128i positions[2], weights[2];
};
static_assert(sizeof(EightPixels) == kEightPixelsBytes);

// Prepare the groups of eight pixels that make up a line, the last one aligned with its end, and return their number.
// Return 0 if the line is too short, or shrinks so much that 16 bytes do not hold the neighbours of eight pixels.
inline int64_t prepare_eights(const Weights& weights, int64_t width, int64_t size, EightPixels* eights) {
    if (width < 8 || size < 16) return 0;
    const int64_t count = (width + 7) / 8;
    for (int64_t i = 0; i < count; ++i) {
        EightPixels& eight = eights[i];
        eight.at = 8 * i < width - 8 ? 8 * i : width - 8;
        eight.base = weights.from[eight.at] < size - 16 ? weights.from[eight.at] : size - 16;
        for (int64_t half = 0; half < 2; ++half) {
            int8_t positions[16];
            int16_t pairs[8];
            for (int64_t k = 0; k < 4; ++k) {
                const int64_t x = eight.at + 4 * half + k, position = weights.from[x] - eight.base;
                if (position < 0 || position > 14) return 0;
                positions[4 * k] = static_cast<int8_t>(position);
                positions[4 * k + 2] = static_cast<int8_t>(position + 1);
                positions[4 * k + 1] = positions[4 * k + 3] = -1;  // the shuffle instruction writes 0 there
                pairs[2 * k] = static_cast<int16_t>(256 - weights.weight[x]);
                pairs[2 * k + 1] = static_cast<int16_t>(weights.weight[x]);
            }
            std::memcpy(&eight.positions[half], positions, sizeof positions);
            std::memcpy(&eight.weights[half], pairs, sizeof pairs);
        }
    }
    return count;
}

// Interpolate a line horizontally, eight pixels at a time, by `count` groups, and write it in 1/256 grey levels.
inline void interpolate_line(const uint8_t* line, const EightPixels* eights, int64_t count, uint16_t* to) {
    for (int64_t i = 0; i < count; ++i) {
        const EightPixels& eight = eights[i];
        __m128i pixels;
        std::memcpy(&pixels, line + eight.base, sizeof pixels);
        const __m128i low = _mm_madd_epi16(_mm_shuffle_epi8(pixels, eight.positions[0]), eight.weights[0]);
        const __m128i high = _mm_madd_epi16(_mm_shuffle_epi8(pixels, eight.positions[1]), eight.weights[1]);
        const __m128i both = _mm_packus_epi32(low, high);
        std::memcpy(to + eight.at, &both, sizeof both);
    }
}

// Interpolate vertically between two lines, eight pixels at a time; return the number of pixels done.  The numbers have
// 16 bits without a sign, but the instruction that adds two products takes signed ones: 2^15 is subtracted before, and
// its products are added back.
inline int64_t blend_eights(const uint16_t* above, const uint16_t* below, uint32_t weight, int64_t width, uint8_t* to) {
    const __m128i parts = _mm_set1_epi32(static_cast<int32_t>((256 - weight) | weight << 16));
    const __m128i sign = _mm_set1_epi16(-32768), back = _mm_set1_epi32((256 << 15) + 32768);
    int64_t x = 0;
    for (; x + 8 <= width; x += 8) {
        __m128i a, b;
        std::memcpy(&a, above + x, sizeof a);
        std::memcpy(&b, below + x, sizeof b);
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

// Write to `to` the image, reduced to width x height pixels by bilinear interpolation that is rounded once.
inline void resize(const Image& image, uint8_t* to, int64_t width, int64_t height, const ResizeMemory& memory) {
    // 1. Prepare the horizontal interpolation, which is the same for all lines.
    const double column_scale = 1.0 / (static_cast<double>(width) / static_cast<double>(image.width));
    const double row_scale = 1.0 / (static_cast<double>(height) / static_cast<double>(image.height));
    for (int64_t x = 0; x < width; ++x) {
        int64_t from;
        find_neighbours(x, column_scale, image.width, from, memory.columns.weight[x]);
        memory.columns.from[x] = static_cast<int32_t>(from);
    }
    EightPixels* const eights = reinterpret_cast<EightPixels*>(memory.eights);
    const int64_t eight_count = prepare_eights(memory.columns, width, image.width, eights);
    const auto interpolate_row = [&](int64_t row, uint16_t* line) {
        const uint8_t* const pixels = image.pixels + row * image.width;
        if (eight_count > 0) return interpolate_line(pixels, eights, eight_count, line);
        return interpolate_line(pixels, memory.columns, width, line);
    };
    uint16_t *above = memory.above, *below = memory.below;
    int64_t row_below = -1;  // the input row whose interpolation `below` holds
    for (int64_t y = 0; y < height; ++y) {
        // 2. Interpolate the two input lines of an output line horizontally, unless the memory holds them already.
        int64_t row;
        uint16_t weight;
        find_neighbours(y, row_scale, image.height, row, weight);
        if (row_below != row + 1) {
            if (row_below == row) {
                uint16_t* const free = above;
                above = below;
                below = free;
            } else {
                interpolate_row(row, above);
            }
            interpolate_row(row + 1, below);
            row_below = row + 1;
        }
        // 3. Interpolate vertically between the two lines.
        const int64_t done = blend_eights(above, below, weight, width, to + y * width);
        blend_lines(above, below, weight, done, width, to + y * width);
    }
}

// A pyramid of which two levels exist at a time: the present one, and the next smaller one.
struct Pyramid {
    ResizeMemory resize_memory;
    uint8_t *level, *next;

    // Divide the caller's workspace for an image of a size, arrays with the strictest alignment first.  Return the
    // address behind the last array, aligned to 4 bytes.
    uint8_t* divide_workspace(uint64_t* workspace, int64_t width, int64_t height) {
        resize_memory.eights = reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(workspace) + 15) / 16 * 16);
        resize_memory.columns.from =
            reinterpret_cast<int32_t*>(resize_memory.eights + kEightPixelsBytes * (width / 8 + 1));
        resize_memory.columns.weight = reinterpret_cast<uint16_t*>(resize_memory.columns.from + width);
        resize_memory.above = resize_memory.columns.weight + width;
        resize_memory.below = resize_memory.above + width;
        level = reinterpret_cast<uint8_t*>(resize_memory.below + width);
        next = level + width * height;
        return reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(next + width * height) + 3) / 4 * 4);
    }

    // Replace `image`, the present level, by the next one, which is computed from it and `scale` times smaller than the
    // whole image.  Return false if that would have fewer than 2 pixels on a side, or more than the present level.  The
    // pixels of the level before stay valid until the next call.
    bool shrink(Image& image, const Image& whole, float scale) {
        const float inverse = 1.0f / scale;
        const int64_t width = round_to_integer(static_cast<float>(whole.width) * inverse);
        const int64_t height = round_to_integer(static_cast<float>(whole.height) * inverse);
        if (width < 2 || height < 2 || width > image.width || height > image.height) return false;
        resize(image, next, width, height, resize_memory);
        image = {next, width, height};
        uint8_t* const free = level;
        level = next;
        next = free;
        return true;
    }
};

}  // namespace rse_pf
