"""``HistMVPolicy.forward``: a finite loss that teaches every weight, counts every row once and falls."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_policy import CAMERAS, TASK, episode, stack, tiny_config, tiny_policy, window
from tiny_scene import tiny_network

from lerobot_histmv import keys
from lerobot_histmv.model.augment import AugmentConfig
from lerobot_histmv.model.config import LossConfig, SemanticsConfig, ViewConfig
from lerobot_histmv.model.losses import term_weights


def training_batch() -> dict[str, Any]:
    """A late window, a whole one and one of an episode of a single row."""
    return stack([window(episode(5), 4), window(episode(5), 1), window(episode(1), 0)])


@pytest.mark.parametrize("choice", ["ranked", "expected", "argmax", "sampled"])
def test_loss_is_finite_and_every_trained_weight_gets_a_gradient(choice: str) -> None:
    policy = tiny_policy(tiny_config(network=tiny_network(views=ViewConfig(decode="one", train_choice=choice)))).train()
    loss, log = policy(training_batch())
    loss.backward()
    assert loss.shape == ()
    assert loss.isfinite()
    assert all(math.isfinite(value) for value in log.values())
    for name, parameter in policy.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
    (group,) = policy.get_optim_params()
    assert sum(p.requires_grad for p in policy.parameters()) == len(group["params"])


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("decode", ["all", "one"])
def test_log_names_every_term_view_and_the_error_in_millimetres(training: bool, decode: str) -> None:
    policy = tiny_policy(tiny_config(network=tiny_network(views=ViewConfig(decode=decode)))).train(training)
    loss, log = policy(training_batch())
    weights = term_weights(policy.config.loss)
    if not training:
        del weights["paraphrase"]
    if not training or decode == "all":
        del weights["choice"]
    assert set(log) == {*weights, "position_mm", *(f"view_{camera}" for camera in CAMERAS)}
    assert math.isclose(sum(weights[name] * log[name] for name in weights), loss.item(), rel_tol=1e-5)
    assert math.isclose(sum(log[f"view_{camera}"] for camera in CAMERAS), 1, rel_tol=1e-5)
    assert 0 < log["position_mm"] < 2000


@pytest.mark.parametrize("form", ["nmi", "text", "literal"])
@pytest.mark.parametrize("gripper", ["bce", "mse"])
def test_every_form_of_the_loss_trains(form: str, gripper: str) -> None:
    network = tiny_network(views=ViewConfig(mi_loss=form))
    policy = tiny_policy(tiny_config(network=network, loss=LossConfig(gripper=gripper, heatmap=0.0))).train()
    loss, log = policy(training_batch())
    loss.backward()
    assert loss.isfinite()
    assert "heatmap" not in log
    assert (log["mutual_information"] <= 0) == (form == "literal")


def test_loss_falls_on_a_handful_of_windows() -> None:
    policy, batch = tiny_policy().train(), window(episode(5), 4)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    for _ in range(20):
        optimizer.zero_grad()
        loss, _ = policy(batch)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert min(losses[-3:]) < 0.6 * losses[0]


def test_strong_augmentation_stays_finite_and_evaluation_is_free_of_it() -> None:
    strong = AugmentConfig(yaw=1.0, shift=0.2, pixels=8, brightness=0.3, contrast=0.3, depth_noise=0.02)
    policy, batch = tiny_policy(tiny_config(augment=strong)), training_batch()
    first, second = policy(batch)[0], policy(batch)[0]
    assert first.equal(second)
    torch.testing.assert_close(first, tiny_policy()(batch)[0])
    loss, _ = policy.train()(batch)
    loss.backward()
    assert loss.isfinite()


def test_batch_given_is_not_changed_by_augmentation() -> None:
    batch = training_batch()
    kept = {key: values.clone() for key, values in batch.items() if isinstance(values, torch.Tensor)}
    tiny_policy(tiny_config(augment=AugmentConfig())).train()(batch)
    assert all(batch[key].equal(values) for key, values in kept.items())


def test_contents_of_padding_do_not_matter() -> None:
    policy, batch = tiny_policy(), training_batch()
    expected, _ = policy(batch)
    for key, values in batch.items():
        if isinstance(values, torch.Tensor) and values.is_floating_point():
            values[batch[f"{key}_is_pad"]] = 0.123
    torch.testing.assert_close(policy(batch)[0], expected)


def test_loss_per_drawn_row_averages_to_the_loss() -> None:
    """However many rows a draw teaches."""
    policy, rows = tiny_policy(), episode(7)
    batch = stack([window(rows, end) for end in (0, 3, 6)])
    mean, _ = policy(batch)
    each, _ = policy(batch, reduction="none")
    assert each.shape == (3,)
    torch.testing.assert_close(each.mean(), mean)
    torch.testing.assert_close(each[1], policy(window(rows, 3))[0])
    torch.testing.assert_close(each[2], policy(window(rows, 6))[0])


def test_episodes_of_one_row_train() -> None:
    policy = tiny_policy().train()
    loss, _ = policy(window(episode(1), 0))
    loss.backward()
    assert loss.isfinite()


def dataset_meta(root: Path) -> Any:
    """The part of LeRobot's metadata that the policy reads."""
    return SimpleNamespace(root=root, tasks=SimpleNamespace(index=[TASK]))


