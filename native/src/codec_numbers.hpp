// Decimal numbers to the nearest double, as JSON writes them; what is rare is left to others.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#include "codec_guards.hpp"
#include "powers_of_ten.hpp"

namespace rse_pf_codec {

// A number as it stands in a text: (-1)^is_negative * digits * 10^exponent.
struct Decimal {
    uint64_t digits;
    int32_t exponent;
    bool is_negative;
    bool is_integer;  // neither a point nor an exponent was written
    bool has_exponent;
};

// Read the number at `at` (RFC 8259, Sect. 6) of at most 19 significant digits; return null for anything else.
inline const uint8_t* read_decimal(const uint8_t* at, const uint8_t* end, Decimal& number) {
    number.is_negative = at < end && *at == '-';
    if (number.is_negative) ++at;
    if (at == end || !is_digit(*at)) return nullptr;
    uint64_t digits = 0;
    int32_t significant = 0, exponent = 0;
    if (*at == '0') {
        ++at;
        if (at < end && is_digit(*at)) return nullptr;
    } else {
        const uint8_t* const begin = at;
        for (; at < end && is_digit(*at); ++at) digits = 10 * digits + (*at - '0');
        if (at - begin > 19) return nullptr;
        significant = static_cast<int32_t>(at - begin);
    }
    number.is_integer = true;
    number.has_exponent = false;
    if (at < end && *at == '.') {
        number.is_integer = false;
        const uint8_t* const point = ++at;
        if (digits == 0) {
            while (at < end && *at == '0') ++at;
        }
        const uint8_t* const begin = at;
        for (; at < end && is_digit(*at); ++at) digits = 10 * digits + (*at - '0');
        if (at == point || at - begin > 19 - significant || at - point > 1000) return nullptr;
        exponent = -static_cast<int32_t>(at - point);
    }
    if (at < end && (*at == 'e' || *at == 'E')) {
        number.is_integer = false;
        number.has_exponent = true;
        ++at;
        const bool is_small = at < end && *at == '-';
        if (at < end && (*at == '-' || *at == '+')) ++at;
        const uint8_t* const begin = at;
        int32_t written = 0;
        for (; at < end && at - begin < 4 && is_digit(*at); ++at) written = 10 * written + (*at - '0');
        if (at == begin || (at < end && is_digit(*at))) return nullptr;
        exponent += is_small ? -written : written;
    }
    number.digits = digits;
    number.exponent = exponent;
    return at;
}

// Round to the nearest double, ties to even; false if it is subnormal, too large, or too hard to tell.
//
// Source: Clinger, "How to read floating point numbers accurately", PLDI 1990, for short decimals; Lemire,
// "Number Parsing at a Gigabyte per Second", 2021, Sect. 5 and algorithm 1, for the others.
inline bool nearest_double(const Decimal& number, double& value) {
    static constexpr double kExact[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                        1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
    const int32_t q = number.exponent;
    uint64_t w = number.digits;
    if (w <= (uint64_t{1} << 53) && q >= -22 && q <= 22) {
        const double exact = static_cast<double>(w);
        const double size = q < 0 ? exact / kExact[-q] : exact * kExact[q];
        // An integer has no sign of zero.
        value = number.is_negative && !(number.is_integer && w == 0) ? -size : size;
        return true;
    }
    if (w == 0 || q < -308 || q > 308) return false;
    const int32_t zeros = __builtin_clzll(w);
    w <<= zeros;
    const uint64_t* const power = kPowersOfTen[q - kLowestPower];
    const auto product = static_cast<unsigned __int128>(w) * power[0];
    uint64_t high = static_cast<uint64_t>(product >> 64), low = static_cast<uint64_t>(product);
    if ((high & 0x1FF) == 0x1FF) {
        const uint64_t more = static_cast<uint64_t>((static_cast<unsigned __int128>(w) * power[1]) >> 64);
        low += more;
        if (low < more) ++high;
    }
    if (low == ~uint64_t{0} && (q < -27 || q > 55)) return false;
    const int32_t upper = static_cast<int32_t>(high >> 63);
    const int32_t shift = upper + 9;
    uint64_t mantissa = high >> shift;
    int32_t power_of_two = ((217706 * q) >> 16) + 63 + upper - zeros + 1023;
    if (power_of_two <= 0) return false;
    if (low <= 1 && q >= -4 && q <= 23 && (mantissa & 3) == 1 && (mantissa << shift) == high) mantissa &= ~uint64_t{1};
    mantissa = (mantissa + (mantissa & 1)) >> 1;
    if (mantissa >= (uint64_t{1} << 53)) {
        mantissa = uint64_t{1} << 52;
        ++power_of_two;
    }
    if (power_of_two >= 0x7FF) return false;
    uint64_t bits = (mantissa & ~(uint64_t{1} << 52)) | (static_cast<uint64_t>(power_of_two) << 52);
    if (number.is_negative) bits |= uint64_t{1} << 63;
    std::memcpy(&value, &bits, sizeof value);
    return true;
}

inline uint64_t eight_bytes(const uint8_t* at) {
    uint64_t bytes;
    std::memcpy(&bytes, at, 8);
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    bytes = __builtin_bswap64(bytes);
#endif
    return bytes;
}

// Return a bit for each of sixteen bytes that is no digit.
inline uint32_t not_digits(const uint8_t* at) {
#if defined(__SSE2__)
    const __m128i bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(at));
    const __m128i values = _mm_sub_epi8(bytes, _mm_set1_epi8('0'));
    const __m128i digits = _mm_cmpeq_epi8(_mm_min_epu8(values, _mm_set1_epi8(9)), values);
    return static_cast<uint32_t>(_mm_movemask_epi8(digits)) ^ 0xFFFFu;
#else
    uint32_t others = 0;
    for (int i = 0; i < 16; ++i) others |= static_cast<uint32_t>(!is_digit(at[i])) << i;
    return others;
#endif
}

// Return the number of `count` digits, 1 to 8, at the begin of eight bytes: pairs, then fours, then all.
inline uint64_t value_of_digits(uint64_t bytes, int32_t count) {
    bytes <<= 64 - 8 * count;
    bytes = (bytes & 0x0F0F0F0F0F0F0F0Fu) * 2561 >> 8;
    bytes = (bytes & 0x00FF00FF00FF00FFu) * 6553601 >> 16;
    return (bytes & 0x0000FFFF0000FFFFu) * 42949672960001u >> 32;
}

// Read a number that ends within sixteen bytes, has at most eight digits before the point and seven behind it,
// with no branch for each digit; return null for others, which `read_decimal` reads, and so near the end.
inline const uint8_t* read_short(const uint8_t* at, const uint8_t* end, double& value) {
    static constexpr double kPowers[] = {1, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7};
    static constexpr uint32_t kWholePowers[] = {1, 10, 100, 1000, 10000, 100000, 1000000, 10000000};
    if (end - at < 32) return nullptr;
    const uint32_t others = not_digits(at);
    const uint32_t is_negative = others & 1;
    // Signs and leading zeros come at random: one condition of both halves is guessed right, two are not.
    if ((is_negative & static_cast<uint32_t>(*at != '-')) != 0) return nullptr;
    const uint32_t behind_sign = others & ~1u;
    const uint32_t behind_point = behind_sign & (behind_sign - 1);
    if (behind_point == 0) return nullptr;
    const int32_t point = __builtin_ctz(behind_sign);
    const int32_t whole_digits = point - static_cast<int32_t>(is_negative);
    const uint8_t* const first = at + is_negative;
    const bool has_leading_zero = (static_cast<uint32_t>(*first == '0') & static_cast<uint32_t>(whole_digits > 1)) != 0;
    if (whole_digits == 0 || whole_digits > 8 || has_leading_zero) return nullptr;
    uint64_t digits = value_of_digits(eight_bytes(first), whole_digits);
    if (at[point] != '.') {
        if (at[point] == 'e' || at[point] == 'E') return nullptr;
        // An integer has no sign of zero.
        const auto whole = static_cast<double>(static_cast<int64_t>(digits));
        value = is_negative != 0 && digits != 0 ? -whole : whole;
        return at + point;
    }
    const int32_t stop = __builtin_ctz(behind_point), decimals = stop - point - 1;
    if (decimals == 0 || decimals > 7 || at[stop] == 'e' || at[stop] == 'E') return nullptr;
    digits = digits * kWholePowers[decimals] + value_of_digits(eight_bytes(at + point + 1), decimals);
    // Both are exact, so their quotient is the nearest double.
    const double size = static_cast<double>(static_cast<int64_t>(digits)) / kPowers[decimals];
    uint64_t bits;
    std::memcpy(&bits, &size, 8);
    bits |= static_cast<uint64_t>(is_negative) << 63;
    std::memcpy(&value, &bits, 8);
    return at + stop;
}

}  // namespace rse_pf_codec
