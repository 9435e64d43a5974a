// Decimal numbers to the nearest double, as JSON writes them; what is rare is left to others.
#pragma once

#include <cstdint>
#include <cstring>

#include "powers_of_ten.hpp"

namespace rse_pf_codec {

// A number as it stands in a text: (-1)^is_negative * digits * 10^exponent.
struct Decimal {
    uint64_t digits;
    int32_t exponent;
    bool is_negative;
    bool is_integer;  // neither a point nor an exponent was written
};

inline bool is_digit(uint8_t byte) { return static_cast<uint8_t>(byte - '0') < 10; }

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

}  // namespace rse_pf_codec
