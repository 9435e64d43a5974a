// The thread that runs the callbacks of a program, so that no callback delays the connection.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <exception>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>

namespace rse_pf::detail {

/// A queue of callbacks: `run` calls them in their order on one thread, and catches and counts their exceptions.
class Callbacks {
  public:
    /// Identifies values of which only the newest is needed: the id of a subscription and the key of an update, or the id of a
    /// command with progress.
    using Key = std::pair<std::uint64_t, std::string>;

    /// Append *callback* to the queue, or replace the queued callback with the same *key*.
    void add(std::function<void()> callback, std::optional<Key> key = {}) {
        const std::lock_guard lock(mutex_);
        if (key) {
            auto& waits = newest_[*key];
            if (waits) {
                waits->swap(callback);  // the older callback is destroyed after the lock
                return;
            }
            waits = &waiting_.emplace_back(std::move(callback), std::move(key)).first;
        } else {
            waiting_.emplace_back(std::move(callback), std::nullopt);
        }
        changed_.notify_all();
    }
    /// Make `run` return after the queued callbacks.
    void end() {
        const std::lock_guard lock(mutex_);
        is_ending_ = true;
        changed_.notify_all();
    }
    /// Wait until `run` has returned; return at once if a callback calls this.
    void wait() {
        std::unique_lock lock(mutex_);
        if (thread_ != std::this_thread::get_id()) changed_.wait(lock, [this] { return thread_ == std::thread::id(); });
    }
    void run() {
        std::unique_lock lock(mutex_);
        thread_ = std::this_thread::get_id();
        for (;;) {
            changed_.wait(lock, [this] { return is_ending_ || !waiting_.empty(); });
            if (waiting_.empty()) break;
            auto [callback, key] = std::move(waiting_.front());
            waiting_.pop_front();
            if (key) newest_.erase(*key);
            lock.unlock();
            call(callback);
            callback = nullptr;  // destroy the callback without the lock as well
            lock.lock();
        }
        thread_ = {};
        changed_.notify_all();
    }
    /// Call *callback* on this thread.
    template <class Callback> void call(const Callback& callback) {
        std::string error = "an exception";
        try {
            return callback();
        } catch (const std::exception& failed) {
            error = failed.what();
        } catch (...) {
        }
        const std::lock_guard lock(mutex_);
        ++errors_;
        last_error_ = std::move(error);
    }
    /// Return the number of callbacks that threw, and the text of the last exception.
    std::pair<std::uint64_t, std::string> errors() const {
        const std::lock_guard lock(mutex_);
        return {errors_, last_error_};
    }

  private:
    mutable std::mutex mutex_;
    std::condition_variable changed_;
    std::deque<std::pair<std::function<void()>, std::optional<Key>>> waiting_;
    std::map<Key, std::function<void()>*> newest_;  ///< callbacks in `waiting_` that have a key, by key
    std::uint64_t errors_ = 0;
    std::string last_error_;
    std::thread::id thread_;
    bool is_ending_ = false;
};

/// Return a function that queues *callback* in *callbacks*; an empty function if *callback* is empty.
template <class... Arguments>
std::function<void(Arguments...)> deferred(const std::shared_ptr<Callbacks>& callbacks, std::function<void(Arguments...)> callback) {
    if (!callback) return {};
    return [callbacks, callback = std::move(callback)](Arguments... arguments) {
        callbacks->add([callback, arguments...] { callback(arguments...); });
    };
}

/// Return a function that queues *callback* for values of which only the newest is needed; *key_of* returns the key of a
/// value within *id*.
template <class KeyOf, class... Arguments>
std::function<void(Arguments...)> newest(const std::shared_ptr<Callbacks>& callbacks, std::function<void(Arguments...)> callback, std::uint64_t id, KeyOf key_of) {
    if (!callback) return {};
    return [callbacks, callback = std::move(callback), id, key_of](Arguments... arguments) {
        callbacks->add([callback, arguments...] { callback(arguments...); }, Callbacks::Key{id, key_of(arguments...)});
    };
}

}  // namespace rse_pf::detail
