"""Peers that are no RSE-PF servers: each answers every connection with given bytes, with or without TLS."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from rse_pf.auth.certificates import CertificateWithKey, issue_server_certificate

HOUR_S = 3600.0


@contextlib.contextmanager
def peer(serve: Callable[[socket.socket], None]) -> Iterator[int]:
    """Serve each connection by a call in a thread of its own; yield the port."""
    listener = socket.create_server(("127.0.0.1", 0))

    def run(made: socket.socket) -> None:
        with contextlib.suppress(OSError), made:
            serve(made)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=run, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield listener.getsockname()[1]
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


def http(head: str, body: str = "", *, version: str = "1.1") -> bytes:
    """Return an HTTP answer with a status line and headers in *head*."""
    lines = [f"HTTP/{version} {head}", f"Content-Length: {len(body)}", "Connection: close"]
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()


def after_request(answer: bytes) -> Callable[[socket.socket], None]:
    """Send *answer* once a head was received, and close."""

    def serve(made: socket.socket) -> None:
        read_head(made)
        made.sendall(answer)

    return serve


def at_once(answer: bytes) -> Callable[[socket.socket], None]:
    """Send *answer* before anything was received, and wait for the other side to close."""

    def serve(made: socket.socket) -> None:
        made.sendall(answer)
        while made.recv(4096):
            pass

    return serve


def silent(made: socket.socket) -> None:
    """Receive, and send nothing."""
    while made.recv(4096):
        pass


def with_tls(
    context: ssl.SSLContext, serve: Callable[[socket.socket], None]
) -> Callable[[socket.socket], None]:
    """Serve behind TLS; a handshake that fails closes the connection."""

    def serve_tls(made: socket.socket) -> None:
        with context.wrap_socket(made, server_side=True) as secured:
            serve(secured)

    return serve_tls


def tls_context(
    authority: CertificateWithKey, names: list[str], folder: Path, now_s: float
) -> ssl.SSLContext:
    """Return the context of a server with a certificate for *names* by *authority*."""
    made = issue_server_certificate(authority, names, now_s=now_s)
    file = folder / "server.pem"
    file.write_text(made.certificate + made.private_key)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(file)
    return context


def proxy_to(port: int, asked: list[str], *, answer: bytes = b"") -> Callable[[socket.socket], None]:
    """Relay each tunnel to *port* of this machine, whatever host is asked for; or only send *answer*."""

    def serve(made: socket.socket) -> None:
        asked.append(read_head(made).decode())
        if answer:
            made.sendall(answer)
            return
        with socket.create_connection(("127.0.0.1", port)) as there:
            made.sendall(b"HTTP/1.1 200 Connection established\r\n\r\n")
            back = threading.Thread(target=_pump, args=(there, made), daemon=True)
            back.start()
            _pump(made, there)
            back.join()

    return serve


def read_head(made: socket.socket) -> bytes:
    """Return what arrives up to an empty line, or to the end."""
    head = b""
    while b"\r\n\r\n" not in head and (more := made.recv(1)):
        head += more
    return head


def _pump(source: socket.socket, target: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            target.sendall(data)
    with contextlib.suppress(OSError):
        target.shutdown(socket.SHUT_WR)
