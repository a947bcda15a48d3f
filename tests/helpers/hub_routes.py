"""The Hub's pages, each a function of a request and of what its address names."""

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import yaml
from helpers.hub_store import File, HubError, Repo

if TYPE_CHECKING:
    from helpers.hub_server import Request


@dataclass(frozen=True)
class Answer:
    status: int = 200
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)


def as_json(content: Any, status: int = 200) -> Answer:
    return Answer(status, json.dumps(content).encode(), {"Content-Type": "application/json"})


def whoami(request: "Request") -> Answer:
    if request.user is None:
        raise HubError(401, "Invalid username or password.")
    return as_json({"type": "user", "name": request.user, "orgs": [], "auth": {"type": "access_token"}})


def validate_yaml(request: "Request") -> Answer:
    """The front matter of a card, as far as licences go."""
    found = re.match(r"\s*---\n(.*?)\n---", request.json["content"], re.DOTALL)
    data = yaml.safe_load(found[1]) if found else {}
    licence = str(data.get("license", "apache-2.0"))
    if not re.fullmatch(r"[a-z0-9][a-z0-9.\-]*", licence):
        return as_json({"errors": [{"message": f'"license" must be one of the Hub\'s, not "{licence}"'}]}, 400)
    return as_json({"errors": [], "warnings": []})


def create_repo(request: "Request") -> Answer:
    wanted = request.json
    request.must_be(wanted["organization"] or request.user)
    name = f"{wanted['organization'] or request.user}/{wanted['name']}"
    kind = wanted.get("type") or "model"
    url = f"{request.hub.url}/{'' if kind == 'model' else kind + 's/'}{name}"
    if (kind, name) in request.hub.repos:
        return as_json({"error": f"You already created this {kind} repo", "url": url}, 409)
    request.hub.repos[kind, name] = Repo(kind, name, wanted.get("visibility") == "private")
    return as_json({"url": url, "name": name})


def repo_info(request: "Request", kind: str, name: str, revision: str | None = None) -> Answer:
    repo = request.readable(kind, name)
    commit = repo.commit_of(revision or "main")
    siblings = [{"rfilename": path} for path in repo.tree(commit)]
    return as_json({"id": name, "sha": commit, "private": repo.private, "siblings": siblings, "tags": []})


def tree(request: "Request", kind: str, name: str, revision: str) -> Answer:
    return as_json([entry(path, file) for path, file in request.readable(kind, name).tree(revision).items()])


def entry(path: str, file: File) -> dict[str, Any]:
    found = {"type": "file", "path": path, "size": len(file.content), "oid": file.blob}
    large = {"lfs": {"oid": file.sha256, "size": len(file.content), "pointerSize": 134}}
    return found | (large if file.large else {})


def refs(request: "Request", kind: str, name: str) -> Answer:
    repo = request.readable(kind, name)
    groups = {"branches": ("heads", repo.branches), "tags": ("tags", repo.tags)}
    listed = {
        group: [{"name": ref, "ref": f"refs/{where}/{ref}", "targetCommit": oid} for ref, oid in found.items()]
        for group, (where, found) in groups.items()
    }
    return as_json({**listed, "converts": []})


def add_tag(request: "Request", kind: str, name: str, revision: str) -> Answer:
    repo, tag = request.writable(kind, name), request.json["tag"]
    if tag in repo.tags:
        raise HubError(409, f"Tag {tag} already exists")
    repo.tags[tag] = repo.commit_of(revision)
    return as_json({})


def delete_tag(request: "Request", kind: str, name: str, revision: str) -> Answer:
    if request.writable(kind, name).tags.pop(revision, None) is None:
        raise HubError(404, f"no tag {revision}", "RevisionNotFound")
    return as_json({})


def preupload(request: "Request", kind: str, name: str, revision: str) -> Answer:
    repo = request.writable(kind, name)
    there = repo.tree(revision)
    files = [
        {
            "path": file["path"],
            "uploadMode": repo.upload_mode(file["path"], file["size"]),
            "shouldIgnore": False,
            **({"oid": there[file["path"]].oid} if file["path"] in there else {}),
        }
        for file in request.json["files"]
    ]
    return as_json({"files": files})


def large_files(request: "Request", kind: str, name: str) -> Answer:
    """LFS's batch: where to upload what is not stored yet."""
    stored = request.writable(kind, name).stored
    objects = []
    for wanted in request.json["objects"]:
        path = f"lfs/{kind}/{name}/{wanted['oid']}"
        actions = {
            "upload": {"href": f"{request.hub.storage}/{path}"},
            "verify": {"href": f"{request.hub.url}/{path}/verify"},
        }
        objects.append(wanted | ({} if wanted["oid"] in stored else {"actions": actions}))
    return as_json({"transfer": "basic", "objects": objects})