def test_loss_of_an_episode_that_fits_into_a_window_does_not_depend_on_the_drawn_row() -> None:
    policy, rows = tiny_policy(tiny_config(past_steps=3)), episode(3)
    expected, _ = policy(window(rows, 2, past_steps=3))
    for drawn in (0, 1):
        torch.testing.assert_close(policy(window(rows, drawn, past_steps=3))[0], expected)


def test_a_late_draw_teaches_its_row_and_those_after_it() -> None:
    """Targets of rows whose history the draw cuts off change nothing."""
    policy, rows, other = tiny_policy(), episode(9), episode(9)
    expected, _ = policy(window(rows, 4))
    other[keys.ACTION][[2, 3, 7, 8]] += 0.1
    torch.testing.assert_close(policy(window(other, 4))[0], expected)
    for row in (4, 5, 6):
        other = episode(9)
        other[keys.ACTION][row] += 0.1
        assert policy(window(other, 4))[0] != expected


def test_training_draws_among_paraphrases_and_evaluation_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    options = [TASK, "grasp the red cube and raise it", "lift the red cube"]
    policy = tiny_policy(tiny_config(instructions={TASK: options}))
    heard: list[str] = []
    encode = policy.net.semantics.text
    monkeypatch.setattr(policy.net.semantics, "text", lambda s, device: heard.extend(s) or encode(s, device))
    policy(training_batch())
    assert set(heard) == {TASK}
    for _ in range(7):
        policy.train()(training_batch())
    assert set(heard) == set(options)


def test_paraphrases_come_from_the_dataset(tmp_path: Path) -> None:
    path = tmp_path / keys.INSTRUCTIONS_FILE
    path.parent.mkdir()
    path.write_text('{"pick up the red cube": ["lift the red cube"]}')
    config = tiny_config(instructions={})
    tiny_policy(config, dataset_meta=dataset_meta(tmp_path))
    assert config.instructions == {TASK: [TASK, "lift the red cube"]}


def test_paraphrases_of_the_configuration_survive_a_dataset_without_any(tmp_path: Path) -> None:
    config = tiny_config(instructions={TASK: [TASK, "lift the red cube"]})
    tiny_policy(config, dataset_meta=dataset_meta(tmp_path))
    assert config.instructions == {TASK: [TASK, "lift the red cube"]}


def test_mixed_precision_trains() -> None:
    policy = tiny_policy().train()
    with torch.autocast("cpu", torch.bfloat16):
        loss, log = policy(training_batch())
    loss.backward()
    assert loss.isfinite()
    assert all(math.isfinite(value) for value in log.values())


def test_no_weight_is_idle_beside_the_sentence_encoder() -> None:
    pytest.importorskip("transformers", reason="the sentence encoder is optional: transformers is not installed")
    network = tiny_network(semantics=SemanticsConfig(text="minilm"))
    policy = tiny_policy(tiny_config(network=network)).train()
    policy(training_batch())[0].backward()
    assert [name for name, p in policy.named_parameters() if p.requires_grad and p.grad is None] == []


def test_policy_without_recorded_wordings_trains() -> None:
    loss, log = tiny_policy(tiny_config(instructions={})).train()(training_batch())
    assert loss.isfinite()
    assert "paraphrase" not in log


@pytest.mark.parametrize("choice", ["ranked", "sampled"])
def test_views_are_judged_by_their_actions_not_by_heat_maps_that_a_blind_view_lacks(choice: str) -> None:
    network = tiny_network(views=ViewConfig(decode="one", train_choice=choice))
    terms = []
    for heatmap in (0.0, 7.0):
        policy = tiny_policy(tiny_config(network=network, loss=LossConfig(heatmap=heatmap))).train()
        torch.manual_seed(1)
        terms.append(policy(training_batch())[1])
    assert terms[0]["choice"] == terms[1]["choice"]
    assert terms[0]["position"] == terms[1]["position"]
