// The levels of ORB's pyramid, which are integers: bit by bit those of OpenCV (INTER_LINEAR_EXACT).
#pragma once

#include <smmintrin.h>

#include <cstdint>
#include <cstring>

namespace rse_pf {

constexpr int64_t kMaxSide = int64_t{1} << 14, kMaxRows = int64_t{1} << 24;
constexpr int32_t kMaxLevels = 32;
constexpr int64_t kEightBytes = 80;

struct Image {
    const uint8_t* pixels;
    int64_t width, height;
};

// How a line is made shorter: for each output pixel the first of two input pixels, and the share of the second.
struct Shares {
    int32_t* from;
    uint16_t* share;
};

// What making a level smaller needs, for the widest level.
struct Shortening {
    Shares across;
    uint16_t *above, *under;  // shortened lines
    uint8_t* eights;          // for eight output pixels each
};

inline int64_t rounded(float value) { return static_cast<int64_t>(__builtin_rintf(value)); }

// Where an output pixel lies between two input pixels: the first one, and the share of the second in 256.
inline void between(int64_t at, double scale, int64_t size, int64_t& from, uint16_t& share) {
    const double place = scale * (static_cast<double>(at) + 0.5) - 0.5;
    const double below = __builtin_floor(place);
    from = below < 0.0 ? 0 : static_cast<int64_t>(below);
    share = below < 0.0 ? uint16_t{0} : static_cast<uint16_t>(__builtin_rint((place - below) * 256.0));
    if (from >= size - 1) {
        from = size - 2;
        share = 256;
    }
}

inline void shorten(const uint8_t* line, const Shares& shares, int64_t width, uint16_t* to) {
    for (int64_t x = 0; x < width; ++x) {
        const uint8_t* const at = line + shares.from[x];
        to[x] = static_cast<uint16_t>(at[0] * (256 - shares.share[x]) + at[1] * shares.share[x]);
    }
}

inline void blend(const uint16_t* above, const uint16_t* under, uint32_t share, int64_t begin, int64_t width, uint8_t* to) {
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
inline int64_t eights_of(const Shares& shares, int64_t width, int64_t size, Eight* eights) {
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

inline void shorten(const uint8_t* line, const Eight* eights, int64_t count, uint16_t* to) {
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
inline int64_t blend_eights(const uint16_t* above, const uint16_t* under, uint32_t share, int64_t width, uint8_t* to) {
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
inline void resize(const Image& image, uint8_t* to, int64_t width, int64_t height, const Shortening& work) {
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

// Two levels at a time, of an image of a width and a height.
struct Pyramid {
    Shortening shortening;
    uint8_t *level, *next;

    // Take memory, and return what is behind it, aligned to 4 bytes: the widest numbers first.
    uint8_t* lend(uint64_t* workspace, int64_t width, int64_t height) {
        shortening.eights = reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(workspace) + 15) / 16 * 16);
        shortening.across.from = reinterpret_cast<int32_t*>(shortening.eights + kEightBytes * (width / 8 + 1));
        shortening.across.share = reinterpret_cast<uint16_t*>(shortening.across.from + width);
        shortening.above = shortening.across.share + width;
        shortening.under = shortening.above + width;
        level = reinterpret_cast<uint8_t*>(shortening.under + width);
        next = level + width * height;
        return reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(next + width * height) + 3) / 4 * 4);
    }

    // Replace a level by the next one, *scale* times smaller than the whole image; say whether it has a size.
    bool shrink(Image& image, const Image& whole, float scale) {
        const float inverse = 1.0f / scale;
        const int64_t width = rounded(static_cast<float>(whole.width) * inverse);
        const int64_t height = rounded(static_cast<float>(whole.height) * inverse);
        if (width < 2 || height < 2 || width > image.width || height > image.height) return false;
        resize(image, next, width, height, shortening);
        image = {next, width, height};
        uint8_t* const free = level;
        level = next;
        next = free;
        return true;
    }
};

}  // namespace rse_pf
