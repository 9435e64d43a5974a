// Read a `pnp` command into arrays: JSON text, or MessagePack with raw arrays.
//
// Only what the SDK writes is read here: known fields, each once, with values of their own type and in their
// range.  Everything else is somebody else's, so that no rule of the decoder in Python is written twice.
#pragma once

#include <cstdint>
#include <cstring>

#include "codec_guards.hpp"
#include "codec_numbers.hpp"
#include "rse_pf_codec.h"

namespace rse_pf_codec {

constexpr int64_t kMaxWord = 64;
constexpr double kMaxDeadlineMs = 3.6e6;
// Far below what overflows when it is squared and summed.
constexpr double kMaxNumber = 1e100;
constexpr int64_t kMaxIdentifier = (int64_t{1} << 53) - 1;
// Levels, lists and maps, and values of a command whose arrays are not counted.
constexpr int64_t kLevels = 4, kContainers = 8, kOtherValues = 128;

struct Name {
    const uint8_t* at;
    int64_t bytes;

    bool is(const char* word) const {
        return std::strlen(word) == static_cast<size_t>(bytes) && std::memcmp(at, word, static_cast<size_t>(bytes)) == 0;
    }
    // Return the place of this name among `words`, which may be used once each; -1 otherwise.
    template <int kWords>
    int once(const char* const (&words)[kWords], uint32_t& used) const {
        for (int i = 0; i < kWords; ++i) {
            if (is(words[i])) {
                if ((used & 1u << i) != 0) return -1;
                used |= 1u << i;
                return i;
            }
        }
        return -1;
    }
};

// A reader offers: `map` and `next_field` to walk over a map, and one function for each type of value.  Each
// returns false for what is not its type.
class JsonReader {
public:
    JsonReader(const uint8_t* text, int64_t bytes) : at_(text), end_(text + bytes) {}

    template <class Field>
    bool map(Field field) {
        if (!take('{')) return false;
        ++maps_;
        if (take('}')) return true;
        do {
            Name name;
            ++colons_;
            if (!word(name) || !take(':') || !field(name)) return false;
        } while (comma());
        return take('}');
    }
    bool word(Name& name) {
        if (!take('"')) return false;
        name.at = at_;
        while (at_ < end_ && *at_ >= 0x20 && *at_ < 0x7F && *at_ != '"' && *at_ != '\\') ++at_;
        name.bytes = at_ - name.at;
        return at_ < end_ && *at_++ == '"';
    }
    bool number(double& value) {
        skip();
        Decimal decimal;
        const uint8_t* const next = read_decimal(at_, end_, decimal);
        if (next == nullptr || !nearest_double(decimal, value)) return false;
        more_ += more_values(decimal, at_, next);
        at_ = next;
        return true;
    }
    bool integer(int64_t& value) {
        skip();
        Decimal decimal;
        const uint8_t* const next = read_decimal(at_, end_, decimal);
        if (next == nullptr || !decimal.is_integer || decimal.is_negative || decimal.digits > kMaxIdentifier) return false;
        value = static_cast<int64_t>(decimal.digits);
        more_ += more_values(decimal, at_, next);
        at_ = next;
        return true;
    }
    bool truth(bool& value) {
        if (literal("true")) return value = true;
        value = false;
        return literal("false");
    }
    bool null() { return literal("null"); }
    bool array(double* numbers, int64_t room, int64_t& count) {
        if (!take('[')) return false;
        ++lists_;
        // Only locals stay in registers.
        const uint8_t* at = at_;
        const uint8_t* const end = end_;
        int64_t read = 0, more = 0;
        for (;; ++read) {
            if (read == room) return false;
            if (at < end && *at <= ' ') at = behind_spaces(at, end);
            double value;
            const uint8_t* next = read_short(at, end, value);
            if (next == nullptr) {
                Decimal decimal;
                next = read_decimal(at, end, decimal);
                if (next == nullptr || !nearest_double(decimal, value)) return false;
                if (!(value <= kMaxNumber && value >= -kMaxNumber)) return false;
                more += more_values(decimal, at, next);
            }
            numbers[read] = value;
            at = next;
            if (at < end && *at <= ' ') at = behind_spaces(at, end);
            if (at == end || *at != ',') break;
            ++at;
        }
        at_ = at;
        commas_ += read;
        more_ += more;
        count = read + 1;
        return take(']');
    }
    bool ends() {
        skip();
        return at_ == end_;
    }
    int64_t values() const { return commas_ + colons_ + kListValues * lists_ + kMapValues * maps_ + more_; }

private:
    static int64_t more_values(const Decimal& number, const uint8_t* at, const uint8_t* next) {
        constexpr uint64_t kMiddle = 1000000000000000u, kLong = 1000000000000000000u;
        const bool may_be_middle = number.digits >= kMiddle && number.exponent >= kMiddlePower;
        const bool may_count = number.digits >= kLong || number.has_exponent || next - at >= kWideDigits;
        return may_count || may_be_middle ? more_values_between(at, next, kFarValues) : 0;
    }
    static const uint8_t* behind_spaces(const uint8_t* at, const uint8_t* end) {
        while (at < end && (*at == ' ' || *at == '\n' || *at == '\r' || *at == '\t')) ++at;
        return at;
    }
    void skip() { at_ = behind_spaces(at_, end_); }
    uint8_t peek() {
        skip();
        return at_ < end_ ? *at_ : 0;
    }
    bool take(uint8_t byte) {
        if (peek() != byte) return false;
        ++at_;
        return true;
    }
    bool comma() {
        const bool is_there = take(',');
        commas_ += is_there;
        return is_there;
    }
    bool literal(const char* word) {
        skip();
        const auto bytes = static_cast<int64_t>(std::strlen(word));
        if (end_ - at_ < bytes || std::memcmp(at_, word, static_cast<size_t>(bytes)) != 0) return false;
        at_ += bytes;
        return true;
    }

