"""Locks of folders."""

import subprocess
import sys
from pathlib import Path

import pytest

from dataset_tools.locks import only_one


def test_folder_belongs_to_one_process_until_it_ends(tmp_path: Path) -> None:
    take = "import sys, fcntl; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX)"
    hold = f"{take}; print('held', flush=True); input()"
    command = [sys.executable, "-c", hold, str(tmp_path / ".lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(ValueError, match="busy"), only_one(tmp_path, "busy"):
            pass
        other.kill()
    with only_one(tmp_path, "busy"):
        pass
