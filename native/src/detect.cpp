// ORB's keypoints, in OpenCV's order and bit by bit its own.
//
// Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011, sect. 3: corners of FAST on each level of
// a pyramid, twice as many as wanted; of those the ones with the highest Harris measure, each with the orientation of
// its intensity centroid.  FAST's measure (Rosten and Drummond, ECCV 2006) is the largest threshold at which nine
// pixels in a row on a circle are all lighter or all darker than its middle; it is computed for every pixel, 32 at a
// time.  Only processors with AVX2 find keypoints here, all others leave them to OpenCV.
#include <cstdint>
#include <cstring>

#include "processor.hpp"
#include "rse_pf_match.h"

#if defined(__x86_64__)
#include <immintrin.h>

#include "best.hpp"
#include "pyramid.hpp"

#define RSE_PF_INLINE static inline __attribute__((always_inline, target("avx2")))
#define RSE_PF_AVX2 __attribute__((target("avx2")))

namespace {

using rse_pf::Image, rse_pf::kMaxLevels, rse_pf::kMaxRows, rse_pf::kMaxSide, rse_pf::Pyramid;
using Corner = rse_pf::Ranked;

// OpenCV finds none nearer to the edge of a level.
constexpr int64_t kEdge = 31;
constexpr int64_t kCircle = 16, kChunk = 32, kHarris = 7;
constexpr int64_t kDisc = 15, kDiscRows = 2 * kDisc + 1;
// Half the width of the disc's rows, from the middle one on.
constexpr int32_t kHalf[kDisc + 1] = {15, 15, 15, 15, 14, 14, 14, 13, 13, 12, 11, 10, 9, 8, 6, 3};
constexpr int64_t kAcross[kCircle] = {0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1};
constexpr int64_t kDown[kCircle] = {3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1, 0, 1, 2, 3};

RSE_PF_INLINE __m256i bytes_at(const uint8_t* at) { return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(at)); }

// Return by how much nine in a row are all above 0 at least, of 16 numbers on a circle.
RSE_PF_INLINE __m256i most_of_nine(const __m256i (&circle)[kCircle]) {
    __m256i two[kCircle / 2], four[kCircle / 2], most = _mm256_setzero_si256();
    // Arcs of eight begin at odd places; with the place before or behind they are the arcs of nine.
    for (int64_t k = 0; k < 8; ++k) two[k] = _mm256_min_epu8(circle[2 * k + 1], circle[(2 * k + 2) % kCircle]);
    for (int64_t k = 0; k < 8; ++k) four[k] = _mm256_min_epu8(two[k], two[(k + 1) % 8]);
    for (int64_t k = 0; k < 8; ++k) {
        const __m256i beside = _mm256_max_epu8(circle[2 * k], circle[(2 * k + 9) % kCircle]);
        const __m256i eight = _mm256_min_epu8(four[k], four[(k + 2) % 8]);
        most = _mm256_max_epu8(most, _mm256_min_epu8(eight, beside));
    }
    return most;
}

// Write FAST's measure of the pixels of a row from *begin* to before *end*, 0 below the threshold.  Up to 31 more are
// written.
RSE_PF_INLINE void measure_row(const Image& image, int64_t row, int64_t begin, int64_t end, uint8_t threshold,
                               uint8_t* measures) {
    const __m256i limit = _mm256_set1_epi8(static_cast<char>(threshold)), one = _mm256_set1_epi8(1);
    const __m256i none = _mm256_setzero_si256();
    int64_t places[kCircle];
    for (int64_t k = 0; k < kCircle; ++k) places[k] = kDown[k] * image.width + kAcross[k];
    for (int64_t x = begin; x < end; x += kChunk) {
        const uint8_t* const at = image.pixels + row * image.width + x;
        const __m256i middle = bytes_at(at);
        __m256i darker[kCircle], lighter[kCircle];
        for (int64_t k = 0; k < kCircle; ++k) {
            const __m256i other = bytes_at(at + places[k]);
            darker[k] = _mm256_subs_epu8(middle, other);
            lighter[k] = _mm256_subs_epu8(other, middle);
        }
        const __m256i most = _mm256_max_epu8(most_of_nine(darker), most_of_nine(lighter));
        const __m256i is_below = _mm256_cmpeq_epi8(_mm256_subs_epu8(most, limit), none);
        const __m256i measure = _mm256_andnot_si256(is_below, _mm256_subs_epu8(most, one));
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(measures + x), measure);
    }
}

