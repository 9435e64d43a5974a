// Disparities of features between the two images of a rectified stereo pair; rse_pf/slam/stereo.py says why.
//
// Sums of products of pixels are integers, and everything else is single IEEE operations in one order, so the
// instructions chosen below change no byte.
#include "rse_pf_stereo.h"

#include <cstring>

#include "processor.hpp"

// What is inlined into a function for AVX2 is compiled for it.
#define RSE_PF_STEREO_INLINE inline __attribute__((always_inline))
#if defined(__x86_64__)
#include <immintrin.h>
#define RSE_PF_STEREO_AVX2 __attribute__((target("avx2")))
#endif

namespace {

constexpr int64_t kMaxRows = int64_t{1} << 24, kMaxSide = int64_t{1} << 16;
constexpr int64_t kRadius = 5, kSide = 2 * kRadius + 1, kCount = kSide * kSide;
// A row of a patch, filled up with zeros, so that what stands beside it in the image does not count.
constexpr int64_t kWide = 16;
constexpr int64_t kStrip = RSE_PF_STEREO_MOST + kSide + kWide;
constexpr int64_t kBeside = 2;
constexpr int kSteps = 8;
constexpr double kConvergedPx = 0.002, kFarPx = 1.25, kStepPx = 0.05;

double not_a_number() { return __builtin_nan(""); }
RSE_PF_STEREO_INLINE double absolute(double value) { return value < 0.0 ? -value : value; }

struct Images {
    const uint8_t *from, *to;
    int64_t width, height;
};

// One patch with its sums.  All sums of products, times kCount, are below 2^30.
struct Patch {
    int16_t pixels[kSide][kWide];
    int32_t sum, sum2;
};

RSE_PF_STEREO_INLINE Patch patch_at(const Images& images, int64_t column, int64_t row) {
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

// Write the sums of products of a patch with the pixels that begin at each of the first places of a strip.
void products_portably(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products) {
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
RSE_PF_STEREO_AVX2 void products_by_avx2(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products) {
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

using Products = void(const Patch& patch, const int16_t* strip, int64_t count, int32_t* products);

struct Best {
    int64_t disparity = 0;
    double likeness = -1.0, rival = -1.0;
};

// Seek the patch of an image at a pixel in the other one, at column + sign * d; the first of equals is taken.
RSE_PF_STEREO_INLINE Best searched(const Images& images, int64_t column, int64_t row, int64_t most, int64_t sign,
                                   Products* write_products) {
    Best best;
    const Patch patch = patch_at(images, column, row);
    const int32_t variance = static_cast<int32_t>(kCount) * patch.sum2 - patch.sum * patch.sum;
    if (variance <= 0) return best;
    // Centres of patches that lie within the image, from left to right.
    int64_t first = sign < 0 ? column - most : column, last = sign < 0 ? column : column + most;
    first = first < kRadius + 1 ? kRadius + 1 : first;
    last = last > images.width - kRadius - 2 ? images.width - kRadius - 2 : last;
    if (first > last) return best;
    const int64_t count = last - first + 1, wide = last - first + kSide;
    int16_t strip[kSide * kStrip];
    int32_t sums[kStrip], squares[kStrip];
    std::memset(sums, 0, static_cast<size_t>(wide) * sizeof *sums);
    std::memset(squares, 0, static_cast<size_t>(wide) * sizeof *squares);
    for (int64_t y = 0; y < kSide; ++y) {
        const uint8_t* const line = images.to + (row - kRadius + y) * images.width + first - kRadius;
        int16_t* const into = strip + y * kStrip;
        for (int64_t x = 0; x < wide; ++x) {
            const int32_t pixel = line[x];
            into[x] = static_cast<int16_t>(pixel);
            sums[x] += pixel;
            squares[x] += pixel * pixel;
        }
        std::memset(into + wide, 0, kWide * sizeof *into);
    }
    // Of the patch that is centred at first + at.
    int32_t sum[RSE_PF_STEREO_MOST + 1], sum2[RSE_PF_STEREO_MOST + 1], products[RSE_PF_STEREO_MOST + 1];
    double likeness[RSE_PF_STEREO_MOST + 1];
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
    write_products(patch, strip, count, products);
    const auto own = static_cast<double>(variance);
    for (int64_t at = 0; at < count; ++at) {
        const int32_t other = static_cast<int32_t>(kCount) * sum2[at] - sum[at] * sum[at];
        const int32_t shared = static_cast<int32_t>(kCount) * products[at] - patch.sum * sum[at];
        const auto covariance = static_cast<double>(shared);
        const double squared = covariance * absolute(covariance) / (own * static_cast<double>(other > 0 ? other : 1));
        likeness[at] = other > 0 ? squared : -1.0;
    }
    // By growing disparities, the nearest of which is here.
    const int64_t nearest = sign < 0 ? count - 1 : 0, step = sign;
    const int64_t least = sign < 0 ? column - last : first - column;
    for (int64_t i = 0; i < count; ++i)
        if (likeness[nearest + step * i] > best.likeness) {
            best.likeness = likeness[nearest + step * i];
            best.disparity = i;
        }
    for (int64_t i = 0; i < count; ++i)
        if ((i < best.disparity - kBeside || i > best.disparity + kBeside) &&
            likeness[nearest + step * i] > best.rival)
            best.rival = likeness[nearest + step * i];
    best.disparity += least;
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

RSE_PF_STEREO_INLINE void centre(double (&values)[kCount]) {
    const double mean = mean_of(values);
    for (double& value : values) value -= mean;
}

// Return the disparity with its fraction, NaN where the least squares fail.
RSE_PF_STEREO_INLINE double refined(const Images& images, int64_t column, int64_t row, int64_t best, double min_likeness) {
    double L[kCount], slopes[kCount], R[kCount];
    for (int64_t y = 0, i = 0; y < kSide; ++y) {
        const uint8_t* const line = images.from + (row - kRadius + y) * images.width + column - kRadius;
        for (int64_t x = 0; x < kSide; ++x, ++i) {
            L[i] = line[x];
            slopes[i] = (static_cast<double>(line[x + 1]) - static_cast<double>(line[x - 1])) / 2.0;
        }
    }
    centre(L);
    centre(slopes);
    const double own2 = dot(L, L), gain = dot(slopes, L) / own2;
    for (int64_t i = 0; i < kCount; ++i) slopes[i] -= gain * L[i];
    const double information = dot(slopes, slopes);
    if (!(information > 0.0)) return not_a_number();
    const auto begin = static_cast<double>(best);
    double found = begin, last = kFarPx, likeness = 0.0;
    for (int step = 0; step < kSteps && !(last < kConvergedPx); ++step) {
        const double x = static_cast<double>(column) - found;
        const double whole = __builtin_floor(x), share = x - whole;
        const int64_t near = static_cast<int64_t>(whole) - kRadius;
        if (near < 0 || near + kSide >= images.width) return not_a_number();
        for (int64_t v = 0, i = 0; v < kSide; ++v) {
            const uint8_t* const line = images.to + (row - kRadius + v) * images.width + near;
            for (int64_t u = 0; u < kSide; ++u, ++i)
                R[i] = (1.0 - share) * static_cast<double>(line[u]) + share * static_cast<double>(line[u + 1]);
        }
        centre(R);
        const double other2 = dot(R, R), shared = dot(L, R);
        if (!(other2 > 0.0 && shared > 0.0)) return not_a_number();
        const double move = shared / other2 * dot(slopes, R) / information;
        likeness = shared * shared / (own2 * other2);
        if (!(absolute(found + move - begin) <= kFarPx)) return not_a_number();
        found += move;
        last = absolute(move);
    }
    return last <= kStepPx && likeness >= min_likeness ? found : not_a_number();
}

bool fits(const rse_pf_stereo_request& request) {
    return request.abi == RSE_PF_STEREO_ABI && (request.flags & ~RSE_PF_STEREO_PORTABLE) == 0 && request.left != nullptr &&
           request.right != nullptr && request.pixels != nullptr && request.rows >= 0 && request.rows <= kMaxRows &&
           request.width >= 1 && request.height >= 1 && request.width <= kMaxSide && request.height <= kMaxSide &&
           request.max_disparity_px >= 1 && request.max_disparity_px <= RSE_PF_STEREO_MOST &&
           request.left_right_px <= RSE_PF_STEREO_MOST && request.min_disparity_px > 0.0 &&
           request.min_likeness > 0.0 && request.uniqueness > 0.0;
}

RSE_PF_STEREO_INLINE double disparity_of(const rse_pf_stereo_request& request, const double* pixel,
                                         Products* write_products) {
    const double u = __builtin_rint(pixel[0]), v = __builtin_rint(pixel[1]);
    const bool is_inside = u >= static_cast<double>(kRadius + 1) && v >= static_cast<double>(kRadius + 1) &&
                           u <= static_cast<double>(request.width - kRadius - 2) &&
                           v <= static_cast<double>(request.height - kRadius - 2);
    if (!is_inside) return not_a_number();
    const auto column = static_cast<int64_t>(u), row = static_cast<int64_t>(v);
    const Images there = {request.left, request.right, request.width, request.height};
    const Best best = searched(there, column, row, request.max_disparity_px, -1, write_products);
    if (!(best.likeness >= request.min_likeness && 1.0 - best.likeness < request.uniqueness * (1.0 - best.rival)))
        return not_a_number();
    if (request.left_right_px >= 0) {
        const Images back = {request.right, request.left, request.width, request.height};
        const Best again = searched(back, column - best.disparity, row, request.max_disparity_px, 1, write_products);
        const int64_t apart = again.disparity - best.disparity;
        if (apart > request.left_right_px || apart < -request.left_right_px) return not_a_number();
    }
    const double found = refined(there, column, row, best.disparity, request.min_likeness);
    return found >= request.min_disparity_px ? found : not_a_number();
}

void match_portably(const rse_pf_stereo_request& request, double* disparities) {
    for (int64_t i = 0; i < request.rows; ++i)
        disparities[i] = disparity_of(request, request.pixels + 2 * i, products_portably);
}

#if defined(__x86_64__)
RSE_PF_STEREO_AVX2 void match_by_avx2(const rse_pf_stereo_request& request, double* disparities) {
    for (int64_t i = 0; i < request.rows; ++i)
        disparities[i] = disparity_of(request, request.pixels + 2 * i, products_by_avx2);
}
#endif

}  // namespace

extern "C" {

__attribute__((visibility("default"))) uint32_t rse_pf_stereo_abi(void) { return RSE_PF_STEREO_ABI; }

__attribute__((visibility("default"))) int32_t rse_pf_disparities(const rse_pf_stereo_request* request,
                                                                  double* disparities) {
    if (request == nullptr || disparities == nullptr || !fits(*request)) return -1;
#if defined(__x86_64__)
    if ((request->flags & RSE_PF_STEREO_PORTABLE) == 0 && rse_pf::processor().avx2) {
        match_by_avx2(*request, disparities);
        return 0;
    }
#endif
    match_portably(*request, disparities);
    return 0;
}
}
