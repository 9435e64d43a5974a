// Doubles to the shortest decimal numbers that are read as the same doubles, in the way msgspec writes JSON.
//
// Source: Giulietti, "The Schubfach way to render doubles", 2020; the boundaries are rounded to odd (Sect. 9.8).
#pragma once

#include <cstdint>
#include <cstring>

#include "powers_of_ten.hpp"

namespace rse_pf_codec {

// Bytes that a number takes at most: a sign, 17 digits, a point, and an exponent or five zeros.
constexpr int64_t kMaxNumberBytes = 32;

// A number as digits * 10^exponent.
struct Shortest {
    uint64_t digits;
    int32_t exponent;
};

// Return floor(power * by / 2^128), whose last bit is set if anything was cut off.
inline uint64_t rounded_to_odd(const uint64_t (&power)[2], uint64_t by) {
    const auto low = static_cast<unsigned __int128>(power[1]) * by;
    const auto high = static_cast<unsigned __int128>(power[0]) * by + static_cast<uint64_t>(low >> 64);
    return static_cast<uint64_t>(high >> 64) | static_cast<uint64_t>(static_cast<uint64_t>(high) > 1);
}

// Return the shortest number between the neighbours of a finite double that is not 0; of several the nearest.
inline Shortest shortest(uint64_t bits) {
    constexpr uint64_t kHidden = uint64_t{1} << 52;
    const uint64_t fraction = bits & (kHidden - 1);
    const auto biased = static_cast<int32_t>(bits >> 52 & 0x7FF);
    const uint64_t c = biased != 0 ? fraction | kHidden : fraction;
    const int32_t q = (biased != 0 ? biased : 1) - 1075;
    const uint64_t is_odd = c & 1;
    const bool is_uneven = fraction == 0 && biased > 1;
    // The exponent of ten, floor(log10(2^q)) or floor(log10(3/4 * 2^q)), and the power's place in 64 bits.
    const int32_t k = (q * 1262611 - (is_uneven ? 524031 : 0)) >> 22;
    const int32_t h = q + ((-k * 1741647) >> 19) + 1;
    uint64_t power[2] = {kPowersOfTen[-k - kLowestPower][0], kPowersOfTen[-k - kLowestPower][1]};
    // Rounded up where it is not exact; the table's from -27 to -1 are so already.
    if (-k < -27 || -k > 55) {
        ++power[1];
        power[0] += power[1] == 0;
    }
    const uint64_t lower = rounded_to_odd(power, (4 * c - 2 + is_uneven) << h) + is_odd;
    const uint64_t middle = rounded_to_odd(power, (4 * c) << h);
    const uint64_t upper = rounded_to_odd(power, (4 * c + 2) << h) - is_odd;
    const uint64_t s = middle / 4;
    if (s >= 10) {
        const uint64_t tens = s / 10;
        const bool down_fits = lower <= 40 * tens, up_fits = 40 * tens + 40 <= upper;
        if (down_fits != up_fits) return {tens + up_fits, k + 1};
    }
    const bool down_fits = lower <= 4 * s, up_fits = 4 * s + 4 <= upper;
    if (down_fits != up_fits) return {s + up_fits, k};
    const uint64_t half = 4 * s + 2;
    return {s + (middle > half || (middle == half && (s & 1) != 0)), k};
}

// Write the digits of `value`, without leading zeros, and return what is behind them.
inline uint8_t* write_digits(uint64_t value, uint8_t* at) {
    uint8_t digits[20];
    int first = 20;
    do {
        digits[--first] = static_cast<uint8_t>('0' + value % 10);
        value /= 10;
    } while (value != 0);
    std::memcpy(at, digits + first, static_cast<size_t>(20 - first));
    return at + (20 - first);
}

// Write a finite double: from 0.00001 to below 1e16 with a point and without an exponent.
inline uint8_t* write_double(double value, uint8_t* at) {
    uint64_t bits;
    std::memcpy(&bits, &value, 8);
    if (bits >> 63 != 0) *at++ = '-';
    bits &= ~(uint64_t{1} << 63);
    if (bits == 0) {
        std::memcpy(at, "0.0", 3);
        return at + 3;
    }
    Shortest number = shortest(bits);
    while (number.digits % 10 == 0) {
        number.digits /= 10;
        ++number.exponent;
    }
    uint8_t digits[20];
    const auto count = static_cast<int32_t>(write_digits(number.digits, digits) - digits);
    // Digits before the point.
    const int32_t point = count + number.exponent;
    const auto put = [&](const uint8_t* from, int32_t size) {
        std::memcpy(at, from, static_cast<size_t>(size));
        at += size;
    };
    const auto put_zeros = [&](int32_t size) {
        for (int32_t i = 0; i < size; ++i) *at++ = '0';
    };
    if (point > 16 || point < -4) {
        *at++ = digits[0];
        if (count > 1) {
            *at++ = '.';
            put(digits + 1, count - 1);
        }
        *at++ = 'e';
        if (point < 1) *at++ = '-';
        return write_digits(static_cast<uint64_t>(point < 1 ? 1 - point : point - 1), at);
    }
    if (point <= 0) {
        std::memcpy(at, "0.", 2);
        at += 2;
        put_zeros(-point);
        put(digits, count);
    } else if (point >= count) {
        put(digits, count);
        put_zeros(point - count);
        std::memcpy(at, ".0", 2);
        at += 2;
    } else {
        put(digits, point);
        *at++ = '.';
        put(digits + point, count - point);
    }
    return at;
}

}  // namespace rse_pf_codec
