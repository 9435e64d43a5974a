// Logarithms of our own: the C library's differ between versions and processors in the last bit.
#pragma once

#include <cstdint>

#include "lanes.hpp"

namespace RSE_PF_ISA {

constexpr double kInfinity = __builtin_inf();
constexpr double kPi = 3.14159265358979323846;

// The compiler turns this into the processor's correctly rounded instruction.
RSE_PF_INLINE double square_root(double x) { return __builtin_sqrt(x); }
RSE_PF_INLINE double absolute(double x) { return __builtin_fabs(x); }

// Return the natural logarithm of a positive finite number; 0 gives -inf, and what is negative or nan, nan.
static double natural_log(double x) {
    if (!(x > 0.0)) return x == 0.0 ? -kInfinity : __builtin_nan("");
    if (x > 1.7976931348623157e308) return x;
    int64_t exponent = 0;
    if (x < 2.2250738585072014e-308) {
        x *= 18014398509481984.0;  // 2^54
        exponent = -54;
    }
    int64_t bits;
    __builtin_memcpy(&bits, &x, sizeof bits);
    exponent += (bits >> 52) - 1022;
    bits = (bits & 0xFFFFFFFFFFFFF) | (int64_t{1022} << 52);
    double mantissa;  // 0.5 .. 1, then 0.707 .. 1.414
    __builtin_memcpy(&mantissa, &bits, sizeof mantissa);
    if (mantissa < 0.70710678118654752) {
        mantissa *= 2.0;
        exponent -= 1;
    }
    // log m = 2 artanh((m - 1) / (m + 1)), and the argument is below 0.1716.
    const double f = (mantissa - 1.0) / (mantissa + 1.0), f2 = f * f;
    double series = 1.0 / 23.0;
    for (int odd = 21; odd >= 1; odd -= 2) series = series * f2 + 1.0 / odd;
    const double e = static_cast<double>(exponent);
    return 2.0 * f * series + e * 1.9082149292705877e-10 + e * 0.69314718036912382;  // ln 2 in two parts
}

// Return ln n! for n >= 0: exact factorials up to 18, Stirling's series beyond.
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

RSE_PF_INLINE double log_choose(int64_t n, int64_t k) {
    return log_factorial(n) - log_factorial(k) - log_factorial(n - k);
}

}  // namespace RSE_PF_ISA
