// Search of the two nearest of many 256-bit descriptors by Hamming distance, the slowest part of matching.
//
// A candidate is one 64-bit number, the distance in its upper half and the row number in its lower half.  The smallest
// candidate is thus the nearest one, and of equal distances that of the lowest row, in whatever order rows are visited.
//
// Three implementations give equal results: processors with AVX-512 VPOPCNTDQ compare eight rows at a time, word by
// word; processors with AVX2 compare 32 rows at a time, byte by byte, and look up the number of bits of each half byte;
// others compare row after row.
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

// Bits of a descriptor, the largest Hamming distance.
constexpr int64_t kBits = 256;
// Bytes of a descriptor.
constexpr int64_t kBytes = 32;
// Words of 64 bits of a descriptor.
constexpr int64_t kWords = 4;
// Rows that AVX-512 compares at a time: eight words of 64 bits fill a register.
constexpr int64_t kEight = 8;
// Rows that AVX2 compares at a time: 32 bytes fill a register.
constexpr int64_t kBlock = 32;
// Value of a candidate or a row number that means "none"; it is larger than all candidates.
constexpr uint64_t kNone = ~uint64_t{0};

struct TwoNearest {
    uint64_t first, second;  // candidates, or kNone
};

// How descriptors are compared: word by word, or by vector instructions.  The results are equal.
enum class Lanes { words, avx2, avx512 };

// The descriptors to search in, and a copy of them in the layout that the vector instructions need (none for
// Lanes::words, whole blocks of 32 rows for Lanes::avx2).
struct Search {
    const uint8_t* descriptors;
    int64_t rows;
    uint64_t* layout;  // kWords * (rows + 7) words of the workspace
    Lanes lanes;
};

inline uint64_t make_candidate(uint64_t distance, uint64_t row) { return distance << 32 | row; }
inline uint64_t distance_of(uint64_t candidate) { return candidate >> 32; }
inline uint64_t row_of(uint64_t candidate) { return candidate & 0xffffffffu; }

inline uint64_t count_bits(uint64_t word) { return static_cast<uint64_t>(__builtin_popcountll(word)); }

// Keep in `two` the two smallest of its candidates and another candidate.
inline void keep_two(TwoNearest& two, uint64_t candidate) {
    if (candidate >= two.second) return;
    two.second = candidate < two.first ? two.first : candidate;
    two.first = candidate < two.first ? candidate : two.first;
}

inline uint64_t read_word(const uint8_t* at) {
    uint64_t value;
    std::memcpy(&value, at, sizeof value);
    return value;
}

// Continue a search at row `begin`, word by word, with the two nearest of the rows before, and return the two nearest
// of all rows.
inline TwoNearest two_nearest_by_words(const Search& search, const uint8_t* query, int64_t begin, TwoNearest two) {
    uint64_t second = two.second == kNone ? kBits + 1 : distance_of(two.second);
    const uint64_t a = read_word(query), b = read_word(query + 8), c = read_word(query + 16), d = read_word(query + 24);
    const uint8_t* at = search.descriptors + kBytes * begin;
    for (int64_t row = begin; row < search.rows; ++row, at += kBytes) {
        const uint64_t distance =
            (count_bits(read_word(at) ^ a) + count_bits(read_word(at + 8) ^ b)) +
            (count_bits(read_word(at + 16) ^ c) + count_bits(read_word(at + 24) ^ d));
        if (__builtin_expect(distance >= second, 1)) continue;  // Of equal distances the lower row stays.
        keep_two(two, make_candidate(distance, static_cast<uint64_t>(row)));
        second = two.second == kNone ? kBits + 1 : distance_of(two.second);
    }
    return two;
}

#if defined(__x86_64__)
typedef uint8_t Block __attribute__((vector_size(32)));
typedef uint16_t Halves __attribute__((vector_size(32)));
typedef int16_t Distances __attribute__((vector_size(32)));

// Start value of a search for the smallest distance, larger than all Hamming distances.
constexpr int16_t kFar = 0x7fff;
// Bytes of a descriptor, three quarters of it, after which a block of 32 rows is dropped if all its rows are already
// too far from the query: most blocks are.
constexpr int64_t kEarlyBytes = 24;
// Most blocks of 32 rows of a search by AVX2: twice the number of a block, plus one, has to fit into a signed number of
// 16 bits.
constexpr int64_t kMaxBlocks = 0x3fff;

// For each of 16 lanes the two smallest distances, and the half block (2 * block, plus 1 for odd rows) that holds the
// row of the first of them.  Lane k compares the rows 2 k and 2 k + 1 of each block.
struct SixteenLanes {
    Distances first, second, half;
};

