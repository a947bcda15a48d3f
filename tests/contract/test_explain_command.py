"""``histmv explain`` from its command line on: a page with all pictures, or a refusal in words."""

import base64
import io
import re
from pathlib import Path

import av
import numpy as np
import pytest
from fake_ur5 import INSTRUCTION, FakeUR5Config, write_checkpoint
from helpers import episodes
from lerobot.policies.act.configuration_act import ACTConfig
from PIL import Image
from tiny_dataset import write_dataset
from tiny_policy import episode, observation, tiny_config
from tiny_scene import tiny_network

from dataset_tools.cli import main
from dataset_tools.eval_checkpoint import PolicySource, load_config
from dataset_tools.explain.chapter import PANELS
from dataset_tools.explain.command import PAGE, ExplainConfig, ExplainedDataset, run
from dataset_tools.explain.sources import explain_dataset, open_keyframes
from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.control import ControlConfig
from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

LENGTHS = (3, 5)
REPO = "local/tiny"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("run") / "pretrained_model")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny", REPO, LENGTHS, INSTRUCTION)


def assert_page(folder: Path, decisions: int) -> str:
    """Pictures and film are there, and the page holds all of them; returns its text."""
    names = {"decisions.png", "film.mp4", PAGE} | {f"episode_{panel.name}.png" for panel in PANELS}
    assert {path.name for path in folder.iterdir()} == names
    text = (folder / PAGE).read_text()
    embedded = re.findall(r'src="data:(\w+/\w+);base64,([^"]*)"', text)
    assert [kind for kind, _ in embedded] == ["video/mp4"] + ["image/png"] * (len(PANELS) + 1)
    assert base64.b64decode(embedded[0][1]) == (folder / "film.mp4").read_bytes()
    for _, data in embedded[1:]:
        assert Image.open(io.BytesIO(base64.b64decode(data, validate=True))).width > 400
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    assert text.count("<tr>") == decisions + 1
    with av.open(str(folder / "film.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) >= 20 * decisions
    return text


@pytest.mark.parametrize("options", [[], ["--policy.control.rate=20"]], ids=["macro steps", "held"])
def test_an_episode_of_a_dataset_is_explained(
    options: list[str], checkpoint: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    flags = [
        f"--policy.path={checkpoint}",
        f"--dataset.repo_id={REPO}",
        f"--dataset.root={dataset}",
        "--episode=1",
        *options,
    ]
    main(["explain", *flags, f"--output={output}"])
    text = assert_page(output, LENGTHS[1])
    assert f"Episode 1: “{INSTRUCTION}”" in text
    assert "distance to the true pose" in text
    assert str(output / PAGE) in capsys.readouterr().out.replace("\n", "")
    with pytest.raises(SystemExit):
        main(["explain", *flags, f"--output={output}"])
    assert "--overwrite=true" in capsys.readouterr().err


def test_a_rollout_is_explained(checkpoint: Path, tmp_path: Path) -> None:
    run(ExplainConfig(policy=PolicySource(str(checkpoint)), env=FakeUR5Config(), seed=200_001, output=tmp_path / "out"))
    text = (tmp_path / "out" / PAGE).read_text()
    assert "Scene 200001" in text
    assert re.search(r"success|failed: ", text)
    assert_page(tmp_path / "out", text.count("<tr>") - 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "explain needs one source"),
        ({"env": FakeUR5Config(), "dataset": ExplainedDataset(REPO)}, "explain needs one source"),
    ],
)
def test_exactly_one_source_is_needed(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExplainConfig(**options)  # type: ignore[arg-type]


def test_what_cannot_be_explained_is_refused_in_words(checkpoint: Path, tmp_path: Path) -> None:
    policy, output = PolicySource(str(checkpoint)), tmp_path / "out"
    dense = ExplainedDataset("test/dense", episodes.write_picks(tmp_path / "dense", 1))
    with pytest.raises(ValueError, match="histmv keyframe"):
        run(ExplainConfig(policy=policy, dataset=dense, output=output))
    with pytest.raises(ValueError, match="2 tasks; name one of them"):
        run(ExplainConfig(policy=policy, env=FakeUR5Config("a,b"), output=output))
    assert not output.exists()


@pytest.mark.parametrize("rate", [0, 20])
def test_errors_are_those_to_the_datasets_own_actions_at_every_row(
    rate: int, checkpoint: Path, dataset: Path, tmp_path: Path
) -> None:
    """A policy that holds its decisions over ticks of a loop decides at every row all the same."""
    config = load_config(PolicySource(str(checkpoint)))
    assert isinstance(config, HistMVConfig)
    config.control = ControlConfig(rate=rate)
    told = explain_dataset(config, open_keyframes(config, REPO, dataset, 1, None), tmp_path / "film.mp4")
    true = episode(LENGTHS[1], seed=1)[keys.ACTION].numpy()
    assert told.truth is not None
    np.testing.assert_allclose(told.truth, true, atol=1e-6)
    policy, rows = HistMVPolicy.from_pretrained(checkpoint), episode(LENGTHS[1], seed=1)
    for image in map(keys.rgb_key, policy.config.cameras):
        rows[image] = (255 * rows[image]).round() / 255
    acted = [policy.select_action(observation(rows, step, INSTRUCTION))[0].numpy() for step in range(LENGTHS[1])]
    off = np.linalg.norm(np.stack(acted)[:, :3] - true[:, :3], axis=1)
    np.testing.assert_allclose(told.errors, off, atol=1e-4)


def test_policies_that_weigh_no_views_are_refused(dataset: Path, tmp_path: Path) -> None:
    tiny_config(network=tiny_network(views=ViewConfig(fusion="mean"))).save_pretrained(tmp_path / "mean")
    ACTConfig(device="cpu").save_pretrained(tmp_path / "act")
    for name in ("mean", "act"):
        (tmp_path / name / "model.safetensors").touch()
    told = ExplainedDataset(REPO, dataset)
    with pytest.raises(ValueError, match=r"mean has views.fusion='mean'; .* which only views.fusion='attention' does"):
        run(ExplainConfig(policy=PolicySource(str(tmp_path / "mean")), dataset=told, output=tmp_path / "out"))
    with pytest.raises(ValueError, match=r"act is a policy of type act; explain looks inside histmv ones"):
        run(ExplainConfig(policy=PolicySource(str(tmp_path / "act")), dataset=told, output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
