// Doubles to the shortest decimal numbers that are read as the same doubles, in the way msgspec writes JSON.
//
// Source: Giulietti, "The Schubfach way to render doubles", 2020; the boundaries are rounded to odd (Sect. 9.8).
#pragma once

#include <cstdint>
#include <cstring>

#include "powers_of_ten.hpp"

namespace rse_pf_codec {

// Bytes that writing a number may touch.
constexpr int64_t kMaxNumberBytes = 48;

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

// Return the eight digits of a number below 10^8, each a byte of its own and the first one lowest.
inline uint64_t eight_digits(uint64_t value) {
    // Two numbers of four digits, then four of two, then eight of one.
    const uint64_t fours = value / 10000 | (value % 10000) << 32;
    const uint64_t hundreds = (fours * 10486 >> 20) & 0x0000007F0000007Fu;
    const uint64_t twos = hundreds | (fours - 100 * hundreds) << 16;
    const uint64_t tens = (twos * 103 >> 10) & 0x000F000F000F000Fu;
    return tens | (twos - 10 * tens) << 8;
}

// The digits of a number below 10^17 that is not 0, as text, without the zeros at both ends.
struct Digits {
    static constexpr int32_t kAll = 17;
    uint8_t text[48];  // whoever copies them may copy more
    int32_t first, count;

    explicit Digits(uint64_t value) {
        constexpr uint64_t kText = 0x3030303030303030u;
        const uint64_t top = value / 10000000000000000u, rest = value % 10000000000000000u;
        const uint64_t middle = eight_digits(rest / 100000000), low = eight_digits(rest % 100000000);
        text[0] = static_cast<uint8_t>('0' + top);
        put(1, middle | kText);
        put(9, low | kText);
        first = top != 0 ? 0 : middle != 0 ? 1 + __builtin_ctzll(middle) / 8 : 9 + __builtin_ctzll(low) / 8;
        const int32_t last =
            low != 0 ? 16 - __builtin_clzll(low) / 8 : middle != 0 ? 8 - __builtin_clzll(middle) / 8 : 0;
        count = last - first + 1;
    }
    const uint8_t* begin() const { return text + first; }

private:
    void put(int at, uint64_t digits) {
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
        digits = __builtin_bswap64(digits);
#endif
        std::memcpy(text + at, &digits, 8);
    }
};

// Write a number below 10^17 without leading zeros and return what is behind it.
inline uint8_t* write_whole(uint64_t value, uint8_t* at) {
    if (value < 10) {
        *at = static_cast<uint8_t>('0' + value);
        return at + 1;
    }
    const Digits digits(value);
    const int32_t count = Digits::kAll - digits.first;
    std::memcpy(at, digits.begin(), 17);
    return at + count;
}

// Write a finite double: from 0.00001 to below 1e16 with a point and without an exponent.  Up to 48 bytes are
// touched, whatever the number needs.
inline uint8_t* write_double(double value, uint8_t* at) {
    uint64_t bits;
    std::memcpy(&bits, &value, 8);
    *at = '-';
    at += bits >> 63;
    bits &= ~(uint64_t{1} << 63);
    if (bits == 0) {
        std::memcpy(at, "0.0", 3);
        return at + 3;
    }
    const Shortest number = shortest(bits);
    const Digits digits(number.digits);
    const uint8_t* const text = digits.begin();
    const int32_t count = digits.count;
    // Digits before the point.
    const int32_t point = Digits::kAll - digits.first + number.exponent;
    if (point > 16 || point < -4) {
        *at++ = text[0];
        *at = '.';
        std::memcpy(at + 1, text + 1, 16);
        if (count > 1) at += count;
        *at++ = 'e';
        if (point < 1) *at++ = '-';
        return write_whole(static_cast<uint64_t>(point < 1 ? 1 - point : point - 1), at);
    }
    if (point <= 0) {
        std::memcpy(at, "0.0000", 6);
        std::memcpy(at + 2 - point, text, 17);
        return at + 2 - point + count;
    }
    std::memcpy(at, text, 17);
    if (point < count) {
        at[point] = '.';
        std::memcpy(at + point + 1, text + point, 16);
        return at + count + 1;
    }
    for (int32_t i = count; i < point; ++i) at[i] = '0';
    std::memcpy(at + point, ".0", 2);
    return at + point + 2;
}

}  // namespace rse_pf_codec
