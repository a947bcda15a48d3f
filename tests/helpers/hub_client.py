"""A user of a Hub, in a process of its own: the client reads address, token and caches once, when it is imported."""

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).parents[2]


def environment(url: str, home: Path, token: str | None) -> dict[str, str]:
    """Variables of a process that talks to the Hub at ``url`` alone, with its own caches below ``home``."""
    inherited = {name: value for name, value in os.environ.items() if name not in ("HF_TOKEN", "HISTMV_TRACEBACK")}
    return {
        **inherited,
        "HF_ENDPOINT": url,
        "HF_HUB_OFFLINE": "0",
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HOME": str(home / "huggingface"),
        "HF_LEROBOT_HOME": str(home / "lerobot"),
        "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}",
        **({"HF_TOKEN": token} if token else {}),
    }


class Client:
    """Runs one command after another.

    Args:
        url: the Hub's address.
        home: folder for its caches.
        token: access token, if the user has one.
    """

    def __init__(self, url: str, home: Path, token: str | None) -> None:
        self.home = home
        command = [sys.executable, "-u", __file__]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, env=environment(url, home, token), **pipes)  # type: ignore[call-overload]

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()

    def call(self, function: str, *arguments: Any) -> Any:
        """What ``module:function`` returns there."""
        self.process.stdin.write(json.dumps([function, arguments]) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def histmv(self, *words: str) -> str:
        """What the command prints; it must succeed."""
        status, printed = self.call("helpers.hub_client:histmv", *words)
        assert status == 0, printed
        return printed

    def fails(self, *words: str) -> str:
        """The one sentence with which the command fails."""
        status, printed = self.call("helpers.hub_client:histmv", *words)
        assert status == 1, printed
        assert "Traceback" not in printed
        lines = [line for line in printed.splitlines() if line.startswith(f"histmv {words[0]}: ")]
        assert len(lines) == 1, printed
        return lines[0]

    def load(self, repo_id: str) -> tuple[Path, int]:
        """Where LeRobot puts a dataset that it knows only by name, and its rows."""
        folder, rows = self.call("helpers.hub_client:load", repo_id)
        return Path(folder), rows


def histmv(*words: str) -> tuple[int, str]:
    from dataset_tools import cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            cli.main(words)
        except SystemExit as stop:
            return int(stop.code or 0), printed.getvalue()
    return 0, printed.getvalue()


def load(repo_id: str) -> tuple[str, int]:
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset(repo_id)
    assert dataset[len(dataset) - 1]["action"].isfinite().all()
    return str(dataset.root), len(dataset)


def checkpoint(path: str) -> str:
    from dataset_tools.eval_checkpoint import checkpoint_folder

    return str(checkpoint_folder(path))


def main() -> None:
    """Answer calls until the input ends. Retries do not wait: they would take half a minute."""
    from huggingface_hub.utils import _http

    _http.time = SimpleNamespace(**(vars(time) | {"sleep": lambda _: None}))
    answers = sys.stdout
    for line in sys.stdin:
        function, arguments = json.loads(line)
        module, _, name = function.partition(":")
        with contextlib.redirect_stdout(sys.stderr):
            answer = getattr(importlib.import_module(module), name)(*arguments)
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