def upload(request: "Request", kind: str, name: str, oid: str) -> Answer:
    """Storage: its addresses are signed, so that it asks for no token."""
    tokenless(request)
    if hashlib.sha256(request.body).hexdigest() != oid:
        raise HubError(400, "the content does not match its SHA-256")
    request.hub.repo(kind, name).stored[oid] = request.body
    return Answer()


def verify(request: "Request", kind: str, name: str, oid: str) -> Answer:
    if len(request.writable(kind, name).stored.get(oid, b"")) != request.json["size"]:
        raise HubError(422, f"{oid} is not stored")
    return as_json({})


def commit(request: "Request", kind: str, name: str, revision: str) -> Answer:
    lines = [json.loads(line) for line in request.body.splitlines()]
    oid = request.writable(kind, name).commit(revision, lines)
    prefix = "" if kind == "model" else f"{kind}s/"
    url = f"{request.hub.url}/{prefix}{name}/commit/{oid}"
    return as_json({"success": True, "commitOid": oid, "commitUrl": url, "hookOutput": ""})


def resolve(request: "Request", name: str, revision: str, path: str, prefix: str | None = None) -> Answer:
    """A small file itself; for a large one the way to storage."""
    repo = request.readable((prefix or "models/").removesuffix("s/"), name)
    head = {"X-Repo-Commit": repo.commit_of(revision)}
    file = repo.tree(revision).get(path)
    if file is None:
        raise HubError(404, "Entry not found", "EntryNotFound")
    if not file.large:
        return part(request, file.content, head | {"ETag": f'"{file.blob}"'})
    large = {"X-Linked-Size": str(len(file.content)), "X-Linked-ETag": f'"{file.sha256}"'}
    return Answer(
        302, b"", head | large | {"Location": f"{request.hub.storage}/storage/{repo.kind}/{name}/{file.sha256}"}
    )


def tokenless(request: "Request") -> None:
    """As storage does: refuse who shows it an access token."""
    if "Authorization" in request.headers:
        raise HubError(400, "only one way of authentication is allowed")


def storage(request: "Request", kind: str, name: str, oid: str) -> Answer:
    tokenless(request)
    return part(request, request.hub.repo(kind, name).stored[oid], {"ETag": f'"{oid}"'})


def part(request: "Request", content: bytes, headers: dict[str, str]) -> Answer:
    """All of it, or from where an earlier download stopped."""
    wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", request.headers.get("Range", ""))
    if not wanted:
        return Answer(200, content, headers | {"Accept-Ranges": "bytes"})
    first, last = int(wanted[1]), int(wanted[2] or len(content) - 1)
    if first >= len(content):
        raise HubError(416, f"there are {len(content)} bytes")
    return Answer(206, content[first : last + 1], headers | {"Content-Range": f"bytes {first}-{last}/{len(content)}"})


_NAME = r"(?P<name>[^/]+/[^/]+)"
_API = rf"/api/(?P<kind>model|dataset)s/{_NAME}"
_REVISION = r"(?P<revision>[^/]+)"
ROUTES: list[tuple[str, str, Callable[..., Answer]]] = [
    ("GET", "/api/whoami-v2", whoami),
    ("POST", "/api/validate-yaml", validate_yaml),
    ("POST", "/api/repos/create", create_repo),
    ("GET", _API, repo_info),
    ("GET", rf"{_API}/revision/{_REVISION}", repo_info),
    ("GET", rf"{_API}/tree/{_REVISION}", tree),
    ("GET", rf"{_API}/refs", refs),
    ("POST", rf"{_API}/tag/{_REVISION}", add_tag),
    ("DELETE", rf"{_API}/tag/{_REVISION}", delete_tag),
    ("POST", rf"{_API}/preupload/{_REVISION}", preupload),
    ("POST", rf"{_API}/commit/{_REVISION}", commit),
    ("PUT", rf"/lfs/(?P<kind>\w+)/{_NAME}/(?P<oid>\w+)", upload),
    ("POST", rf"/lfs/(?P<kind>\w+)/{_NAME}/(?P<oid>\w+)/verify", verify),
    ("GET HEAD", rf"/storage/(?P<kind>\w+)/{_NAME}/(?P<oid>\w+)", storage),
    ("GET HEAD", rf"/(?P<prefix>datasets/)?{_NAME}/resolve/{_REVISION}/(?P<path>.+)", resolve),
    ("POST", rf"/{_NAME}\.git/info/lfs/objects/batch", lambda request, name: large_files(request, "model", name)),
    (
        "POST",
        rf"/datasets/{_NAME}\.git/info/lfs/objects/batch",
        lambda request, name: large_files(request, "dataset", name),
    ),
]