RSE_PF_AVX2 inline void keep_two(SixteenLanes& lanes, Distances distance, Distances half) {
    const Distances farther = distance > lanes.first ? distance : lanes.first;
    lanes.second = farther < lanes.second ? farther : lanes.second;
    lanes.half = distance < lanes.first ? half : lanes.half;
    lanes.first = distance < lanes.first ? distance : lanes.first;
}

// Return the number of bits of each byte, which is below 16, by a table.
RSE_PF_AVX2 inline Block count_bits_of_half_bytes(Block bytes) {
    const Block counts = {0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4};
    return reinterpret_cast<Block>(
        _mm256_shuffle_epi8(reinterpret_cast<__m256i>(counts), reinterpret_cast<__m256i>(bytes)));
}

// Return for each of 32 descriptors the number of bits by which its next `count` bytes, at most 31, differ from the
// query. descriptors: the layout of a block, from the first of these bytes on; query: each of these bytes 32 times.
RSE_PF_AVX2 inline Block count_differing_bits(const uint8_t* descriptors, const uint8_t* query, int64_t count) {
    Block sum = {};
    for (int64_t k = 0; k < count; ++k) {
        Block bytes, other;
        std::memcpy(&bytes, descriptors + kBlock * k, sizeof bytes);
        std::memcpy(&other, query + kBlock * k, sizeof other);
        bytes ^= other;
        const Block high = reinterpret_cast<Block>(reinterpret_cast<Halves>(bytes) >> 4);
        sum += count_bits_of_half_bytes(bytes & 15) + count_bits_of_half_bytes(high & 15);
    }
    return sum;
}

RSE_PF_AVX2 inline int min_of_eight(__m128i numbers) { return _mm_extract_epi16(_mm_minpos_epu16(numbers), 0); }

// Return a distance that at least two rows do not exceed: the larger of the smallest distances of the two halves of the
// lanes.  The second smallest distance of all rows so far is at most this one.
RSE_PF_AVX2 inline int bound_second_distance(const SixteenLanes& lanes) {
    const __m256i first = reinterpret_cast<__m256i>(lanes.first);
    const int low = min_of_eight(_mm256_castsi256_si128(first));
    const int high = min_of_eight(_mm256_extracti128_si256(first, 1));
    return low > high ? low : high;
}

// Return the two rows nearest to a query by AVX2, in blocks of 32 rows; of the second one only the distance is valid.
RSE_PF_AVX2 inline TwoNearest two_nearest_by_blocks(const Search& search, const uint8_t* query) {
    alignas(32) uint8_t query_bytes[kBytes * kBlock];
    for (int64_t k = 0; k < kBytes; ++k) std::memset(query_bytes + kBlock * k, query[k], kBlock);
    const Distances far = Distances{} + kFar;
    SixteenLanes lanes = {far, far, Distances{}};
    Block limit = Block{} + static_cast<uint8_t>(255);
    const int64_t blocks = search.rows / kBlock;
    const uint8_t* at = reinterpret_cast<const uint8_t*>(search.layout);
    for (int64_t block = 0; block < blocks; ++block, at += kBytes * kBlock) {
        // 1. Drop the block if three quarters of the bytes show that no row is among the two nearest.
        const Block early = count_differing_bits(at, query_bytes, kEarlyBytes);
        if (_mm256_movemask_epi8(reinterpret_cast<__m256i>(early < limit)) == 0) continue;
        // 2. Add the other bytes, and widen the distances of even and of odd rows to 16 bits.
        const Block rest =
            count_differing_bits(at + kEarlyBytes * kBlock, query_bytes + kEarlyBytes * kBlock, kBytes - kEarlyBytes);
        const Distances even = reinterpret_cast<Distances>((reinterpret_cast<Halves>(early) & 255) +
                                                           (reinterpret_cast<Halves>(rest) & 255));
        const Distances odd =
            reinterpret_cast<Distances>((reinterpret_cast<Halves>(early) >> 8) + (reinterpret_cast<Halves>(rest) >> 8));
        // 3. Keep the two smallest distances of each lane, and tighten the limit.
        const int16_t half = static_cast<int16_t>(2 * block);
        keep_two(lanes, even, Distances{} + half);
        keep_two(lanes, odd, Distances{} + static_cast<int16_t>(half + 1));
        const int bound = bound_second_distance(lanes);
        limit = Block{} + static_cast<uint8_t>(bound < 255 ? bound : 255);
    }
    // 4. Merge the lanes, then search the rows behind the last whole block.
    TwoNearest two = {kNone, kNone};
    for (int lane = 0; blocks > 0 && lane < 16; ++lane) {
        const int64_t half = lanes.half[lane];
        const int64_t row = half / 2 * kBlock + 2 * lane + half % 2;
        keep_two(two, make_candidate(static_cast<uint64_t>(lanes.first[lane]), static_cast<uint64_t>(row)));
        // The row of a lane's second distance is unknown, and not needed: only its distance is used.
        keep_two(two, make_candidate(static_cast<uint64_t>(lanes.second[lane]), 0xffffffffu));
    }
    return two_nearest_by_words(search, query, blocks * kBlock, two);
}