// Write the corners of a level whose measure is above that of their eight neighbours, row by row; return their number.
RSE_PF_INLINE int64_t find_corners(const Image& image, uint8_t threshold, uint8_t* const (&lines)[3], Corner* corners) {
    const int64_t begin = kEdge, end = image.width - kEdge, bottom = image.height - kEdge;
    int64_t count = 0;
    if (begin >= end || kEdge >= bottom) return 0;
    for (int64_t row = kEdge - 1; row <= bottom; ++row) {
        measure_row(image, row, begin - 1, end + 1, threshold, lines[row % 3]);
        if (row <= kEdge) continue;
        const int64_t y = row - 1;
        const uint8_t *const above = lines[(y - 1) % 3], *const own = lines[y % 3], *const under = lines[(y + 1) % 3];
        for (int64_t x = begin; x < end; x += kChunk) {
            const __m256i middle = bytes_at(own + x);
            __m256i most = _mm256_max_epu8(bytes_at(own + x - 1), bytes_at(own + x + 1));
            for (int64_t k = -1; k <= 1; ++k)
                most = _mm256_max_epu8(most, _mm256_max_epu8(bytes_at(above + x + k), bytes_at(under + x + k)));
            const __m256i is_less = _mm256_cmpeq_epi8(_mm256_subs_epu8(middle, most), _mm256_setzero_si256());
            uint32_t found = ~static_cast<uint32_t>(_mm256_movemask_epi8(is_less));
            if (end - x < kChunk) found &= (uint32_t{1} << (end - x)) - 1;
            for (; found != 0; found &= found - 1) {
                const int64_t column = x + __builtin_ctz(found);
                corners[count++] = {static_cast<float>(own[column]), static_cast<int32_t>(y * image.width + column)};
            }
        }
    }
    return count;
}

RSE_PF_INLINE int32_t sum_of(__m128i four) {
    four = _mm_add_epi32(four, _mm_shuffle_epi32(four, 0x4e));
    return _mm_cvtsi128_si32(_mm_add_epi32(four, _mm_shuffle_epi32(four, 0xb1)));
}

RSE_PF_INLINE __m128i eight_at(const uint8_t* at) {
    return _mm_cvtepu8_epi16(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(at)));
}

// Return the Harris measure of the 7x7 pixels around a place, of the slopes that Sobel's operator has there.
RSE_PF_INLINE float harris(const Image& image, int64_t place) {
    constexpr int64_t kReach = kHarris / 2;
    const __m128i seven = _mm_setr_epi16(-1, -1, -1, -1, -1, -1, -1, 0);
    __m128i slopes[kHarris + 2], smooth[kHarris + 2];
    for (int64_t y = 0; y < kHarris + 2; ++y) {
        const uint8_t* const at = image.pixels + place + (y - kReach - 1) * image.width - kReach;
        const __m128i left = eight_at(at - 1), middle = eight_at(at), right = eight_at(at + 1);
        slopes[y] = _mm_and_si128(_mm_sub_epi16(right, left), seven);
        smooth[y] = _mm_and_si128(_mm_add_epi16(_mm_add_epi16(left, right), _mm_slli_epi16(middle, 1)), seven);
    }
    __m128i xx = _mm_setzero_si128(), yy = xx, xy = xx;
    for (int64_t y = 1; y <= kHarris; ++y) {
        const __m128i beside = _mm_add_epi16(slopes[y - 1], slopes[y + 1]);
        const __m128i across = _mm_add_epi16(beside, _mm_slli_epi16(slopes[y], 1));
        const __m128i down = _mm_sub_epi16(smooth[y + 1], smooth[y - 1]);
        xx = _mm_add_epi32(xx, _mm_madd_epi16(across, across));
        yy = _mm_add_epi32(yy, _mm_madd_epi16(down, down));
        xy = _mm_add_epi32(xy, _mm_madd_epi16(across, down));
    }
    constexpr float kScale = 1.0f / (4 * kHarris * 255.0f), kShare = 0.04f;
    const auto a = static_cast<float>(sum_of(xx)), b = static_cast<float>(sum_of(yy)), c = static_cast<float>(sum_of(xy));
    return (a * b - c * c - kShare * (a + b) * (a + b)) * (kScale * kScale * kScale * kScale);
}