    const uint8_t* at_;
    const uint8_t* const end_;
    int64_t commas_ = 0, colons_ = 0, lists_ = 0, maps_ = 0, more_ = 0;
};

class MsgpackReader {
public:
    MsgpackReader(const uint8_t* data, int64_t bytes) : at_(data), end_(data + bytes) {}

    template <class Field>
    bool map(Field field) {
        if (at_ == end_ || *at_ < 0x80 || *at_ > 0x8F) return false;
        const int count = *at_++ & 15;
        for (int i = 0; i < count; ++i) {
            Name name;
            if (!word(name) || !field(name)) return false;
        }
        return true;
    }
    bool word(Name& name) {
        if (at_ == end_) return false;
        if (*at_ >= 0xA0 && *at_ < 0xC0) {
            name.bytes = *at_++ & 31;
        } else if (*at_ == 0xD9 && end_ - at_ >= 2) {
            name.bytes = at_[1];
            at_ += 2;
        } else {
            return false;
        }
        if (end_ - at_ < name.bytes) return false;
        name.at = at_;
        at_ += name.bytes;
        for (int64_t i = 0; i < name.bytes; ++i) {
            if (name.at[i] < 0x20 || name.at[i] > 0x7E) return false;
        }
        return true;
    }
    bool number(double& value) {
        if (at_ < end_ && *at_ == 0xCB && end_ - at_ >= 9) {
            const uint64_t bits = big_endian(at_ + 1, 8);
            std::memcpy(&value, &bits, 8);
            at_ += 9;
            return true;
        }
        if (at_ < end_ && *at_ == 0xCA && end_ - at_ >= 5) {
            const auto bits = static_cast<uint32_t>(big_endian(at_ + 1, 4));
            float single;
            std::memcpy(&single, &bits, 4);
            value = static_cast<double>(single);
            at_ += 5;
            return true;
        }
        int64_t whole;
        if (!integer(whole)) return false;
        value = static_cast<double>(whole);
        return true;
    }
    bool integer(int64_t& value) {
        if (at_ == end_) return false;
        const uint8_t first = *at_;
        if (first < 0x80) {
            value = first;
            ++at_;
            return true;
        }
        if (first < 0xCC || first > 0xCF) return false;
        const int width = 1 << (first - 0xCC);
        if (end_ - at_ <= width) return false;
        const uint64_t bits = big_endian(at_ + 1, width);
        if (bits > static_cast<uint64_t>(kMaxIdentifier)) return false;
        value = static_cast<int64_t>(bits);
        at_ += 1 + width;
        return true;
    }
    bool truth(bool& value) {
        if (at_ == end_ || (*at_ != 0xC2 && *at_ != 0xC3)) return false;
        value = *at_++ == 0xC3;
        return true;
    }
    bool null() {
        if (at_ == end_ || *at_ != 0xC0) return false;
        ++at_;
        return true;
    }
    // Extensions 1 (float32), 2 (uint32) and 3 (float64) hold little-endian numbers.
    bool array(double* numbers, int64_t room, int64_t& count) {
        if (at_ == end_) return false;
        int64_t bytes = 0;
        int head = 2;
        if (*at_ >= 0xC7 && *at_ <= 0xC9) {
            const int width = 1 << (*at_ - 0xC7);
            head = 2 + width;
            if (end_ - at_ < head) return false;
            bytes = static_cast<int64_t>(big_endian(at_ + 1, width));
        } else if (*at_ >= 0xD4 && *at_ <= 0xD8) {
            if (end_ - at_ < head) return false;
            bytes = 1 << (*at_ - 0xD4);
        } else {
            return false;
        }
        const uint8_t kind = at_[head - 1];
        const int64_t each = kind == 3 ? 8 : 4;
        if (kind < 1 || kind > 3 || bytes == 0 || bytes % each != 0 || bytes > end_ - at_ - head) return false;
        count = bytes / each;
        if (count > room) return false;
        const uint8_t* const raw = at_ + head;
        if (kind == 1) {
            for (int64_t i = 0; i < count; ++i) {
                float single;
                std::memcpy(&single, raw + 4 * i, 4);
                numbers[i] = static_cast<double>(single);
            }
        } else if (kind == 2) {
            for (int64_t i = 0; i < count; ++i) {
                uint32_t whole;
                std::memcpy(&whole, raw + 4 * i, 4);
                numbers[i] = whole;
            }
        } else {
            std::memcpy(numbers, raw, static_cast<size_t>(bytes));
        }
        int64_t wrong = 0;
        for (int64_t i = 0; i < count; ++i) wrong += numbers[i] <= kMaxNumber && numbers[i] >= -kMaxNumber ? 0 : 1;
        at_ = raw + bytes;
        return wrong == 0;
    }
    bool ends() { return at_ == end_; }

private:
    const uint8_t* at_;
    const uint8_t* const end_;
};

template <class Reader>
class PnpCommand {
public:
    PnpCommand(Reader& reader, const uint8_t* begin, rse_pf_codec_call& call) : reader_(reader), begin_(begin), call_(call) {}

