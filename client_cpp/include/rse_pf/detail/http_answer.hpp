// Decode unsuccessful HTTP answers: those to a WebSocket handshake, and those of the data service.
#pragma once

#include <algorithm>
#include <chrono>
#include <map>
#include <optional>
#include <string>

#include <nlohmann/json.hpp>

#include "../errors.hpp"

namespace rse_pf::detail {

inline double now_s() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}
/// Return Unix seconds of the wall clock, with which a robot signs its tokens. The clock may be wrong, and may be set.
inline double wall_s() {
    return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

/// Why an attempt to connect failed.
struct DialFailure {
    Failure failure;
    double after_s = 0;
    bool is_refusal = false;     // a server refuses this robot, possibly for a long time
    bool wrong_address = false;  // the address is no RSE-PF server: the first `connect` fails at once
    bool unanswered = false;     // no host accepted the TCP connection
    bool refuses_any = false;    // the server would refuse a fresh token as well
    std::optional<double> valid_from{};  // Unix time from which tokens are accepted
};

/// Collects the strings and numbers at the top level of a JSON object. A parsed tree would make programs larger.
struct Strings final : nlohmann::json_sax<nlohmann::json> {
    std::map<std::string, std::string> found;
    std::map<std::string, double> numbers;
    std::string name;
    int level = 0;

    bool string(string_t& value) override {
        if (level == 1) found[name] = value;
        return true;
    }
    bool key(string_t& value) override {
        if (level == 1) name = value;
        return true;
    }
    bool start_object(std::size_t) override { return ++level < 16; }
    bool end_object() override { return --level >= 0; }
    bool start_array(std::size_t) override { return ++level < 16; }
    bool end_array() override { return --level >= 0; }
    bool null() override { return true; }
    bool boolean(bool) override { return true; }
    bool number_integer(number_integer_t value) override { return number(static_cast<double>(value)); }
    bool number_unsigned(number_unsigned_t value) override { return number(static_cast<double>(value)); }
    bool number_float(number_float_t value, const string_t&) override { return number(value); }
    bool number(double value) {
        if (level == 1) numbers[name] = value;
        return true;
    }
    bool binary(binary_t&) override { return true; }
    bool parse_error(std::size_t, const std::string&, const nlohmann::detail::exception&) override { return false; }
};

/// Return the failure that an HTTP answer to the handshake states.
inline DialFailure refused(const std::string& address, unsigned status, const std::string& retry_after, const std::string& body) {
    Strings fields;
    nlohmann::json::sax_parse(body, &fields);
    const auto field = [&](const char* name) { return fields.found[name]; };
    DialFailure out;
    out.failure = {field("code"), field("message"), field("hint")};
    if (!retry_after.empty() && retry_after.size() < 6 && retry_after.find_first_not_of("0123456789") == std::string::npos) {
        out.after_s = std::min(300.0, std::stod(retry_after));
    }
    // Firewalls and login pages answer 401 and 403, too: only a body with "platform": "rse-pf" is a refusal of this robot.
    out.is_refusal = (status == 401 || status == 403) && field("platform") == "rse-pf";
    const std::string cause = field("cause");
    out.refuses_any = cause == "disabled" || cause == "cut-off" || cause == "not-yet-valid";
    const auto from = fields.numbers.find("valid_from_s");
    if (from != fields.numbers.end() && from->second >= 0 && from->second < 1e11) out.valid_from = from->second;
    out.wrong_address = status == 400 || status == 404 || status == 426 || status == 200;
    if (out.failure.code.empty()) {
        out.failure.code = status == 401 ? "unauthorized" : status == 403 ? "forbidden" : out.wrong_address ? "unsupported" : "connect";
    }
    if (out.failure.message.empty()) out.failure.message = address + " answered the handshake with HTTP " + std::to_string(status);
    return out;
}

}  // namespace rse_pf::detail
