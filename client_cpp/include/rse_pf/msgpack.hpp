// MessagePack as the sub-protocol rse-pf.v1.bin uses it: a writer of commands and a reader of answers.
//
// nlohmann-json also reads and writes MessagePack, and is used for payloads of any shape. The messages around them, and
// the arrays of `pnp`, are written and read here without a tree of objects. The reader bounds nesting and checks every
// length, so that malformed input cannot exhaust the stack.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include "errors.hpp"

namespace rse_pf::msgpack {

/// Extension types of arrays: raw little-endian numbers.
enum Extension : std::int8_t { float32 = 1, uint32 = 2, float64 = 3 };

/// Append MessagePack to a string.
class Writer {
  public:
    explicit Writer(std::string& out) : out_(out) {}

    Writer& map(std::uint32_t n) { return head(n, 0x80, 15, 0, 0xde, 0xdf); }
    Writer& list(std::uint32_t n) { return head(n, 0x90, 15, 0, 0xdc, 0xdd); }
    Writer& text(std::string_view value) {
        head(static_cast<std::uint32_t>(value.size()), 0xa0, 31, 0xd9, 0xda, 0xdb);
        out_.append(value);
        return *this;
    }
    Writer& integer(std::uint64_t value) {
        if (value < 0x80) return byte(static_cast<unsigned>(value));
        if (value <= 0xff) return byte(0xcc).big(value, 1);
        if (value <= 0xffff) return byte(0xcd).big(value, 2);
        if (value <= 0xffffffff) return byte(0xce).big(value, 4);
        return byte(0xcf).big(value, 8);
    }
    Writer& number(double value) {
        std::uint64_t bits;
        std::memcpy(&bits, &value, 8);
        return byte(0xcb).big(bits, 8);
    }
    Writer& boolean(bool value) { return byte(value ? 0xc3 : 0xc2); }
    Writer& nil() { return byte(0xc0); }
    /// Append a value that is already encoded.
    Writer& raw(std::string_view encoded) {
        out_.append(encoded);
        return *this;
    }
    /// Begin an extension of *bytes* bytes; append them with `raw`.
    Writer& extension(Extension type, std::size_t bytes) {
        if (bytes <= 0xff) byte(0xc7).big(bytes, 1);
        else if (bytes <= 0xffff) byte(0xc8).big(bytes, 2);
        else byte(0xc9).big(bytes, 4);
        return byte(static_cast<unsigned char>(type));
    }
    Writer& floats(const double* values, std::size_t n) {
        extension(float32, 4 * n);
        const std::vector<float> narrow(values, values + n);
        return little(narrow.data(), n);
    }
    Writer& doubles(const double* values, std::size_t n) {
        extension(float64, 8 * n);
        return little(values, n);
    }

  private:
    Writer& byte(unsigned value) {
        out_.push_back(static_cast<char>(value));
        return *this;
    }
    Writer& big(std::uint64_t value, int bytes) {
        char data[8];
        for (int i = 0; i < bytes; ++i) data[i] = static_cast<char>(value >> (8 * (bytes - 1 - i)));
        out_.append(data, static_cast<std::size_t>(bytes));
        return *this;
    }
    template <class Number> Writer& little(const Number* values, std::size_t n) {
        static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "arrays are copied as they are in memory");
        if (n > 0) out_.append(reinterpret_cast<const char*>(values), n * sizeof(Number));
        return *this;
    }
    Writer& head(std::uint32_t n, unsigned fixed, unsigned most, unsigned in8, unsigned in16, unsigned in32) {
        if (n <= most) return byte(fixed | n);
        if (in8 != 0 && n <= 0xff) return byte(in8).big(n, 1);
        if (n <= 0xffff) return byte(in16).big(n, 2);
        return byte(in32).big(n, 4);
    }

    std::string& out_;
};

/// Read MessagePack; a method throws RsePfError `bad-message` if the next value is not of its type.
class Reader {
  public:
    explicit Reader(std::string_view data) : at_(data.data()), end_(data.data() + data.size()) {}

    bool done() const { return at_ == end_; }
    const char* position() const { return at_; }

