// Sparse stereo matching of a rectified pair: normalised cross-correlation along the row, a left-right check, and
// sub-pixel refinement by least squares.  rse_pf/slam/stereo.py calls it.
//
// Sums of products of pixels are integers, and everything else is single IEEE 754 operations in one order, so the
// choice of instructions below changes no byte of the result.
#include "rse_pf_stereo.h"

#include <cstring>

#include "processor.hpp"

// A function that is inlined into a function for AVX2 is compiled for AVX2 as well.
#define RSE_PF_STEREO_INLINE inline __attribute__((always_inline))
#if defined(__x86_64__)
#include <immintrin.h>
#define RSE_PF_STEREO_AVX2 __attribute__((target("avx2")))
#endif

namespace {

// Most features of a request: a limit of plausible requests.
constexpr int64_t kMaxRows = int64_t{1} << 24;
// Largest height or width of an image, pixels: a limit of plausible requests.
constexpr int64_t kMaxSide = int64_t{1} << 16;
// Pixels that the patch of a feature reaches on each side: patches of 11 x 11 px are correlated.
constexpr int64_t kRadius = 5;
// Side of the patch of a feature, pixels.
constexpr int64_t kSide = 2 * kRadius + 1;
// Number of pixels in the patch of a feature.
constexpr int64_t kCount = kSide * kSide;
// Numbers that store a row of a patch: 16 fill a vector, and those behind the patch are zero, so that they do not
// count.
constexpr int64_t kPaddedSide = 16;
// Numbers that store a row of the search strip: all pixels of the other image that a search can read.
constexpr int64_t kStrip = RSE_PF_STEREO_MAX_DISPARITY_PX + kSide + kPaddedSide;
// Distance (px) from the best disparity within which other disparities are not its rivals: the correlation has a broad
// peak.
constexpr int64_t kPeakRadius = 2;
// Most Gauss-Newton steps of the sub-pixel refinement of a disparity.
constexpr int kMaxSteps = 8;
// Step (px) of the sub-pixel refinement of a disparity below which the refinement has converged and stops.
constexpr double kConvergedPx = 0.002;
// Largest distance (px) between the refined disparity and the integer disparity: farther away lies another peak of the
// correlation, and the feature gets no disparity.
constexpr double kMaxShiftPx = 1.25;
// Largest last step (px) of a sub-pixel refinement whose result is accepted, although it has not converged.
constexpr double kMaxLastStepPx = 0.05;

double not_a_number() { return __builtin_nan(""); }
RSE_PF_STEREO_INLINE double absolute(double value) { return value < 0.0 ? -value : value; }

// The image that holds a feature (`from`), and the image in which it is searched for (`to`); both are height x width
// grey levels, row-major.
struct Images {
    const uint8_t *from, *to;
    int64_t width, height;
};

// The pixels of a patch, their sum and the sum of their squares.  Such sums times kCount stay below 2^30, so they fit
// into 32 bits.
struct Patch {
    int16_t pixels[kSide][kPaddedSide];
    int32_t sum, sum2;
};

RSE_PF_STEREO_INLINE Patch read_patch(const Images& images, int64_t column, int64_t row) {
    Patch patch = {};
    for (int64_t y = 0; y < kSide; ++y) {
        const uint8_t* const line = images.from + (row - kRadius + y) * images.width + column - kRadius;
        for (int64_t x = 0; x < kSide; ++x) {
            const int32_t pixel = line[x];
            patch.pixels[y][x] = static_cast<int16_t>(pixel);
            patch.sum += pixel;
            patch.sum2 += pixel * pixel;
        }
    }
    return patch;
}

// Write to products[k] the sum of the products of the patch's pixels with those of the strip from column k on, for k
// from 0 to count - 1.
void correlate_portably(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products) {
    for (int64_t at = 0; at < count; ++at, ++strip) {
#if defined(__x86_64__)
        __m128i sum = _mm_setzero_si128();
        for (int64_t y = 0; y < kSide; ++y) {
            const auto* const own = reinterpret_cast<const __m128i*>(patch.pixels[y]);
            const auto* const other = reinterpret_cast<const __m128i*>(strip + y * kStrip);
            sum = _mm_add_epi32(sum, _mm_madd_epi16(_mm_loadu_si128(own), _mm_loadu_si128(other)));
            sum = _mm_add_epi32(sum, _mm_madd_epi16(_mm_loadu_si128(own + 1), _mm_loadu_si128(other + 1)));
        }
        sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0x4e));
        products[at] = _mm_cvtsi128_si32(_mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0xb1)));
