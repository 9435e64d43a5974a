// Logarithms computed from correctly rounded operations only: those of the C library differ in the last bit between
// its versions and between processors.
#pragma once

#include <cstdint>

#include "lanes.hpp"

namespace RSE_PF_ISA {

constexpr double kInfinity = __builtin_inf();  // cost of an impossible pose
constexpr double kPi = 3.14159265358979323846;

// The compiler translates this into the square root instruction, which IEEE 754 rounds correctly.
RSE_PF_INLINE double square_root(double x) { return __builtin_sqrt(x); }
RSE_PF_INLINE double absolute(double x) { return __builtin_fabs(x); }

// Return the natural logarithm of a number; -inf of 0, and nan of a negative number or nan.
static double natural_log(double x) {
    if (!(x > 0.0)) return x == 0.0 ? -kInfinity : __builtin_nan("");
    if (x > 1.7976931348623157e308) return x;
    // 1. Split x into mantissa * 2^exponent with a mantissa in 0.707..1.414; scale subnormal numbers first.
    int64_t exponent = 0;
    if (x < 2.2250738585072014e-308) {
        x *= 18014398509481984.0;  // 2^54
        exponent = -54;
    }
    int64_t bits;
    __builtin_memcpy(&bits, &x, sizeof bits);
    exponent += (bits >> 52) - 1022;
    bits = (bits & 0xFFFFFFFFFFFFF) | (int64_t{1022} << 52);
    double mantissa;
    __builtin_memcpy(&mantissa, &bits, sizeof mantissa);
    if (mantissa < 0.70710678118654752) {
        mantissa *= 2.0;
        exponent -= 1;
    }
    // 2. log m = 2 artanh((m - 1) / (m + 1)), by the series of artanh, whose argument is below 0.1716 here.
    const double f = (mantissa - 1.0) / (mantissa + 1.0), f2 = f * f;
    double series = 1.0 / 23.0;
    for (int odd = 21; odd >= 1; odd -= 2) series = series * f2 + 1.0 / odd;
    // 3. Add exponent * ln 2, where ln 2 is the sum of two constants, so that the products are exact enough.
    const double e = static_cast<double>(exponent);
    return 2.0 * f * series + e * 1.9082149292705877e-10 + e * 0.69314718036912382;
}

// Return ln(n!) for n >= 0: from the exact factorial up to 18, from Stirling's series of ln(gamma(n + 1)) beyond.
static double log_factorial(int64_t n) {
    if (n <= 18) {
        double product = 1.0;
        for (int64_t i = 2; i <= n; ++i) product *= static_cast<double>(i);
        return natural_log(product);
    }
    const double x = static_cast<double>(n) + 1.0, inverse = 1.0 / x, inverse2 = inverse * inverse;
    const double tail =
        inverse * (1.0 / 12.0 - inverse2 * (1.0 / 360.0 - inverse2 * (1.0 / 1260.0 - inverse2 / 1680.0)));
    return (x - 0.5) * natural_log(x) - x + 0.91893853320467274 + tail;
}

// Return the natural logarithm of the binomial coefficient "n choose k".
RSE_PF_INLINE double log_choose(int64_t n, int64_t k) {
    return log_factorial(n) - log_factorial(k) - log_factorial(n - k);
}

}  // namespace RSE_PF_ISA
