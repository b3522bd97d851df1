"""A server on loopback that speaks as much of the Hub's protocol as uploads and downloads of small files need."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import yaml


class FakeHub(ThreadingHTTPServer):
    """``repos`` maps names to files; ``asked`` lists the requests, ``METHOD path``."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repos: dict[str, dict[str, bytes]] = {}
        self.asked: list[str] = []
        self.endpoint = f"http://127.0.0.1:{self.server_port}"
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    def commit(self, repo: str) -> str:
        files = self.repos[repo]
        digest = hashlib.sha1(repr(sorted((n, hash_of(x)) for n, x in files.items())).encode())
        return digest.hexdigest()


def hash_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FakeHub

    def log_message(self, *_) -> None:
        pass

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.server.asked.append(f"POST {self.path}")
        if self.path == "/api/repos/create":
            given = json.loads(body)
            repo = f"{given['organization']}/{given['name']}"
            self.server.repos.setdefault(repo, {})
            return self.answer({"url": f"{self.server.endpoint}/{repo}", "name": repo})
        if match := re.fullmatch(r"/api/models/(.+)/preupload/main", self.path):
            files = [
                {"path": one["path"], "uploadMode": "regular", "shouldIgnore": False}
                for one in json.loads(body)["files"]
            ]
            return self.answer({"files": files})
        if match := re.fullmatch(r"/api/models/(.+)/commit/main", self.path):
            for line in body.splitlines():
                entry = json.loads(line)
                if entry["key"] == "file":
                    data = base64.b64decode(entry["value"]["content"])
                    self.server.repos[match[1]][entry["value"]["path"]] = data
            sha = self.server.commit(match[1])
            url = f"{self.server.endpoint}/{match[1]}/commit/{sha}"
            return self.answer({"success": True, "commitOid": sha, "commitUrl": url})
        if self.path == "/api/validate-yaml":
            front = yaml.safe_load(json.loads(body)["content"].split("---")[1])
            known = isinstance(front.get("tags"), list) and "library_name" in front
            errors = [] if known else [{"message": "no tags, or no library"}]
            return self.answer({"errors": errors, "warnings": []})
        return self.answer({"error": "unknown"}, 400)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self.server.asked.append(f"{self.command} {self.path}")
        repos = self.server.repos
        path = self.path.split("?")[0]
        if match := re.fullmatch(r"/api/models/([^/]+/[^/]+)(/revision/[^/]+)?", path):
            if match[1] not in repos:
                return self.refuse("RepoNotFound")
            sha = self.server.commit(match[1])
            if match[2] not in (None, "/revision/main", f"/revision/{sha}"):
                return self.refuse("RevisionNotFound")
            siblings = [{"rfilename": name} for name in repos[match[1]]]
            return self.answer(
                {"id": match[1], "modelId": match[1], "sha": sha, "siblings": siblings, "tags": []}
            )
        if match := re.fullmatch(r"/api/models/([^/]+/[^/]+)/tree/[^/]+", path):
            return self.answer(
                [
                    {"type": "file", "path": name, "size": len(data), "oid": hash_of(data)[:40]}
                    for name, data in repos[match[1]].items()
                ]
            )
        if match := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            data = repos.get(match[1], {}).get(match[3])
            if data is None:
                return self.refuse("EntryNotFound")
            extra = {
                "ETag": f'"{hash_of(data)}"',
                "X-Repo-Commit": self.server.commit(match[1]),
                "Content-Type": "application/octet-stream",
            }
            return self.send(200, data, extra)
        return self.refuse("EntryNotFound")

    def refuse(self, code: str) -> None:
        self.send(404, b'{"error": "not found"}', {"X-Error-Code": code})

    def answer(self, value: object, status: int = 200) -> None:
        self.send(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)