#else
        int32_t sum = 0;
        for (int64_t y = 0; y < kSide; ++y)
            for (int64_t x = 0; x < kSide; ++x) sum += patch.pixels[y][x] * strip[y * kStrip + x];
        products[at] = sum;
#endif
    }
}

#if defined(__x86_64__)
RSE_PF_STEREO_AVX2 void correlate_with_avx2(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products) {
    __m256i own[kSide];
    for (int64_t y = 0; y < kSide; ++y) own[y] = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(patch.pixels[y]));
    for (int64_t at = 0; at < count; ++at, ++strip) {
        __m256i sum = _mm256_setzero_si256();
        for (int64_t y = 0; y < kSide; ++y) {
            const auto* const other = reinterpret_cast<const __m256i*>(strip + y * kStrip);
            sum = _mm256_add_epi32(sum, _mm256_madd_epi16(own[y], _mm256_loadu_si256(other)));
        }
        __m128i half = _mm_add_epi32(_mm256_castsi256_si128(sum), _mm256_extracti128_si256(sum, 1));
        half = _mm_add_epi32(half, _mm_shuffle_epi32(half, 0x4e));
        products[at] = _mm_cvtsi128_si32(_mm_add_epi32(half, _mm_shuffle_epi32(half, 0xb1)));
    }
}
#endif

using Correlate = void(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products);

// The best disparity (px) of a search, its squared correlation with the sign of the correlation (-1..1), and the same
// of the best disparity that is more than kPeakRadius away.  A correlation is -1 where there is nothing to compare.
struct Match {
    int64_t disparity = 0;
    double correlation2 = -1.0, rival_correlation2 = -1.0;
};

// Find the disparity d, 0..max_disparity, for which the patch at (column, row) of images.from correlates best with that
// at (column + sign * d, row) of images.to.  The smallest of equally good disparities is taken.  A patch without
// contrast, or without a patch in reach in the other image, has the correlation -1.
RSE_PF_STEREO_INLINE Match find_match(const Images& images, int64_t column, int64_t row, int64_t max_disparity,
                                      int64_t sign, Correlate* correlate) {
    Match best;
    const Patch patch = read_patch(images, column, row);
    const int32_t variance = static_cast<int32_t>(kCount) * patch.sum2 - patch.sum * patch.sum;
    if (variance <= 0) return best;
    // 1. Find the first and last column of the search range whose patch lies inside the other image.
    int64_t first = sign < 0 ? column - max_disparity : column, last = sign < 0 ? column : column + max_disparity;
    first = first < kRadius + 1 ? kRadius + 1 : first;
    last = last > images.width - kRadius - 2 ? images.width - kRadius - 2 : last;
    if (first > last) return best;
    // 2. Copy the pixels of these patches to a strip, and sum pixels and squares of each column of the strip.
    const int64_t count = last - first + 1, width = last - first + kSide;
    int16_t strip[kSide * kStrip];
    int32_t sums[kStrip], squares[kStrip];
    std::memset(sums, 0, static_cast<size_t>(width) * sizeof *sums);
    std::memset(squares, 0, static_cast<size_t>(width) * sizeof *squares);
    for (int64_t y = 0; y < kSide; ++y) {
        const uint8_t* const line = images.to + (row - kRadius + y) * images.width + first - kRadius;
        int16_t* const into = strip + y * kStrip;
        for (int64_t x = 0; x < width; ++x) {
            const int32_t pixel = line[x];
            into[x] = static_cast<int16_t>(pixel);
            sums[x] += pixel;
            squares[x] += pixel * pixel;
        }
        std::memset(into + width, 0, kPaddedSide * sizeof *into);
    }
    // 3. For the patch centred at column first + at, compute the sums of its pixels and squares by running sums.
    constexpr int64_t kMaxOffsets = RSE_PF_STEREO_MAX_DISPARITY_PX + 1;
    int32_t sum[kMaxOffsets], sum2[kMaxOffsets], products[kMaxOffsets];
    double correlation2[kMaxOffsets];
    int32_t running = 0, running2 = 0;
    for (int64_t x = 0; x < kSide - 1; ++x) {
        running += sums[x];
        running2 += squares[x];
    }
    for (int64_t at = 0; at < count; ++at) {
        running += sums[at + kSide - 1];
        running2 += squares[at + kSide - 1];
        sum[at] = running;
        sum2[at] = running2;
        running -= sums[at];
        running2 -= squares[at];
    }
    // 4. Compute the squared correlation of each offset, with the sign of the correlation.
    correlate(patch, strip, count, products);
    const auto patch_variance = static_cast<double>(variance);
    for (int64_t at = 0; at < count; ++at) {
        const int32_t other_variance = static_cast<int32_t>(kCount) * sum2[at] - sum[at] * sum[at];
        const int32_t product = static_cast<int32_t>(kCount) * products[at] - patch.sum * sum[at];
        const auto covariance = static_cast<double>(product);
        const double squared = covariance * absolute(covariance) /
                               (patch_variance * static_cast<double>(other_variance > 0 ? other_variance : 1));
        correlation2[at] = other_variance > 0 ? squared : -1.0;
    }
    // 5. In the order of ascending disparities, take the best one, then the best one more than kPeakRadius away from
    // it.
    const int64_t start = sign < 0 ? count - 1 : 0, step = sign;
    const int64_t min_disparity = sign < 0 ? column - last : first - column;
    for (int64_t i = 0; i < count; ++i)
        if (correlation2[start + step * i] > best.correlation2) {
            best.correlation2 = correlation2[start + step * i];
            best.disparity = i;
        }
    for (int64_t i = 0; i < count; ++i)
        if ((i < best.disparity - kPeakRadius || i > best.disparity + kPeakRadius) &&
            correlation2[start + step * i] > best.rival_correlation2)
            best.rival_correlation2 = correlation2[start + step * i];
    best.disparity += min_disparity;
    return best;
}

