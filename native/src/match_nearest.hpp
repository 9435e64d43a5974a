// The two nearest of many 256-bit descriptors; all of the front end's time but the features' goes here.
//
// A candidate is one number, its distance above its row, so the least number is the nearest one and the first
// of equals, in any order of search.  Processors that count the bits of eight words at once (AVX-512 VPOPCNTDQ)
// take eight candidates at a time, word by word of their descriptors; those with AVX2 take 32, byte by byte,
// and look up the bits of half a byte; others count word after word.
#pragma once

#include <cstdint>
#include <cstring>

#include "processor.hpp"

#if defined(__x86_64__)
#include <immintrin.h>
#define RSE_PF_AVX2 __attribute__((target("avx2")))
#define RSE_PF_AVX512 __attribute__((target("avx512f,avx512vpopcntdq")))
#endif

namespace rse_pf_match_detail {

constexpr int64_t kBits = 256, kBytes = 32, kWords = 4, kEight = 8, kBlock = 32;
constexpr uint64_t kNone = ~uint64_t{0};

struct Nearest {
    uint64_t first, second;
};

enum class Lanes { words, avx2, avx512 };

struct Search {
    const uint8_t* descriptors;
    int64_t rows;
    uint64_t* room;  // kWords * (rows + 7) words of the workspace
    Lanes lanes;
};

inline uint64_t key(uint64_t distance, uint64_t row) { return distance << 32 | row; }
inline uint64_t distance_of(uint64_t candidate) { return candidate >> 32; }
inline uint64_t row_of(uint64_t candidate) { return candidate & 0xffffffffu; }

inline uint64_t bits(uint64_t word) { return static_cast<uint64_t>(__builtin_popcountll(word)); }

inline void keep_two(Nearest& found, uint64_t candidate) {
    if (candidate >= found.second) return;
    found.second = candidate < found.first ? found.first : candidate;
    found.first = candidate < found.first ? candidate : found.first;
}

inline uint64_t word(const uint8_t* at) {
    uint64_t value;
    std::memcpy(&value, at, sizeof value);
    return value;
}

inline Nearest two_nearest_of_words(const Search& search, const uint8_t* sought, int64_t begin, Nearest found) {
    uint64_t second = found.second == kNone ? kBits + 1 : distance_of(found.second);
    const uint64_t a = word(sought), b = word(sought + 8), c = word(sought + 16), d = word(sought + 24);
    const uint8_t* at = search.descriptors + kBytes * begin;
    for (int64_t row = begin; row < search.rows; ++row, at += kBytes) {
        const uint64_t distance =
            (bits(word(at) ^ a) + bits(word(at + 8) ^ b)) + (bits(word(at + 16) ^ c) + bits(word(at + 24) ^ d));
        if (__builtin_expect(distance >= second, 1)) continue;  // a later one of equals is no candidate
        keep_two(found, key(distance, static_cast<uint64_t>(row)));
        second = found.second == kNone ? kBits + 1 : distance_of(found.second);
    }
    return found;
}

#if defined(__x86_64__)
typedef uint8_t Block __attribute__((vector_size(32)));
typedef uint16_t Halves __attribute__((vector_size(32)));
typedef int16_t Distances __attribute__((vector_size(32)));

constexpr int16_t kFar = 0x7fff;
// After three quarters of their bytes most candidates are known to be too far.
constexpr int64_t kMost = 24;
constexpr int64_t kMostBlocks = 0x3fff;

// Per lane of 16: the two least distances, and which half of which block the first of them came from.
struct Sixteen {
    Distances first, second, half;
};

RSE_PF_AVX2 inline void keep_two(Sixteen& found, Distances distance, Distances half) {
    const Distances farther = distance > found.first ? distance : found.first;
    found.second = farther < found.second ? farther : found.second;
    found.half = distance < found.first ? half : found.half;
    found.first = distance < found.first ? distance : found.first;
}

RSE_PF_AVX2 inline Block bits_of_halves(Block bytes) {
    const Block counts = {0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4};
    return reinterpret_cast<Block>(
        _mm256_shuffle_epi8(reinterpret_cast<__m256i>(counts), reinterpret_cast<__m256i>(bytes)));
}

// Add the bits of `count` bytes of each of 32 descriptors that differ from the sought one's; at most 31 bytes.
RSE_PF_AVX2 inline Block differing(const uint8_t* descriptors, const uint8_t* sought, int64_t count) {
    Block sum = {};
    for (int64_t k = 0; k < count; ++k) {
        Block bytes, other;
        std::memcpy(&bytes, descriptors + kBlock * k, sizeof bytes);
        std::memcpy(&other, sought + kBlock * k, sizeof other);
        bytes ^= other;
        const Block high = reinterpret_cast<Block>(reinterpret_cast<Halves>(bytes) >> 4);
        sum += bits_of_halves(bytes & 15) + bits_of_halves(high & 15);
    }
    return sum;
}

RSE_PF_AVX2 inline int least_of_eight(__m128i numbers) { return _mm_extract_epi16(_mm_minpos_epu16(numbers), 0); }

// Two candidates at least are as near as this: the nearest of either half of the lanes.
RSE_PF_AVX2 inline int near_enough(const Sixteen& found) {
    const __m256i first = reinterpret_cast<__m256i>(found.first);
    const int low = least_of_eight(_mm256_castsi256_si128(first));
    const int high = least_of_eight(_mm256_extracti128_si256(first, 1));
    return low > high ? low : high;
}

RSE_PF_AVX2 inline Nearest two_nearest_of_blocks(const Search& search, const uint8_t* sought) {
    alignas(32) uint8_t each[kBytes * kBlock];
    for (int64_t k = 0; k < kBytes; ++k) std::memset(each + kBlock * k, sought[k], kBlock);
    const Distances far = Distances{} + kFar;
    Sixteen lanes = {far, far, Distances{}};
    Block limit = Block{} + static_cast<uint8_t>(255);
    const int64_t blocks = search.rows / kBlock;
    const uint8_t* at = reinterpret_cast<const uint8_t*>(search.room);
    for (int64_t block = 0; block < blocks; ++block, at += kBytes * kBlock) {
        const Block most = differing(at, each, kMost);
        if (_mm256_movemask_epi8(reinterpret_cast<__m256i>(most < limit)) == 0) continue;
        const Block rest = differing(at + kMost * kBlock, each + kMost * kBlock, kBytes - kMost);
        const Distances even = reinterpret_cast<Distances>((reinterpret_cast<Halves>(most) & 255) +
                                                           (reinterpret_cast<Halves>(rest) & 255));
        const Distances odd =
            reinterpret_cast<Distances>((reinterpret_cast<Halves>(most) >> 8) + (reinterpret_cast<Halves>(rest) >> 8));
        const int16_t half = static_cast<int16_t>(2 * block);
        keep_two(lanes, even, Distances{} + half);
        keep_two(lanes, odd, Distances{} + static_cast<int16_t>(half + 1));
        const int enough = near_enough(lanes);
        limit = Block{} + static_cast<uint8_t>(enough < 255 ? enough : 255);
    }
    Nearest found = {kNone, kNone};
    for (int lane = 0; blocks > 0 && lane < 16; ++lane) {
        const int64_t half = lanes.half[lane];
        const int64_t row = half / 2 * kBlock + 2 * lane + half % 2;
        keep_two(found, key(static_cast<uint64_t>(lanes.first[lane]), static_cast<uint64_t>(row)));
        keep_two(found, key(static_cast<uint64_t>(lanes.second[lane]), 0xffffffffu));  // of any row behind it
    }
    return two_nearest_of_words(search, sought, blocks * kBlock, found);
}

typedef uint64_t Eight __attribute__((vector_size(64)));

RSE_PF_AVX512 inline Eight bits_of_eight(const uint64_t* at, uint64_t sought) {
    Eight words;
    std::memcpy(&words, at, sizeof words);
    return reinterpret_cast<Eight>(_mm512_popcnt_epi64(reinterpret_cast<__m512i>(words ^ sought)));
}

RSE_PF_AVX512 inline Nearest two_nearest_of_eights(const Search& search, const uint8_t* sought) {
    const uint64_t a = word(sought), b = word(sought + 8), c = word(sought + 16), d = word(sought + 24);
    const Eight none = {kNone, kNone, kNone, kNone, kNone, kNone, kNone, kNone};
    const uint64_t end = static_cast<uint64_t>(search.rows);
    Eight first = none, second = none, rows = {0, 1, 2, 3, 4, 5, 6, 7};
    const uint64_t* at = search.room;
    for (int64_t row = 0; row < search.rows; row += kEight, at += kWords * kEight) {
        const Eight distance = (bits_of_eight(at, a) + bits_of_eight(at + kEight, b)) +
                               (bits_of_eight(at + 2 * kEight, c) + bits_of_eight(at + 3 * kEight, d));
        const Eight candidate = rows < end ? (distance << 32 | rows) : none;
        const Eight farther = candidate < first ? first : candidate;
        second = farther < second ? farther : second;
        first = candidate < first ? candidate : first;
        rows += static_cast<uint64_t>(kEight);
    }
    Nearest found = {kNone, kNone};
    for (int64_t lane = 0; lane < kEight; ++lane) {
        keep_two(found, first[lane]);
        keep_two(found, second[lane]);
    }
    return found;
}
#endif

// Choose the instructions, and lay out the candidates for them.
inline Search prepared(const uint8_t* descriptors, int64_t rows, uint64_t* room, Lanes most) {
    Search search = {descriptors, rows, room, Lanes::words};
#if defined(__x86_64__)
    const bool has_avx512 = rse_pf::processor().avx512_popcount;
    if (most == Lanes::avx512 && has_avx512) {
        search.lanes = Lanes::avx512;
        const int64_t eights = (rows + kEight - 1) / kEight;
        std::memset(room, 0, static_cast<size_t>(eights * kEight * kBytes));
        for (int64_t row = 0; row < rows; ++row)
            for (int64_t k = 0; k < kWords; ++k)
                room[(row / kEight * kWords + k) * kEight + row % kEight] = word(descriptors + kBytes * row + 8 * k);
    } else if (most != Lanes::words && rse_pf::processor().avx2 && rows / kBlock <= kMostBlocks) {
        search.lanes = Lanes::avx2;
        uint8_t* const bytes = reinterpret_cast<uint8_t*>(room);
        for (int64_t row = 0; row < rows / kBlock * kBlock; ++row)
            for (int64_t k = 0; k < kBytes; ++k)
                bytes[(row / kBlock * kBytes + k) * kBlock + row % kBlock] = descriptors[kBytes * row + k];
    }
#else
    static_cast<void>(most);
#endif
    return search;
}

// Return the two candidates nearest to one descriptor; of the second one the distance only.  There are two and more.
inline Nearest two_nearest(const Search& search, const uint8_t* sought) {
#if defined(__x86_64__)
    if (search.lanes == Lanes::avx512) return two_nearest_of_eights(search, sought);
    if (search.lanes == Lanes::avx2) return two_nearest_of_blocks(search, sought);
#endif
    return two_nearest_of_words(search, sought, 0, {kNone, kNone});
}

}  // namespace rse_pf_match_detail
