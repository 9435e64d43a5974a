"""Serve the pages of this folder, and the client that they use, to browsers.

For this machine alone: python examples/web/serve.py

For phones of the network, by the certificate of a platform that runs with rse-pf local --lan:
python examples/web/serve.py --host 192.168.1.20 --state FOLDER
"""

from __future__ import annotations

import argparse
import http.server
import json
import ssl
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent
FILES = {
    "/": (HERE / "index.html", "text/html; charset=utf-8"),
    "/camera_pose.js": (HERE / "camera_pose.js", "text/javascript"),
    "/place": (HERE / "place.html", "text/html; charset=utf-8"),
    "/place.js": (HERE / "place.js", "text/javascript"),
    "/rse-pf.js": (EXAMPLES.parent / "client_web" / "rse-pf.js", "text/javascript"),
    "/cover.png": (EXAMPLES / "robots" / "object_recognition_service" / "objects" / "cover.png", "image/png"),
}
TAG = 7
TAG_PX = 400


def tag_picture() -> bytes:
    """Return a tag with the white border that it needs, as PNG; empty without OpenCV."""
    try:
        import cv2
    except ImportError:
        return b""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(dictionary, TAG, TAG_PX)
    paper = cv2.copyMakeBorder(marker, 80, 80, 80, 80, cv2.BORDER_CONSTANT, value=255)
    return bytes(cv2.imencode(".png", paper)[1])


class Page(http.server.BaseHTTPRequestHandler):
    """The files of `FILES`, and nothing else of this machine."""

    def do_GET(self) -> None:
        """Answer one request."""
        file, kind = FILES.get(self.path, (None, "image/png"))
        body = file.read_bytes() if file is not None else b""
        if self.path == "/tag.png":
            body = tag_picture()
        self.send_response(200 if body else 404)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Write no line for a request."""


def certificate_of(state: Path) -> ssl.SSLContext:
    """Return the TLS context of the platform whose folder is *state*."""
    resource = json.loads((state / "tls.json").read_text(encoding="utf-8"))["resources"][0]
    certificate = resource["tls_certificate"]
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with tempfile.NamedTemporaryFile("w", suffix=".pem") as file:  # readable by its owner only
        file.write(
            certificate["certificate_chain"]["inline_string"] + certificate["private_key"]["inline_string"]
        )
        file.flush()
        context.load_cert_chain(file.name)
    return context


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=8088, help="port to listen on; 0 takes a free one")
    parser.add_argument("--state", type=Path, help="folder of a platform with --lan: serve https")
    arguments = parser.parse_args()
    server = http.server.ThreadingHTTPServer((arguments.host, arguments.port), Page)
    scheme = "http"
    if arguments.state is not None:
        server.socket = certificate_of(arguments.state).wrap_socket(server.socket, server_side=True)
        scheme = "https"
    print(f"{scheme}://{arguments.host}:{server.server_port}/", flush=True)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        server.server_close()


if __name__ == "__main__":
    main()