RSE_PF_STEREO_INLINE double mean_of(const double (&values)[kCount]) {
    double sum = 0.0;
    for (const double value : values) sum += value;
    return sum / static_cast<double>(kCount);
}

RSE_PF_STEREO_INLINE double dot(const double (&a)[kCount], const double (&b)[kCount]) {
    double lanes[8] = {};
    int64_t i = 0;
    for (; i + 8 <= kCount; i += 8)
        for (int64_t k = 0; k < 8; ++k) lanes[k] += a[i + k] * b[i + k];
    double sum = ((lanes[0] + lanes[4]) + (lanes[1] + lanes[5])) + ((lanes[2] + lanes[6]) + (lanes[3] + lanes[7]));
    for (; i < kCount; ++i) sum += a[i] * b[i];
    return sum;
}

RSE_PF_STEREO_INLINE void subtract_mean(double (&values)[kCount]) {
    const double mean = mean_of(values);
    for (double& value : values) value -= mean;
}

// Refine an integer disparity to a fraction of a pixel by least squares matching: Gauss-Newton steps on the difference
// of the patches L (left) and R (right, interpolated), after the mean and the gain of brightness are removed.  Return
// NaN where the steps do not converge or lead too far, where the right patch leaves the image, or where the squared
// correlation of the patches is below min_correlation2.
RSE_PF_STEREO_INLINE double refine_disparity(const Images& images, int64_t column, int64_t row, int64_t disparity,
                                             double min_correlation2) {
    // 1. Read the left patch and its horizontal gradient, and subtract their means.  Subtract from the gradient its
    // part that is a multiple of the patch: a change of gain would explain that part.
    double L[kCount], slopes[kCount], R[kCount];
    for (int64_t y = 0, i = 0; y < kSide; ++y) {
        const uint8_t* const line = images.from + (row - kRadius + y) * images.width + column - kRadius;
        for (int64_t x = 0; x < kSide; ++x, ++i) {
            L[i] = line[x];
            slopes[i] = (static_cast<double>(line[x + 1]) - static_cast<double>(line[x - 1])) / 2.0;
        }
    }
    subtract_mean(L);
    subtract_mean(slopes);
    const double left2 = dot(L, L), gain = dot(slopes, L) / left2;
    for (int64_t i = 0; i < kCount; ++i) slopes[i] -= gain * L[i];
    const double information = dot(slopes, slopes);
    if (!(information > 0.0)) return not_a_number();
    const auto start = static_cast<double>(disparity);
    double refined = start, last_step = kMaxShiftPx, correlation2 = 0.0;
    for (int step = 0; step < kMaxSteps && !(last_step < kConvergedPx); ++step) {
        // 2. Interpolate the right patch at the present disparity, and subtract its mean.
        const double x = static_cast<double>(column) - refined;
        const double whole = __builtin_floor(x), share = x - whole;
        const int64_t first = static_cast<int64_t>(whole) - kRadius;
        if (first < 0 || first + kSide >= images.width) return not_a_number();
        for (int64_t v = 0, i = 0; v < kSide; ++v) {
            const uint8_t* const line = images.to + (row - kRadius + v) * images.width + first;
            for (int64_t u = 0; u < kSide; ++u, ++i)
                R[i] = (1.0 - share) * static_cast<double>(line[u]) + share * static_cast<double>(line[u + 1]);
        }
        subtract_mean(R);
        // 3. Scale the right patch to the gain of the left one, and add to the disparity the shift along the gradient
        // that explains the difference of the patches.
        const double right2 = dot(R, R), product = dot(L, R);
        if (!(right2 > 0.0 && product > 0.0)) return not_a_number();
        const double move = product / right2 * dot(slopes, R) / information;
        correlation2 = product * product / (left2 * right2);
        if (!(absolute(refined + move - start) <= kMaxShiftPx)) return not_a_number();
        refined += move;
        last_step = absolute(move);
    }
    return last_step <= kMaxLastStepPx && correlation2 >= min_correlation2 ? refined : not_a_number();
}