    std::uint32_t map() { return count(0x80, 0xde, "an object"); }
    std::uint32_t list() { return count(0x90, 0xdc, "a list"); }
    std::string_view text() {
        const unsigned tag = take();
        if ((tag & 0xe0) == 0xa0) return bytes(tag & 0x1f);
        if (tag >= 0xd9 && tag <= 0xdb) return bytes(big(1 << (tag - 0xd9)));
        throw wrong("a string");
    }
    std::uint64_t integer() {
        const double value = number();
        if (!(value >= 0 && value <= 9007199254740992.0) || value != std::floor(value)) throw wrong("an integer");
        return static_cast<std::uint64_t>(value);
    }
    double number() {
        const unsigned tag = take();
        if (tag < 0x80) return tag;
        if (tag >= 0xe0) return static_cast<std::int8_t>(tag);
        if (tag >= 0xcc && tag <= 0xcf) return static_cast<double>(big(1 << (tag - 0xcc)));
        switch (tag) {
            case 0xd0: return static_cast<std::int8_t>(big(1));
            case 0xd1: return static_cast<std::int16_t>(big(2));
            case 0xd2: return static_cast<std::int32_t>(big(4));
            case 0xd3: return static_cast<double>(static_cast<std::int64_t>(big(8)));
            case 0xca: return as<float, std::uint32_t>(static_cast<std::uint32_t>(big(4)));
            case 0xcb: return as<double, std::uint64_t>(big(8));
            default: throw wrong("a number");
        }
    }
    bool boolean() {
        const unsigned tag = take();
        if (tag != 0xc2 && tag != 0xc3) throw wrong("a boolean");
        return tag == 0xc3;
    }
    /// Consume a null if it is the next value.
    bool nil() {
        if (at_ == end_ || static_cast<unsigned char>(*at_) != 0xc0) return false;
        ++at_;
        return true;
    }
    /// Return an array of numbers: an extension, or a plain list.
    std::vector<double> numbers() {
        std::vector<double> values;
        const unsigned tag = peek();
        if ((tag & 0xf0) == 0x90 || tag == 0xdc || tag == 0xdd) {
            const std::uint32_t n = list();
            if (n > static_cast<std::size_t>(end_ - at_)) throw wrong("a list that is complete");
            values.reserve(n);
            for (std::uint32_t i = 0; i < n; ++i) values.push_back(number());
            return values;
        }
        take();
        if ((tag < 0xc7 || tag > 0xc9) && (tag < 0xd4 || tag > 0xd8)) throw wrong("an array");
        const std::size_t size = tag <= 0xc9 ? big(1 << (tag - 0xc7)) : std::size_t{1} << (tag - 0xd4);
        const auto type = static_cast<std::int8_t>(take());
        const std::string_view data = bytes(size);
        const std::size_t width = type == float64 ? 8 : 4;
        if (type < float32 || type > float64 || size % width != 0) throw wrong("an array of a known type");
        values.resize(size / width);
        const auto* raw = reinterpret_cast<const unsigned char*>(data.data());
        for (std::size_t i = 0; i < values.size(); ++i, raw += width) {
            std::uint64_t bits = 0;
            for (std::size_t b = width; b-- > 0;) bits = bits << 8 | raw[b];
            values[i] = type == float64   ? as<double, std::uint64_t>(bits)
                        : type == float32 ? as<float, std::uint32_t>(static_cast<std::uint32_t>(bits))
                                          : static_cast<double>(bits);
        }
        return values;
    }
    /// Consume one value of any kind and return its bytes; at most *levels* levels deep.
    std::string_view value(int levels = 32) {
        const char* begin = at_;
        skip(levels);
        return {begin, static_cast<std::size_t>(at_ - begin)};
    }

  private:
    static RsePfError wrong(const char* expected) {
        return {"bad-message", std::string("the message does not have ") + expected + " where the protocol requires it"};
    }
    unsigned peek() const {
        if (at_ == end_) throw wrong("as many bytes as its lengths state");
        return static_cast<unsigned char>(*at_);
    }
    unsigned take() {
        const unsigned tag = peek();
        ++at_;
        return tag;
    }
    std::string_view bytes(std::size_t n) {
        if (n > static_cast<std::size_t>(end_ - at_)) throw wrong("as many bytes as its lengths state");
        const std::string_view view(at_, n);
        at_ += n;
        return view;
    }
    std::uint64_t big(int n) {
        std::uint64_t value = 0;
        for (const char each : bytes(static_cast<std::size_t>(n))) value = value << 8 | static_cast<unsigned char>(each);
        return value;
    }
    std::uint32_t count(unsigned fixed, unsigned in16, const char* what) {
        const unsigned tag = take();
        if ((tag & 0xf0) == fixed) return tag & 0x0f;
        if (tag == in16) return static_cast<std::uint32_t>(big(2));
        if (tag == in16 + 1) return static_cast<std::uint32_t>(big(4));
        throw wrong(what);
    }
    template <class Value, class Bits> static Value as(Bits bits) {
        Value value;
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }
    void skip(int levels) {
        if (levels == 0) throw wrong("at most 32 nested levels");
        const unsigned tag = peek();
        if ((tag & 0xf0) == 0x80 || tag == 0xde || tag == 0xdf) {
            for (std::uint64_t n = 2 * static_cast<std::uint64_t>(map()); n > 0; --n) skip(levels - 1);
        } else if ((tag & 0xf0) == 0x90 || tag == 0xdc || tag == 0xdd) {
            for (std::uint64_t n = list(); n > 0; --n) skip(levels - 1);
        } else if ((tag & 0xe0) == 0xa0 || (tag >= 0xd9 && tag <= 0xdb)) {
            text();
        } else if (tag < 0x80 || tag >= 0xe0 || (tag >= 0xca && tag <= 0xd3)) {
            number();
        } else if (tag == 0xc0 || tag == 0xc2 || tag == 0xc3) {
            take();
        } else if (tag >= 0xc4 && tag <= 0xc6) {
            take();
            bytes(big(1 << (tag - 0xc4)));
        } else if (tag >= 0xc7 && tag <= 0xc9) {
            take();
            bytes(big(1 << (tag - 0xc7)) + 1);
        } else if (tag >= 0xd4 && tag <= 0xd8) {
            take();
            bytes((std::size_t{1} << (tag - 0xd4)) + 1);
        } else {
            throw wrong("MessagePack");
        }
    }

    const char* at_;
    const char* end_;
};

}  // namespace rse_pf::msgpack
