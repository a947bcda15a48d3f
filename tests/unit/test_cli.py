"""``histmv``: teaches with --help, starts fast, and answers mistakes with what exists."""

import subprocess
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from dataset_tools import cli, command_line, config_files


@dataclass
class FakeConfig:
    """A subcommand's options."""

    size: int = 2


@pytest.fixture
def fake_command(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A subcommand ``fake`` that notes its config's size, and refuses 13."""
    seen: list[int] = []

    def run(config: FakeConfig) -> None:
        if config.size == 13:
            raise ValueError("size is 13; anything else is accepted")
        seen.append(config.size)

    monkeypatch.setitem(cli.COMMANDS, "fake", cli.Command("fake_module", "a test's command"))
    monkeypatch.setitem(sys.modules, "fake_module", SimpleNamespace(run=run))  # type: ignore[misc]
    return seen


@pytest.mark.parametrize("word", ["--size=-7", "--si-ze=3"])
def test_options_may_be_spelt_with_dashes(word: str) -> None:
    assert command_line.underscored(word) == {"--size=-7": "--size=-7", "--si-ze=3": "--si_ze=3"}[word]
    assert command_line.underscored("a-b") == "a-b"


@pytest.mark.parametrize("name", sorted(cli.COMMANDS.keys() - {"eval", "explain"}))
def test_every_commands_help_can_be_shown(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """argparse formats an option's comment: a percent sign in it would raise."""
    with pytest.raises(SystemExit, match="0"):
        cli.main([name, "--help"])
    assert "--" in capsys.readouterr().out


def test_help_lists_every_command_with_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["--help"])
    out = capsys.readouterr().out
    assert all(name in out and command.summary in out for name, command in cli.COMMANDS.items())


def test_help_fits_a_terminal() -> None:
    assert max(map(len, cli.usage().splitlines())) <= 120


def test_help_imports_nothing_heavy() -> None:
    probe = "import sys; from dataset_tools.cli import main; main(['--help']); print(*sys.modules, file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert not {"torch", "numpy", "lerobot", "draccus", "rich"} & set(result.stderr.split())


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_exists_and_has_one_documented_config(name: str) -> None:
    _, config_class = cli.runner(name)
    assert config_class.__doc__


def test_options_reach_the_command(fake_command: list[int]) -> None:
    cli.main(["fake", "--size=7"])
    assert fake_command == [7]


def test_unknown_command_is_told_what_exists(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["recrd"])
    message = capsys.readouterr().err
    assert stop.value.code == 2
    assert "did you mean 'record'?" in message
    assert "keyframe" in message


def test_unknown_option_is_refused(fake_command: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fake", "--sise=7"])
    assert stop.value.code == 2
    assert "--sise is not an option, did you mean --size?" in capsys.readouterr().err
    assert fake_command == []


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--env.disturbances.fog=1", "--env.disturbances.rgb_noise"),
        ("--seed=1.5", "`seed`: Couldn't parse '1.5' into an int"),
        ("--env.image_size=large", "`env.image_size`: Couldn't parse 'large' into an int"),
        ("--env.disturbances.depth=-1", "disturbances.depth is -1.0; it must not be negative"),
        ("--env.task=nope", "accepted are reach_target, "),
    ],
)
def test_a_wrong_option_is_named_with_what_exists(
    option: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(cli.TRACEBACK_VARIABLE, raising=False)
    with pytest.raises(SystemExit):
        cli.main(["record", "--env.task=turn_tap", option])
    assert message in capsys.readouterr().err


def test_a_users_mistake_gives_one_sentence_and_a_traceback_on_request(
    fake_command: list[int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(cli.TRACEBACK_VARIABLE, raising=False)
    with pytest.raises(SystemExit) as stop:
        cli.main(["fake", "--size=13"])
    message = capsys.readouterr().err
    assert stop.value.code == 1
    assert "histmv fake: size is 13; anything else is accepted" in message
    assert "Traceback" not in message
    monkeypatch.setenv(cli.TRACEBACK_VARIABLE, "1")
    with pytest.raises(ValueError, match="size is 13"):
        cli.main(["fake", "--size=13"])


def test_config_files_are_found_by_name_and_listed_when_the_name_is_wrong() -> None:
    for name in config_files.names():
        assert config_files.find(name).is_file()
    with pytest.raises(ValueError, match="train/default"):
        config_files.find("train/no_such_file")
