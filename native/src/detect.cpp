// ORB keypoints, equal to those of OpenCV bit by bit and in the same order (Rublee et al., ORB: an efficient
// alternative to SIFT or SURF, ICCV 2011, Sect. 3).
//
// On each level of an image pyramid:
// 1. Compute the FAST score of every pixel, 32 pixels at a time: the largest threshold at which nine contiguous pixels
//    of a circle of 16 are all brighter or all darker than the centre (Rosten and Drummond, ECCV 2006).
// 2. Keep the local maxima of the score, and of these the 2 n best, where n is the number of keypoints wanted of the
//    level.
// 3. Keep the n with the highest Harris response.  Here and before, those that equal the last one are kept as well.
// 4. Compute the orientation (degrees) of each keypoint from the intensity centroid of the disc around it.
//
// Processors without AVX2 have no implementation here; the caller uses OpenCV.
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

// Distance (px) from the border of a level within which no keypoints are detected, as in OpenCV.
constexpr int64_t kBorder = 31;
// Pixels of the circle around a pixel that the FAST detector compares.
constexpr int64_t kCircle = 16;
// Pixels that are processed at a time: 32 bytes fill a register of AVX2.
constexpr int64_t kChunk = 32;
// Side (px) of the square over which the Harris response sums gradients, as in OpenCV.
constexpr int64_t kHarrisSide = 7;
// Radius (px) of the disc whose intensity centroid gives the orientation of a keypoint, as in OpenCV.
constexpr int64_t kDiscRadius = 15;
// Rows of the disc whose intensity centroid gives the orientation of a keypoint.
constexpr int64_t kDiscRows = 2 * kDiscRadius + 1;
// Half widths (px) of the rows of the disc of the intensity centroid, from the middle row to the last one.
constexpr int32_t kHalfWidths[kDiscRadius + 1] = {15, 15, 15, 15, 14, 14, 14, 13, 13, 12, 11, 10, 9, 8, 6, 3};
// Column and row of the pixels of FAST's circle, relative to its centre.
constexpr int64_t kCircleColumns[kCircle] = {0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1};
constexpr int64_t kCircleRows[kCircle] = {3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1, 0, 1, 2, 3};

RSE_PF_INLINE __m256i load_bytes(const uint8_t* at) { return _mm256_loadu_si256(reinterpret_cast<const __m256i*>(at)); }

// Return the largest of the minima of all arcs of nine contiguous numbers, of 16 on a circle; for 32 circles at a time.
RSE_PF_INLINE __m256i max_of_arc_minima(const __m256i (&circle)[kCircle]) {
    __m256i two[kCircle / 2], four[kCircle / 2], highest = _mm256_setzero_si256();
    // Arcs of eight begin at odd positions; with the position before or behind they are the arcs of nine.
    for (int64_t k = 0; k < 8; ++k) two[k] = _mm256_min_epu8(circle[2 * k + 1], circle[(2 * k + 2) % kCircle]);
    for (int64_t k = 0; k < 8; ++k) four[k] = _mm256_min_epu8(two[k], two[(k + 1) % 8]);
    for (int64_t k = 0; k < 8; ++k) {
        const __m256i ninth = _mm256_max_epu8(circle[2 * k], circle[(2 * k + 9) % kCircle]);
        const __m256i eight = _mm256_min_epu8(four[k], four[(k + 2) % 8]);
        highest = _mm256_max_epu8(highest, _mm256_min_epu8(eight, ninth));
    }
    return highest;
}