    bool read() {
        static constexpr const char* kNames[] = {"type", "id",   "service",     "payload", "stream",
                                                 "seq",  "keep", "deadline_ms", "trace"};
        uint32_t used = 0;
        const bool is_map = reader_.map([&](const Name& name) {
            Name word;
            bool is_true = false;
            switch (name.once(kNames, used)) {
                case 0: return reader_.word(word) && word.is("command");
                case 1: return reader_.integer(call_.id);
                case 2: return reader_.word(word) && word.is("pnp");
                case 3: return payload();
                case 4: return text(call_.stream_at, call_.stream_bytes);
                case 5: return reader_.integer(call_.seq);
                case 6:
                    if (!reader_.truth(is_true)) return false;
                    if (is_true) call_.fields |= RSE_PF_CODEC_HAS_KEEP;
                    return true;
                case 7: return deadline();
                case 8: return text(call_.trace_at, call_.trace_bytes);
                default: return false;
            }
        });
        return is_map && reader_.ends() && (used & 15) == 15;
    }

private:
    bool text(int64_t& at, int64_t& bytes) {
        Name word;
        if (!reader_.word(word) || word.bytes > kMaxWord) return false;
        at = word.at - begin_;
        bytes = word.bytes;
        return true;
    }
    bool deadline() {
        if (reader_.null()) return true;
        call_.fields |= RSE_PF_CODEC_HAS_DEADLINE;
        return reader_.number(call_.deadline_ms) && call_.deadline_ms >= 0 && call_.deadline_ms <= kMaxDeadlineMs;
    }
    bool payload() {
        static constexpr const char* kNames[] = {"camera", "points_world", "pixels", "options", "depths_m"};
        uint32_t used = 0;
        const bool is_map = reader_.map([&](const Name& name) {
            switch (name.once(kNames, used)) {
                case 0: return camera();
                case 1:
                    // The arrays stand in this order, so that each knows where the one before it ends.
                    if ((used & 20) != 0) return false;
                    return reader_.array(call_.numbers, call_.numbers_room, call_.points);
                case 2:
                    if ((used & 18) != 2) return false;
                    return reader_.array(call_.numbers + call_.points, call_.numbers_room - call_.points, call_.pixels);
                case 3: return reader_.null() || options();
                case 4:
                    if ((used & 4) == 0) return false;
                    return reader_.array(call_.numbers + call_.points + call_.pixels,
                                         call_.numbers_room - call_.points - call_.pixels, call_.depths);
                default: return false;
            }
        });
        return is_map && (used & 7) == 7;
    }
    bool camera() {
        static constexpr const char* kNames[] = {"fx", "fy", "cx", "cy", "width", "height"};
        uint32_t used = 0;
        const bool is_map = reader_.map([&](const Name& name) {
            switch (name.once(kNames, used)) {
                case 0: return reader_.number(call_.fx);
                case 1: return reader_.number(call_.fy);
                case 2: return reader_.number(call_.cx);
                case 3: return reader_.number(call_.cy);
                case 4: return reader_.integer(call_.width);
                case 5: return reader_.integer(call_.height);
                default: return false;
            }
        });
        return is_map && (used & 63) == 63;
    }
    bool options() {
        static constexpr const char* kNames[] = {"engine", "inlier_px", "max_iterations", "min_iterations", "confidence"};
        uint32_t used = 0;
        call_.options |= RSE_PF_CODEC_HAS_OPTIONS;
        return reader_.map([&](const Name& name) {
            switch (name.once(kNames, used)) {
                case 0: return engine();
                case 1: return has(RSE_PF_CODEC_HAS_INLIER_PX) && reader_.number(call_.inlier_px);
                case 2: return has(RSE_PF_CODEC_HAS_MAX_ITERATIONS) && reader_.integer(call_.max_iterations);
                case 3: return has(RSE_PF_CODEC_HAS_MIN_ITERATIONS) && reader_.integer(call_.min_iterations);
                case 4: return has(RSE_PF_CODEC_HAS_CONFIDENCE) && reader_.number(call_.confidence);
                default: return false;
            }
        });
    }
    bool engine() {
        if (reader_.null()) return true;
        Name word;
        if (!reader_.word(word) || word.bytes >= static_cast<int64_t>(sizeof call_.engine)) return false;
        std::memcpy(call_.engine, word.at, static_cast<size_t>(word.bytes));
        return has(RSE_PF_CODEC_HAS_ENGINE);
    }
    bool has(int64_t field) {
        call_.options |= field;
        return true;
    }

    Reader& reader_;
    const uint8_t* const begin_;
    rse_pf_codec_call& call_;
};

}  // namespace rse_pf_codec
