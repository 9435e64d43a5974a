// Client of the data service: store and load objects (bytes named by their sha256 digest) over HTTP. Calls block; use a
// client in one thread only.
#pragma once

#include <algorithm>
#include <chrono>
#include <memory>
#include <random>
#include <string>
#include <string_view>
#include <thread>

#include <nlohmann/json.hpp>
#include <openssl/sha.h>

#include "detail/http_answer.hpp"
#include "detail/transport.hpp"

namespace rse_pf {

/// Return the sha256 of *bytes* in hexadecimal digits.
inline std::string sha256(std::string_view bytes) {
    unsigned char digest[SHA256_DIGEST_LENGTH];
    SHA256(reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size(), digest);
    std::string out;
    for (const unsigned char each : digest) {
        out += "0123456789abcdef"[each >> 4];
        out += "0123456789abcdef"[each & 15];
    }
    return out;
}

struct DataOptions {
    std::string ca_file{};       ///< file of trusted authorities in PEM; empty: the authorities of the machine
    double timeout_s = 10;       ///< longest duration of one request
    double deadline_s = 60;      ///< longest duration of a call, with its repeated requests
    std::size_t part_bytes = 1 << 20, max_object_bytes = 256 << 20;
};

class DataClient {
  public:
    /// Store the address; nothing is sent yet. *url*: http(s)://HOST:PORT, or the ws(s):// address of the servers.
    DataClient(const std::string& url, std::string token, DataOptions options = {})
        : address_(detail::address_of(url)), tls_(detail::tls_context(address_, {options.ca_file})),
          token_(std::move(token)), options_(std::move(options)), random_(std::random_device{}()) {}

    /// Store *bytes* and return their digest, once the object is durable; an interrupted upload is resumed.
    std::string upload(std::string_view bytes) {
        const std::string digest = sha256(bytes);
        if (bytes.size() <= options_.part_bytes) {
            request(Verb::put, "/data/v1/objects/" + digest, bytes);
            return digest;
        }
        const std::string path = "/data/v1/uploads/" + digest;
        const std::string begin = nlohmann::json{{"size", bytes.size()}}.dump();
        Upload state = upload_of(request(Verb::put, path, begin));
        const std::size_t part = std::max<std::size_t>(1, std::min(options_.part_bytes, state.part_bytes));
        for (int conflicts = 0; state.offset < bytes.size();) {
            try {
                const auto piece = bytes.substr(state.offset, part);
                state = upload_of(request(Verb::patch, path, piece, {"Upload-Offset", std::to_string(state.offset)}));
            } catch (const RsePfError& error) {  // the answer to a part was lost, or another process sends the same bytes
                if ((error.code() != "conflict" && error.code() != "not-found") || ++conflicts > 10) throw;
                state = upload_of(request(Verb::put, path, begin));
            }
        }
        return digest;
    }

    /// Return the object of *digest*; throws RsePfError `not-found`, or `store` if the bytes are not those of the digest.
    std::string download(const std::string& digest) {
        std::string bytes = request(Verb::get, "/data/v1/objects/" + digest, {});
        if (sha256(bytes) != digest) throw RsePfError("store", "the bytes do not match the digest", "download the object again");
        return bytes;
    }

    /// Remove an object; it is no error if there is no such object.
    void remove(const std::string& digest) { request(Verb::delete_, "/data/v1/objects/" + digest, {}); }

  private:
    using Verb = detail::http::verb;
    using Response = detail::http::response<detail::http::string_body>;
    using Header = std::pair<std::string, std::string>;
    struct Upload {
        std::size_t offset, part_bytes;
    };

    static Upload upload_of(const std::string& body) {
        const auto state = nlohmann::json::parse(body, nullptr, false);
        if (!state.is_object() || !state.contains("offset") || !state["offset"].is_number_unsigned()) {
            throw RsePfError("bad-message", "the answer of the data service does not hold the offset of an upload");
        }
        return {state["offset"].get<std::size_t>(), state.value("part_bytes", std::size_t{1} << 20)};
    }

    /// Repeat a request until it succeeds or is refused; all requests of this class are idempotent.
    std::string request(Verb method, const std::string& path, std::string_view body, const Header& header = {}) {
        const double begin = detail::now_s();
        for (double pause = 0.1;; pause = std::min(5.0, 2 * pause)) {
            double after = 0;
            Failure failure;
            detail::error_code broken;
            Response response;
            once(method, path, body, header, response, broken);
            const unsigned status = response.result_int();
            if (!broken && status < 300) return std::move(response.body());
            if (broken) {
                failure = {"connect", "no answer from " + address_.shown() + ": " + detail::cause_of(broken), "call again to resume"};
            } else {
                auto refusal = detail::refused(address_.shown(), status, std::string(response[detail::http::field::retry_after]), response.body());
                if (status == 404 && refusal.failure.code == "unsupported") refusal.failure.code = "not-found";
                if (status != 429 && status != 502 && status != 503 && status != 504) throw RsePfError(refusal.failure);
                failure = std::move(refusal.failure);
                after = refusal.after_s;
            }
            const double wait = std::max(after, pause * std::uniform_real_distribution<double>(0.5, 1)(random_));
            if (detail::now_s() - begin + wait > options_.deadline_s) throw RsePfError(failure);
            std::this_thread::sleep_for(std::chrono::duration<double>(wait));
        }
    }

    void once(Verb method, const std::string& path, std::string_view body, const Header& header, Response& response, detail::error_code& broken) {
        namespace http = detail::http;
        detail::asio::io_context io{1};
        detail::Transport transport(io, tls_);
        detail::tcp::resolver resolver(io);
        detail::asio::steady_timer timer(io, std::chrono::milliseconds(static_cast<std::int64_t>(options_.timeout_s * 1e3)));
        http::request<http::string_body> request{method, path, 11};
        request.set(http::field::host, address_.authority());
        request.set(http::field::connection, "close");
        if (!token_.empty()) request.set(http::field::authorization, "Bearer " + token_);
        if (!header.first.empty()) request.set(header.first, header.second);
        request.body() = std::string(body);
        request.prepare_payload();
        http::response_parser<http::string_body> parser;
        parser.body_limit(options_.max_object_bytes);
        detail::beast::flat_buffer buffer;
        bool is_late = false;
        const auto done = [&](detail::error_code failed) {
            broken = is_late ? detail::error_code(detail::asio::error::timed_out) : failed;
            timer.cancel();
        };
        timer.async_wait([&](detail::error_code stopped) {
            if (stopped) return;
            is_late = true;
            resolver.cancel();
            transport.close();
        });
        resolver.async_resolve(address_.host, address_.port, [&](detail::error_code unknown, auto found) {
            if (unknown) return done(unknown);
            detail::asio::async_connect(transport.socket(), found, [&](detail::error_code unreachable, const detail::tcp::endpoint&) {
                if (unreachable) return done(unreachable);
                transport.async_secure(address_.host, [&](detail::error_code untrusted) {
                    if (untrusted) return done(untrusted);
                    http::async_write(transport, request, [&](detail::error_code cut, std::size_t) {
                        if (cut && cut != detail::asio::error::broken_pipe && cut != detail::asio::error::connection_reset) return done(cut);
                        http::async_read(transport, buffer, parser, [&](detail::error_code failed, std::size_t) { done(failed); });
                    });
                });
            });
        });
        io.run();
        if (!broken) response = parser.release();
    }

    detail::Address address_;
    std::shared_ptr<detail::asio::ssl::context> tls_;
    std::string token_;
    DataOptions options_;
    std::mt19937_64 random_;
};

}  // namespace rse_pf