// Write the FAST score of the pixels [begin, end) of a row to scores[begin, end), 0 where it is below the threshold
// (grey levels).  Whole chunks are written, so up to 31 scores behind `end` are written as well.
RSE_PF_INLINE void score_row(const Image& image, int64_t row, int64_t begin, int64_t end, uint8_t threshold,
                             uint8_t* scores) {
    const __m256i limit = _mm256_set1_epi8(static_cast<char>(threshold)), one = _mm256_set1_epi8(1);
    const __m256i none = _mm256_setzero_si256();
    int64_t offsets[kCircle];
    for (int64_t k = 0; k < kCircle; ++k) offsets[k] = kCircleRows[k] * image.width + kCircleColumns[k];
    for (int64_t x = begin; x < end; x += kChunk) {
        const uint8_t* const at = image.pixels + row * image.width + x;
        const __m256i middle = load_bytes(at);
        __m256i darker[kCircle], brighter[kCircle];
        for (int64_t k = 0; k < kCircle; ++k) {
            const __m256i pixel = load_bytes(at + offsets[k]);
            darker[k] = _mm256_subs_epu8(middle, pixel);
            brighter[k] = _mm256_subs_epu8(pixel, middle);
        }
        const __m256i highest = _mm256_max_epu8(max_of_arc_minima(darker), max_of_arc_minima(brighter));
        const __m256i is_below = _mm256_cmpeq_epi8(_mm256_subs_epu8(highest, limit), none);
        const __m256i score = _mm256_andnot_si256(is_below, _mm256_subs_epu8(highest, one));
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(scores + x), score);
    }
}

