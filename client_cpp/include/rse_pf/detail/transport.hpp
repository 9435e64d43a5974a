// A TCP connection with or without TLS, as one type, so that Beast's templates are instantiated once, not twice.
#pragma once

#include <algorithm>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>

#include <boost/asio/basic_stream_socket.hpp>
#include <boost/asio/connect.hpp>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/ssl.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/beast/core.hpp>
#include <boost/beast/http.hpp>
#include <boost/beast/websocket.hpp>

#include "../errors.hpp"

namespace rse_pf::detail {

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace http = beast::http;
namespace websocket = beast::websocket;
using boost::system::error_code;
using asio::ip::tcp;

/// Address of a server, parsed from a URL with ws://, wss://, http:// or https://.
struct Address {
    bool secure = false;
    std::string host, port, target;

    std::string shown() const { return host + ":" + port; }
    std::string authority() const {
        const std::string name = host.find(':') == std::string::npos ? host : "[" + host + "]";
        return port == (secure ? "443" : "80") ? name : name + ":" + port;
    }
};

/// Return the parts of *url*; throws RsePfError `usage` if it is no address, or carries a user or a query.
inline Address address_of(const std::string& url) {
    const RsePfError wrong("usage", "this is not an address of a server", "write wss://HOST/ws or ws://HOST:PORT/ws");
    const auto colon = url.find("://");
    if (colon == std::string::npos) throw wrong;
    const std::string scheme = url.substr(0, colon);
    Address out;
    if (scheme == "wss" || scheme == "https") out.secure = true;
    else if (scheme != "ws" && scheme != "http") throw wrong;
    std::string rest = url.substr(colon + 3);
    const auto slash = rest.find('/');
    out.target = slash == std::string::npos ? "" : rest.substr(slash);
    rest = rest.substr(0, slash);
    const auto bracket = rest.find(']');
    const auto port = rest.find(':', bracket == std::string::npos ? 0 : bracket);
    out.port = port == std::string::npos ? (out.secure ? "443" : "80") : rest.substr(port + 1);
    out.host = rest.substr(0, port);
    if (bracket != std::string::npos && out.host.size() > 2) out.host = out.host.substr(1, out.host.size() - 2);
    const bool digits = out.port.find_first_not_of("0123456789") == std::string::npos && !out.port.empty() && out.port.size() < 6;
    if (out.host.empty() || !digits || url.find_first_of("@?# \t\r\n") != std::string::npos) throw wrong;
    return out;
}

/// Authorities whose certificates are trusted; by default the authorities of the machine.
struct Trust {
    /// File of authorities in PEM, which replace those of the machine.
    std::string ca_file{};
};

/// Return the TLS context that checks the server's certificate and name; throws RsePfError `usage` if the file cannot be read.
inline std::shared_ptr<asio::ssl::context> tls_context(const Address& address, const Trust& trust) {
    if (!address.secure) return nullptr;
    auto context = std::make_shared<asio::ssl::context>(asio::ssl::context::tls_client);
    SSL_CTX_set_min_proto_version(context->native_handle(), TLS1_2_VERSION);
    context->set_verify_mode(asio::ssl::verify_peer);
    error_code failed;
    if (trust.ca_file.empty()) context->set_default_verify_paths(failed);
    else context->load_verify_file(trust.ca_file, failed);
    if (failed) throw RsePfError("usage", "the file of trusted authorities cannot be read", "ca_file names a file in PEM");
    return context;
}

/// A type-erased handler: templates below it are instantiated once, which halves compile time and size of a program.
class AnyHandler {
  public:
    template <class Handler, class = std::enable_if_t<!std::is_same_v<std::decay_t<Handler>, AnyHandler>>>
    explicit AnyHandler(Handler&& handler) : held_(std::make_unique<Of<std::decay_t<Handler>>>(std::forward<Handler>(handler))) {}
    void operator()(error_code error, std::size_t size) {
        const auto held = std::move(held_);
        held->call(error, size);
    }

