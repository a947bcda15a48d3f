"""What is pushed comes back byte by byte; a broken upload changes nothing for readers; refusals are one sentence."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fake_ur5 import write_checkpoint
from helpers.episodes import pick, snapshot, write_picks, write_vector_picks
from helpers.hub_client import Client, environment
from helpers.hub_server import Fault, Hub, serve
from helpers.hub_store import File, Repo

from lerobot_histmv import keys

ATTRIBUTES = ".gitattributes"
FRAMES = len(pick(np.random.default_rng(0))["gripper"])


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with serve(ann="token-of-ann", ben="token-of-ben") as hub:
        yield hub


@pytest.fixture(autouse=True)
def sound(hub: Hub) -> Iterator[None]:
    yield
    hub.fault = None


@pytest.fixture(scope="module")
def ann(hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with Client(hub.url, tmp_path_factory.mktemp("ann"), "token-of-ann") as client:
        yield client


@pytest.fixture(scope="module")
def nobody(hub: Hub, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with Client(hub.url, tmp_path_factory.mktemp("nobody"), None) as client:
        yield client


@pytest.fixture(scope="module")
def dense(ann: Client, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dense dataset that is on the Hub as ann/dense."""
    root = write_picks(tmp_path_factory.mktemp("data") / "dense")
    printed = ann.histmv("push", f"--root={root}", "--repo_id=ann/dense")
    assert "2 episodes" in printed
    assert "/datasets/ann/dense" in printed
    return root


def contents(repo: Repo, revision: str = "main") -> dict[str, bytes]:
    return {path: file.content for path, file in repo.tree(revision).items() if path != ATTRIBUTES}


def pulled(folder: Path) -> dict[str, bytes]:
    return {name: content for name, content in snapshot(folder).items() if name != ATTRIBUTES}


def test_dense_dataset_comes_back_byte_by_byte_and_with_its_card(hub: Hub, ann: Client, dense: Path) -> None:
    repo = hub.repo("dataset", "ann/dense")
    assert repo.tags == {"v3.0": repo.branches["main"]}
    assert contents(repo, "v3.0") == snapshot(dense)
    folder, rows = ann.load("ann/dense")
    assert not folder.is_relative_to(dense.parent)
    assert rows == 2 * FRAMES
    assert pulled(folder) == snapshot(dense)
    assert {"README.md", keys.INSTRUCTIONS_FILE} <= set(pulled(folder))


def test_dataset_is_keyframed_by_its_name_and_pushed(hub: Hub, ann: Client, dense: Path, tmp_path: Path) -> None:
    names = ["--dataset.repo_id=ann/dense", "--output.repo_id=ann/keys", f"--output.root={tmp_path / 'keys'}"]
    printed = ann.histmv("keyframe", *names, "--output.push_to_hub=true", "--output.license=cc-by-4.0")
    assert "/datasets/ann/keys" in printed
    folder, rows = ann.load("ann/keys")
    assert rows == 6
    assert pulled(folder) == snapshot(tmp_path / "keys") == contents(hub.repo("dataset", "ann/keys"), "v3.0")
    assert {"README.md", keys.INSTRUCTIONS_FILE, keys.KEYFRAMING_FILE} <= set(pulled(folder))
    card = (folder / "README.md").read_text()
    assert "license: cc-by-4.0" in card
    assert "`ga`" in card


def test_a_smaller_dataset_leaves_nothing_of_the_larger_one(hub: Hub, ann: Client, tmp_path: Path) -> None:
    root = write_vector_picks(tmp_path / "small", count=1)
    ann.histmv("push", f"--root={root}", "--repo_id=ann/shrinks")
    repo = hub.repo("dataset", "ann/shrinks")
    more = {"data/chunk-000/file-001.parquet": File(b"of a larger one", True), "notes.txt": File(b"by hand", False)}
    repo.add("main", repo.tree("main") | more)
    ann.histmv("push", f"--root={root}", "--repo_id=ann/shrinks")
    assert contents(repo, "v3.0") == snapshot(root) | {"notes.txt": b"by hand"}


def test_broken_upload_shows_nothing_and_is_continued(hub: Hub, ann: Client, tmp_path: Path) -> None:
    root = write_vector_picks(tmp_path / "data", count=1)
    push = ["push", f"--root={root}", "--repo_id=ann/breaks"]
    before = len(hub.begun)
    hub.fault = Fault(first=before + 1, after=100)
    assert "no connection to http" in (said := ann.fails(*push))
    assert "ann/breaks" in said
    repo = hub.repo("dataset", "ann/breaks")
    assert contents(repo) == {}
    assert repo.tags == {}
    unfinished = ann.fails(
        "keyframe", "--dataset.repo_id=ann/breaks", f"--output.root={tmp_path}/k", "--output.repo_id=a/b"
    )
    assert "its upload is not finished" in unfinished
    arrived = set(hub.begun[before:]) & set(repo.stored)
    assert len(arrived) == 1
    hub.fault, repeated = None, len(hub.begun)
    ann.histmv(*push)
    assert contents(repo, "v3.0") == snapshot(root)
    assert len(hub.begun[repeated:]) == 2
    assert not arrived & set(hub.begun[repeated:])


