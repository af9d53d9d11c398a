"""The page on this machine alone, renewed while runs go on."""

import hashlib
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from race.errors import RaceError, RunDirectoryError
from race.viewing.report.page import message_page

ADDRESS = "127.0.0.1"


def fingerprint(paths: list[Path]) -> str:
    """Changes whenever rows are written, or runs begin."""
    digest = hashlib.blake2b(digest_size=8)
    for path in paths:
        files = [path] if path.is_file() else sorted(path.rglob("*"))
        for file in files:
            if file.name in ("metrics.jsonl", "config.json") or file.name.endswith(".jsonl.gz"):
                try:
                    told = file.stat()
                except OSError:  # gone since
                    continue
                digest.update(f"{file} {told.st_size} {told.st_mtime_ns};".encode())
    return digest.hexdigest()


def server(paths: list[Path], make: Callable[[str], str], port: int) -> ThreadingHTTPServer:
    """A server of the page, on the loopback address; `serve_forever` runs it.

    Args:
        paths: what the runs are read from.
        make: a fingerprint -> the page, made anew.
        port: 0 takes any that is free.

    Raises:
        RaceError: if the port is taken or none.
    """
    lock, made = threading.Lock(), {"of": "", "page": ""}

    def page() -> str:
        with lock:  # several windows ask at once; one makes it
            now = fingerprint(paths)
            if made["of"] != now:
                try:
                    made["page"] = make(now)
                except RaceError as error:  # such as a run without rows: it may have some soon
                    return message_page(str(error), now)
                made["of"] = now
            return made["page"]

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """Answers with the page or with its fingerprint."""
            if self.path == "/":
                self._answer(200, "text/html; charset=utf-8", page())
            elif self.path == "/fingerprint":
                self._answer(200, "text/plain", fingerprint(paths))
            else:
                self._answer(404, "text/plain", "there is nothing here")

        def _answer(self, status: int, kind: str, text: str) -> None:
            body = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            try:
                self.wfile.write(body)
            except OSError:  # the window was closed
                self.close_connection = True

        def log_message(self, format: str, *arguments: object) -> None:
            """Says nothing of every request."""

    for path in paths:
        if not path.exists():
            raise RunDirectoryError(f"{path} does not exist. Give the directory of runs.")
    try:
        return ThreadingHTTPServer((ADDRESS, port), Handler)
    except (OSError, OverflowError) as error:
        raise RaceError(
            f"The page cannot be served at port {port}: {error}. Choose another with --port, or 0 "
            "for any that is free."
        ) from error
