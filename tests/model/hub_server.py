"""A stand-in for the Hugging Face hub on this machine: the requests that loading and pushing weights make, no more."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@dataclass
class FakeHub:
    """What the hub holds.

    Attributes:
        files: bytes by ``owner/name``, revision and file.
        gated: repositories whose terms have to be accepted.
        tokens: who may write; without one of these, nobody.
        requests: method and path of all requests so far.
    """

    files: dict[str, dict[str, dict[str, bytes]]] = field(default_factory=dict)
    gated: set[str] = field(default_factory=set)
    tokens: set[str] = field(default_factory=set)
    requests: list[str] = field(default_factory=list)

    @contextmanager
    def serve(self) -> Iterator[str]:
        """Serve from another thread; gives the address."""
        hub = self

        class Handler(_Handler):
            held = hub

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            server.server_close()
            thread.join()


class _Handler(BaseHTTPRequestHandler):
    held: FakeHub
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self._file(body=False)

    def do_GET(self) -> None:
        self._file(body=True)

    def do_POST(self) -> None:
        self.held.requests.append(f"POST {self.path}")
        data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == "/api/validate-yaml":
            return self._json({"errors": [], "warnings": []})
        if self.headers.get("Authorization", "").removeprefix("Bearer ") not in self.held.tokens:
            return self._error(401, "", "Invalid username or password.")
        if self.path == "/api/repos/create":
            asked = json.loads(data)
            repo = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
            self.held.files.setdefault(repo, {"main": {}})
            return self._json({"url": f"http://{self.headers['Host']}/{repo}", "name": repo})
        repo, _, rest = self.path.removeprefix("/api/models/").partition("/preupload/")
        if rest:
            paths = [f["path"] for f in json.loads(data)["files"]]
            return self._json({"files": [{"path": p, "uploadMode": "regular", "shouldIgnore": False} for p in paths]})
        repo, _, revision = self.path.removeprefix("/api/models/").partition("/commit/")
        files = self.held.files[repo].setdefault(revision.partition("?")[0], {})
        for line in data.splitlines():
            entry = json.loads(line)
            if entry["key"] == "file":
                files[entry["value"]["path"]] = base64.b64decode(entry["value"]["content"])
        address = f"http://{self.headers['Host']}/{repo}/commit/{COMMIT}"
        return self._json({"commitUrl": address, "commitOid": COMMIT})

    def _file(self, *, body: bool) -> None:
        self.held.requests.append(f"{self.command} {self.path}")
        if self.path.startswith("/api/models/"):
            return self._json({"id": "owner/name", "sha": COMMIT, "siblings": []})
        repo, _, rest = self.path.removeprefix("/").partition("/resolve/")
        revision, _, name = rest.partition("/")
        if repo in self.held.gated:
            return self._error(403, "GatedRepo", "Access is restricted.")
        if repo not in self.held.files:
            return self._error(401, "RepoNotFound", "Repository not found.")
        if revision not in (*self.held.files[repo], COMMIT):
            return self._error(404, "RevisionNotFound", "Invalid rev id.")
        data = self.held.files[repo]["main" if revision == COMMIT else revision].get(name)
        if data is None:
            return self._error(404, "EntryNotFound", "Entry not found.")
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()}"')
        self.send_header("X-Repo-Commit", COMMIT)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if body:
            self.wfile.write(data)
        return None

    def _json(self, value: object) -> None:
        data = json.dumps(value).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def _error(self, status: int, code: str, message: str) -> None:
        self.send_response(status)
        if code:
            self.send_header("X-Error-Code", code)
        self.send_header("X-Error-Message", message)
        self.send_header("Content-Length", "0")
        self.end_headers()
