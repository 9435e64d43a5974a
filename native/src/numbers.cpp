// A reader of the lists of decimal numbers in a JSON text, the form in which a `pnp` command carries its matches.
#include <cstdint>
#include <cstring>

#include "rse_pf_native.h"

namespace {

// Most digits of a number: 10^15 is below 2^53, so digits and power of ten are exact doubles, and their quotient, which
// is rounded once, is the double nearest to the text.
constexpr int64_t kMaxDigits = 15;
// 10^0 to 10^15, by which a number without its decimal point is divided.
constexpr double kPowersOfTen[kMaxDigits + 1] = {1e0, 1e1, 1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                                 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15};
// Bytes of the string "\u000K" that replaces a list.
constexpr int64_t kPlaceholderBytes = 8;

const char* skip_spaces(const char* at, const char* end) {
    while (at < end && (*at == ' ' || *at == '\n' || *at == '\t' || *at == '\r')) ++at;
    return at;
}

// Append the decimal digits at an address, of which there may be none, to a value, and return the address behind them.
const char* read_digits(const char* at, const char* end, uint64_t& value) {
    for (; at < end && *at >= '0' && *at <= '9'; ++at) value = 10 * value + static_cast<uint64_t>(*at - '0');
    return at;
}

// Read the number at an address and return the address behind it; null where there is no number of JSON, or one with an
// exponent or with more than kMaxDigits digits, or -0.
const char* read_number(const char* at, const char* end, double& number) {
    const bool is_negative = at < end && *at == '-';
    const char* const first = at + (is_negative ? 1 : 0);
    uint64_t value = 0;
    const char* next = read_digits(first, end, value);
    int64_t digits = next - first, decimals = 0;
    if (digits == 0 || (digits > 1 && *first == '0')) return nullptr;
    if (next < end && *next == '.') {
        const char* const point = next++;
        next = read_digits(next, end, value);
        decimals = next - point - 1;
        digits += decimals;
        if (decimals == 0) return nullptr;
    }
    if (digits > kMaxDigits || (next < end && (*next == 'e' || *next == 'E'))) return nullptr;
    if (is_negative && value == 0 && decimals == 0) return nullptr;  // -0: JSON parsers disagree whether it is 0 or -0.0.
    const double quotient = static_cast<double>(value) / kPowersOfTen[decimals];
    number = is_negative ? -quotient : quotient;
    return next;
}

// Read the list whose bracket is at an address and return the address behind the list.  Its numbers are written from
// `next` on, which moves behind them.  Null if the list is empty, holds anything but numbers, or more of them than fit
// before `last`.
const char* read_list(const char* at, const char* end, double*& next, const double* last) {
    while (next < last) {
        at = read_number(skip_spaces(at + 1, end), end, *next++);
        if (at == nullptr) return nullptr;
        at = skip_spaces(at, end);
        if (at == end || (*at != ',' && *at != ']')) return nullptr;
        if (*at == ']') return at + 1;
    }
    return nullptr;
}

}  // namespace

extern "C" __attribute__((visibility("default"))) int64_t rse_pf_cut_lists(const char* text, int64_t bytes,
                                                                          rse_pf_lists* lists) {
    const char* const end = text + bytes;
    double* next = lists->numbers;
    char* rest = lists->rest;
    const char* const last = rest + RSE_PF_MAX_REST - kPlaceholderBytes;
    lists->count = 0;
    for (const char* at = text; at < end;) {
        if (rest > last || *at == '\\') return -1;
        if (*at != '[') {
            *rest++ = *at++;
            continue;
        }
        if (lists->count == RSE_PF_MAX_LISTS) return -1;
        at = read_list(at, end, next, lists->numbers + lists->room);
        if (at == nullptr) return -1;
        std::memcpy(rest, "\"\\u0000\"", kPlaceholderBytes);
        rest[6] = static_cast<char>('0' + lists->count);
        rest += kPlaceholderBytes;
        lists->ends[lists->count++] = next - lists->numbers;
    }
    return rest - lists->rest;
}
