"""Runs a function in fresh processes, alone or as the ranks of one process group, without importing LeRobot anew."""

import faulthandler
import logging
import multiprocessing
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

PRELOADED = ["lerobot.scripts.lerobot_train", "lerobot_histmv.modeling_histmv"]
"""Imported once by the server that every process is forked from: these imports take longer than all the rest."""

PATIENCE = 240.0
"""How long [s] the processes may take."""


def in_ranks(count: int, log: Path, function: Callable[..., None], *arguments: Any, end_with: int = 0) -> None:
    """``function(rank, *arguments)`` in ``count`` processes that find each other as torchrun's would.

    ``log`` gets what they print. AssertionError with that, if one ends with another exit code than ``end_with``, or
    after ``PATIENCE``: a rank whose neighbour has failed waits for it.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [
        context.Process(target=_run, args=(rank, count, port, log, function, arguments)) for rank in range(count)
    ]
    for process in processes:
        process.start()
    end = time.monotonic() + PATIENCE
    for process in processes:
        process.join(max(0.0, end - time.monotonic()))
    late = [process for process in processes if process.exitcode is None]
    for process in late:
        process.kill()
        process.join()
    assert all(process.exitcode == end_with for process in processes), f"{len(late)} did not end:\n{log.read_text()}"


def _run(rank: int, count: int, port: int, log: Path, function: Callable[..., None], arguments: Sequence[Any]) -> None:
    if count > 1:
        names = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count, "MASTER_PORT": port}
        os.environ |= {name: str(value) for name, value in names.items()} | {"MASTER_ADDR": "127.0.0.1"}
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        # Where a rank hangs, the log shall say; its end as a process, in which torch's threads may wait for each other
        # after all is done, is none of the tests' business.
        faulthandler.dump_traceback_later(0.9 * PATIENCE)
        failed = 0
        try:
            function(rank, *arguments)
        except BaseException:
            failed = 1
            traceback.print_exc()
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(failed)


def lerobot_train(_: int, words: Sequence[str]) -> None:
    """The command ``lerobot-train`` with these words."""
    from lerobot.scripts.lerobot_train import main

    sys.argv = ["lerobot-train", *words]
    main()


def lerobot_train_killed(rank: int, words: Sequence[str]) -> None:
    """The same, killed as soon as its first checkpoint is complete."""
    from lerobot.scripts import lerobot_train as script

    complete = script.update_last_checkpoint

    def complete_and_die(checkpoint: Path) -> None:
        complete(checkpoint)
        os.kill(os.getpid(), signal.SIGKILL)

    script.update_last_checkpoint = complete_and_die
    lerobot_train(rank, words)