// For each row of the disc the weights of its pixels: their column, and whether they are in it.
struct Disc {
    int8_t columns[kDiscRows][kChunk], inside[kDiscRows][kChunk];

    constexpr Disc() : columns(), inside() {
        for (int64_t y = 0; y < kDiscRows; ++y)
            for (int64_t x = 0; x < kDiscRows; ++x) {
                const int64_t down = y < kDisc ? kDisc - y : y - kDisc, across = x < kDisc ? kDisc - x : x - kDisc;
                if (across > kHalf[down]) continue;
                columns[y][x] = static_cast<int8_t>(x - kDisc);
                inside[y][x] = 1;
            }
    }
};

constexpr Disc kWeights;

// Return the angle in degrees of a point, by OpenCV's polynomial.
RSE_PF_INLINE float angle_deg(float y, float x) {
    constexpr double kDegrees = 180.0 / 3.1415926535897932384626433832795;
    constexpr float kTurn = static_cast<float>(kDegrees);
    constexpr float p1 = 0.9997878412794807f * kTurn, p3 = -0.3258083974640975f * kTurn;
    constexpr float p5 = 0.1555786518463281f * kTurn, p7 = -0.04432655554792128f * kTurn;
    const float across = x < 0.0f ? -x : x, down = y < 0.0f ? -y : y;
    const bool is_flat = across >= down;
    const float least = 2.2204460492503131e-16f;
    const float c = is_flat ? down / (across + least) : across / (down + least), c2 = c * c;
    const float turn = (((p7 * c2 + p5) * c2 + p3) * c2 + p1) * c;
    float angle = is_flat ? turn : 90.0f - turn;
    if (x < 0.0f) angle = 180.0f - angle;
    return y < 0.0f ? 360.0f - angle : angle;
}

// Return the angle in degrees from a place to the intensity centroid of the disc around it.
RSE_PF_INLINE float orientation(const Image& image, int64_t place) {
    const __m256i ones = _mm256_set1_epi16(1);
    __m256i across = _mm256_setzero_si256(), down = across;
    for (int64_t y = 0; y < kDiscRows; ++y) {
        const __m256i pixels = bytes_at(image.pixels + place + (y - kDisc) * image.width - kDisc);
        const __m256i columns = bytes_at(reinterpret_cast<const uint8_t*>(kWeights.columns[y]));
        const __m256i inside = bytes_at(reinterpret_cast<const uint8_t*>(kWeights.inside[y]));
        const __m256i rows = _mm256_set1_epi16(static_cast<int16_t>(y - kDisc));
        across = _mm256_add_epi32(across, _mm256_madd_epi16(_mm256_maddubs_epi16(pixels, columns), ones));
        down = _mm256_add_epi32(down, _mm256_madd_epi16(_mm256_maddubs_epi16(pixels, inside), rows));
    }
    const __m128i x = _mm_add_epi32(_mm256_castsi256_si128(across), _mm256_extracti128_si256(across, 1));
    const __m128i y = _mm_add_epi32(_mm256_castsi256_si128(down), _mm256_extracti128_si256(down, 1));
    return angle_deg(static_cast<float>(sum_of(y)), static_cast<float>(sum_of(x)));
}

