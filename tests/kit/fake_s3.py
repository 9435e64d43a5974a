"""S3 on a port of this machine, by moto, that answers 503 or nothing at all when it is told to."""

from __future__ import annotations

import http.client
import logging
import threading
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Literal

Mood = Literal["well", "unavailable", "silent"]

_BUSY = b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>"
_HOP = ("connection", "keep-alive", "transfer-encoding", "host", "content-length", "date", "server")
_TIMEOUT_S = 30.0


class PlayedS3:
    """An S3 whose `mood` may change at any time; a context manager, whose ``url`` is the endpoint."""

    def __init__(self) -> None:
        from moto.server import ThreadedMotoServer

        logging.getLogger("werkzeug").setLevel(logging.ERROR)  # it logs every request
        self.mood: Mood = "well"
        self._over = threading.Event()
        self._moto = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        played = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            timeout = _TIMEOUT_S

            def answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                mood = played.mood
                if mood == "silent":
                    while played.mood == "silent" and not played._over.wait(0.1):
                        pass
                    self.close_connection = True
                elif mood == "unavailable":
                    self._send(503, {"Content-Type": "application/xml"}, _BUSY)
                else:
                    self._pass_on(body)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = answer

            def _pass_on(self, body: bytes) -> None:
                host, port = played._moto.get_host_and_port()
                connection = http.client.HTTPConnection(host, port, timeout=_TIMEOUT_S)
                sent = {name: value for name, value in self.headers.items() if name.lower() != "connection"}
                connection.request(self.command, self.path, body, sent)
                made = connection.getresponse()
                headers = {name: value for name, value in made.getheaders() if name.lower() not in _HOP}
                length = made.headers.get("Content-Length") if self.command == "HEAD" else None
                self._send(made.status, headers, made.read(), length)
                connection.close()

            def _send(
                self, status: int, headers: dict[str, str], body: bytes, length: str | None = None
            ) -> None:
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)) if length is None else length)
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                """Log nothing."""

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, request: Any, client_address: Any) -> None:
                """A client that went away meanwhile is part of the play."""

        self._server = Server(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> PlayedS3:
        self._moto.start()
        host, port = self._moto.get_host_and_port()
        forget = urllib.request.Request(f"http://{host}:{port}/moto-api/reset", method="POST")
        urllib.request.urlopen(forget, timeout=_TIMEOUT_S).close()  # buckets of earlier plays in this process
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(10)
        self._moto.stop()
