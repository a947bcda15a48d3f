"""What a Hub keeps: repositories with branches, tags and atomic commits, and large files from before their commit."""

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath

LARGE = (".parquet", ".safetensors", ".mp4", ".arrow", ".bin", ".png")
"""Suffixes that the Hub's own first commit, the file .gitattributes, sends to large file storage."""
REGULAR_LIMIT = 10 * 1024**2


@dataclass(frozen=True)
class HubError(Exception):
    """An answer other than 2xx, with the headers by which the client tells errors apart."""

    status: int
    message: str
    code: str = ""


@dataclass(frozen=True)
class File:
    content: bytes
    large: bool

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    @property
    def blob(self) -> str:
        """Git's identifier: of the content or, for a large file, of the pointer that git stores in its place."""
        pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{self.sha256}\nsize {len(self.content)}\n"
        stored = pointer.encode() if self.large else self.content
        return hashlib.sha1(b"blob %d\0" % len(stored) + stored).hexdigest()

    @property
    def oid(self) -> str:
        """What the client compares with its own file to see whether it changed."""
        return self.sha256 if self.large else self.blob


Tree = dict[str, File]


@dataclass
class Repo:
    kind: str
    name: str
    private: bool
    commits: dict[str, Tree] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    stored: dict[str, bytes] = field(default_factory=dict)
    """Large files by SHA-256, whether a commit names them or not."""

    def __post_init__(self) -> None:
        attributes = "".join(f"*{suffix} filter=lfs diff=lfs merge=lfs -text\n" for suffix in LARGE)
        self.add("main", {".gitattributes": File(attributes.encode(), False)})

    @property
    def owner(self) -> str:
        return self.name.partition("/")[0]

    def add(self, branch: str, tree: Tree) -> str:
        """The new head of ``branch``; until here nothing of a commit is visible."""
        content = [f"{path} {file.blob}" for path, file in sorted(tree.items())]
        number = f"{len(self.commits)} {self.branches.get(branch)}"
        oid = hashlib.sha1("\n".join([number, *content]).encode()).hexdigest()
        self.commits[oid] = tree
        self.branches[branch] = oid
        return oid

    def commit_of(self, revision: str) -> str:
        oid = self.branches.get(revision) or self.tags.get(revision) or revision
        if oid not in self.commits:
            raise HubError(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return oid

    def tree(self, revision: str) -> Tree:
        return self.commits[self.commit_of(revision)]

    def upload_mode(self, path: str, size: int) -> str:
        return "lfs" if PurePosixPath(path).suffix in LARGE or size > REGULAR_LIMIT else "regular"

    def commit(self, branch: str, lines: Iterable[Mapping]) -> str:
        """Apply a commit's operations, header first, as the client sends them: all or none."""
        tree = dict(self.tree(branch))
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                tree[value["path"]] = File(base64.b64decode(value["content"]), False)
            elif line["key"] == "lfsFile":
                if value["oid"] not in self.stored:
                    raise HubError(400, f"LFS pointer pointed to a file that does not exist: {value['path']}")
                tree[value["path"]] = File(self.stored[value["oid"]], True)
            elif line["key"] == "deletedFile":
                if tree.pop(value["path"], None) is None:
                    raise HubError(404, "A file with this name doesn't exist", "EntryNotFound")
            elif line["key"] != "header":
                raise HubError(400, f"unknown operation {json.dumps(line['key'])}")
        return self.add(branch, tree)
