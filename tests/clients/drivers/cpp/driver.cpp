// The C++ client in the conformance table: DRIVER SCENARIO, JSON lines on stdout and stdin (tests/clients/README.md).
#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <fstream>
#include <functional>
#include <iostream>
#include <map>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <openssl/evp.h>

#include <rse_pf/rse_pf.hpp>

namespace {

using rse_pf::Answer;
using rse_pf::json;
using rse_pf::Outcome;
using Clock = std::chrono::steady_clock;

void say(const json& event) {
    static std::mutex one_at_a_time;
    const std::lock_guard lock(one_at_a_time);
    std::cout << event.dump() << std::endl;
}

std::string variable(const char* name) {
    const char* value = std::getenv(name);
    return value == nullptr ? "" : value;
}

void require(bool holds, const std::string& what) {
    if (!holds) throw std::runtime_error(what);
}

void wait(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

json read_json(const std::string& path) {
    std::ifstream file(path);
    return json::parse(file);
}

/// The 64 digits of RFC 4648, 5.
std::string digits64() {
    std::string out;
    for (char c = 'A'; c <= 'Z'; ++c) out += c;
    for (char c = 'a'; c <= 'z'; ++c) out += c;
    for (char c = '0'; c <= '9'; ++c) out += c;
    return out + "-_";
}

std::string base64url(const std::string& bytes) {
    const std::string digits = digits64();
    std::string out;
    for (std::size_t i = 0; i < bytes.size(); i += 3) {
        const auto byte = [&](std::size_t at) { return at < bytes.size() ? static_cast<unsigned char>(bytes[at]) : 0U; };
        const unsigned three = byte(i) << 16 | byte(i + 1) << 8 | byte(i + 2);
        for (int k = 0; k < 4; ++k) out += digits[three >> (18 - 6 * k) & 63];
    }
    out.resize((bytes.size() * 4 + 2) / 3);
    return out;
}

std::string from_base64url(const std::string& text) {
    const std::string digits = digits64();
    std::string out;
    unsigned held = 0;
    int bits = 0;
    for (const char c : text) {
        held = held << 6 | static_cast<unsigned>(digits.find(c));
        bits += 6;
        if (bits >= 8) out += static_cast<char>(held >> (bits -= 8) & 255);
    }
    return out;
}

/// Return a token of the robot's own key.
std::string signed_token(const json& own) {
    static std::atomic<unsigned> number{0};
    const auto now = std::chrono::duration_cast<std::chrono::seconds>(std::chrono::system_clock::now().time_since_epoch()).count();
    const json head = {{"alg", "EdDSA"}, {"typ", "robot+jwt"}, {"kid", own["kid"]}};
    const json claims = {{"iss", own["iss"]}, {"aud", own["aud"]}, {"sub", own["sub"]}, {"iat", now}, {"exp", now + 900},
                         {"jti", "cpp-" + std::to_string(now) + "-" + std::to_string(++number)}};
    const std::string text = base64url(head.dump()) + "." + base64url(claims.dump()), seed = from_base64url(own["d"]);
    const auto* bytes = reinterpret_cast<const unsigned char*>(seed.data());
    EVP_PKEY* key = EVP_PKEY_new_raw_private_key(EVP_PKEY_ED25519, nullptr, bytes, seed.size());
    EVP_MD_CTX* context = EVP_MD_CTX_new();
    std::size_t size = 64;
    std::string signature(size, '\0');
    const bool is_signed = EVP_DigestSignInit(context, nullptr, nullptr, nullptr, key) == 1 &&
        EVP_DigestSign(context, reinterpret_cast<unsigned char*>(signature.data()), &size,
                       reinterpret_cast<const unsigned char*>(text.data()), text.size()) == 1;
    EVP_MD_CTX_free(context);
    EVP_PKEY_free(key);
    require(is_signed, "the token could not be signed");
    return text + "." + base64url(signature);
}

/// Counts what was sent and answered; callbacks run on the client's thread.
class Tally {
  public:
    rse_pf::OnEnd<Answer> next() {
        const std::lock_guard lock(mutex_);
        const std::size_t number = ended_.size();
        ended_.push_back(0);
        outcomes_.emplace_back();
        return [this, number](Outcome<Answer> outcome) {
            const std::lock_guard locked(mutex_);
            if (ended_[number]++ > 0) ++twice_;
            if (outcome.ok()) {
                ++answered_;
                times_ms_.push_back(outcome.value().round_trip_ms);
            } else {
                ++codes_[outcome.failure().code];
            }
            outcomes_[number] = std::make_shared<Outcome<Answer>>(std::move(outcome));
            changed_.notify_all();
        };
    }
    Outcome<Answer> outcome(std::size_t number) {
        std::unique_lock lock(mutex_);
        require(changed_.wait_for(lock, std::chrono::seconds(30), [&] { return outcomes_[number] != nullptr; }), "no answer");
        return *outcomes_[number];
    }
    bool all_ended(double within_s) {
        std::unique_lock lock(mutex_);
        return changed_.wait_for(lock, std::chrono::duration<double>(within_s), [&] {
            return std::all_of(ended_.begin(), ended_.end(), [](int each) { return each > 0; });
        });
    }
    std::size_t answered() {
        const std::lock_guard lock(mutex_);
        return answered_;
    }
    void count(const std::string& code) {
        const std::lock_guard lock(mutex_);
        ++codes_[code];
    }
    json done() {
        const std::lock_guard lock(mutex_);
        std::sort(times_ms_.begin(), times_ms_.end());
        const auto percentile = [&](double share) { return times_ms_.empty() ? 0.0 : times_ms_[static_cast<std::size_t>(share * static_cast<double>(times_ms_.size() - 1))]; };
        std::size_t lost = 0;
        for (const int each : ended_) lost += each == 0;
        for (const char* code : {"disconnected", "connect"}) lost += codes_.count(code) > 0 ? codes_[code] : 0;
        return {{"event", "done"}, {"sent", ended_.size()}, {"answered", answered_}, {"twice", twice_}, {"lost", lost},
                {"codes", codes_}, {"p50_ms", percentile(0.5)}, {"p99_ms", percentile(0.99)}};
    }

  private:
    std::mutex mutex_;
    std::condition_variable changed_;
    std::deque<int> ended_;
    std::deque<std::shared_ptr<Outcome<Answer>>> outcomes_;
    std::vector<double> times_ms_;
    std::map<std::string, std::size_t> codes_;
    std::size_t answered_ = 0, twice_ = 0;
};

class Driver {
  public:
    explicit Driver(bool signs_itself) {
        const std::string path = variable("RSE_PF_INPUT");
        if (!path.empty()) input = read_json(path);
        rse_pf::Options options;
        options.url = variable("RSE_PF_URL");
        if (signs_itself) options.token = [own = input["own_key"]] { return signed_token(own); };
        else options.token = variable("RSE_PF_TOKEN");
        options.on_change = [this](const std::string& what, const std::string& why) {
            if (what == "moved") say({{"event", "moved"}, {"server", why}});
            if (what == "link-back") say({{"event", "back"}});
            if (what == "refused") {
                say({{"event", "refused"}, {"why", why}});
                const std::lock_guard lock(mutex_);
                ended_ = why.substr(0, why.find(':'));
                over_.notify_all();
            }
        };
        client = std::make_unique<rse_pf::Robot>(options);
        for (auto& command : input["commands"]) command["payload"] = with_arrays(command["payload"]);
    }
    void connect() {
        client->connect();
        say({{"event", "ready"}});
    }
    const json& command(std::size_t number) const { return input["commands"][number % input["commands"].size()]; }
    void send(std::size_t number, rse_pf::CallOptions options = {}) {
        const json& given = command(number);
        client->call(given["service"], given["payload"], std::move(options), tally.next());
    }
    std::string ended(double within_s) {
        std::unique_lock lock(mutex_);
        over_.wait_for(lock, std::chrono::duration<double>(within_s), [&] { return !ended_.empty(); });
        return ended_;
    }
    static json with_arrays(json payload) {
        for (const char* field : {"points_world", "pixels", "depths_m"}) {
            if (payload.contains(field) && payload[field].is_array()) payload[field] = rse_pf::array(payload[field].get<std::vector<double>>());
        }
        return payload;
    }

    Tally tally;
    json input;

  private:
    std::mutex mutex_;
    std::condition_variable over_;
    std::string ended_;

  public:
    std::unique_ptr<rse_pf::Robot> client;  // the last member: it ends first, and its callbacks with it
};

/// Return *value* with plain lists in place of arrays.
json plain(const json& value) {
    if (value.is_binary()) {
        if (value.get_binary().has_subtype()) return rse_pf::numbers(value);
        return std::string(value.get_binary().begin(), value.get_binary().end());
    }
    if (!value.is_structured()) return value;
    json out = value;
    for (auto& each : out) each = plain(each);
    return out;
}

std::string bytes_of(const std::string& base64) {
    static const std::string alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    std::string bytes;
    int bits = 0, value = 0;
    for (const char each : base64) {
        const auto digit = alphabet.find(each);
        if (digit == std::string::npos) continue;
        value = (value << 6 | static_cast<int>(digit)) & 0xffff;
        if ((bits += 6) >= 8) bytes.push_back(static_cast<char>(value >> (bits -= 8)));
    }
    return bytes;
}

void golden(Driver& driver) {
    const std::string path = driver.input.contains("golden") ? driver.input["golden"].get<std::string>() : variable("RSE_PF_GOLDEN");
    const json messages = read_json(path);
    for (const auto& [name, message] : messages.items()) {
        const std::string bytes = bytes_of(message["bytes"]["rse-pf.v1.bin"]);
        require(plain(json::from_msgpack(bytes)) == message["meaning"], name + ": the codec of JSON reads something else");
        const auto read = rse_pf::detail::read_message(bytes);
        require(read.type == message["meaning"]["type"].get<std::string>(), name + ": another type");
        const auto same = [&](const char* field, auto found) {
            if (message["meaning"].contains(field)) require(message["meaning"][field] == found, name + ": another " + field);
        };
        if (read.id) same("id", *read.id);
        same("server", read.server);
        same("code", read.code);
        same("message", read.message);
        same("hint", read.hint);
        same("object", read.object);
        same("queue_ms", read.queue_ms);
        same("compute_ms", read.compute_ms);
        same("received_s", read.received_s);
        same("answered_s", read.answered_s);
        same("within_ms", read.within_ms);
        same("key", read.key);
        if (read.type == "update") same("payload", plain(json::from_msgpack(read.payload)));
        if (read.type == "result" && !read.reply.empty()) same("reply", plain(json::from_msgpack(read.reply)));
    }
    say({{"event", "ready"}});
}

void pnp(Driver& driver) {
    driver.connect();
    double worst = 0;
    for (std::size_t i = 0; i < driver.input["commands"].size(); ++i) {
        driver.send(i);
        const Outcome<Answer> outcome = driver.tally.outcome(i);
        const json& expected = driver.input["expected"][i];
        if (expected.is_null()) continue;
        const rse_pf::PoseAnswer pose = rse_pf::pose_of(outcome.value());
        for (std::size_t k = 0; k < 16; ++k) worst = std::max(worst, std::abs(pose.T_camera_world[k] - expected["T_camera_world"][k].get<double>()));
        if (expected.contains("verdict")) require(pose.verdict == expected["verdict"].get<std::string>(), "another verdict");
    }
    require(worst <= 1e-6, "a pose differs by " + std::to_string(worst));
}

void typed_error(Driver& driver) {
    driver.connect();
    driver.client->call("nothing-here", json::object(), {}, driver.tally.next());
    const auto unknown = driver.tally.outcome(0);
    require(!unknown.ok() && !unknown.failure().hint.empty(), "no failure with a hint");
    json payload = driver.command(0)["payload"];
    auto points = rse_pf::numbers(payload["points_world"]), pixels = rse_pf::numbers(payload["pixels"]);
    points.resize(9);
    pixels.resize(6);
    payload["points_world"] = rse_pf::array(points);
    payload["pixels"] = rse_pf::array(pixels);
    driver.client->call("pnp", payload, {}, driver.tally.next());
    driver.tally.outcome(1);
}

/// Send each kind, and a valid command behind it.
void undecodable(Driver& driver, json& more) {
    driver.connect();
    std::size_t number = 0;
    double slowest_s = 0;
    more["wrong"] = json::array();
    const json& kinds = driver.input["undecodable"]["bin"];
    for (const json& kind : kinds) {
        rse_pf::CallOptions options;
        options.trace = kind["trace"];
        options.stream = kind["stream"];
        const auto began = Clock::now();
        const std::string payload = bytes_of(kind["payload"]);
        // An empty payload of this client is a null.
        if (payload.empty()) continue;
        driver.client->send(kind["service"], payload, options, driver.tally.next());
        const auto failed = driver.tally.outcome(number++);
        const double took_s = std::chrono::duration<double>(Clock::now() - began).count();
        slowest_s = std::max(slowest_s, took_s);
        driver.client->call("echo", {{"value", 1}}, {}, driver.tally.next());
        const auto valid = driver.tally.outcome(number++);
        const json& codes = kind["codes"];
        const bool is_typed = !failed.ok() && !failed.failure().hint.empty() &&
                              std::find(codes.begin(), codes.end(), failed.failure().code) != codes.end();
        if (!is_typed || took_s > 1 || !valid.ok()) {
            more["wrong"].push_back({kind["name"], failed.ok() ? "ok" : failed.failure().message, took_s, valid.ok()});
        }
    }
    more["kinds"] = number / 2;
    more["slowest_s"] = slowest_s;
}

void busy(Driver& driver) {
    driver.connect();
    const auto end = Clock::now() + std::chrono::duration<double>(std::stod(variable("RSE_PF_SECONDS")));
    std::size_t n = 0;
    for (; Clock::now() < end; ++n) {
        driver.send(n, rse_pf::Robot::in_stream("offered"));  // four times the limits of 20 a second
        wait(1 / 80.0);
    }
    require(driver.tally.all_ended(10), "commands without an end");
}

void deadline(Driver& driver) {
    driver.connect();
    const auto end = Clock::now() + std::chrono::milliseconds(1500);
    rse_pf::CallOptions options;
    options.deadline_s = 0.001;
    for (std::size_t n = 0; Clock::now() < end; ++n) {
        driver.send(n, options);
        driver.tally.outcome(n);
        wait(0.07);
    }
}

void newest(Driver& driver, json& more) {
    driver.connect();
    bool newest_ok = true;
    for (std::size_t burst = 0; burst < 4; ++burst) {
        for (std::size_t i = 0; i < 12; ++i) driver.send(0, rse_pf::Robot::in_stream("front"));  // 8 are sent
        newest_ok = newest_ok && driver.tally.outcome(12 * burst + 11).ok();
        wait(0.5);
    }
    require(driver.tally.all_ended(10), "commands without an end");
    more["newest_ok"] = newest_ok;
}

void stream(Driver& driver) {
    driver.connect();
    std::atomic<bool> stopped{false};
    std::thread orders([&] {
        std::string line;
        while (!stopped && std::getline(std::cin, line)) {
            const json order = json::parse(line, nullptr, false);
            if (!order.is_object()) continue;
            if (order.value("do", "") == "stop") break;
            if (order.value("do", "") == "renew") driver.client->renew(order.value("token", ""));
        }
        stopped = true;
    });
    auto said = Clock::now();
    rse_pf::CallOptions options;
    options.deadline_s = 30;
    for (std::size_t n = 0; !stopped; ++n) {
        driver.send(n, options);
        if (Clock::now() - said > std::chrono::milliseconds(250)) {
            said = Clock::now();
            say({{"event", "count"}, {"answered", driver.tally.answered()}});
        }
        wait(0.1);
    }
    orders.join();
    driver.tally.all_ended(20);
}

/// Call until told to stop; a call may end with the reason of a refusal, or expire.
void returns(Driver& driver) {
    driver.connect();
    std::atomic<bool> stopped{false};
    std::thread orders([&] {
        std::string line;
        std::getline(std::cin, line);
        stopped = true;
    });
    std::size_t answered = 0;
    rse_pf::CallOptions options;
    options.deadline_s = 1;
    for (std::size_t n = 0; !stopped; ++n) {
        driver.client->call("echo", {{"value", 1}}, options, driver.tally.next());
        if (driver.tally.outcome(n).ok()) say({{"event", "count"}, {"answered", ++answered}});
        wait(0.1);
    }
    orders.join();
}

void ended(Driver& driver) {
    driver.connect();
    const std::string code = driver.ended(60);
    require(!code.empty(), "the robot was not refused");
    driver.tally.count(code);
    wait(0.5);  // a client that connects again would do so now
}

void updates(Driver& driver, json& more) {
    driver.connect();
    std::promise<std::string> first;
    std::atomic<bool> told{false};
    driver.client->subscribe("live/" + variable("RSE_PF_MAP"), [&](const std::string& key, const json&) {
        if (!told.exchange(true)) first.set_value(key);
    });
    auto key = first.get_future();
    require(key.wait_for(std::chrono::seconds(10)) == std::future_status::ready, "no update");
    more["key"] = key.get();
    driver.client->close();
}

void progress(Driver& driver) {
    driver.connect();
    std::promise<double> first;
    std::atomic<bool> told{false};
    rse_pf::CallOptions options;
    options.on_progress = [&](double done, const std::string&) {
        if (!told.exchange(true)) first.set_value(done);
    };
    const json& given = driver.input["long"];
    const auto id = driver.client->call(given["service"], given["payload"], options, driver.tally.next());
    require(first.get_future().wait_for(std::chrono::seconds(20)) == std::future_status::ready, "no progress");
    driver.client->cancel(id);
    driver.tally.outcome(0);
}

void data(Driver&) {
    rse_pf::DataClient client(variable("RSE_PF_DATA_URL"), variable("RSE_PF_TOKEN"));
    say({{"event", "ready"}});
    for (const std::size_t size : {1000UL, 3UL << 20}) {
        std::string bytes;
        for (std::size_t i = 0; bytes.size() < size; ++i) bytes += std::to_string(i * i);
        require(client.download(client.upload(bytes)) == bytes, "other bytes came back");
    }
}

}  // namespace

int main(int argc, char** argv) {
    json more = json::object();
    const std::map<std::string, std::function<void(Driver&)>> scenarios = {
        {"golden", golden}, {"pnp", pnp}, {"typed-error", typed_error},
        {"undecodable", [&](Driver& driver) { undecodable(driver, more); }}, {"busy", busy}, {"deadline", deadline},
        {"newest", [&](Driver& driver) { newest(driver, more); }}, {"stream", stream}, {"renew", stream},
        {"returns", returns}, {"expired", ended}, {"revoked", ended}, {"updates", [&](Driver& driver) { updates(driver, more); }},
        {"progress", progress}, {"data", data},
    };
    const std::string scenario = argc > 1 ? argv[1] : "";
    if (scenario == "--claims") {
        json names = json::array();
        for (const auto& each : scenarios) names.push_back(each.first);
        std::cout << names.dump() << std::endl;
        return 0;
    }
    const auto found = scenarios.find(scenario);
    if (found == scenarios.end()) {
        say({{"event", "unsupported"}});
        return 3;
    }
    try {
        Driver driver(scenario == "returns");
        found->second(driver);
        json last = driver.tally.done();
        last.update(more);
        const rse_pf::Stats stats = driver.client->stats();
        last["resent"] = stats.resent;
        last["reconnects"] = stats.reconnects;
        say(last);
        return 0;
    } catch (const std::exception& error) {
        say({{"event", "error"}, {"message", error.what()}});
        return 1;
    }
}