// Write the corners of a level whose FAST score exceeds that of their eight neighbours, row by row, and return their
// number.  The rank of a corner is its score.  `lines` is scratch memory for the scores of three rows.
RSE_PF_INLINE int64_t find_corners(const Image& image, uint8_t threshold, uint8_t* const (&lines)[3], Corner* corners) {
    const int64_t begin = kBorder, end = image.width - kBorder, bottom = image.height - kBorder;
    int64_t count = 0;
    if (begin >= end || kBorder >= bottom) return 0;
    for (int64_t row = kBorder - 1; row <= bottom; ++row) {
        score_row(image, row, begin - 1, end + 1, threshold, lines[row % 3]);
        if (row <= kBorder) continue;
        const int64_t y = row - 1;
        const uint8_t *const above = lines[(y - 1) % 3], *const own = lines[y % 3], *const under = lines[(y + 1) % 3];
        for (int64_t x = begin; x < end; x += kChunk) {
            const __m256i middle = load_bytes(own + x);
            __m256i highest = _mm256_max_epu8(load_bytes(own + x - 1), load_bytes(own + x + 1));
            for (int64_t k = -1; k <= 1; ++k)
                highest = _mm256_max_epu8(highest, _mm256_max_epu8(load_bytes(above + x + k), load_bytes(under + x + k)));
            const __m256i is_less = _mm256_cmpeq_epi8(_mm256_subs_epu8(middle, highest), _mm256_setzero_si256());
            uint32_t maxima = ~static_cast<uint32_t>(_mm256_movemask_epi8(is_less));  // one bit per pixel
            if (end - x < kChunk) maxima &= (uint32_t{1} << (end - x)) - 1;
            for (; maxima != 0; maxima &= maxima - 1) {
                const int64_t column = x + __builtin_ctz(maxima);
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

RSE_PF_INLINE __m128i load_eight(const uint8_t* at) {
    return _mm_cvtepu8_epi16(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(at)));
}

// Return the Harris response of the 7x7 pixels around the pixel with an index in the image, from Sobel gradients and
// with Harris' constant k = 0.04, as OpenCV scales it.
RSE_PF_INLINE float harris_response(const Image& image, int64_t index) {
    constexpr int64_t kRadius = kHarrisSide / 2;
    const __m128i seven = _mm_setr_epi16(-1, -1, -1, -1, -1, -1, -1, 0);
    __m128i slopes[kHarrisSide + 2], smooth[kHarrisSide + 2];
    for (int64_t y = 0; y < kHarrisSide + 2; ++y) {
        const uint8_t* const at = image.pixels + index + (y - kRadius - 1) * image.width - kRadius;
        const __m128i left = load_eight(at - 1), middle = load_eight(at), right = load_eight(at + 1);
        slopes[y] = _mm_and_si128(_mm_sub_epi16(right, left), seven);
        smooth[y] = _mm_and_si128(_mm_add_epi16(_mm_add_epi16(left, right), _mm_slli_epi16(middle, 1)), seven);
    }
    __m128i xx = _mm_setzero_si128(), yy = xx, xy = xx;
    for (int64_t y = 1; y <= kHarrisSide; ++y) {
        const __m128i neighbours = _mm_add_epi16(slopes[y - 1], slopes[y + 1]);
        const __m128i across = _mm_add_epi16(neighbours, _mm_slli_epi16(slopes[y], 1));
        const __m128i down = _mm_sub_epi16(smooth[y + 1], smooth[y - 1]);
        xx = _mm_add_epi32(xx, _mm_madd_epi16(across, across));
        yy = _mm_add_epi32(yy, _mm_madd_epi16(down, down));
        xy = _mm_add_epi32(xy, _mm_madd_epi16(across, down));
    }
    constexpr float kScale = 1.0f / (4 * kHarrisSide * 255.0f), kHarrisConstant = 0.04f;
    const auto a = static_cast<float>(sum_of(xx)), b = static_cast<float>(sum_of(yy)), c = static_cast<float>(sum_of(xy));
    return (a * b - c * c - kHarrisConstant * (a + b) * (a + b)) * (kScale * kScale * kScale * kScale);
}

// The weights of the pixels of each row of the disc in its moments: the column relative to the centre for the first
// moment, and 1 for the sum; both are 0 outside of the disc.
struct Disc {
    int8_t columns[kDiscRows][kChunk], inside[kDiscRows][kChunk];

    constexpr Disc() : columns(), inside() {
        for (int64_t y = 0; y < kDiscRows; ++y)
            for (int64_t x = 0; x < kDiscRows; ++x) {
                const int64_t down = y < kDiscRadius ? kDiscRadius - y : y - kDiscRadius;
                const int64_t across = x < kDiscRadius ? kDiscRadius - x : x - kDiscRadius;
                if (across > kHalfWidths[down]) continue;
                columns[y][x] = static_cast<int8_t>(x - kDiscRadius);
                inside[y][x] = 1;
            }
    }
};

constexpr Disc kWeights;

// Return the angle of a vector from the x axis towards the y axis in degrees, 0..360, by the polynomial of
// cv::fastAtan2.
RSE_PF_INLINE float angle_deg(float y, float x) {
    constexpr double kDegrees = 180.0 / 3.1415926535897932384626433832795;
    constexpr float kDegreesPerRadian = static_cast<float>(kDegrees);
    constexpr float p1 = 0.9997878412794807f * kDegreesPerRadian, p3 = -0.3258083974640975f * kDegreesPerRadian;
    constexpr float p5 = 0.1555786518463281f * kDegreesPerRadian, p7 = -0.04432655554792128f * kDegreesPerRadian;
    const float across = x < 0.0f ? -x : x, down = y < 0.0f ? -y : y;
    const bool is_flat = across >= down;
    const float epsilon = 2.2204460492503131e-16f;
    const float c = is_flat ? down / (across + epsilon) : across / (down + epsilon), c2 = c * c;
    const float octant_angle = (((p7 * c2 + p5) * c2 + p3) * c2 + p1) * c;
    float angle = is_flat ? octant_angle : 90.0f - octant_angle;
    if (x < 0.0f) angle = 180.0f - angle;
    return y < 0.0f ? 360.0f - angle : angle;
}

// Return the orientation of the keypoint at the pixel with an index in the image: the direction from this pixel to the
// intensity centroid of the disc around it, in degrees, 0..360, clockwise from the x axis.
RSE_PF_INLINE float orientation_deg(const Image& image, int64_t index) {
    const __m256i ones = _mm256_set1_epi16(1);
    __m256i across = _mm256_setzero_si256(), down = across;
    for (int64_t y = 0; y < kDiscRows; ++y) {
        const __m256i pixels = load_bytes(image.pixels + index + (y - kDiscRadius) * image.width - kDiscRadius);
        const __m256i columns = load_bytes(reinterpret_cast<const uint8_t*>(kWeights.columns[y]));
        const __m256i inside = load_bytes(reinterpret_cast<const uint8_t*>(kWeights.inside[y]));
        const __m256i rows = _mm256_set1_epi16(static_cast<int16_t>(y - kDiscRadius));
        across = _mm256_add_epi32(across, _mm256_madd_epi16(_mm256_maddubs_epi16(pixels, columns), ones));
        down = _mm256_add_epi32(down, _mm256_madd_epi16(_mm256_maddubs_epi16(pixels, inside), rows));
    }
    const __m128i x = _mm_add_epi32(_mm256_castsi256_si128(across), _mm256_extracti128_si256(across, 1));
    const __m128i y = _mm_add_epi32(_mm256_castsi256_si128(down), _mm256_extracti128_si256(down, 1));
    return angle_deg(static_cast<float>(sum_of(y)), static_cast<float>(sum_of(x)));
}

// The arrays of the caller, with room for `room` keypoints, and the number of keypoints written so far.
struct Keypoints {
    float *pixels, *responses, *angles_deg;
    int32_t* octaves;
    int64_t room, rows;
};

// Detect the keypoints of one level, about `wanted` of them, and append them to `keypoints`, with pixels of the whole
// image.  Return false if there is no room for them, or if OpenCV's order is not known.  lines, corners: scratch
// memory.
RSE_PF_INLINE bool detect_level(const Image& image, int32_t octave, float scale, int64_t wanted, uint8_t threshold,
                                uint8_t* const (&lines)[3], Corner* corners, Keypoints& keypoints) {
    int64_t count = find_corners(image, threshold, lines, corners);
    count = rse_pf::keep_best(corners, count, 2 * wanted);
    for (int64_t i = 0; i < count; ++i) corners[i].rank = harris_response(image, corners[i].index);
    if (count >= 0) count = rse_pf::keep_best(corners, count, wanted);
    if (count < 0 || count > keypoints.room - keypoints.rows) return false;
    for (int64_t i = 0; i < count; ++i, ++keypoints.rows) {
        const int64_t index = corners[i].index;
        keypoints.pixels[2 * keypoints.rows] = static_cast<float>(index % image.width) * scale;
        keypoints.pixels[2 * keypoints.rows + 1] = static_cast<float>(index / image.width) * scale;
        keypoints.responses[keypoints.rows] = corners[i].rank;
        keypoints.angles_deg[keypoints.rows] = orientation_deg(image, index);
        keypoints.octaves[keypoints.rows] = octave;
    }
    return true;
}

RSE_PF_AVX2 int64_t detect_all(const rse_pf_detect_request& request, Keypoints keypoints) {
    Image image = {request.gray, request.width, request.height};
    const Image whole = image;
    Pyramid pyramid;
    uint8_t* const rest = pyramid.divide_workspace(request.workspace, whole.width, whole.height);
    Corner* const corners = reinterpret_cast<Corner*>(rest);
    uint8_t* const first = rest + (whole.width / 2 + 1) * (whole.height / 2 + 1) * static_cast<int64_t>(sizeof(Corner));
    const int64_t line = whole.width + kChunk;
    uint8_t* const lines[3] = {first, first + line, first + 2 * line};
    for (int32_t level = 0; level < request.levels; ++level) {
        const float scale = request.scales[level];
        if (!(scale >= 1.0f && scale < 1e4f) || request.wanted[level] < 0 || request.wanted[level] > kMaxRows) return -1;
        if (level > 0 && !pyramid.shrink(image, whole, scale)) return -1;
        const auto threshold = static_cast<uint8_t>(request.threshold);
        if (!detect_level(image, level, scale, request.wanted[level], threshold, lines, corners, keypoints)) return -1;
    }
    return keypoints.rows;
}

bool is_valid(const rse_pf_detect_request& request) {
    return request.gray != nullptr && request.scales != nullptr && request.wanted != nullptr &&
           request.workspace != nullptr && request.width >= 2 && request.height >= 2 && request.width <= kMaxSide &&
           request.height <= kMaxSide && request.levels >= 1 && request.levels <= kMaxLevels &&
           request.threshold >= 0 && request.threshold <= 255 && request.room >= 0 && request.room <= kMaxRows &&
           rse_pf::processor().avx2;
}

}  // namespace
#else
#pragma GCC diagnostic ignored "-Wunused-parameter"  // Other processors have no implementation: the caller uses OpenCV.
#endif

extern "C" __attribute__((visibility("default"))) int64_t rse_pf_detect(const rse_pf_detect_request* request,
                                                                        float* pixels, float* responses,
                                                                        float* angles_deg, int32_t* octaves) {
#if defined(__x86_64__)
    if (request == nullptr || pixels == nullptr || responses == nullptr || angles_deg == nullptr || octaves == nullptr ||
        !is_valid(*request))
        return -1;
    return detect_all(*request, {pixels, responses, angles_deg, octaves, request->room, 0});
#else
    return -1;
#endif
}
