// The options of a call and its answer.
#pragma once

#include <cstdint>
#include <functional>
#include <future>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "errors.hpp"
#include "msgpack.hpp"

namespace rse_pf {

using json = nlohmann::json;

/// Options of one command.
struct CallOptions {
    /// Seconds within which the answer is needed. Without a value: `Options::answer_timeout_s`, or no deadline for a long
    /// service.
    std::optional<double> deadline_s{};
    /// Name of the camera or task; within a stream the newest command wins. Empty: no stream.
    std::string stream{};
    /// Whether this command is answered although newer commands of its stream follow.
    bool keep = false;
    /// Word of at most 64 characters that the log of the server records with this command.
    std::string trace{};
    /// Called on the thread of callbacks with the progress of a long service: the completed share (0 to 1) and the name of
    /// the current step.
    std::function<void(double, const std::string&)> on_progress{};
};

/// The result of a command.
struct Answer {
    std::uint64_t id = 0;
    std::string reply_msgpack{};  ///< the undecoded reply, in MessagePack; empty: null
    std::string object{};         ///< digest of a reply that is stored as an object; `reply()` is then null
    std::string server{};
    double queue_ms = 0, compute_ms = 0;
    double round_trip_ms = 0;  ///< from the call to the answer
    /// Delays from robot to server and back; without a value until the offset of their clocks is known.
    std::optional<double> up_ms{}, down_ms{};

    /// Return the reply as JSON; arrays are binary values, see `numbers`. Throws RsePfError `bad-message`.
    json reply() const {
        if (reply_msgpack.empty()) return nullptr;
        try {
            return json::from_msgpack(reply_msgpack);
        } catch (const json::exception& error) {
            throw RsePfError("bad-message", error.what());
        }
    }
};

/// A command that was sent: its id, for `Robot::cancel`, and its result; `get()` throws RsePfError.
template <class T> struct Call {
    std::uint64_t id = 0;
    std::future<T> result{};

    T get() { return result.get(); }
};

template <class T> using OnEnd = std::function<void(Outcome<T>)>;

/// Return *values* as a value of a payload: an array of float64.
inline json array(const std::vector<double>& values) {
    std::string out;
    msgpack::Writer(out).doubles(values.data(), values.size());
    const std::size_t head = out.size() - 8 * values.size();
    return json::binary(std::vector<std::uint8_t>(out.begin() + static_cast<std::ptrdiff_t>(head), out.end()),
                        msgpack::float64);
}

/// Return the numbers of an array of a reply, or of a plain list; throws RsePfError `bad-message` if it is neither.
inline std::vector<double> numbers(const json& value) {
    const auto encoded = json::to_msgpack(value);
    return msgpack::Reader({reinterpret_cast<const char*>(encoded.data()), encoded.size()}).numbers();
}

/// Return *value* in MessagePack.
inline std::string encoded(const json& value) {
    std::string out;
    json::to_msgpack(value, out);
    return out;
}

}  // namespace rse_pf
