"""Runs a command with its output in a log file, and reads the progress that its progress bar shows.

The command gets a pseudo-terminal, because progress bars are drawn only on terminals.
"""

import codecs
import contextlib
import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ESCAPES = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
COUNT = re.compile(r"(?<![\d.])(\d+)/(\d+)(?![\d.])")
TQDM_BAR = re.compile(r"^.*?\d+/\d+ \[[^\]]*\]")
"""A progress bar. Text may follow on the same line: on a terminal the next drawing would have covered the bar."""

PLAIN_TERMINAL = {"TERM": "xterm", "NO_COLOR": "1", "PYTHONUNBUFFERED": "1"}
ROWS, COLUMNS = 40, 120
PATIENCE = 10.0
"""Seconds that an interrupted command gets to stop by itself."""

LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Child:
    """A running command and the reading end of its terminal."""

    process: subprocess.Popen[bytes]
    output: int

    def follow(self, log: Path, report: Callable[[int, int], None]) -> int:
        """Read the command's output to its end; returns its exit status.

        Args:
            log: file to which every finished line is appended; lines that are drawn over are left out.
            report: called with (done, total) each time the command's progress bar moves.
        """
        with log.open("a") as file:
            for text, finished in terminal_lines(self.output):
                bar = TQDM_BAR.match(text)
                shown = bar.group() if bar else "" if finished else text
                if finished:
                    file.write((text.removeprefix(shown) or text) + "\n")
                    file.flush()
                if counts := COUNT.findall(shown):
                    done, total = map(int, counts[-1])
                    if done <= total:
                        report(done, total)
        return self.process.wait()


@contextlib.contextmanager
def start(command: Sequence[str], environment: Mapping[str, str]) -> Iterator[Child]:
    """Start ``command`` (a console script and its arguments); it is stopped if the block is left before its end.

    Args:
        command: the console script is looked for beside this interpreter, then on PATH.
        environment: variables added to this process's own.

    Raises:
        ValueError: there is no such console script.
    """
    output, terminal = os.openpty()
    tty.setraw(terminal)
    termios.tcsetwinsize(terminal, (ROWS, COLUMNS))
    process = subprocess.Popen(
        [executable(command[0]), *command[1:]],
        stdin=subprocess.DEVNULL,
        stdout=terminal,
        stderr=terminal,
        env={**os.environ, **PLAIN_TERMINAL, **environment},
        preexec_fn=die_with_parent if sys.platform == "linux" else None,
    )
    os.close(terminal)
    try:
        yield Child(process, output)
    finally:
        os.close(output)
        stop(process)


def executable(name: str) -> str:
    """Full path of a console script."""
    found = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if found is None:
        raise ValueError(f"command {name!r} is neither installed beside {sys.executable} nor on PATH")
    return found


def die_with_parent() -> None:
    """In the child: ask Linux for SIGTERM when the parent dies, so that a killed run leaves nothing at work."""
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a process that is still running, first asking it to stop."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def terminal_lines(output: int) -> Iterator[tuple[str, bool]]:
    """Lines without escape codes, and whether each is finished (ends with a newline) or will be drawn over."""
    decode = codecs.getincrementaldecoder("utf-8")(errors="replace").decode
    rest = ""
    while chunk := read_chunk(output):
        *complete, rest = re.split(r"(?<=[\r\n])", rest + decode(chunk))
        for text in complete:
            yield ESCAPES.sub("", text[:-1]), text[-1] == "\n"
    if rest:
        yield ESCAPES.sub("", rest), True


def read_chunk(output: int) -> bytes:
    """What the terminal holds; empty at the end, which Linux tells by an error."""
    try:
        return os.read(output, 65536)
    except OSError:
        return b""
