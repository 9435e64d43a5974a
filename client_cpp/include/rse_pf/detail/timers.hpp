// Rules that depend on time, with the time in seconds as an argument: rate limit, clock offset, renewal of a token.
#pragma once

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <optional>

#include "../messages.hpp"

namespace rse_pf::detail {

constexpr double never = std::numeric_limits<double>::infinity();
/// Longest pause of a stream after one `busy` answer, whatever its retry_after_ms says.
constexpr double max_pause_s = 60;

/// A token bucket of nine tenths of the server's limits, since a network may deliver messages closer together than they
/// were sent.
class RateLimiter {
  public:
    RateLimiter() = default;
    RateLimiter(const Limits& limits, double now) : rate_(0.9 * limits.max_commands_per_s), filled_(now) {
        burst_ = left_ = std::max(1.0, 0.9 * limits.command_burst);
    }
    bool allows(double now) {
        if (rate_ <= 0) return true;
        fill(now);
        return left_ >= 1;
    }
    void spend(double now) {
        if (rate_ <= 0) return;
        fill(now);
        left_ -= 1;
    }
    /// Return when the next message may be sent.
    double next_s(double now) const { return rate_ <= 0 || left_ >= 1 ? now : now + (1 - left_) / rate_ + 1e-4; }

  private:
    void fill(double now) {
        left_ = std::min(burst_, left_ + rate_ * std::max(0.0, now - filled_));
        filled_ = now;
    }
    double rate_ = 0, burst_ = 1, left_ = 1, filled_ = 0;
};

/// The offset of the server's clock, from the exchange with the shortest round trip of the last eight.
class ClockOffset {
  public:
    void add(double t1, double t2, double t3, double t4) {
        const double round_trip = (t4 - t1) - (t3 - t2);
        if (!(round_trip >= 0) || !(t3 >= t2) || !std::isfinite(t2)) return;
        last_.push_back({round_trip, ((t2 - t1) + (t3 - t4)) / 2});
        if (last_.size() > 8) last_.pop_front();
    }
    std::optional<double> offset_s() const {
        if (last_.empty()) return std::nullopt;
        return std::min_element(last_.begin(), last_.end(), [](auto& a, auto& b) { return a.round_trip < b.round_trip; })->offset;
    }

  private:
    struct Exchange {
        double round_trip, offset;
    };
    std::deque<Exchange> last_;
};

/// Compute when to send a fresh token: after 80 % of the time that is left, then after half of the rest.
class RenewalTimer {
  public:
    void expires_in(double token_s, double now) {
        const double left = token_s >= 0 && token_s <= 3600 ? token_s : 3600;
        ends_ = now + left;
        due_ = now + 0.8 * left;
    }
    bool is_due(double now) {
        if (now < due_) return false;
        due_ = now + std::max(1.5, (ends_ - now) / 2);
        return true;
    }
    double due_s() const { return due_; }

  private:
    double ends_ = never, due_ = never;
};

}  // namespace rse_pf::detail