struct Found {
    float *pixels, *responses, *angles_deg;
    int32_t* octaves;
    int64_t room, rows;
};

// Find the keypoints of one level; say whether there is room for them.
RSE_PF_INLINE bool find(const Image& image, int32_t octave, float scale, int64_t wanted, uint8_t threshold,
                        uint8_t* const (&lines)[3], Corner* corners, Found& found) {
    int64_t count = find_corners(image, threshold, lines, corners);
    count = rse_pf::keep_best(corners, count, 2 * wanted);
    for (int64_t i = 0; i < count; ++i) corners[i].rank = harris(image, corners[i].index);
    if (count >= 0) count = rse_pf::keep_best(corners, count, wanted);
    if (count < 0 || count > found.room - found.rows) return false;
    for (int64_t i = 0; i < count; ++i, ++found.rows) {
        const int64_t place = corners[i].index;
        found.pixels[2 * found.rows] = static_cast<float>(place % image.width) * scale;
        found.pixels[2 * found.rows + 1] = static_cast<float>(place / image.width) * scale;
        found.responses[found.rows] = corners[i].rank;
        found.angles_deg[found.rows] = orientation(image, place);
        found.octaves[found.rows] = octave;
    }
    return true;
}

RSE_PF_AVX2 int64_t find_all(const rse_pf_detect_request& request, Found found) {
    Image image = {request.gray, request.width, request.height};
    const Image whole = image;
    Pyramid pyramid;
    uint8_t* const rest = pyramid.lend(request.workspace, whole.width, whole.height);
    Corner* const corners = reinterpret_cast<Corner*>(rest);
    uint8_t* const first = rest + (whole.width / 2 + 1) * (whole.height / 2 + 1) * static_cast<int64_t>(sizeof(Corner));
    const int64_t line = whole.width + kChunk;
    uint8_t* const lines[3] = {first, first + line, first + 2 * line};
    for (int32_t level = 0; level < request.levels; ++level) {
        const float scale = request.scales[level];
        if (!(scale >= 1.0f && scale < 1e4f) || request.wanted[level] < 0 || request.wanted[level] > kMaxRows) return -1;
        if (level > 0 && !pyramid.shrink(image, whole, scale)) return -1;
        const auto threshold = static_cast<uint8_t>(request.threshold);
        if (!find(image, level, scale, request.wanted[level], threshold, lines, corners, found)) return -1;
    }
    return found.rows;
}

bool fits(const rse_pf_detect_request& request) {
    return request.gray != nullptr && request.scales != nullptr && request.wanted != nullptr &&
           request.workspace != nullptr && request.width >= 2 && request.height >= 2 && request.width <= kMaxSide &&
           request.height <= kMaxSide && request.levels >= 1 && request.levels <= kMaxLevels &&
           request.threshold >= 0 && request.threshold <= 255 && request.room >= 0 && request.room <= kMaxRows &&
           rse_pf::processor().avx2;
}

}  // namespace
#else
#pragma GCC diagnostic ignored "-Wunused-parameter"  // not written for other processors: the caller uses OpenCV
#endif

extern "C" __attribute__((visibility("default"))) int64_t rse_pf_detect(const rse_pf_detect_request* request,
                                                                        float* pixels, float* responses,
                                                                        float* angles_deg, int32_t* octaves) {
#if defined(__x86_64__)
    if (request == nullptr || pixels == nullptr || responses == nullptr || angles_deg == nullptr || octaves == nullptr ||
        !fits(*request))
        return -1;
    return find_all(*request, {pixels, responses, angles_deg, octaves, request->room, 0});
#else
    return -1;
#endif
}