bool is_valid(const rse_pf_stereo_request& request) {
    return request.abi == RSE_PF_STEREO_ABI && (request.flags & ~RSE_PF_STEREO_PORTABLE) == 0 && request.left != nullptr &&
           request.right != nullptr && request.pixels != nullptr && request.rows >= 0 && request.rows <= kMaxRows &&
           request.width >= 1 && request.height >= 1 && request.width <= kMaxSide && request.height <= kMaxSide &&
           request.max_disparity_px >= 1 && request.max_disparity_px <= RSE_PF_STEREO_MAX_DISPARITY_PX &&
           request.left_right_px <= RSE_PF_STEREO_MAX_DISPARITY_PX && request.min_disparity_px > 0.0 &&
           request.min_correlation2 > 0.0 && request.uniqueness > 0.0;
}

// Return the disparity (px) of the feature at a pixel of the left image, NaN where no match passes the limits.
RSE_PF_STEREO_INLINE double measure_disparity(const rse_pf_stereo_request& request, const double* pixel,
                                              Correlate* correlate) {
    // 1. Round the feature to the nearest pixel; the patch around it, with one pixel more on each side, must lie inside
    // the image.
    const double u = __builtin_rint(pixel[0]), v = __builtin_rint(pixel[1]);
    const bool is_inside = u >= static_cast<double>(kRadius + 1) && v >= static_cast<double>(kRadius + 1) &&
                           u <= static_cast<double>(request.width - kRadius - 2) &&
                           v <= static_cast<double>(request.height - kRadius - 2);
    if (!is_inside) return not_a_number();
    const auto column = static_cast<int64_t>(u), row = static_cast<int64_t>(v);
    // 2. Find the match in the right image; its correlation must be high enough, and clearly above that of its rival.
    const Images left_to_right = {request.left, request.right, request.width, request.height};
    const Match match = find_match(left_to_right, column, row, request.max_disparity_px, -1, correlate);
    if (!(match.correlation2 >= request.min_correlation2 &&
          1.0 - match.correlation2 < request.uniqueness * (1.0 - match.rival_correlation2)))
        return not_a_number();
    // 3. Search back in the left image, which must lead to the feature again.
    if (request.left_right_px >= 0) {
        const Images right_to_left = {request.right, request.left, request.width, request.height};
        const Match back =
            find_match(right_to_left, column - match.disparity, row, request.max_disparity_px, 1, correlate);
        const int64_t difference = back.disparity - match.disparity;
        if (difference > request.left_right_px || difference < -request.left_right_px) return not_a_number();
    }
    // 4. Refine the disparity to a fraction of a pixel; it must not be below the smallest one of the request.
    const double disparity = refine_disparity(left_to_right, column, row, match.disparity, request.min_correlation2);
    return disparity >= request.min_disparity_px ? disparity : not_a_number();
}

void match_portably(const rse_pf_stereo_request& request, double* disparities) {
    for (int64_t i = 0; i < request.rows; ++i)
        disparities[i] = measure_disparity(request, request.pixels + 2 * i, correlate_portably);
}

#if defined(__x86_64__)
RSE_PF_STEREO_AVX2 void match_with_avx2(const rse_pf_stereo_request& request, double* disparities) {
    for (int64_t i = 0; i < request.rows; ++i)
        disparities[i] = measure_disparity(request, request.pixels + 2 * i, correlate_with_avx2);
}
#endif

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_stereo_abi(void) { return RSE_PF_STEREO_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_disparities(const rse_pf_stereo_request* request,
                                                                  double* disparities) {
    if (request == nullptr || disparities == nullptr || !is_valid(*request)) return -1;
#if defined(__x86_64__)
    if ((request->flags & RSE_PF_STEREO_PORTABLE) == 0 && rse_pf::processor().avx2) {
        match_with_avx2(*request, disparities);
        return 0;
    }
#endif
    match_portably(*request, disparities);
    return 0;
}
}
