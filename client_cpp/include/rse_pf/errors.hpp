// Failures of the server, the network and this client: as values, and as one exception class.
#pragma once

#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>

namespace rse_pf {

/// Why a command or a connection ended without a result. `code` is a code of section 5 of docs/protocol.md.
struct Failure {
    std::string code;
    std::string message;
    std::string hint{};
    std::optional<double> retry_after_ms{};
    std::string server{};
    std::string trace{};
};

/// The exception of this client; it carries a `Failure`.
class RsePfError : public std::runtime_error {
  public:
    explicit RsePfError(Failure failure)
        : std::runtime_error(failure.code + ": " + failure.message +
                             (failure.hint.empty() ? "" : "\n  hint: " + failure.hint)),
          failure_(std::move(failure)) {}
    RsePfError(std::string code, std::string message, std::string hint = {})
        : RsePfError(Failure{std::move(code), std::move(message), std::move(hint)}) {}

    const Failure& failure() const noexcept { return failure_; }
    const std::string& code() const noexcept { return failure_.code; }

  private:
    Failure failure_;
};

/// A value or a `Failure`: the argument of callbacks, since exceptions do not reach them.
template <class T> class Outcome {
  public:
    Outcome(T value) : state_(std::move(value)) {}
    Outcome(Failure failure) : state_(std::move(failure)) {}

    bool ok() const noexcept { return state_.index() == 0; }
    explicit operator bool() const noexcept { return ok(); }

    /// Return the value; throws the RsePfError of the failure if there is no value.
    const T& value() const& {
        if (!ok()) throw RsePfError(std::get<1>(state_));
        return std::get<0>(state_);
    }
    T&& value() && {
        if (!ok()) throw RsePfError(std::get<1>(state_));
        return std::get<0>(std::move(state_));
    }
    /// Return the failure; call it only if `ok()` is false.
    const Failure& failure() const { return std::get<1>(state_); }

  private:
    std::variant<T, Failure> state_;
};

}  // namespace rse_pf
