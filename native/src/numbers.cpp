// Lists of decimal numbers in JSON, as the matches of a command are sent.
#include <cstdint>
#include <cstring>

#include "rse_pf_native.h"

namespace {

// A quotient of two integers below 2^53 is rounded once, so it is the number nearest to the text.
constexpr int64_t kMaxDigits = 15;
constexpr double kPowers[kMaxDigits + 1] = {1e0, 1e1, 1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                            1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15};

const char* behind_spaces(const char* at, const char* end) {
    while (at < end && (*at == ' ' || *at == '\n' || *at == '\t' || *at == '\r')) ++at;
    return at;
}

const char* behind_digits(const char* at, const char* end, uint64_t& value) {
    for (; at < end && *at >= '0' && *at <= '9'; ++at) value = 10 * value + static_cast<uint64_t>(*at - '0');
    return at;
}

// Return what is behind the number at `at`; null if there is none, or one that is not read here.
const char* read_number(const char* at, const char* end, double& number) {
    const bool is_negative = at < end && *at == '-';
    const char* const first = at + (is_negative ? 1 : 0);
    uint64_t value = 0;
    const char* next = behind_digits(first, end, value);
    int64_t digits = next - first, decimals = 0;
    if (digits == 0 || (digits > 1 && *first == '0')) return nullptr;
    if (next < end && *next == '.') {
        const char* const point = next++;
        next = behind_digits(next, end, value);
        decimals = next - point - 1;
        digits += decimals;
        if (decimals == 0) return nullptr;
    }
    if (digits > kMaxDigits || (next < end && (*next == 'e' || *next == 'E'))) return nullptr;
    if (is_negative && value == 0 && decimals == 0) return nullptr;  // -0 is the integer 0 for some, -0.0 for others
    const double quotient = static_cast<double>(value) / kPowers[decimals];
    number = is_negative ? -quotient : quotient;
    return next;
}

// Read the list at `at` and return what is behind it; null if it is not one of numbers, or too long.
const char* read_list(const char* at, const char* end, double*& next, const double* last) {
    while (next < last) {
        at = read_number(behind_spaces(at + 1, end), end, *next++);
        if (at == nullptr) return nullptr;
        at = behind_spaces(at, end);
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
    const char* const last = rest + RSE_PF_MAX_REST - 8;
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
        std::memcpy(rest, "\"\\u0000\"", 8);
        rest[6] = static_cast<char>('0' + lists->count);
        rest += 8;
        lists->ends[lists->count++] = next - lists->numbers;
    }
    return rest - lists->rest;
}
