"""Fails on tracked files that are too big, or that name a package registry or a path of somebody's machine."""

import re
import subprocess
import sys
from pathlib import Path

LARGEST = 2_000_000
FORBIDDEN = {
    "a registry": re.compile(
        "index" + "-url|find" + r"-links\b.*[:/]|https?://\S+/simp" + r"le\b|https?://\S+\.(?:whl|tar\.gz)\b"
    ),
    "a registry's host": re.compile(r"\b(?:pypi|pythonhosted|npmjs)\.(?:org|com)\b|\bdeb\.debian\.org\b"),
    "a machine's path": re.compile(r"(?<![\w./$}])/(?:root|work|home/\w+|Users/\w+)/"),
}


def tracked() -> list[Path]:
    """Files that git knows and that exist."""
    listed = subprocess.run(["git", "ls-files", "-z"], capture_output=True, text=True, check=True).stdout
    return [path for name in listed.split("\0") if name and (path := Path(name)).is_file()]


def complaints(path: Path) -> list[str]:
    """What is wrong with one file."""
    if path.stat().st_size > LARGEST:
        return [f"{path}: {path.stat().st_size} bytes; at most {LARGEST} are allowed"]
    try:
        lines = path.read_text().splitlines()
    except UnicodeDecodeError:
        return []
    if path == Path(".ci/check_files.py"):
        return []
    return [
        f"{path}:{number}: names {what}: {line.strip()[:100]}"
        for number, line in enumerate(lines, 1)
        for what, pattern in FORBIDDEN.items()
        if pattern.search(line)
    ]


def main() -> None:
    """Print all complaints; exit with 1 if there are any."""
    found = [complaint for path in tracked() for complaint in complaints(path)]
    print("\n".join(found), end="\n" if found else "")
    sys.exit(bool(found))


main()