  private:
    struct Held {
        virtual ~Held() = default;
        virtual void call(error_code error, std::size_t size) = 0;
    };
    template <class Handler> struct Of final : Held {
        explicit Of(Handler given) : handler(std::move(given)) {}
        void call(error_code error, std::size_t size) override { handler(error, size); }
        Handler handler;
    };
    std::unique_ptr<Held> held_;
};

/// A stream whose reads and writes use one buffer each; sequences of buffers of Beast are copied into one.
class Transport {
  public:
    using Socket = asio::basic_stream_socket<tcp, asio::io_context::executor_type>;
    using executor_type = Socket::executor_type;

    Transport(asio::io_context& io, std::shared_ptr<asio::ssl::context> tls) : socket_(io.get_executor()), tls_(std::move(tls)) {
        if (tls_) stream_ = std::make_unique<asio::ssl::stream<Socket&>>(socket_, *tls_);
    }

    executor_type get_executor() noexcept { return socket_.get_executor(); }
    Socket& socket() noexcept { return socket_; }

    template <class Buffers, class Handler> void async_read_some(const Buffers& buffers, Handler&& handler) {
        asio::mutable_buffer first;
        for (auto each = asio::buffer_sequence_begin(buffers); each != asio::buffer_sequence_end(buffers) && first.size() == 0; ++each) {
            first = asio::mutable_buffer(*each);
        }
        read_(first, AnyHandler(std::forward<Handler>(handler)));
    }
    template <class Buffers, class Handler> void async_write_some(const Buffers& buffers, Handler&& handler) {
        flat_.resize(std::min<std::size_t>(asio::buffer_size(buffers), max_flat));
        asio::buffer_copy(asio::buffer(flat_), buffers);
        write_(AnyHandler(std::forward<Handler>(handler)));
    }

    /// Do the TLS handshake with *host*; without TLS the handler is called at once.
    template <class Handler> void async_secure(const std::string& host, Handler&& handler) {
        if (!stream_) {
            asio::post(get_executor(), [handler = std::forward<Handler>(handler)]() mutable { handler(error_code{}); });
            return;
        }
        error_code ignored;
        asio::ip::make_address(host, ignored);
        if (ignored) SSL_set_tlsext_host_name(stream_->native_handle(), host.c_str());
        stream_->set_verify_callback(asio::ssl::host_name_verification(host));
        stream_->async_handshake(asio::ssl::stream_base::client, std::forward<Handler>(handler));
    }
    void close() noexcept {
        error_code ignored;
        socket_.shutdown(Socket::shutdown_both, ignored);
        socket_.close(ignored);
    }

  private:
    static constexpr std::size_t max_flat = 1 << 16;

    void read_(asio::mutable_buffer buffer, AnyHandler handler) {
        const asio::mutable_buffers_1 one(buffer);
        if (stream_) stream_->async_read_some(one, std::move(handler));
        else socket_.async_read_some(one, std::move(handler));
    }
    void write_(AnyHandler handler) {
        const asio::const_buffers_1 one(flat_.data(), flat_.size());
        if (stream_) stream_->async_write_some(one, std::move(handler));
        else socket_.async_write_some(one, std::move(handler));
    }

    std::string flat_;
    Socket socket_;
    std::shared_ptr<asio::ssl::context> tls_;
    std::unique_ptr<asio::ssl::stream<Socket&>> stream_;
};

// Functions that Beast calls at the end of a WebSocket, and finds by argument-dependent lookup.
inline void teardown(beast::role_type, Transport& transport, error_code& error) {
    transport.close();
    error = {};
}
template <class Handler> void async_teardown(beast::role_type, Transport& transport, Handler&& handler) {
    transport.close();
    asio::post(transport.get_executor(), beast::bind_front_handler(std::forward<Handler>(handler), error_code{}));
}
inline void beast_close_socket(Transport& transport) { transport.close(); }

inline const std::string untrusted_certificate = "the certificate is not trusted";

/// Return the cause of a failed handshake or connection in a few words.
inline std::string cause_of(const error_code& error) {
    if (error.category() == asio::error::get_ssl_category()) {
        return ERR_GET_REASON(static_cast<unsigned long>(error.value())) == SSL_R_CERTIFICATE_VERIFY_FAILED
                   ? untrusted_certificate
                   : "TLS failed: " + error.message();
    }
    return error.message();
}

}  // namespace rse_pf::detail