def test_broken_update_leaves_the_old_version_to_readers(hub: Hub, ann: Client, tmp_path: Path) -> None:
    old, new = (write_vector_picks(tmp_path / str(count), count) for count in (2, 3))
    ann.histmv("push", f"--root={old}", "--repo_id=ann/grows")
    repo = hub.repo("dataset", "ann/grows")
    hub.fault = Fault(first=len(hub.begun) + 1)
    ann.fails("push", f"--root={new}", "--repo_id=ann/grows")
    hub.fault = None
    assert contents(repo, "v3.0") == contents(repo) == snapshot(old)
    ann.histmv("push", f"--root={new}", "--repo_id=ann/grows")
    assert contents(repo, "v3.0") == contents(repo) == snapshot(new)


def test_checkpoint_comes_back_byte_by_byte_and_with_its_card(hub: Hub, ann: Client, tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path / "policy")
    printed = ann.histmv("push", f"--root={folder}", "--repo_id=ann/policy", "--license=mit")
    assert "lerobot-eval --policy.path=ann/policy" in printed
    assert contents(hub.repo("model", "ann/policy")) == snapshot(folder)
    assert pulled(Path(ann.call("helpers.hub_client:checkpoint", "ann/policy"))) == snapshot(folder)
    assert "license: mit" in (folder / "README.md").read_text()


def test_private_dataset_is_shown_to_its_owner_alone(hub: Hub, ann: Client, nobody: Client, tmp_path: Path) -> None:
    root = write_vector_picks(tmp_path / "data", count=1)
    ann.histmv("push", f"--root={root}", "--repo_id=ann/secret", "--private=true")
    assert hub.repo("dataset", "ann/secret").private
    assert ann.load("ann/secret")[1] > 0
    hidden = nobody.fails("keyframe", "--dataset.repo_id=ann/secret", "--output.repo_id=local/keys")
    assert f"{hub.url} shows no ann/secret: it does not exist, or it is private" in hidden
    assert "there is no access token; log in with `hf auth login` or set HF_TOKEN" in hidden
    model = nobody.fails("eval", "--policy.path=ann/hidden", "--env.type=ur5", "--env.task=reach_target")
    assert "shows no ann/hidden" in model


def test_uploads_that_the_hub_would_not_take_are_refused_before_work(
    hub: Hub, ann: Client, nobody: Client, dense: Path, tmp_path: Path
) -> None:
    known = set(hub.repos)
    said = nobody.fails("push", f"--root={dense}", "--repo_id=ann/other")
    assert "there is no access token for ann/other" in said
    assert "hf auth login" in said
    assert "namespace" in ann.fails("push", f"--root={dense}", "--repo_id=ben/dense")
    assert "is public" in ann.fails("push", f"--root={dense}", "--repo_id=ann/dense", "--private=true")
    assert "user/name" in ann.fails("push", f"--root={dense}", "--repo_id=dense")
    output = ["--output.repo_id=ben/keys", f"--output.root={tmp_path / 'keys'}", "--output.push_to_hub=true"]
    assert "ben/keys" in ann.fails("keyframe", "--dataset.repo_id=ann/dense", *output)
    assert not (tmp_path / "keys").exists()
    odd = write_vector_picks(tmp_path / "odd", count=1)
    assert "Invalid metadata" in ann.fails("push", f"--root={odd}", "--repo_id=ann/odd", "--license=My Own")
    assert set(hub.repos) - known == {("dataset", "ann/odd")}
    assert contents(hub.repo("dataset", "ann/odd")) == {}


def test_offline_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    from dataset_tools import cli

    with pytest.raises(SystemExit):
        cli.main(["keyframe", "--dataset.repo_id=ann/far", "--output.repo_id=local/keys"])
    assert "ann/far is not on this machine, and HF_HUB_OFFLINE is set" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "message"),
    [("/elsewhere", "is HF_ENDPOINT right?"), ("", "check the network and HF_ENDPOINT")],
)
def test_wrong_address_is_told(hub: Hub, tmp_path: Path, path: str, message: str) -> None:
    with serve() as gone:
        url = f"{hub.url}{path}" if path else gone.url
    command = [
        sys.executable,
        "-c",
        "from dataset_tools.hub import repositories; repositories.prepare('ann/dense', private=False)",
    ]
    variables = environment(url, tmp_path, "token-of-ann")
    result = subprocess.run(command, env=variables, capture_output=True, text=True)
    said = result.stderr.splitlines()[-1]
    assert said.startswith("ValueError: ")
    assert url in said
    assert "ann/dense" in said
    assert message in said
