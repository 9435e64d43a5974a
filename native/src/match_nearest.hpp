// The two nearest of many 256-bit descriptors; all of the front end's time but the features' goes here.
//
// A candidate is one number, its distance above its row, so the least number is the nearest one and the first
// of equals, in any order of search.  Processors that count the bits of eight words at once take eight
// candidates at a time, word by word of their descriptors; others count word after word.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#define RSE_PF_AVX512 __attribute__((target("avx512f,avx512vpopcntdq")))
#endif

namespace rse_pf_match_detail {

constexpr int64_t kBits = 256, kBytes = 32, kWords = 4, kEight = 8;
constexpr uint64_t kNone = ~uint64_t{0};

struct Nearest {
    uint64_t first, second;
};

struct Search {
    const uint8_t* descriptors;
    int64_t rows;
    uint64_t* words;  // kWords * (rows + 7) of the workspace
    bool may_use_avx512;
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

inline Nearest two_nearest_of_words(const Search& search, const uint64_t (&sought)[kWords]) {
    Nearest found = {kNone, kNone};
    const uint8_t* at = search.descriptors;
    for (int64_t row = 0; row < search.rows; ++row, at += kBytes) {
        uint64_t words[kWords];
        std::memcpy(words, at, sizeof words);
        const uint64_t distance = (bits(words[0] ^ sought[0]) + bits(words[1] ^ sought[1])) +
                                  (bits(words[2] ^ sought[2]) + bits(words[3] ^ sought[3]));
        keep_two(found, key(distance, static_cast<uint64_t>(row)));
    }
    return found;
}

#if defined(__x86_64__)
inline bool has_avx512(const Search& search) {
    return search.may_use_avx512 && __builtin_cpu_supports("avx512f") != 0 &&
           __builtin_cpu_supports("avx512vpopcntdq") != 0;
}

typedef uint64_t Eight __attribute__((vector_size(64)));

RSE_PF_AVX512 inline Eight bits_of_eight(const uint64_t* at, uint64_t sought) {
    Eight words;
    std::memcpy(&words, at, sizeof words);
    return reinterpret_cast<Eight>(_mm512_popcnt_epi64(reinterpret_cast<__m512i>(words ^ sought)));
}

RSE_PF_AVX512 inline Nearest two_nearest_of_eights(const Search& search, const uint64_t (&sought)[kWords]) {
    const Eight none = {kNone, kNone, kNone, kNone, kNone, kNone, kNone, kNone};
    const uint64_t end = static_cast<uint64_t>(search.rows);
    Eight first = none, second = none, rows = {0, 1, 2, 3, 4, 5, 6, 7};
    const uint64_t* at = search.words;
    for (int64_t row = 0; row < search.rows; row += kEight, at += kWords * kEight) {
        const Eight distance = (bits_of_eight(at, sought[0]) + bits_of_eight(at + kEight, sought[1])) +
                               (bits_of_eight(at + 2 * kEight, sought[2]) + bits_of_eight(at + 3 * kEight, sought[3]));
        const Eight candidate = rows < end ? (distance << 32 | rows) : none;
        const Eight farther = candidate < first ? first : candidate;
        second = farther < second ? farther : second;
        first = candidate < first ? candidate : first;
        rows += kEight;
    }
    Nearest found = {kNone, kNone};
    for (int64_t lane = 0; lane < kEight; ++lane) {
        keep_two(found, first[lane]);
        keep_two(found, second[lane]);
    }
    return found;
}
#endif

// Lay out the candidates' words for the search.
inline void prepare(const Search& search) {
#if defined(__x86_64__)
    if (!has_avx512(search)) return;
    const int64_t eights = (search.rows + kEight - 1) / kEight;
    std::memset(search.words, 0, static_cast<size_t>(eights * kEight * kBytes));
    for (int64_t row = 0; row < search.rows; ++row) {
        uint64_t words[kWords];
        std::memcpy(words, search.descriptors + kBytes * row, sizeof words);
        uint64_t* const to = search.words + row / kEight * kWords * kEight + row % kEight;
        for (int64_t k = 0; k < kWords; ++k) to[k * kEight] = words[k];
    }
#else
    static_cast<void>(search);
#endif
}

// Return the two candidates nearest to one descriptor; the search is prepared and has two rows and more.
inline Nearest two_nearest(const Search& search, const uint8_t* descriptor) {
    uint64_t sought[kWords];
    std::memcpy(sought, descriptor, sizeof sought);
#if defined(__x86_64__)
    if (has_avx512(search)) return two_nearest_of_eights(search, sought);
#endif
    return two_nearest_of_words(search, sought);
}

}  // namespace rse_pf_match_detail