typedef uint64_t Eight __attribute__((vector_size(64)));

RSE_PF_AVX512 inline Eight count_bits_of_eight(const uint64_t* at, uint64_t query) {
    Eight words;
    std::memcpy(&words, at, sizeof words);
    return reinterpret_cast<Eight>(_mm512_popcnt_epi64(reinterpret_cast<__m512i>(words ^ query)));
}

// Return the two rows nearest to a query by AVX-512, eight rows at a time.
RSE_PF_AVX512 inline TwoNearest two_nearest_by_eights(const Search& search, const uint8_t* query) {
    const uint64_t a = read_word(query), b = read_word(query + 8), c = read_word(query + 16), d = read_word(query + 24);
    const Eight none = {kNone, kNone, kNone, kNone, kNone, kNone, kNone, kNone};
    const uint64_t end = static_cast<uint64_t>(search.rows);
    Eight first = none, second = none, rows = {0, 1, 2, 3, 4, 5, 6, 7};
    const uint64_t* at = search.layout;
    for (int64_t row = 0; row < search.rows; row += kEight, at += kWords * kEight) {
        const Eight distance = (count_bits_of_eight(at, a) + count_bits_of_eight(at + kEight, b)) +
                               (count_bits_of_eight(at + 2 * kEight, c) + count_bits_of_eight(at + 3 * kEight, d));
        const Eight candidate = rows < end ? (distance << 32 | rows) : none;
        const Eight farther = candidate < first ? first : candidate;
        second = farther < second ? farther : second;
        first = candidate < first ? candidate : first;
        rows += static_cast<uint64_t>(kEight);
    }
    TwoNearest two = {kNone, kNone};
    for (int64_t lane = 0; lane < kEight; ++lane) {
        keep_two(two, first[lane]);
        keep_two(two, second[lane]);
    }
    return two;
}
#endif

// Return a search in the descriptors with the widest instructions that the processor has and `widest` allows.  The
// descriptors are copied to `layout`, memory of the caller, as these instructions read them: word k of eight rows one
// after the other (AVX-512), or byte k of 32 rows (AVX2).
inline Search prepare_search(const uint8_t* descriptors, int64_t rows, uint64_t* layout, Lanes widest) {
    Search search = {descriptors, rows, layout, Lanes::words};
#if defined(__x86_64__)
    const bool has_avx512 = rse_pf::processor().avx512_popcount;
    if (widest == Lanes::avx512 && has_avx512) {
        search.lanes = Lanes::avx512;
        const int64_t eights = (rows + kEight - 1) / kEight;
        std::memset(layout, 0, static_cast<size_t>(eights * kEight * kBytes));
        for (int64_t row = 0; row < rows; ++row)
            for (int64_t k = 0; k < kWords; ++k)
                layout[(row / kEight * kWords + k) * kEight + row % kEight] = read_word(descriptors + kBytes * row + 8 * k);
    } else if (widest != Lanes::words && rse_pf::processor().avx2 && rows / kBlock <= kMaxBlocks) {
        search.lanes = Lanes::avx2;
        uint8_t* const bytes = reinterpret_cast<uint8_t*>(layout);
        for (int64_t row = 0; row < rows / kBlock * kBlock; ++row)
            for (int64_t k = 0; k < kBytes; ++k)
                bytes[(row / kBlock * kBytes + k) * kBlock + row % kBlock] = descriptors[kBytes * row + k];
    }
#else
    static_cast<void>(widest);
#endif
    return search;
}

// Return the two candidates nearest to a descriptor; of the second one only the distance is valid.  The search must
// hold at least two descriptors.
inline TwoNearest find_two_nearest(const Search& search, const uint8_t* query) {
#if defined(__x86_64__)
    if (search.lanes == Lanes::avx512) return two_nearest_by_eights(search, query);
    if (search.lanes == Lanes::avx2) return two_nearest_by_blocks(search, query);
#endif
    return two_nearest_by_words(search, query, 0, {kNone, kNone});
}

}  // namespace rse_pf_match_detail
